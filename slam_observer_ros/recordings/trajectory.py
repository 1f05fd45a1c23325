"""What is true of poses and landmarks; poses over time, between their stamps and in files."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
import logging
from operator import attrgetter
from pathlib import Path
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import EvaluationError, failing, TransformError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import IMPOSSIBLE_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.messages.poses import PoseBlock
from slam_observer_ros.recordings.frames import TransformBuffer

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
    with failing(EvaluationError, f"can't write {path}"), unfinished_file(path) as file:
        file.write(_TUM_HEADER)
        file.writelines(lines)
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


logger = logging.getLogger(__name__)

_AT_BASE = np.eye(4)

_Positions: TypeAlias = dict[int, tuple[float, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkTracks:
    """Where landmarks truly were: (j, n, 3) positions of ``ids`` (n,) at j increasing stamps.

    Between these they moved in a line or were at rest; one that was not seen yet is where it is
    first. In the world, metres.
    """

    stamps_ns: IntArray
    ids: IntArray
    world_points: FloatArray

    @classmethod
    def from_messages(cls, messages: Iterable[ObservationEvent]) -> LandmarkTracks | None:
        """Gather positions of any order; None if no message has a landmark."""
        stamps_ns: list[int] = []
        states: list[_Positions] = []
        for stamp_ns, positions in _positions_by_stamp(messages):
            state = states[-1] | positions if states else positions
            if states[-2:] == [state, state]:  # at rest: its beginning and its end are enough
                stamps_ns[-1] = stamp_ns
                continue
            stamps_ns.append(stamp_ns)
            states.append(state)
        first: _Positions = {}
        for state in reversed(states):
            first |= state
        ids = sorted(first)
        points = [[state.get(i, first[i]) for i in ids] for state in states]
        return cls(np.array(stamps_ns), np.array(ids), np.array(points)) if ids else None

    def at(self, stamp_ns: int) -> LandmarkTruth:
        """Return where they were, in a line from one position to the next."""
        after = int(np.searchsorted(self.stamps_ns, stamp_ns, side='right'))
        before, after = max(after - 1, 0), min(after, len(self.stamps_ns) - 1)
        start_ns, end_ns = self.stamps_ns[[before, after]].tolist()
        share = (stamp_ns - start_ns) / (end_ns - start_ns) if end_ns > start_ns else 0.0
        points = (1.0 - share) * self.world_points[before] + share * self.world_points[after]
        return LandmarkTruth(self.ids, points if share else self.world_points[before])

    def flattened(self, height_m: float) -> LandmarkTracks:
        """Return it with all landmarks at one height."""
        points = self.world_points.copy()
        points[..., 2] = height_m
        return replace(self, world_points=points)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What the estimate is compared with, in the axes of the recording's world frame.

    The true poses (k, 4, 4), body to world, have strictly increasing stamps (k,), nanoseconds;
    k is 0 and ``tracks`` of landmarks are None if the recording has none.
    """

    stamps_ns: IntArray
    poses: FloatArray
    tracks: LandmarkTracks | None

    @property
    def trajectory(self) -> Trajectory:
        """The true poses."""
        return Trajectory(self.stamps_ns, self.poses)

    @property
    def landmarks(self) -> LandmarkTruth | None:
        """True landmark positions at the end; None if the recording has none."""
        return None if self.tracks is None else self.tracks.at(int(self.tracks.stamps_ns[-1]))

    @classmethod
    def from_messages(
        cls,
        poses: Sequence[PoseBlock],
        base_in: Mapping[str, FloatArray],
        landmarks: Iterable[ObservationEvent],
    ) -> Truth:
        """Gather poses and landmarks of any order; ``base_in`` is of :func:`base_in_frames`."""
        none = np.empty(0, dtype=np.int64)
        stamps_ns = np.concatenate([none, *(block.stamps_ns for block in poses)])
        stamps_ns, order = np.unique(stamps_ns, return_index=True)
        of_base = [block.poses @ base_in.get(block.child_frame_id, _AT_BASE) for block in poses]
        world_poses = np.concatenate([np.empty((0, 4, 4)), *of_base])
        return cls(stamps_ns, world_poses[order], LandmarkTracks.from_messages(landmarks))

    def flattened(self) -> Truth:
        """Return it with the landmarks at the robot's height, where a planar map has them."""
        if self.tracks is None:
            return self
        height_m = float(np.median(self.poses[:, 2, 3])) if len(self.poses) else 0.0
        return replace(self, tracks=self.tracks.flattened(height_m))


def _positions_by_stamp(messages: Iterable[ObservationEvent]) -> Iterator[tuple[int, _Positions]]:
    """Yield what all messages of a stamp hold together, in the order of the stamps."""
    by_stamp = attrgetter('stamp_ns')
    for stamp_ns, together in groupby(sorted(messages, key=by_stamp), key=by_stamp):
        positions: _Positions = {}
        for event in together:
            points = map(tuple, event.points.tolist())
            positions |= zip(event.ids.tolist(), points, strict=True)
        for no_id in (UNKNOWN_ID, IMPOSSIBLE_ID):
            positions.pop(no_id, None)
        yield stamp_ns, positions


def other_frames(base_frame: str, poses: Iterable[PoseBlock]) -> set[str]:
    """Return the frames of poses that say whose they are, and are not the base's."""
    known = ('', base_frame.lstrip('/'))
    frames = {block.child_frame_id for block in poses}
    return {frame for frame in frames if base_frame and frame.lstrip('/') not in known}


def base_in_frames(
    frames: Collection[str], base_frame: str, transforms: TransformBuffer
) -> dict[str, FloatArray]:
    """Return the pose (4, 4) of the base in each frame: identity, with a warning, if unknown."""
    base_in = dict.fromkeys(frames, np.eye(4))
    for frame in frames:
        try:
            base_in[frame] = transforms.lookup(frame, base_frame, 0)
        except TransformError as error:
            finding = found('truth_frame', frame=frame, base_frame=base_frame, error=error)
            logger.warning('%s', finding)
    return base_in
