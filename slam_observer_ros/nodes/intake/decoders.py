"""Decoders that say once what the messages lack."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.cloud_fields import ID_NAME, missing_ids, read_fields
from slam_observer_ros.messages.detections import no_tags, observed_tags
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.messages.message_types import CLOUD_DECODERS
from slam_observer_ros.messages.poses_and_velocities import (
    decode_odometry_pose,
    decode_odometry_twist,
    decode_transforms,
)

MOVED_M = 0.1
"""How far an odometry's poses go before its velocities can't all be zero, metres."""

WITHOUT_TAG_S = 20.0
"""Time without any fiducial on /tf after which their names may be others."""


class CloudDecoder:
    """Decodes clouds, and says once if their points have no field or channel for ids.

    They are told apart by where they are then, as is wanted, or as a name is misspelt.

    Parameters
    ----------
    node : Node
        Node that logs.
    message_type : str
        One of ``CLOUD_DECODERS``.

    """

    def __init__(self, node: Node, message_type: str) -> None:
        self._node = node
        self._message_type = message_type
        self._is_looked_at = False

    def __call__(self, raw: Buffer, receive_ns: int) -> Measurement[ObservationEvent]:
        """Decode a cloud."""
        message = CLOUD_DECODERS[self._message_type](raw, receive_ns)
        ids = message.event.ids
        if not self._is_looked_at and len(ids) and (ids == UNKNOWN_ID).all():
            self._is_looked_at = True
            self._look(raw)
        return message

    def _look(self, raw: Buffer) -> None:
        names = read_fields(raw, self._message_type).names
        missing = missing_ids(names, self._message_type)
        if missing:
            topic = self._node.resolve_topic_name('landmarks')
            self._node.get_logger().warning(
                f"points on '{topic}' come {missing}: they are told apart by where they are; if "
                f"they have ids, name these '{ID_NAME}'"
            )


class OdometryDecoder:
    """Decodes velocities of odometries, and says once if these are zero though the poses move.

    Parameters
    ----------
    node : Node
        Node that logs.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._is_told = False
        self._first: FloatArray | None = None

    def __call__(self, raw: Buffer, receive_ns: int) -> Measurement[VelocityEvent]:
        """Decode the velocity of a nav_msgs/Odometry."""
        message = decode_odometry_twist(raw, receive_ns)
        # One that has told a velocity will do so again.
        self._is_told = self._is_told or bool(message.event.body_velocity.any())
        if not self._is_told:
            self._look(raw)
        return message

    def _look(self, raw: Buffer) -> None:
        try:
            position = decode_odometry_pose(raw).position
        except MessageError:  # with a quaternion of zeros, say: nobody asked for its pose
            return
        if self._first is None:
            self._first = position
        if np.linalg.norm(position - self._first) > MOVED_M:
            self._is_told = True
            topic = self._node.resolve_topic_name('twist')
            self._node.get_logger().warning(
                f"all velocities on '{topic}' are zero, but its poses move: set velocity_source "
                "to 'pose_differences'"
            )


class TagDecoder:
    """Decodes fiducials on /tf, and says once if no frame is named as they are.

    Parameters
    ----------
    node : Node
        Node that logs.
    tag_frame_prefix : str
        See :func:`.observed_tags`.

    """

    def __init__(self, node: Node, tag_frame_prefix: str) -> None:
        self._node = node
        self._prefix = tag_frame_prefix
        self._tell_at_s = time.monotonic() + WITHOUT_TAG_S
        self._is_told = False
        self._frames: set[str] = set()

    def __call__(self, raw: Buffer, _receive_ns: int) -> list[Measurement[ObservationEvent]]:
        """Decode what of a tf2_msgs/TFMessage are sightings of fiducials."""
        transforms = decode_transforms(raw)
        seen = observed_tags(transforms, self._prefix)
        self._is_told = self._is_told or bool(seen)
        if not self._is_told:
            self._frames |= {transform.child_frame_id for transform in transforms}
            if time.monotonic() > self._tell_at_s:
                self._is_told = True
                told = no_tags(self._prefix, self._frames)
                self._node.get_logger().warning(f'no fiducial seen so far: {told}')
        return seen
