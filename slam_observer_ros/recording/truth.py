"""What is known to be true, to compare an estimate with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.events import LandmarkTruth, UNKNOWN_ID
from slam_observer_ros.recording.messages import pose_stack, PoseMessage
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Truth:
    """What the estimate is compared with, in the axes of the recording's world frame.

    Attributes
    ----------
    stamps_ns : IntArray
        (k,) strictly increasing stamps of the true poses, nanoseconds.
    poses : FloatArray
        (k, 4, 4) true poses, body to world; k is 0 if the recording has none.
    landmarks : LandmarkTruth or None
        True landmark positions; None if the recording has none.

    """

    stamps_ns: IntArray
    poses: FloatArray
    landmarks: LandmarkTruth | None

    @classmethod
    def from_messages(
        cls, poses: Iterable[PoseMessage], landmarks: Iterable[ObservationMessage]
    ) -> Truth:
        """Gather poses of any order, and landmarks of which the last position counts."""
        return cls(*_gathered_poses(list(poses)), _gathered_landmarks(landmarks))

    def flattened(self) -> Truth:
        """Return it with the landmarks at the robot's height, where a planar map has them."""
        if self.landmarks is None:
            return self
        points = self.landmarks.world_points.copy()
        points[:, 2] = np.median(self.poses[:, 2, 3]) if len(self.poses) else 0.0
        return replace(self, landmarks=replace(self.landmarks, world_points=points))


def _gathered_poses(messages: Sequence[PoseMessage]) -> tuple[IntArray, FloatArray]:
    stamps_ns, order = np.unique(
        np.array([message.stamp_ns for message in messages], dtype=np.int64), return_index=True
    )
    return stamps_ns, pose_stack([messages[i] for i in order])


def _gathered_landmarks(messages: Iterable[ObservationMessage]) -> LandmarkTruth | None:
    positions: dict[int, FloatArray] = {}
    for message in messages:
        positions |= zip(message.event.ids.tolist(), message.event.points, strict=True)
    positions.pop(UNKNOWN_ID, None)
    if not positions:
        return None
    ids = np.array(sorted(positions), dtype=np.int64)
    return LandmarkTruth(ids, np.array([positions[landmark_id] for landmark_id in ids]))
