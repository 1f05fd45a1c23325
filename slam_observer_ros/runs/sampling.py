"""Trajectories of a run, sampled at the stamps of its events, at most at 20 Hz."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.stamps import due_rows, NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.trajectory import Trajectory

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


MOST_PENDING = 64
"""Motions that are worked off at once: one by one costs three times as much."""


class DeadReckoning:
    """Collects the poses that the velocities alone lead through, from the identity on."""

    def __init__(self, keep_all: bool = True) -> None:
        self._pose = np.eye(4)
        self._samples = PoseSamples(keep_all)
        self._pending: list[tuple[FloatArray, IntArray]] = []
        self._most_pending = MOST_PENDING if keep_all else 1
        self._has_begun = False
        self._end_ns = 0

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move on from one stamp to another, nanoseconds."""
        held = velocities.held(start_ns, end_ns)
        self._has_begun = self._has_begun or bool(held.dt_s.any())
        if not self._has_begun:
            return
        if start_ns != self._end_ns or len(self._pending) == self._most_pending:
            self._move_on()
        elapsed_s = np.append(0.0, np.cumsum(held.dt_s + held.gap_s))
        stamps_ns = start_ns + np.rint(elapsed_s * NANOSECONDS_PER_SECOND).astype(np.int64)
        self._pending.append((held.body_velocities * held.dt_s[:, None], stamps_ns))
        self._end_ns = end_ns

    def _move_on(self) -> None:
        """Work off motions that follow each other, each from where the one before it ended."""
        if not self._pending:
            return
        twists, stamps_ns = zip(*self._pending, strict=True)
        self._pending.clear()
        path = se3.path(self._pose, np.concatenate(twists))
        at_ns = np.concatenate([stamps_ns[0][:1], *(each[1:] for each in stamps_ns)])
        rows = self._samples.due(at_ns)
        self._samples.add(at_ns[rows], path[rows])
        self._pose = se3.pose(so3.normalise(path[-1, :3, :3]), path[-1, :3, 3])

    @property
    def trajectory(self) -> Trajectory:
        """The poses kept, in stamp order."""
        self._move_on()
        return self._samples.trajectory
