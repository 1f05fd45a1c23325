"""What is kept of a run as it goes on: sampled poses and states, and how far off residuals were.

Memory and time are bounded: as a run grows longer, instants lie further apart.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.stamps import due_rows, is_due, NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.run_record import Innovations, Instant
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory

SAMPLE_PERIOD_NS = 50_000_000
"""Least time between two poses of a sampled trajectory."""


class PoseSamples:
    """Poses (4, 4) with their stamps, none less than a period after the one before.

    Where not all are kept, the first and the last are.
    """

    def __init__(self, keep_all: bool = True) -> None:
        self._keep_all = keep_all
        self.stamps_ns: list[int] = []
        self._poses: list[FloatArray] = []

    def due(self, stamps_ns: IntArray) -> list[int]:
        """Return the rows of increasing stamps (s,) at which poses are to be added."""
        last_ns = self.stamps_ns[-1] if self.stamps_ns else None
        return due_rows(stamps_ns, last_ns, SAMPLE_PERIOD_NS)

    def add(self, stamps_ns: IntArray, poses: FloatArray) -> None:
        """Append poses (s, 4, 4)."""
        self.stamps_ns += stamps_ns.tolist()
        self._poses += list(poses)
        if not self._keep_all:
            del self.stamps_ns[1:-1], self._poses[1:-1]

    @property
    def trajectory(self) -> Trajectory:
        """The poses in stamp order."""
        return Trajectory.from_samples(self.stamps_ns, self._poses)


class TrajectorySampler:
    """Collects poses and their covariances (6, 6), where these are known."""

    def __init__(self) -> None:
        self._samples = PoseSamples()
        self._covariances: list[FloatArray] = []

    def due(self, stamps_ns: IntArray) -> IntArray:
        """Return the increasing stamps, among these (s,), at which poses are to be added."""
        return stamps_ns[self._samples.due(stamps_ns)]

    def add(self, stamps_ns: IntArray, poses: FloatArray, covariances: FloatArray | None) -> None:
        """Append poses (s, 4, 4), and their covariances (s, 6, 6)."""
        self._samples.add(stamps_ns, poses)
        if covariances is not None:
            self._covariances += list(covariances)

    @property
    def trajectory(self) -> Trajectory:
        """The poses kept, in stamp order."""
        return self._samples.trajectory

    @property
    def covariances(self) -> FloatArray | None:
        """(k, 6, 6) covariance of each pose of the trajectory; None where they are not known."""
        if not self._covariances:
            return None
        latest = dict(zip(self._samples.stamps_ns, self._covariances, strict=True))
        return np.array([latest[stamp_ns] for stamp_ns in sorted(latest)])


class DeadReckoning:
    """Collects the poses that the velocities alone lead through, from the identity on."""

    def __init__(self, keep_all: bool = True) -> None:
        self._pose = np.eye(4)
        self._samples = PoseSamples(keep_all)

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move on from one stamp to another, nanoseconds."""
        held = velocities.held(start_ns, end_ns)
        if not (self._samples.stamps_ns or held.dt_s.any()):
            return
        path = se3.path(self._pose, held.body_velocities * held.dt_s[:, None])
        elapsed_s = np.append(0.0, np.cumsum(held.dt_s + held.gap_s))
        stamps_ns = start_ns + np.rint(elapsed_s * NANOSECONDS_PER_SECOND).astype(np.int64)
        rows = self._samples.due(stamps_ns)
        self._samples.add(stamps_ns[rows], path[rows])
        self._pose = se3.pose(so3.normalise(path[-1, :3, :3]), path[-1, :3, 3])

    @property
    def trajectory(self) -> Trajectory:
        """The poses kept, in stamp order."""
        return self._samples.trajectory


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
        """Take in an observation, of which the estimator has judged the innovation."""
        if len(update.ids):
            self._updates.append(update)

    def note_stamp(self, estimator: Estimator) -> None:
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

    def finish(self, estimator: Estimator) -> tuple[Instant, ...]:
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
        """Take in an observation, of which the estimator has judged the innovation."""
        innovation = update.innovation
        if innovation is not None and innovation.nis is not None:
            self._nis += innovation.nis
            self._degrees_of_freedom += innovation.degrees_of_freedom

    @property
    def mean_nis(self) -> float | None:
        """As :attr:`.Innovations.mean_nis`."""
        total = self._degrees_of_freedom
        return self._nis / total if total else None


def _instant(estimator: Estimator, stamp_ns: int) -> Instant:
    return Instant(
        stamp_ns=stamp_ns,
        pose=estimator.pose,
        pose_covariance=estimator.pose_covariance,
        ids=estimator.landmark_ids,
        world_points=estimator.world_points,
        landmark_covariances=estimator.landmark_covariances,
        calibration=tuple(estimator.calibration),
        dropped=estimator.dropped.copy(),
    )
