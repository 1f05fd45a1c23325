"""What is true of poses and landmarks; poses over time, between their stamps and in files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie import se3, so3

MAX_GAP_NS = NANOSECONDS_PER_SECOND // 2
"""Truth is not interpolated between samples further apart than this."""

_TUM_HEADER = '# timestamp[s] x y z [m] qx qy qz qw\n'


@dataclass(frozen=True, slots=True)
class PoseTruth:
    """True pose (4, 4) of the robot, base frame to world, at a time."""

    stamp_ns: int
    pose: FloatArray


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """True positions (n, 3) of landmarks, in the world, metres, and their ids (n,)."""

    ids: IntArray
    world_points: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses (k, 4, 4), body to world, at strictly increasing stamps (k,).

    Raises an EvaluationError if shapes don't fit, a pose isn't finite or stamps don't increase.
    """

    stamps_ns: IntArray
    poses: FloatArray

    def __post_init__(self) -> None:
        if self.stamps_ns.ndim != 1 or self.poses.shape != (len(self.stamps_ns), 4, 4):
            raise EvaluationError(
                f'a trajectory needs (k,) stamps and (k, 4, 4) poses, '
                f'not {self.stamps_ns.shape} and {self.poses.shape}'
            )
        if not np.isfinite(self.poses).all():
            raise EvaluationError("a trajectory's poses must be finite")
        if not (self.stamps_ns[1:] > self.stamps_ns[:-1]).all():
            raise EvaluationError("a trajectory's stamps must increase strictly")

    @classmethod
    def from_samples(cls, stamps_ns: Sequence[int], poses: Sequence[FloatArray]) -> Trajectory:
        """Collect poses (4, 4) in any order; of those with one stamp, the last given counts."""
        latest = dict(zip(stamps_ns, poses, strict=True))
        ordered = sorted(latest)
        stacked = np.array([latest[stamp] for stamp in ordered], dtype=np.float64)
        return cls(np.array(ordered, dtype=np.int64), stacked.reshape(-1, 4, 4))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> FloatArray:
        """(k, 3) positions of the body in the world, metres."""
        return self.poses[:, :3, 3]

    @property
    def rotations(self) -> FloatArray:
        """(k, 3, 3) rotations from body to world axes."""
        return self.poses[:, :3, :3]

    def during(self, other: Trajectory) -> Trajectory:
        """Return the shortest part that spans the time of another one, as far as this one does."""
        first = np.searchsorted(self.stamps_ns, other.stamps_ns[0], side='right') - 1
        last = np.searchsorted(self.stamps_ns, other.stamps_ns[-1])
        kept = slice(max(first, 0), last + 1)
        return Trajectory(self.stamps_ns[kept], self.poses[kept])

    def moved(self, transform: FloatArray) -> Trajectory:
        """Express it in another world frame, to which ``transform`` (4, 4) leads from this one."""
        return Trajectory(self.stamps_ns, transform @ self.poses)


def interpolate(
    trajectory: Trajectory, stamps_ns: IntArray, max_gap_ns: int = MAX_GAP_NS
) -> tuple[FloatArray, BoolArray]:
    """Interpolate poses: linear in position, constant angular velocity in rotation (slerp).

    Returns poses (m, 4, 4) at stamps (m,) of any order, NaN where the trajectory does not cover
    that time, and whether it does (m,). At its own stamps its poses are returned bit for bit.
    Nothing is extrapolated before the first or after the last, nor bridged over longer gaps.
    """
    poses = np.full((len(stamps_ns), 4, 4), np.nan)
    before = np.searchsorted(trajectory.stamps_ns, stamps_ns, side='right') - 1
    covered: BoolArray = before >= 0
    before, wanted_ns = before[covered], stamps_ns[covered]
    after = np.minimum(before + 1, len(trajectory) - 1)
    # How far each is on its way from the pose before to the one after
    elapsed_ns = wanted_ns - trajectory.stamps_ns[before]
    gap_ns = trajectory.stamps_ns[after] - trajectory.stamps_ns[before]
    usable = (elapsed_ns == 0) | ((gap_ns > 0) & (gap_ns <= max_gap_ns))
    covered[covered] = usable
    fraction = elapsed_ns[usable] / np.maximum(gap_ns[usable], 1)
    poses[covered] = se3.interpolate(
        trajectory.poses[before[usable]], trajectory.poses[after[usable]], fraction
    )
    return poses, covered


