"""One hypothesis of pose and map: gains, errors, landmarks and history."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field

import numpy as np

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Change, Outcomes, Smoothed, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.flat_arrays import Advanced, Interval, Observed, Seen
from slam_observer_ros.filter.gains import Errors, Gains
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import correlations_of
from slam_observer_ros.models.held_velocities import Velocities
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.relinearisation import NoPast, Relinearisation
from slam_observer_ros.tracking import covariances

OLD_NEWS = 10.0
"""By what factor covariances of views have grown, while a robot stands, that are not kept."""


class State:
    """Pose and map as of one instant; :mod:`.step` changes them."""

    def __init__(self, gains: Gains, settings: Settings) -> None:
        self.settings = settings  # those in force
        self.judges_innovations = False  # which takes time, and is for those who look at them
        self.is_mapping = True  # landmarks are added, and relocated if rejected too often
        self.gains, self.errors = gains, gains.errors  # they move X̂, and know its errors or not
        self.observer, self.axes = gains.observer, gains.axes
        self.calibration, self.motion_noise = gains.calibration, gains.motion_noise
        self.landmarks = self.observer.landmarks
        # How fast landmarks may move, m/s, where it is estimated; else 0, as sensors give it.
        is_ignored = 'landmark_velocity_stddev' in gains.ignores
        self.landmark_velocity_stddev = 0.0 if is_ignored else settings.landmark_velocity_stddev
        self.relinearisation: NoPast | Relinearisation = NoPast()
        if self.errors is not None and not self.landmark_velocity_stddev:
            self.relinearisation = Relinearisation(self.errors, self.calibration, settings)
        self.counts = Outcomes()  # landmarks rejected, moved, forgotten and so on
        self.rejected_in_a_row = 0  # observations in which all known landmarks were rejected
        self.was_contradicted = False  # most known landmarks seen last were rejected
        self.observation_noise = ObservationNoise(settings)
        # Around the state's stamp, as the last motion had it; the next one begins with the same.
        self.end_velocity: FloatArray | None = None

    def copy(self) -> State:
        """Return an independent copy: one copy of memory an array."""
        other = copy(self)
        other.gains = gains = self.gains.copy()
        other.observer, other.errors = gains.observer, gains.errors
        other.calibration, other.motion_noise = gains.calibration, gains.motion_noise
        other.landmarks, other.counts = gains.observer.landmarks, self.counts.copy()
        other.relinearisation = self.relinearisation.copy(other)
        return other

    @property
    def known_errors(self) -> Errors:
        """The errors, for association, which only gains that know them have."""
        if self.errors is None:
            raise TypeError('these gains know no joint covariance')
        return self.errors

    @property
    def confirmed(self) -> IntArray:
        """Rows of the landmarks seen often enough to be in the map.

        One seen once or twice may still be an outlier, and one without an id a false point for
        longer; it helps to estimate the pose, but is not published.
        """
        often = self.landmarks.counts >= self.settings.confirmations
        return np.flatnonzero(often & ~self.landmarks.tentative)

    def landmark_covariances(self, duration_s: float = 0.0) -> FloatArray | None:
        """Return those (n, 3, 3) of landmarks after ``duration_s``, world, m²; or None."""
        if self.errors is None:
            return None
        return covariances.of_landmarks(
            self.observer, self.errors.landmark_covariances(duration_s)
        )

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of landmarks as seen from the robot, m².

        None in an exact map, or where gains know none.
        """
        if (P := self.gains.joint_covariance(rows)) is None:
            return None
        return covariances.of_configuration(self.observer, self.axes, rows, P)

    def poses_until(
        self, velocities: Sequence[Velocities], start_ns: int, stamps_ns: Sequence[int]
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the poses (s, 4, 4) at stamps, body to world, and their covariances (s, 6, 6).

        Each along other velocities since the state's stamp ``start_ns``. Covariances are of
        rotation vectors and positions, along the world's axes, rad² and m²; None if unknown.
        """
        intervals = [self._interval(start_ns, stamp_ns) for stamp_ns in stamps_ns]
        A, of_errors = self.gains.led_to(velocities, intervals)
        poses = self.observer.reference_pose @ A
        if self.errors is None:
            return poses, None
        return poses, covariances.of_pose(self.observer, of_errors, A)

    def effect(
        self, A: FloatArray, velocities: Velocities, start_ns: int, end_ns: int
    ) -> Advanced:
        """Return the effect of a motion between two stamps from Â = ``A`` (4, 4), not made."""
        interval = self._interval(start_ns, end_ns)._replace(at_start=None)
        return self.gains.effect(A, velocities, interval)

    def _interval(self, start_ns: int, end_ns: int) -> Interval:
        calibration = self.calibration
        delays_ns = calibration.delay_ns, calibration.delay_error_ns
        return Interval(start_ns, end_ns, *delays_ns, self.end_velocity)

    def advance(self, velocities: Velocities, start_ns: int, end_ns: int) -> FloatArray:
        """Move on between two stamps (27); return the variances (6,) of the motion by axis."""
        before, calibration = self.observer.A.copy(), self.calibration
        delays_ns = calibration.delay_ns, calibration.delay_error_ns
        interval = Interval(start_ns, end_ns, *delays_ns, self.end_velocity)
        motion = self.gains.advance(velocities, interval)
        self.relinearisation.move(before, motion, interval)
        if calibration.delay_error_ns:
            self.end_velocity = motion.at_end
        return motion.variances

    def learn_at_rest(self, rate: FloatArray, variances: FloatArray) -> None:
        """Learn the bias of a gyroscope of which a mean ``rate`` (3,) is of rest, rad/s."""
        r, H = self.calibration.at_rest(rate)
        if not H.any():
            return
        R, before = np.diag(variances[-len(r) :]), self.observer.A.copy()
        self.relinearisation.know_calibration(r, H, R)
        self.gains.know_calibration(r, H, R)
        self.relinearisation.note_correction(before, self.observer.A)

    def slip(self, after: FloatArray, covariance: FloatArray) -> None:
        """Let the robot be at Â = ``after`` (4, 4), by a motion that odometry has not seen.

        Its ``covariance`` (6, 6) is in the body frame there, rad² and m².
        """
        before = self.observer.A.copy()
        self.relinearisation.slip(before, self.gains.slip(after, covariance))

    def set_pose(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Move the robot to ``pose`` (4, 4), body to world, uncorrelated with the map from now on.

        ``covariance`` (6, 6) is as of :meth:`poses_until`; None for an exact pose.
        """
        observer = self.observer
        if not len(self.landmarks):
            # Else ε would turn about an origin that may be kilometres away.
            observer.set_reference_pose(pose)
        A = se3.inverse(observer.reference_pose) @ pose
        observer.set_pose(A)
        given = np.zeros((6, 6)) if covariance is None else covariance
        self.gains.set_pose(A, covariances.of_pose_error(observer, given))
        self.was_contradicted = False
        self.forget_past('the pose was set')

    def clear_time(self) -> None:
        """Go on from here at any other time; what was seen before is not relinearised."""
        self.end_velocity = None
        self.was_contradicted = False
        self.landmarks.clear_time()
        self.forget_past('the clock jumped')

    def forget_past(self, since: str) -> None:
        """Relinearise nothing of what was seen until now; ``since`` says what has happened."""
        self.relinearisation.reset(since)

    def calibrate(self, of: str | int) -> None:
        """Begin to calibrate another frame's sensor, or ranges from a landmark, by its id."""
        self.gains.calibrate(of)
        self.relinearisation.add_calibration()

    def calibrate_ranges(self, ids: IntArray) -> None:
        """Begin to calibrate ranges from landmarks (m,), where that is new; −1 is none."""
        if self.calibration.range_bias_m:
            for landmark_id in self.calibration.new_anchors(ids):
                self.calibrate(landmark_id)

    def relocate(
        self, rows: IntArray, points: FloatArray, covariances: FloatArray, D: FloatArray | None
    ) -> None:
        """Take landmarks (m,) for new ones: :meth:`.Gains.relocate`."""
        self.gains.relocate(rows, points, covariances, D)
        self.relinearisation.relocate(rows)

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``; those behind move up."""
        self.relinearisation.remove(rows)
        self.gains.remove(rows)

    def merge(self, rows: IntArray, copies: IntArray, most: float) -> float:
        """Take landmarks ``copies`` (m,) for ``rows`` (m,) if they fit: :meth:`.Gains.merge`."""
        ids = self.landmarks.ids[copies]  # which go
        square = self.gains.merge(rows, copies, most)
        if square <= most:
            self.relinearisation.merge(rows, copies)
            self.counts.note(Change.MERGED, ids, int(self.landmarks.last_seen_ns.max()))
        return square

    def forget(self, rows: IntArray, why: Change, stamp_ns: int) -> None:
        """Remove landmarks, if there are any at ``rows``, and count them."""
        if len(rows):
            self.counts.note(why, self.landmarks.ids[rows], stamp_ns)
            self.remove(rows)

    def fix_landmarks(self, known: KnownLandmarks) -> None:
        """Take all landmarks for exact and at rest where a map has them."""
        self.gains.fix_landmarks(known)
        self.landmark_velocity_stddev = 0.0
        self.relinearisation = NoPast()  # there is no drift to undo

    def smooth(self) -> Smoothed:
        """Return the smoothed trajectory and map; see :meth:`.Relinearisation.smooth`."""
        if self.observer.is_exact:
            raise ParameterError("there is nothing to smooth with 'localization_mode: fixed'")
        if self.landmark_velocity_stddev:
            raise ParameterError(
                "smoothing takes landmarks to rest: 'landmark_velocity_stddev' must be 0"
            )
        # From the reference frame to the world.
        (step, slips, history), rows = self.relinearisation.smooth(), self.confirmed
        found, calibration = step.end, self.calibration
        entries = slice(self.axes.p, self.axes.p + calibration.count)
        covariance = step.factors.marginal()[entries, entries]
        values = calibration.shifted(found.calibrations[-1] - calibration.values)
        P = self.observer.reference_pose
        return Smoothed(
            stamps_ns=np.array(history.stamps_ns, dtype=np.int64),
            poses=P @ found.poses[1:],
            world_points=se3.transform(P, found.points[rows]),
            ids=self.landmarks.ids[rows],
            since=history.since,
            slips=slips,
            orientations=P[:3, :3] @ found.orientations[rows],
            calibration=calibration.estimates(np.diagonal(covariance), values),
            calibration_correlations=correlations_of(covariance),
        )


@dataclass(slots=True, eq=False)
class Association:
    """Which landmarks of a ``state`` the points (m,) of an observation are of, and what it did.

    If it ``may_refuse``, it ``is_refused`` where most points of known landmarks are rejected:
    nothing has changed then, and there is no ``update``.
    """

    state: State
    event: ObservationEvent
    rows: IntArray  # (m,) −1 for new landmarks
    may_refuse: bool = False
    is_refused: bool = False
    known: BoolArray = field(init=False)  # (m,) points of landmarks that were known before
    seen: Seen = field(init=False)  # what the filter was given …
    out: Observed = field(init=False)  # … and its answer
    rejected: BoolArray = field(init=False)  # (m,)
    in_map: ObservationEvent = field(init=False)  # points whose landmarks are in the map by now …
    at: IntArray = field(init=False)  # … and the rows of these
    in_doubt: BoolArray = field(init=False)  # whether these were rejected too often
    update: Update = field(init=False)
