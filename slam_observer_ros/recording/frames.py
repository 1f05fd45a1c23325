"""Frames of recorded or received messages: where sensors sit on the robot."""

from __future__ import annotations

from collections.abc import Iterable

from slam_observer_ros.errors import TransformError
from slam_observer_ros.events import Event, VelocityEvent
from slam_observer_ros.extrinsics import move_observation, move_velocity
from slam_observer_ros.recording.messages import PoseMessage, VelocityMessage
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.transform_buffer import TransformBuffer


def insert_transforms(
    buffer: TransformBuffer, transforms: Iterable[PoseMessage], *, is_static: bool
) -> None:
    """Put the transforms of a message on /tf or /tf_static into a buffer."""
    for transform in transforms:
        buffer.insert(
            transform.frame_id,
            transform.child_frame_id,
            transform.stamp_ns,
            transform.pose,
            is_static=is_static,
        )


def event_in_frame(
    base_frame: str, message: VelocityMessage | ObservationMessage, transforms: TransformBuffer
) -> Event:
    """Return the event as the base has it; as it is where nothing connects their frames."""
    event = message.event
    if not base_frame or message.frame_id in ('', base_frame):
        return event
    try:
        pose = transforms.lookup(base_frame, message.frame_id, event.stamp_ns)
    except TransformError:
        return event
    if isinstance(event, VelocityEvent):
        return move_velocity(event, pose)
    return move_observation(event, pose)