def associate(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory, BoolArray]:
    """Pair each estimated pose that the truth covers with the true one, interpolated, at its time.

    Where true poses are further apart, as a total station's, it is the estimate that is
    interpolated, at their times. Returns estimate and truth at these stamps, and which (k,) of the
    estimated poses these are, or come before them.
    """
    if is_sparse(truth):
        return _associate_at_truth(estimate, truth)
    true_poses, covered = interpolate(truth, estimate.stamps_ns)
    stamps_ns = estimate.stamps_ns[covered]
    return (
        Trajectory(stamps_ns, estimate.poses[covered]),
        Trajectory(stamps_ns, true_poses[covered]),
        covered,
    )


def is_sparse(trajectory: Trajectory) -> bool:
    """Return whether most of the poses are too far apart to interpolate between them."""
    gaps_ns = np.diff(trajectory.stamps_ns)
    return len(gaps_ns) > 0 and bool(np.median(gaps_ns) > MAX_GAP_NS)


def _associate_at_truth(
    estimate: Trajectory, truth: Trajectory
) -> tuple[Trajectory, Trajectory, BoolArray]:
    poses, covered = interpolate(estimate, truth.stamps_ns)
    rows = np.searchsorted(estimate.stamps_ns, truth.stamps_ns[covered], side='right') - 1
    rows, first = np.unique(rows, return_index=True)
    stamps_ns = truth.stamps_ns[covered][first]
    used = np.zeros(len(estimate), dtype=bool)
    used[rows] = True
    return (
        Trajectory(stamps_ns, poses[covered][first]),
        Trajectory(stamps_ns, truth.poses[covered][first]),
        used,
    )


def write_tum(trajectory: Trajectory, path: Path) -> Path:
    """Write a TUM file (``t x y z qx qy qz qw``), as evo and others read it.

    Stamps are written to the nanosecond and numbers with all their digits, so reading the file
    gives the stamps and positions back bit for bit. The file appears whole or not at all. Returns
    its path; raises an EvaluationError if it can't be written.
    """
    numbers = np.hstack([trajectory.positions, so3.to_quaternion(trajectory.rotations)]).tolist()
    lines = (
        f'{_seconds_text(stamp_ns)} {" ".join(map(repr, row))}\n'
        for stamp_ns, row in zip(trajectory.stamps_ns.tolist(), numbers, strict=True)
    )
    try:
        with unfinished_file(path) as file:
            file.write(_TUM_HEADER)
            file.writelines(lines)
    except OSError as error:
        raise EvaluationError(f"can't write {path}: {error.strerror}") from error
    return path


def _seconds_text(stamp_ns: int) -> str:
    seconds, rest_ns = divmod(abs(stamp_ns), NANOSECONDS_PER_SECOND)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{rest_ns:09d}'


def filled(estimate: Trajectory, motion: Trajectory, stamps_ns: IntArray) -> Trajectory:
    """Return an estimate at other stamps (m,), as a motion that drifts passed through it.

    The motion, such as dead reckoning, may be in another world. From each estimated pose on its
    shape is kept; what it misses the next one by is made up for in proportion to the time. Before
    the first and after the last pose it is as it is. Where no motion is known, the estimate is
    returned at its own stamps.
    """
    if len(motion) < 2 or not len(estimate):
        return estimate
    reckoned, wanted = _moved_to(motion, estimate.stamps_ns), _moved_to(motion, stamps_ns)
    # What the motion misses each next pose by, and which share of that it has missed by then.
    arrivals = estimate.poses[:-1] @ se3.inverse(reckoned[:-1]) @ reckoned[1:]
    misses = np.concatenate(
        [se3.log(se3.inverse(arrivals) @ estimate.poses[1:]), np.zeros((1, 6))]
    )
    before = np.searchsorted(estimate.stamps_ns, stamps_ns, side='right') - 1
    start = np.maximum(before, 0)
    durations_ns = np.append(np.diff(estimate.stamps_ns), 1)
    shares = (stamps_ns - estimate.stamps_ns[start]) / durations_ns[start] * (before >= 0)
    moved = estimate.poses[start] @ se3.inverse(reckoned[start]) @ wanted
    return Trajectory(stamps_ns, moved @ se3.exp(shares[:, None] * misses[start]))


def _moved_to(motion: Trajectory, stamps_ns: IntArray) -> FloatArray:
    """Return the poses (m, 4, 4) of a motion at any stamps (m,), beyond its ends going on."""
    before = np.searchsorted(motion.stamps_ns, stamps_ns, side='right') - 1
    before = np.clip(before, 0, len(motion) - 2)
    elapsed_ns = stamps_ns - motion.stamps_ns[before]
    fraction = elapsed_ns / np.diff(motion.stamps_ns)[before]
    # No further than that by as much as the last two are apart.
    limited = np.clip(fraction, 0.0, 2.0)
    return se3.interpolate(motion.poses[before], motion.poses[before + 1], limited)
