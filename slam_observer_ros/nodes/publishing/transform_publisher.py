"""Transforms on /tf and /tf_static, where tf2_msgs is installed."""

from __future__ import annotations

from collections import deque

from rclpy.node import Node
from rclpy.qos import QoSProfile

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.messages.state_messages import encode_transform

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # No wheel of it exists; scripts/build_tf2_msgs.py builds it.
    TFMessage = None

SENT = 10  # messages that may be on their way back at once

__all__ = ['TFMessage', 'TransformPublisher']


class TransformPublisher:
    """Publishes single transforms on ``/tf``, or latched on ``/tf_static``.

    Without tf2_msgs it logs so once and does nothing. ``sent`` are the last messages.
    """

    def __init__(self, node: Node, topic: str, qos: QoSProfile) -> None:
        self.sent: deque[bytes] = deque(maxlen=SENT)
        self._publisher = None
        if TFMessage is None:
            node.get_logger().warning(f'tf2_msgs is not installed: nothing goes out on {topic}')
        else:
            self._publisher = node.create_publisher(TFMessage, topic, qos)

    @property
    def can_publish(self) -> bool:
        """Whether transforms go out."""
        return self._publisher is not None

    def publish(self, stamp_ns: int, parent: str, child: str, pose: FloatArray) -> None:
        """Publish the pose (4, 4) of frame ``child`` in frame ``parent``."""
        if self._publisher is not None:
            message = encode_transform(stamp_ns, parent, child, pose)
            self.sent.append(message)
            self._publisher.publish(message)
