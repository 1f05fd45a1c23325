"""What is known to be true, to compare an estimate with it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
import logging
from operator import attrgetter
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import IMPOSSIBLE_ID, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.messages.poses import PoseBlock
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.recordings.trajectory import LandmarkTruth

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


def _positions_by_stamp(
    messages: Iterable[ObservationEvent],
) -> Iterator[tuple[int, _Positions]]:
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
