"""Classes of ROS messages, imported when they are needed, and the topics' qualities of service."""

from __future__ import annotations

from array import array
from functools import cache
import importlib
from importlib.util import find_spec
import os
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.messages.outgoing import OutgoingMessages

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # No wheel of it exists; scripts/build_tf2_msgs.py builds it.
    TFMessage = None


@cache
def message_class(type_name: str) -> Any:
    """Import a type such as ``sensor_msgs/msg/Imu``; ParameterError without its package."""
    package, _, name = type_name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except ImportError as error:
        raise ParameterError(
            f'{type_name} needs the package {package}: {install_command(package)}, or source the '
            'workspace that has it'
        ) from error


def is_installed(type_name: str) -> bool:
    """Return whether the package of a message type is there; it is not imported."""
    return find_spec(type_name.partition('/')[0]) is not None


def install_command(package: str) -> str:
    """Return how a package of the ROS distribution at hand is installed."""
    distribution = os.environ.get('ROS_DISTRO', '$ROS_DISTRO')  # a shell puts it in, too
    return f'apt install ros-{distribution}-{package.replace("_", "-")}'


MESSAGES = OutgoingMessages(message_class, lambda data: array('B', data))
"""Makes what the nodes publish."""


RELIABLE_QOS = QoSProfile(depth=10)
"""Out: any subscriber fits a reliable publisher."""

LATCHED_POSE_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: as AMCL's pose; a late subscriber gets the last ones, as many as it keeps itself."""

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: a subscriber that comes late gets the last message."""
