"""The nodes that observer_node is compared with: ``node_subjects.py bare|echo [events]``."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import Twist
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

RELIABLE = QoSProfile(depth=100)


def main(kind: str, executor_kind: str = 'plain') -> None:
    """Receive twist and landmarks, and publish them again or not."""
    rclpy.init()
    node = rclpy.create_node(kind)
    for message_class, topic in ((Twist, 'twist'), (PointCloud2, 'landmarks')):
        callback = echo(node, message_class, topic) if kind == 'echo' else drop
        node.create_subscription(message_class, topic, callback, RELIABLE)
    executor = EventsExecutor() if executor_kind == 'events' else SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.1)  # EventsExecutor.spin hears of no message
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


def echo(node: Node, message_class: Any, topic: str) -> Any:
    """Return what publishes each message of a topic again."""
    return node.create_publisher(message_class, f'echo/{topic}', RELIABLE).publish


def drop(_message: Any) -> None:
    """Do nothing."""


if __name__ == '__main__':
    main(*sys.argv[1:])
