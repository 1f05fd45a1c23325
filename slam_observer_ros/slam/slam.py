"""The observer with its gains, its noise and its landmark table: one state that moves on."""

from __future__ import annotations

from collections import Counter

import numpy as np

from slam_observer_ros.estimates import Smoothed
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.gains import make_gains
from slam_observer_ros.gains.base import Residuals
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.motion.integration import integrate
from slam_observer_ros.motion.motion import Motion
from slam_observer_ros.motion.noise import MotionNoise
from slam_observer_ros.motion.velocity_history import VelocityHistory
from slam_observer_ros.observation_noise import ObservationNoise
from slam_observer_ros.observer import Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.slam import covariances
from slam_observer_ros.slam.landmark_index import LandmarkIndex
from slam_observer_ros.slam.landmark_table import LandmarkTable
from slam_observer_ros.slam.measurement import MatchedObservation, MeasurementModel
from slam_observer_ros.slam.outcome import is_contradiction, Outcome
from slam_observer_ros.slam.surroundings import Surroundings
from slam_observer_ros.types import BoolArray, FloatArray, IntArray


class Slam:
    """Pose and map as of one instant, with the life cycle of the landmarks.

    Parameters
    ----------
    settings : Settings
        All settings.
    initial_pose : FloatArray
        (4, 4) pose at the start, body to world; also the reference P°.

    Attributes
    ----------
    observer : Observer
        State X̂ and reference ξ°.
    axes : Axes
        What of the pose and of points is estimated.
    gains : GainDesign
        What turns residuals into corrections.
    landmarks : LandmarkTable
        Ids and counts of the n known landmarks.
    is_mapping : bool
        Whether landmarks are added, and taken to have moved if they are rejected too often.
    motion_noise : MotionNoise
        Noise of velocities.
    observation_noise : ObservationNoise
        Noise of observed points.
    measurement_model : MeasurementModel
        Where landmarks should be seen.
    index : LandmarkIndex
        For landmarks near a point.
    counts : Counter
        How many landmarks were rejected, have moved, were forgotten and so on.
    rejected_in_a_row : int
        Observations since the last one of which a known landmark was not rejected.
    was_contradicted : bool
        Whether of the latest observation of known landmarks most were rejected.

    """

    def __init__(self, settings: Settings, initial_pose: FloatArray) -> None:
        self.settings = settings
        self.observer = Observer(initial_pose)
        self.axes = axes_of(settings.two_d_mode)
        self.gains = make_gains(settings)
        self.landmarks = LandmarkTable()
        self.is_mapping = True
        self.counts: Counter[str] = Counter()
        self.rejected_in_a_row = 0
        self.was_contradicted = False
        self.motion_noise = MotionNoise(settings)
        self.observation_noise = ObservationNoise(settings)
        self.measurement_model = MeasurementModel(
            self.observer, self.landmarks, self.observation_noise, settings
        )
        # Around the state's stamp, as the last motion had it; the next one begins with the same.
        self._end_velocity: FloatArray | None = None
        self.index = LandmarkIndex()
        self._surroundings = Surroundings(self.observer, self.landmarks, self.axes.point)

    @property
    def is_fixed(self) -> bool:
        """Whether the landmarks are those of a map that is exact, and at rest."""
        return not self.is_mapping and self.settings.localization_mode == 'fixed'

    @property
    def confirmed(self) -> IntArray:
        """Rows of the landmarks seen often enough to be in the map.

        One that was seen once or twice may still be an outlier, and one without an id may be a
        false point for longer; it helps to tell the pose, but nobody is told of it.
        """
        often = self.landmarks.counts >= self.settings.confirmations
        return np.flatnonzero(often & ~self.landmarks.tentative)

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        observer = self.observer
        shifts = se3.rotate(observer.reference_pose, self.gains.postponed_shifts())
        return observer.world_points + shifts

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks, world, m²; None where the gains know none."""
        return covariances.of_landmarks(self.observer, self.gains.landmark_error_covariances)

    def landmark_covariances_after(self, duration_s: float) -> FloatArray | None:
        """Return the same as they will be when landmarks that move have moved on."""
        after = self.gains.landmark_error_covariances_after(self.observer, duration_s)
        return covariances.of_landmarks(self.observer, after)

    def pose_after(
        self, velocities: VelocityHistory, start_ns: int, end_ns: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return what the pose will be at ``end_ns``, and how uncertain it will be.

        Returns
        -------
        pose : FloatArray
            (4, 4) body to world.
        covariance : FloatArray or None
            (6, 6) of its rotation vector and position, along the world's axes, rad² and m². None
            where the gains know none.

        """
        moved = self._motion(velocities, start_ns, end_ns)
        after = self.gains.pose_error_covariance_after(moved)
        A = moved.path[-1]
        return self.observer.reference_pose @ A, covariances.of_pose(self.observer, after, A)

    def set_pose(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Move the robot and keep the map; what they have to do with each other is forgotten.

        Parameters
        ----------
        pose : FloatArray
            (4, 4) body to world.
        covariance : FloatArray or None
            (6, 6) as :meth:`pose_after` has it; None for an exact pose.

        """
        observer = self.observer
        if not len(self.landmarks):
            # Else ε would turn about an origin that may be kilometres away.
            observer.reference_pose = pose
        observer.A = se3.inverse(observer.reference_pose) @ pose
        self.was_contradicted = False
        given = np.zeros((6, 6)) if covariance is None else covariance
        self.gains.set_pose_error_covariance(covariances.of_pose_error(observer, given))
        self.gains.restart(observer, 'the pose was set')

    def restart_time(self) -> None:
        """Go on from here at any other time; what was seen before can't be looked back at."""
        self._end_velocity = None
        self.was_contradicted = False
        self.landmarks.restart_time()
        self.gains.restart(self.observer, 'the clock jumped')

    def change_settings(self, settings: Settings) -> None:
        """Use other values of the settings that may change, from now on."""
        self.settings = settings
        self.gains.change_settings(settings)

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move the state, which is that of ``start_ns``, on to ``end_ns``."""
        moved = self._motion(velocities, start_ns, end_ns)
        self.observer.propagate(moved.path)
        self.observer.move_landmarks(moved.duration_s)
        self.gains.predict(self.observer, moved)
        self._end_velocity = None if moved.at_ends is None else moved.at_ends[1]

    def _motion(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> Motion:
        return integrate(
            velocities,
            self.gains.calibration,
            self.motion_noise,
            self.observer.A,
            start_ns,
            end_ns,
            self._end_velocity,
        )

    def covariances_of(self, event: ObservationEvent) -> FloatArray:
        """Return what its points would be taken to be off by: (m, 3, 3), body frame, m².

        It moves landmarks whose gains had put that off.
        """
        rows = self.landmarks.rows_of(event.ids)
        self.gains.recall(self.observer, rows)
        return self.measurement_model.covariances(event, rows)

    @property
    def landmark_velocity_error(self) -> float:
        """How fast landmarks may move, m/s, where it is estimated; else 0, as sensors tell it."""
        is_ignored = 'landmark_velocity_error' in self.gains.ignores
        return 0.0 if self.is_fixed or is_ignored else self.settings.landmark_velocity_error

    def velocities_of(self, event: ObservationEvent, A: FloatArray) -> FloatArray:
        """Return how its landmarks (m, 3) move, m/s, along the axes of the body at Â = ``A``.

        As estimated, or else as the observation says, which is made there; zero if neither is.
        """
        velocities = np.zeros_like(event.points)
        if self.is_fixed:
            return velocities
        if not self.landmark_velocity_error:
            return velocities if event.velocities is None else event.velocities
        rows = self.landmarks.rows_of(event.ids)
        velocities[rows >= 0] = self.observer.u[rows[rows >= 0]]
        return se3.rotate(se3.inverse(A), velocities)

    def match(self, event: ObservationEvent) -> MatchedObservation:
        """Match an observation made at the state's instant with landmarks, before it is used.

        It moves landmarks whose gains had put that off.
        """
        m, rows = len(event.ids), self.landmarks.rows_of(event.ids)
        if not self.is_mapping:
            event, rows = self._mapped(event)
        self.gains.recall(self.observer, rows)
        return self.measurement_model.match(event, rows, m - len(event.ids))

    def _mapped(self, event: ObservationEvent) -> tuple[ObservationEvent, IntArray]:
        """Return the part of an observation that is of known landmarks, and their rows."""
        rows = self.landmarks.rows_of(event.ids)
        return event.select(rows >= 0), rows[rows >= 0]

    def observe(self, matched: MatchedObservation) -> Outcome:
        """Use what :meth:`match` has returned for an observation; return what was made of it."""
        self.counts['unmapped_landmark'] += matched.left_out
        event, rows, known = matched.event, matched.rows, matched.known
        forgotten = self._in_the_way(matched)
        if len(forgotten):
            # A history without them would lose what they have told of the pose.
            self.gains.restart(self.observer, 'landmarks had to make room (max_landmarks)')
        rejected = self._correct(known, matched.residuals)
        if len(known.ids) < len(rows):
            is_new = rows < 0
            self._forget(forgotten, 'forgotten_landmark')
            self._initialise(event.select(is_new), matched.covariances[is_new])
            event, rows = self._mapped(event)
        moved_ids = self._look_back(event, rows)
        self._note_velocities(event, rows)
        return Outcome(known.ids, matched.residuals.r, rejected, moved_ids)

    def disbelieve(self, event: ObservationEvent) -> None:
        """Count points as rejected although the gate lets them pass.

        Landmarks that are in doubt by then are forgotten, and are new when they are seen next.
        """
        event, rows = self._mapped(event)  # one may have made room
        self.landmarks.reject(rows, *self.measurement_model.places(event))
        in_doubt = self.landmarks.in_doubt(rows, self.settings.max_rejections) & self.is_mapping
        if in_doubt.any():
            self.remove(rows[in_doubt])

    def rejected_before(self, matched: MatchedObservation) -> tuple[BoolArray, FloatArray]:
        """Return which known landmarks (m,) in it were rejected before where they are seen now.

        And how far all of them (m, 3) are from where they were rejected last, metres, reference
        frame.
        """
        rows = matched.residuals.rows
        points, tolerances_m = self.measurement_model.places(matched.known)
        again = self.landmarks.are_rejected_again(rows, points, tolerances_m)
        return again, points - self.landmarks.rejected_last[rows]

    def smooth(self) -> Smoothed:
        """Return trajectory and map in hindsight; see :meth:`.GainDesign.smooth`."""
        found, rows = self.gains.smooth(self.observer), self.confirmed
        P = self.observer.reference_pose
        return Smoothed(
            stamps_ns=found.stamps_ns,
            poses=P @ found.poses,
            world_points=se3.transform(P, found.points[rows]),
            ids=self.landmarks.ids[rows],
            since=found.since,
        )

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        self.observer.remove_landmarks(rows)
        self.gains.remove_landmarks(rows)
        self.landmarks.remove(rows)

    def note_surroundings(self, event: ObservationEvent, some_have_ids: bool) -> float:
        """Count what was in view of an observation of landmarks without an id.

        Return −2 ln of the probability that what was not seen of it was not.

        Those that were seen too seldom while they were in view are forgotten; out of view none
        is: it may be the only tie to what was mapped before. Parameters are those of
        :meth:`.Surroundings.note`.
        """
        cost, is_strange = self._surroundings.note(event, some_have_ids)
        self.counts['strange_place'] += is_strange
        unsupported = self.landmarks.unsupported(self.settings.min_support)
        self._forget(unsupported, 'unsupported_landmark')
        return cost

    def _forget(self, rows: IntArray, why: str) -> None:
        if len(rows):
            self.remove(rows)
            self.counts[why] += len(rows)

    def _correct(self, event: ObservationEvent, residuals: Residuals) -> BoolArray:
        """Correct the state by the landmarks of ``event``; return which (m,) were rejected."""
        rows = residuals.rows
        if not len(rows):
            return np.empty(0, dtype=np.bool_)
        correction, weights = self.gains.correct(residuals)
        self.observer.correct(correction)
        self.gains.settle(self.observer)
        rejected: BoolArray = weights == 0.0
        count = int(np.count_nonzero(rejected))
        self.rejected_in_a_row = self.rejected_in_a_row + 1 if count == len(rows) else 0
        self.was_contradicted = is_contradiction(rejected)
        self.landmarks.accept(rows[~rejected], event.stamp_ns)
        if count:
            places = self.measurement_model.places(event.select(rejected))
            self.landmarks.reject(rows[rejected], *places)
            self.counts['rejected_landmark'] += count
        return rejected

    def _note_velocities(self, event: ObservationEvent, rows: IntArray) -> None:
        """Let landmarks move as the sensor says; by one that says nothing they are static."""
        velocities = event.velocities
        if velocities is None and self.observer.have_moved:
            velocities = np.zeros((len(rows), 3))
        if velocities is None or self.landmark_velocity_error or self.is_fixed:
            return
        used = self.landmarks.rejections[rows] == 0
        self.observer.set_landmark_velocities(rows[used], velocities[used])

    def _look_back(self, event: ObservationEvent, rows: IntArray) -> IntArray:
        """Let the gains look back; start landmarks in doubt anew if that doesn't explain them.

        Now that the state is corrected, it is known better than before from where they were seen.
        Return the ids of those that have moved.
        """
        in_doubt = self.landmarks.in_doubt(rows, self.settings.max_rejections) & self.is_mapping
        some_are = bool(in_doubt.any())
        if self.gains.looks_back:
            seen = self.measurement_model.frame_observation(event, rows)
            self.gains.look_back(self.observer, seen, some_are)
        if some_are:
            return self._relocate(event.select(in_doubt), rows[in_doubt])
        return np.empty(0, dtype=np.int64)

    def _relocate(self, event: ObservationEvent, rows: IntArray) -> IntArray:
        """Start landmarks in doubt anew that are still far from where they were expected.

        Return the ids of those that were seen often enough to say that they have moved.
        """
        noise = self.observation_noise.covariances(event)
        residuals = self.measurement_model.residuals(event, rows, noise)
        far = self.gains.distances(residuals) > self.settings.rejection_distance
        moved = far & (self.landmarks.counts[rows] >= self.settings.confirmations)
        self.counts['moved_landmark'] += int(np.sum(moved))
        if far.any():
            self.observer.relocate_landmarks(rows[far], event.points[far])
            y_ref = self.observer.y_ref[rows[far]]
            self.gains.relocate_landmarks(rows[far], y_ref, residuals.covariances[far])
            self.landmarks.restart(rows[far], event.stamp_ns)
        return event.ids[moved]

    def _in_the_way(self, matched: MatchedObservation) -> IntArray:
        """Return which landmarks out of view make room for the new ones of ``matched``.

        The least often seen go first.
        """
        limit, new = self.settings.max_landmarks, len(matched.rows) - len(matched.residuals.rows)
        excess = len(self.landmarks) + new - limit
        if limit == 0 or new == 0 or excess <= 0:
            return np.empty(0, dtype=np.int64)
        unseen = self.landmarks.unseen_since(matched.event.stamp_ns)
        return np.sort(unseen[~np.isin(unseen, matched.rows)][:excess])

    def _initialise(self, event: ObservationEvent, noise: FloatArray) -> None:
        """Add landmarks where they were seen, as many as ``max_landmarks`` allows."""
        limit, new = self.settings.max_landmarks, len(event.ids)
        m = min(new, max(limit - len(self.landmarks), 0)) if limit else new
        self.counts['unmapped_landmark'] += new - m
        if not m:
            return
        event = event.select(np.arange(new) < m)
        self.observer.add_landmarks(event.points)
        self.gains.add_landmarks(self.observer.y_ref[-m:], self.observer.turned(noise[:m]))
        self.landmarks.add(event.ids, event.stamp_ns)
