"""What came of a run: figures of a replay, and what a report shows, recorded while it goes on.

Memory and time are bounded: as a run grows longer, instants lie further apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.stamps import is_due, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import (
    CalibrationEstimate,
    Innovations,
    Instant,
    Outcome,
    RangePower,
    Reason,
    Update,
)
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.events import UNKNOWN_ID
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import interpolate, LandmarkTruth, Trajectory, Truth
from slam_observer_ros.runs.metrics import ConfigurationError, pose_errors, TrajectoryErrors
from slam_observer_ros.settings.estimator_settings import Settings

FIRST_PERIOD_NS = 250_000_000
"""Time between two instants at first; it doubles whenever there are too many of them."""

MAX_INSTANTS = 600
MAX_LANDMARKS_KEPT = 100_000
"""Landmarks of all instants together."""


class RunRecorder:
    """Notes instants and innovations of a run while it goes on."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._instants: list[Instant] = []
        self._updates: list[Update] = []
        self._period_ns = FIRST_PERIOD_NS

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        if len(update.ids):
            self._updates.append(update)

    def note_stamp(self, estimator: Estimate) -> None:
        """Take in the state when all events of a stamp have been used, if one is due."""
        stamp_ns = estimator.stamp_ns
        if stamp_ns is None or not estimator.is_localised:
            return
        if not is_due(stamp_ns, self._last_ns, self._period_ns):
            return
        self._instants.append(_instant(estimator, stamp_ns))
        kept = sum(len(instant.ids) for instant in self._instants)
        if len(self._instants) > MAX_INSTANTS or kept > MAX_LANDMARKS_KEPT:
            del self._instants[1::2]
            self._period_ns *= 2

    @property
    def _last_ns(self) -> int | None:
        return self._instants[-1].stamp_ns if self._instants else None

    def finish(self, estimator: Estimate) -> tuple[Instant, ...]:
        """Return the instants in the order of their stamps, the end of the run as the last."""
        by_stamp = {instant.stamp_ns: instant for instant in self._instants}
        if estimator.stamp_ns is not None and estimator.is_localised:
            by_stamp[estimator.stamp_ns] = _instant(estimator, estimator.stamp_ns)
        return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))

    @property
    def mean_nis(self) -> float | None:
        """As :attr:`.Innovations.mean_nis`."""
        return self.innovations.mean_nis

    @property
    def innovations(self) -> Innovations:
        """What was noted of all observations."""
        judged = [(update, update.innovation) for update in self._updates if update.innovation]
        updates = [update for update, _ in judged]
        each = [innovation for _, innovation in judged]
        stamps_ns = np.array([update.stamp_ns for update in updates], dtype=np.int64)
        counts = np.array([len(update.ids) for update in updates], dtype=np.int64)
        none = np.empty(0)
        return Innovations(
            stamps_ns=np.repeat(stamps_ns, counts),
            ids=np.concatenate([none.astype(np.int64), *(update.ids for update in updates)]),
            distances=np.concatenate([none, *(innovation.distances for innovation in each)]),
            residuals=np.concatenate(
                [np.empty((0, 3)), *(update.residuals for update in updates)]
            ),
            weights=np.concatenate([none, *(innovation.weights for innovation in each)]),
            moved=np.concatenate(
                [none.astype(np.bool_), *(np.isin(u.ids, u.moved_ids) for u in updates)]
            ),
            update_stamps_ns=stamps_ns,
            nis=np.array([innovation.nis for innovation in each], dtype=np.float64),
            degrees_of_freedom=np.array(
                [innovation.degrees_of_freedom for innovation in each], dtype=np.int64
            ),
            lyapunov=np.array([update.lyapunov for update in updates]),
        )


