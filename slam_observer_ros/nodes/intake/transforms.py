"""What /tf and CameraInfo have: transforms, the odometry among them, and cameras; live."""

from __future__ import annotations

from typing import Protocol

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from slam_observer_ros.common.errors import MessageError, TransformError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.detections import CAMERA_INFO, decode_camera_info
from slam_observer_ros.messages.poses import decode_transforms
from slam_observer_ros.nodes.guarded_node import ThrottledLog
from slam_observer_ros.nodes.intake.input_topic import take
from slam_observer_ros.nodes.ros_interface import message_class, TFMessage
from slam_observer_ros.recordings.frames import ALWAYS_NS, insert_transforms, TransformBuffer
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

TF_QOS = QoSProfile(depth=100)
CAMERA_TOPIC = 'camera_info'
CAMERA_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
TF_STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SentTransforms(Protocol):
    """What is published on /tf from here."""

    def is_own(self, raw: bytes) -> bool:
        """Return whether a message heard on /tf came from here; then it is not looked into."""

    def hear(self, parent: str, child: str, stamp_ns: int | None) -> None:
        """Take what was heard from others; without stamp what is static."""


class LiveTransforms:
    """Listens to /tf, /tf_static and camera_info; without tf2_msgs no transform is ever known.

    Parameters
    ----------
    node : Node
    buffer : TransformBuffer
        Takes what is heard.
    own : (str, str)
        Parent and child of the transform that the node itself publishes where nobody else gives
        the child a parent: heard back, it would replace another parent.
    sent : SentTransforms, optional
        What is published from here; None if nothing is.

    """

    def __init__(
        self,
        node: Node,
        buffer: TransformBuffer,
        own: tuple[str, str],
        sent: SentTransforms | None = None,
    ) -> None:
        self._node = node
        self._buffer = buffer
        self._own, self._sent = own, sent
        self._log = ThrottledLog(node)
        self._dynamic: Subscription | None = None
        if TFMessage is not None:
            self._dynamic = self._subscribe('/tf', TF_QOS, is_static=False)
            self._subscribe('/tf_static', TF_STATIC_QOS, is_static=True)
        node.create_subscription(
            message_class(CAMERA_INFO), CAMERA_TOPIC, self._receive_camera, CAMERA_QOS, raw=True
        )

    def read_waiting(self) -> None:
        """Take what has come on /tf: while the node was busy, it may be a lot."""
        if self._dynamic is None:
            return
        for _ in range(TF_QOS.depth):
            taken = take(self._dynamic)
            if taken is None:
                return
            self._dynamic.callback(taken[0])

    def _receive_camera(self, raw: bytes) -> None:
        try:
            frame, camera = decode_camera_info(raw)
        except MessageError as error:
            topic = f"'{self._node.resolve_topic_name(CAMERA_TOPIC)}'"
            self._log.event('malformed_message', CAMERA_TOPIC, topic=topic, error=error)
            return
        self._buffer.cameras[frame.lstrip('/')] = camera

    def _subscribe(self, topic: str, qos: QoSProfile, *, is_static: bool) -> Subscription:
        def receive(raw: bytes) -> None:
            if self._sent is not None and self._sent.is_own(raw):
                return
            try:
                transforms = decode_transforms(raw)
            except MessageError as error:
                self._log.event('malformed_message', topic, topic=f"'{topic}'", error=error)
                return
            if self._sent is not None:
                for each in transforms:
                    stamp_ns = None if is_static else each.stamp_ns
                    self._sent.hear(each.frame_id, each.child_frame_id, stamp_ns)
            others = [t for t in transforms if (t.frame_id, t.child_frame_id) != self._own]
            insert_transforms(self._buffer, others, is_static=is_static)

        return self._node.create_subscription(TFMessage, topic, receive, qos, raw=True)


class TransformedOdometry:
    """Where the base is in ``odom_frame``, if that is on /tf."""

    def __init__(self, settings: ObserverNodeSettings, transforms: TransformBuffer) -> None:
        self._frames = settings.odom_frame, settings.base_frame
        self._transforms = transforms

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp, nanoseconds; None if there is no odometry that moves."""
        newest_ns = self._transforms.newest_ns(*self._frames) if self._frames[0] else None
        return None if newest_ns == ALWAYS_NS else newest_ns

    def pose_until(self, stamp_ns: int) -> FloatArray | None:
        """Return the pose (4, 4) of the base at a stamp, or the newest before; None if unknown."""
        newest_ns = self.newest_ns
        if newest_ns is None:
            return None
        try:
            return self._transforms.lookup(*self._frames, min(stamp_ns, newest_ns))
        except TransformError:
            return None

    def motion(self, start_ns: int, end_ns: int) -> FloatArray | None:
        """Return how the base has moved (4, 4) between two stamps; None if that is not known."""
        start, end = self.pose_until(start_ns), self.pose_until(end_ns)
        return None if start is None or end is None else se3.inverse(start) @ end
