"""Transforms from /tf and /tf_static, and measurements brought into the base frame by them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from slam_observer_ros.errors import MessageError, TransformError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.extrinsics import move_observation, move_velocity, pose_from_rpy
from slam_observer_ros.nodes.settings import ObserverNodeSettings
from slam_observer_ros.nodes.transforms import TFMessage
from slam_observer_ros.recording.detections import TagDetections
from slam_observer_ros.recording.frames import insert_transforms
from slam_observer_ros.recording.messages import (
    decode_transforms,
    ImuMessage,
    pose_matrices,
    VelocityMessage,
)
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.transform_buffer import TransformBuffer
from slam_observer_ros.types import FloatArray

try:
    import tf2_ros
except ImportError:  # No wheel of it exists; TopicTransforms does the same.
    tf2_ros = None

MeasuredT = TypeVar('MeasuredT', ObservationEvent, VelocityEvent, ImuMessage)

TF_QOS = QoSProfile(depth=100)
TF_STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TransformSource(Protocol):
    """Where transforms come from."""

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) of frame ``source`` in frame ``target``.

        Raises
        ------
        TransformError
            If it is not known at that time.

        """

    def clear(self) -> None:
        """Forget what has a time, after a jump of the clock."""


class TopicTransforms:
    """A listener of /tf and /tf_static of our own.

    Parameters
    ----------
    node : Node
        Node that subscribes; without tf2_msgs no transform is ever known.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer = TransformBuffer()
        self.lookup = self._buffer.lookup
        self.clear = self._buffer.clear
        if TFMessage is not None:
            self._subscribe('/tf', TF_QOS, is_static=False)
            self._subscribe('/tf_static', TF_STATIC_QOS, is_static=True)

    def _subscribe(self, topic: str, qos: QoSProfile, *, is_static: bool) -> None:
        def receive(raw: bytes) -> None:
            try:
                transforms = decode_transforms(raw)
            except MessageError as error:
                self._node.get_logger().warning(
                    f"malformed message on '{topic}' dropped: {error}", throttle_duration_sec=10.0
                )
                return
            insert_transforms(self._buffer, transforms, is_static=is_static)

        self._node.create_subscription(TFMessage, topic, receive, qos, raw=True)


class Tf2Transforms:
    """tf2_ros's buffer and listener.

    Parameters
    ----------
    node : Node
        Node that subscribes.

    """

    def __init__(self, node: Node) -> None:
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self.clear: Callable[[], None] = self._buffer.clear

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """As :meth:`TransformSource.lookup`."""
        try:
            stamped = self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns))
        except tf2_ros.TransformException as error:
            raise TransformError(str(error)) from error
        position, q = stamped.transform.translation, stamped.transform.rotation
        return pose_matrices(
            np.array([position.x, position.y, position.z]), np.array([q.x, q.y, q.z, q.w])
        )


def open_transforms(node: Node) -> TransformSource:
    """Return tf2_ros's buffer where ROS provides it, else a listener of our own."""
    return TopicTransforms(node) if tf2_ros is None else Tf2Transforms(node)


class BaseFrame:
    """Brings measurements into the base frame.

    A message without frame is taken to be in the base frame already.

    Parameters
    ----------
    settings : ObserverNodeSettings
        Frames, and the pose of the sensor if it isn't on /tf.
    transforms : TransformSource
        Where the sensors are.

    """

    def __init__(self, settings: ObserverNodeSettings, transforms: TransformSource) -> None:
        self._transforms = transforms
        self._base_frame = settings.base_frame
        self._world_frames = (settings.map_frame, settings.odom_frame)
        self._sensor_frame = settings.sensor_frame
        self._tag_frame_prefix = settings.tag_frame_prefix
        self._sensor_pose: FloatArray | None = None
        if any(settings.sensor_pose):
            self._sensor_pose = pose_from_rpy(settings.sensor_pose)

    def observation(self, message: ObservationMessage) -> ObservationEvent:
        """Return landmarks in the base frame.

        Raises
        ------
        TransformError
            If the sensor's pose is not known (yet).

        """
        if self._sensor_pose is not None:
            return move_observation(message.event, self._sensor_pose)
        frame_id = self._sensor_frame or message.frame_id
        return self._moved(move_observation, message.event, frame_id)

    def tags(self, detections: TagDetections) -> ObservationEvent:
        """Return where /tf has the fiducials of a detection message, in the base frame.

        Raises
        ------
        TransformError
            If one of them is not known (yet).

        """
        camera_frame = self._sensor_frame or detections.frame_id
        points = [
            self._tag_position(camera_frame, family, number, detections.stamp_ns)
            for family, number in zip(detections.families, detections.ids, strict=True)
        ]
        ids = np.array(detections.ids, dtype=np.int64)
        event = ObservationEvent(detections.stamp_ns, ids, np.array(points).reshape(-1, 3))
        return self.observation(ObservationMessage(camera_frame, event))

    def velocity(self, message: VelocityMessage) -> VelocityEvent:
        """Return the velocity of the base.

        Raises
        ------
        TransformError
            If the pose of the message's frame is not known (yet), or it is no part of the robot.

        """
        if message.frame_id in self._world_frames:
            raise TransformError(f"'{message.frame_id}' does not move with the robot")
        return self._moved(move_velocity, message.event, message.frame_id)

    def angular_velocity(self, message: ImuMessage) -> ImuMessage:
        """Return an angular velocity in the base frame's axes.

        Raises
        ------
        TransformError
            If the sensor's pose is not known (yet).

        """
        return self._moved(_turn_imu, message, message.frame_id)

    def _moved(
        self,
        move: Callable[[MeasuredT, FloatArray], MeasuredT],
        measured: MeasuredT,
        frame_id: str,
    ) -> MeasuredT:
        if frame_id.lstrip('/') in ('', self._base_frame):
            return measured
        return move(
            measured, self._transforms.lookup(self._base_frame, frame_id, measured.stamp_ns)
        )

    def _tag_position(self, camera: str, family: str, number: int, stamp_ns: int) -> FloatArray:
        """Return where a tag is in the camera's frame (3,), under either of its names."""
        try:
            return self._transforms.lookup(camera, f'{family}:{number}', stamp_ns)[:3, 3]
        except TransformError:
            frame = f'{self._tag_frame_prefix}{number}'
            return self._transforms.lookup(camera, frame, stamp_ns)[:3, 3]


def _turn_imu(message: ImuMessage, pose: FloatArray) -> ImuMessage:
    R = pose[:3, :3]
    covariance = None if message.covariance is None else R @ message.covariance @ R.T
    return ImuMessage(message.stamp_ns, message.frame_id, R @ message.angular_velocity, covariance)