class NisTally:
    """Sums up the normalised innovations of a run, and keeps nothing else of it."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._nis, self._degrees_of_freedom = 0.0, 0

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        innovation = update.innovation
        if innovation is not None and innovation.nis is not None:
            self._nis += innovation.nis
            self._degrees_of_freedom += innovation.degrees_of_freedom

    @property
    def mean_nis(self) -> float | None:
        """As :attr:`.Innovations.mean_nis`."""
        total = self._degrees_of_freedom
        return self._nis / total if total else None


LATELY_NS = 1_000_000_000
"""How long ago an observation may be that an instant shows."""


def _instant(estimator: Estimate, stamp_ns: int) -> Instant:
    last = estimator.last_update
    is_late = last is None or not 0 <= stamp_ns - last.stamp_ns < LATELY_NS
    return Instant(
        stamp_ns=stamp_ns,
        pose=estimator.pose,
        pose_covariance=estimator.pose_covariance,
        ids=estimator.landmark_ids,
        world_points=estimator.world_points,
        landmark_covariances=estimator.landmark_covariances,
        calibration=tuple(estimator.calibration),
        dropped=estimator.dropped.copy(),
        seen=None if is_late else last,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What came of a replay; since the last reset, if the clock jumped.

    Attributes
    ----------
    estimator : Estimate
        In its final state, with the map and the events dropped.
    trajectory, pose_covariances : Trajectory, FloatArray or None
        k poses of the online estimate, and (k, 6, 6) :attr:`.Estimator.pose_covariance` of each;
        None without truth to compare their errors with.
    dead_reckoning : Trajectory
        What the velocities alone give, from the identity pose.
    configuration : ConfigurationError
        Gauge-free error after each observation; empty without truth.
    residual_stamps_ns, residuals, rejected : (m,), (m, 3), (m,)
        Residuals of the landmarks seen, metres, and which were too large to be used.
    seconds : float
        CPU time of the estimator alone, without reading and measuring.
    start_ns : int
        Stamp of the first event that was used, nanoseconds; 0 if none was.
    range_power : RangePower or None
        How ranges grow with the cosine of the angle off the sensor's axis.
    localised_ns : (int, int) or None
        First and last stamp at which the pose in its final frame was known; None if it never was.
    events, observations, angular_velocities : int
        Events, dropped ones included; observations with points that were used; angular velocities
        of an Imu that were taken in: all of them also before the last reset.

    """

    estimator: Estimate
    trajectory: Trajectory
    pose_covariances: FloatArray | None
    dead_reckoning: Trajectory
    configuration: ConfigurationError
    residual_stamps_ns: IntArray
    residuals: FloatArray
    rejected: BoolArray
    events: int
    seconds: float
    in_known_map: bool
    start_ns: int
    localised_ns: tuple[int, int] | None
    range_power: RangePower | None
    observations: int
    angular_velocities: int

    @property
    def resets(self) -> int:
        """How often the estimator was reset by a jump of the clock."""
        resets = self.estimator.settings.on_time_jump == 'reset'
        return self.estimator.jumps if resets else 0

    def seconds_until(self, stamp_ns: int) -> float:
        """Return the time from the first event to a stamp, seconds."""
        return to_s(stamp_ns - self.start_ns)


