"""Pose, landmarks and velocity as they are estimated, with their covariances, to be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import (
    Ambiguity,
    CalibrationEstimate,
    MotionFactor,
    Outcome,
    Outcomes,
    Smoothed,
    Update,
)
from slam_observer_ros.estimator.event_warnings import EventWarnings
from slam_observer_ros.estimator.timeline import Timeline
from slam_observer_ros.estimator.undisturbed import Undisturbed
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.localiser import Localiser
from slam_observer_ros.mapping.merging import map_of
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.half_points import HalfPoints
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.tracking.state import State


class Estimate:
    """Pose and landmark map at ``stamp_ns``, the stamp of the last event used.

    From the last observation on they follow the velocity.
    """

    _timeline: Timeline

    def __init__(self, settings: Settings, hypotheses: Hypotheses, localiser: Localiser) -> None:
        self.settings = settings  # those in force
        self.dropped: Counter[str] = Counter()  # events refused, by reason
        self.jumps = 0  # how often the clock has jumped
        self.last_update: Update | None = None  # None before the first observation
        self._hypotheses, self._localiser = hypotheses, localiser
        self._counts = Outcomes(is_kept=hypotheses.best.counts.is_kept)
        self._warnings, self._undisturbed = EventWarnings(), Undisturbed()
        self._half_points = HalfPoints(self._counts)

    @property
    def counts(self) -> Counter[str]:
        """How many events were used, by kind, and the outcome for the landmarks in them.

        Events used (``'velocity'``, ``'observation'``), late ones among them (``'late_velocity'``,
        ``'late_observation'``), points (``'observed_point'``), observations made before the pose
        in a loaded map was found (``'not_localised'``), how often it was lost (``'lost'``),
        contradicted by all that is seen (``'contradicted_pose'``) or the estimate has diverged
        (``'diverged'``), the robot not where odometry had it (``'slip'``) or nothing in view where
        the map has it (``'unexpected_place'``), landmarks (``'rejected_landmark'``,
        ``'rejected_orientation'``, ``'moved_landmark'``, ``'carried_landmark'``,
        ``'forgotten_landmark'``, ``'unmapped_landmark'``, ``'unsupported_landmark'``,
        ``'merged_landmark'``, ``'doubled_landmark'``) and points not used (``'unknown_id'``,
        ``'repeated_id'``, ``'reserved_id'``, ``'impossible_id'``, ``'surplus_point'``,
        ``'bad_point'``). ``'vague_point'`` counts points that are used, but whose stated
        covariance says nothing.
        """
        return self._counts + self._localiser.counts + self._hypotheses.counts

    @property
    def outcomes(self) -> list[Outcome]:
        """What became of each unused point and each landmark, by stamp, if that was kept.

        Points that were used, and the residuals of rejected ones, are in each :class:`.Update`.
        """
        each = self._counts.each + self._hypotheses.outcomes
        return sorted(each, key=lambda outcome: outcome.stamp_ns)

    @property
    def is_contradicted(self) -> bool:
        """Whether all that is seen of a loaded map, which does not change, contradicts the pose.

        Behaviour is then not to rely on it, however small its covariance is.
        """
        return self._localiser.is_contradicted

    @property
    def ambiguity(self) -> Ambiguity | None:
        """Since when what is seen without ids fits several maps; None if it fits one."""
        return self._hypotheses.ambiguity

    @property
    def doubted_ids(self) -> IntArray:
        """Ids (d,) of landmarks that another map which fits has elsewhere, or has not."""
        ambiguity = self.ambiguity
        return np.empty(0, dtype=np.int64) if ambiguity is None else ambiguity.ids

    @property
    def longest_ambiguity(self) -> Ambiguity | None:
        """The longest time in which it fitted several; None if it never did for long."""
        return self._hypotheses.longest_ambiguity

    @property
    def waiting_landmarks(self) -> int:
        """How many landmarks without an id are not in the map, as they may not exist."""
        return int(np.count_nonzero(self._state.landmarks.tentative))

    @property
    def is_localised(self) -> bool:
        """Whether the estimate is in its final frame: a map's, if one was loaded."""
        return self._localiser.is_localised

    @property
    def localisation_problem(self) -> Finding | None:
        """Why the pose in a loaded map is not known; None if it is."""
        return self._localiser.problem(self._state)

    @property
    def ids_at_two_places(self) -> list[Finding]:
        """Landmarks whose id seems to be there twice, by how they were seen so far."""
        return list(self._warnings.two_places.findings.values())

    @property
    def possible_poses(self) -> FloatArray:
        """(q, 4, 4) where in a loaded map the robot may be, by points without ids, likely first.

        As of the last search; empty where none fits, and where the pose is known.
        """
        places = [] if self.is_localised else self._localiser.places
        poses = [place.transform @ self._state.observer.A for place in places]
        return np.array(poses).reshape(-1, 4, 4)

    @property
    def anchor_biases(self) -> dict[int, float]:
        """Metres by which ranges from landmarks are too long everywhere, by id."""
        return self._half_points.offsets.constant

    @property
    def open_sides(self) -> list[int]:
        """Ids of new landmarks that ranges or directions put in two places."""
        return self._half_points.open_sides

    @property
    def map_name(self) -> str:
        """Name of the loaded map in whose frame the estimate is; empty if it is in none."""
        loaded = self._localiser.loaded
        return loaded.name if loaded is not None and self.is_localised else ''

    @property
    def loaded_maps(self) -> Sequence[LandmarkMap]:
        """The maps that were loaded, in one of which the robot is; empty if none was."""
        return tuple(self._localiser.maps)

    @property
    def landmark_map(self) -> LandmarkMap:
        """The present map, as it can be saved and loaded: without landmarks that move.

        Unless it is in the frame of a loaded map, its covariances are of its shape alone.
        """
        state, loaded = self._state, self._localiser.loaded if self.is_localised else None
        landmark_map = map_of(state, loaded)
        is_joint = landmark_map.joint_covariance is not None or state.observer.is_exact
        if landmark_map.covariances is not None and not is_joint:
            self._warnings.warn('left_out_correlations', count=len(landmark_map.ids))
        return landmark_map

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last event that was used, nanoseconds; None before the first."""
        return self._timeline.stamp_ns

    @property
    def pose(self) -> FloatArray:
        """(4, 4) estimated pose at ``stamp_ns``, body to world."""
        leads_on = self._timeline.lead_s > 0.0
        return self.uncertain_pose[0] if leads_on else self._state.observer.pose

    def pose_at(self, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) at any time: the state, moved on by the velocities since."""
        observer, state_ns = self._state.observer, self._timeline.state_ns
        if state_ns is None or stamp_ns == state_ns:
            return observer.pose
        return observer.pose @ self._timeline.motion(state_ns, stamp_ns)

    def poses_at(
        self, stamps_ns: IntArray, with_covariances: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the poses (s, 4, 4) and their covariances (s, 6, 6) as they were known then.

        Of stamps (s,) that ``on_stamps`` has just been called with. None if no covariance is
        known, or asked for: they take longer.
        """
        timeline = self._timeline
        if stamps_ns[0] < (timeline.stamp_ns or 0):
            return self._hypotheses.poses_until(
                timeline.velocities, timeline.state_ns or 0, stamps_ns, with_covariances
            )
        # The present stamp alone, maybe of an observation.
        if not with_covariances:
            return self.pose[None], None
        pose, covariance = self._hypotheses.pose_after(
            timeline.velocities, timeline.state_ns or 0, timeline.stamp_ns or 0
        )
        return pose[None], None if covariance is None else covariance[None]

    @property
    def pose_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of the pose at ``stamp_ns``: rotation vector, position; rad², m².

        Along the world's axes; it includes that the most likely hypothesis may be wrong. None
        where the filter knows no covariance.
        """
        return self.uncertain_pose[1]

    @property
    def uncertain_pose(self) -> tuple[FloatArray, FloatArray | None]:
        """:attr:`pose` and :attr:`pose_covariance`, both for what one of them costs."""
        timeline = self._timeline
        start_ns, end_ns = timeline.state_ns or 0, timeline.stamp_ns or 0
        pose, covariance = self._hypotheses.pose_after(timeline.velocities, start_ns, end_ns)
        return pose if end_ns > start_ns else self._state.observer.pose, covariance

    @property
    def body_velocity(self) -> FloatArray:
        """(6,) newest velocity (Ω, v), calibrated, rad/s and m/s; zero when it has timed out."""
        velocity = self._timeline.body_velocity  # of a little earlier or later if delayed
        return np.zeros(6) if velocity is None else self._state.calibration.apply(velocity)

    @property
    def body_velocity_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of :attr:`body_velocity`, as stated with it or as the settings say.

        Without a velocity it is what the robot may do then. None before there are two messages.
        """
        held = self._timeline.velocity_in_force
        if held is None:
            return None
        state, axes = self._state, self._state.axes
        measured = state.motion_noise.velocity_covariance(held)
        if axes.p < len(measured):
            measured = axes.full_pose_covariance(measured[axes.pose, axes.pose])
        return state.calibration.apply_to_covariance(
            measured, held.body_velocities[0], state.gains.calibration_variances
        )

    @property
    def velocity_is_stale(self) -> bool:
        """Whether no velocity was in force at ``stamp_ns``, so that the pose is being held."""
        return self._timeline.body_velocity is None

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the landmarks in the map: those seen ``confirmations`` times or more."""
        return self._state.landmarks.ids[self._state.confirmed]

    @property
    def landmark_counts(self) -> IntArray:
        """(n,) number of observations of each landmark."""
        return self._state.landmarks.counts[self._state.confirmed]

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks at ``stamp_ns``, metres, world."""
        state, lead_s = self._state, self._timeline.lead_s
        points = state.observer.world_points[state.confirmed]
        return points + lead_s * self.landmark_velocities if lead_s else points

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks at ``stamp_ns``, world, m²; None if unknown."""
        of_all = self._state.landmark_covariances(self._timeline.lead_s)
        return None if of_all is None else of_all[self._state.confirmed]

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of landmarks as seen from the robot, m².

        In the body frame, of k coordinates (2 in ``two_d_mode``, else 3), as of the last
        observation: ask for it in ``on_update``. ``rows`` (m,) are indices into ``landmark_ids``.
        It includes that the most likely hypothesis may be wrong.
        None where the filter knows none, or landmarks are fixed, whose errors nobody knows.
        """
        return self._hypotheses.configuration_covariance(self._state.confirmed[rows])

    @property
    def landmark_velocities(self) -> FloatArray:
        """(n, 3) velocities of landmarks that move, known or estimated, m/s, world."""
        observer = self._state.observer
        return se3.rotate(observer.reference_pose, observer.u[self._state.confirmed])

    @property
    def calibration(self) -> list[CalibrationEstimate]:
        """Scale, bias and delay of the velocity, as far as the settings ask for them."""
        return self._hypotheses.calibration

    @property
    def motion_factors(self) -> list[MotionFactor]:
        """Noise of turning and driving over what is stated; empty where it is not known."""
        return self._state.motion_noise.factors.estimates

    @property
    def undisturbed(self) -> tuple[list[CalibrationEstimate], list[MotionFactor]]:
        """``calibration`` and ``motion_factors`` without what slips and the like pass for.

        Without what was learnt before something was known that explains it: wheels that slip, a
        robot or landmark that is carried, or what :meth:`.Estimator.distrust_odometry` was for.
        """
        clean = self._undisturbed
        return (
            [clean.of_calibration(part) for part in self.calibration],
            [clean.of_noise(factor, self.settings) for factor in self.motion_factors],
        )

    @property
    def has_rare_velocities(self) -> bool:
        """Whether velocities come so seldom that each one that is missing leaves a gap."""
        return 2.0 * self.velocity_period_s > self.settings.velocity_timeout

    @property
    def velocity_period_s(self) -> float:
        """Median time between two velocities of late, seconds; 0 while that is not known."""
        return self._timeline.velocities.median_period_s

    def knows_motion_since(self, stamp_ns: int) -> bool:
        """Return whether velocities are known from a stamp on, nanoseconds: of seconds at most."""
        return self._timeline.knows_motion_since(stamp_ns)

    def smooth(self) -> Smoothed:
        """Return the smoothed trajectory and map since the history began; the state is kept.

        With ``smoothing_window`` 0 that is the whole run. Raise ParameterError if no history is
        kept, and SmoothingError if the observations don't determine everything.
        """
        return self._state.copy().smooth()  # what is postponed stays so: bits do not change

    @property
    def lyapunov(self) -> float:
        """L (34) of the latest observation's residuals; zero before the first."""
        return 0.0 if self.last_update is None else self.last_update.lyapunov

    @property
    def _state(self) -> State:
        """The most likely state."""
        return self._hypotheses.best
