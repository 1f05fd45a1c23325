"""Transforms on /tf and /tf_static, where tf2_msgs is installed."""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.nodes.publishing.conversions import header_message, transform_message

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # No wheel of it exists; scripts/build_tf2_msgs.py builds it.
    TFMessage = None

__all__ = ['TFMessage', 'TransformPublisher']


class TransformPublisher:
    """Publishes single transforms; without tf2_msgs it says so once and does nothing.

    Parameters
    ----------
    node : Node
        Node that publishes.
    topic : str
        ``/tf`` or ``/tf_static``.
    qos : QoSProfile
        Volatile for the one, latched for the other.

    """

    def __init__(self, node: Node, topic: str, qos: QoSProfile) -> None:
        self._publisher = None
        if TFMessage is None:
            node.get_logger().warning(f'tf2_msgs is not installed: nothing goes out on {topic}')
        else:
            self._publisher = node.create_publisher(TFMessage, topic, qos)

    def publish(self, stamp_ns: int, parent: str, child: str, pose: FloatArray) -> None:
        """Publish the pose (4, 4) of frame ``child`` in frame ``parent``."""
        if self._publisher is None:
            return
        transform = TransformStamped(
            header=header_message(stamp_ns, parent),
            child_frame_id=child,
            transform=transform_message(pose),
        )
        self._publisher.publish(TFMessage(transforms=[transform]))
