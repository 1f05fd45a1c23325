"""What is known to be true, to compare an estimate with it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import logging

import numpy as np

from slam_observer_ros.errors import TransformError
from slam_observer_ros.events import LandmarkTruth, UNKNOWN_ID
from slam_observer_ros.recording.frames import TransformSource
from slam_observer_ros.recording.messages import pose_stack, PoseMessage
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.types import FloatArray, IntArray

_logger = logging.getLogger(__name__)


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
        cls,
        poses: Sequence[PoseMessage],
        base_in: Mapping[str, FloatArray],
        landmarks: Iterable[ObservationMessage],
    ) -> Truth:
        """Gather poses of any order, and landmarks of which the last position counts.

        ``base_in`` has the pose (4, 4) of the robot's base in each frame whose poses these are.
        """
        stamps_ns = np.array([message.stamp_ns for message in poses], dtype=np.int64)
        stamps_ns, order = np.unique(stamps_ns, return_index=True)
        bases = np.array([base_in[message.child_frame_id] for message in poses])
        world_poses = pose_stack(poses) @ bases.reshape(-1, 4, 4)
        return cls(stamps_ns, world_poses[order], _gathered_landmarks(landmarks))

    def flattened(self) -> Truth:
        """Return it with the landmarks at the robot's height, where a planar map has them."""
        if self.landmarks is None:
            return self
        points = self.landmarks.world_points.copy()
        points[:, 2] = np.median(self.poses[:, 2, 3]) if len(self.poses) else 0.0
        return replace(self, landmarks=replace(self.landmarks, world_points=points))


def base_in_frames(
    frames: Collection[str], base_frame: str, transforms: TransformSource
) -> dict[str, FloatArray]:
    """Return the pose (4, 4) of the base frame in each of ``frames``, by name.

    Identity where a name is empty, and, with a warning, where ``transforms`` don't have both.
    """
    base_in = dict.fromkeys(frames, np.eye(4))
    for frame in frames:
        if frame.lstrip('/') in ('', base_frame.lstrip('/')) or not base_frame:
            continue
        try:
            base_in[frame] = transforms.lookup(frame, base_frame, 0)
        except TransformError as error:
            _logger.warning(
                "The true poses are of '%s', and the estimated ones of '%s': they are compared "
                'as if that were one place (%s).',
                frame,
                base_frame,
                error,
            )
    return base_in


def _gathered_landmarks(messages: Iterable[ObservationMessage]) -> LandmarkTruth | None:
    positions: dict[int, FloatArray] = {}
    for message in messages:
        positions |= zip(message.event.ids.tolist(), message.event.points, strict=True)
    positions.pop(UNKNOWN_ID, None)
    if not positions:
        return None
    ids = np.array(sorted(positions), dtype=np.int64)
    return LandmarkTruth(ids, np.array([positions[landmark_id] for landmark_id in ids]))