MIN_GAP_S = 3.0
"""Shortest stretch without a used landmark that is marked."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """An observation of a landmark, or a change of the landmark itself, and what came of it."""

    seconds: float  # since the first event of the run
    sigmas: float  # Mahalanobis distance of the residual before the correction; NaN if unknown
    residual_m: float
    what: str


def _use(weight: float) -> str:
    if weight == 0.0:
        return Reason.REJECTED.words
    return 'used' if weight == 1.0 else f'used with weight {weight:.2f}'


@dataclass(frozen=True, slots=True, eq=False)
class ReportedRun:
    """A replay with what was recorded of it, from ``start_ns`` on.

    ``trajectory`` is the online one and ``errors`` its errors; ``dead_reckoning`` follows the
    velocities alone; ``anees`` is the pose's. Both are None where there is no truth.
    ``smoothed`` is None unless smoothing was asked for, ``smoothed_errors`` without truth, too.
    """

    settings: Settings
    start_ns: int
    trajectory: Trajectory
    dead_reckoning: Trajectory
    in_known_map: bool
    truth: Truth
    errors: TrajectoryErrors | None
    anees: float | None
    configuration: ConfigurationError
    instants: Sequence[Instant]
    innovations: Innovations
    outcomes: Sequence[Outcome]
    smoothed: Trajectory | None = None
    smoothed_points: FloatArray | None = None  # (n, 3) landmarks, metres, world
    smoothed_errors: TrajectoryErrors | None = None

    @property
    def seen_ids(self) -> list[int]:
        """Ids that points had, ascending."""
        others = {each.landmark_id for each in self.outcomes}
        return sorted(others.union(self.innovations.ids.tolist()) - {UNKNOWN_ID})

    def life(self, landmark_id: int) -> list[Sighting]:
        """Return what came of each observation of a landmark, and of itself, by time."""
        seen, of_it = self.innovations, self.innovations.ids == landmark_id
        lines = [
            Sighting(seconds, sigmas, residual_m, _use(weight))
            for seconds, sigmas, residual_m, weight in zip(
                self.seconds(seen.stamps_ns[of_it]).tolist(),
                seen.distances[of_it].tolist(),
                seen.residuals_m[of_it].tolist(),
                seen.weights[of_it].tolist(),
                strict=True,
            )
        ]
        for each in self.without_residual:
            if each.landmark_id == landmark_id:
                seconds = to_s(each.stamp_ns - self.start_ns)
                lines.append(Sighting(seconds, math.nan, math.nan, each.what.words))
        return sorted(lines, key=lambda line: line.seconds)

    @property
    def without_residual(self) -> list[Outcome]:
        """Outcomes that the innovations have not, as they have each residual that was rejected."""
        seen = self.innovations
        judged = set(zip(seen.stamps_ns.tolist(), seen.ids.tolist(), strict=True))
        return [
            each
            for each in self.outcomes
            if each.what is not Reason.REJECTED or (each.stamp_ns, each.landmark_id) not in judged
        ]

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Return times since the first event of the run, seconds."""
        seconds: FloatArray = (stamps_ns - self.start_ns) / 1e9
        return seconds

    @property
    def instants_s(self) -> FloatArray:
        """(i,) times of the instants, seconds."""
        return self.seconds(self._instants_ns)

    @property
    def _instants_ns(self) -> IntArray:
        return np.array([instant.stamp_ns for instant in self.instants], dtype=np.int64)

    @property
    def calibration(self) -> Sequence[CalibrationEstimate]:
        """What was found out about the velocity in the end."""
        return self.instants[-1].calibration if self.instants else ()

    def calibration_over_time(self, name: str) -> tuple[FloatArray, list[CalibrationEstimate]]:
        """Return when a property was estimated, seconds, and what was known of it at each time.

        That of a sensor begins where the sensor is heard first.
        """
        known = [
            (row, part)
            for row, instant in enumerate(self.instants)
            for part in instant.calibration
            if part.name == name
        ]
        return self.instants_s[[row for row, _ in known]], [part for _, part in known]

    @property
    def used_s(self) -> FloatArray:
        """(u,) times at which landmarks were used, seconds."""
        innovations = self.innovations
        return np.unique(self.seconds(innovations.stamps_ns[innovations.weights > 0.0]))

    @property
    def gaps_s(self) -> FloatArray:
        """(g, 2) beginnings and ends of the stretches in which no landmark was used, seconds."""
        edges_s = np.concatenate([[0.0], self.used_s, self.instants_s[-1:]])
        is_gap = np.diff(edges_s) >= MIN_GAP_S
        return np.column_stack([edges_s[:-1][is_gap], edges_s[1:][is_gap]])

    @property
    def aligned_landmarks(self) -> LandmarkTruth | None:
        """The true landmarks where the estimate should have them; None without truth."""
        truth = self.truth.landmarks
        if truth is None or self.errors is None:
            return None
        return LandmarkTruth(truth.ids, self.errors.in_estimate(truth.world_points))

    def anchored_errors(self) -> tuple[FloatArray, IntArray] | None:
        """Return pose errors (a, 6) from the first pose on, and the rows (a,) of their instants.

        The covariance is of these: it counts from the first pose. None where there is no truth, or
        the pose is that in a loaded map.
        """
        if self.errors is None or self.in_known_map:
            return None
        true_poses, covered = interpolate(
            Trajectory(self.truth.stamps_ns, self.truth.poses), self._instants_ns
        )
        rows = np.flatnonzero(covered).astype(np.int64)
        if not len(rows):
            return None
        poses = np.array([self.instants[row].pose for row in rows.tolist()])
        anchored = poses[0] @ se3.inverse(true_poses[rows[0]]) @ true_poses[rows]
        return pose_errors(poses, anchored), rows
