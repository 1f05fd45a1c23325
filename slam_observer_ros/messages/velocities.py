"""Velocities of ROS messages, and the poses that come with an odometry's.

ROS puts linear before angular components; the paper's (9), and all arrays that leave this module,
put angular first.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import AngularVelocityEvent, VelocityEvent
from slam_observer_ros.messages.cdr import CdrReader
from slam_observer_ros.messages.poses import checked_pose, PoseMessage, read_covariance, read_pose
from slam_observer_ros.messages.registry import Decoder, reads

ODOMETRY = 'nav_msgs/msg/Odometry'  # a velocity and a pose


@reads('geometry_msgs/msg/TwistStamped', role='velocity')
def decode_twist_stamped(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/TwistStamped."""
    stamp_ns, frame_id = reader.header()
    return VelocityEvent(stamp_ns, _read_twist(reader), sensor_frame=frame_id)


@reads('geometry_msgs/msg/TwistWithCovarianceStamped', role='velocity')
def decode_twist_with_covariance_stamped(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/TwistWithCovarianceStamped."""
    stamp_ns, frame_id = reader.header()
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=frame_id)


@reads('geometry_msgs/msg/Twist', role='velocity')
def decode_twist(reader: CdrReader) -> VelocityEvent:
    """Read a geometry_msgs/Twist, whose only time is that of its reception."""
    return VelocityEvent(reader.receive_ns, _read_twist(reader))


@reads(ODOMETRY, role='velocity')
def decode_odometry_twist(reader: CdrReader) -> VelocityEvent:
    """Read the twist of a nav_msgs/Odometry, which is in its child frame."""
    stamp_ns, _ = reader.header()
    child_frame_id = reader.string()
    reader.float64(7 + 36)  # The pose and its covariance.
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=child_frame_id)


@reads(ODOMETRY, role='pose')
def decode_odometry_pose(reader: CdrReader) -> PoseMessage:
    """Read the pose of a nav_msgs/Odometry."""
    return checked_pose(_read_odometry(reader)[0])


@Decoder
def decode_odometry(reader: CdrReader) -> tuple[PoseMessage, VelocityEvent]:
    """Read pose, which may be none (``problem``), and twist of a nav_msgs/Odometry."""
    return _read_odometry(reader)


@reads('sensor_msgs/msg/Imu', role='angular velocity')
def decode_imu(reader: CdrReader) -> AngularVelocityEvent:
    """Read the angular velocity of a sensor_msgs/Imu; MessageError if it has none (-1)."""
    stamp_ns, frame_id = reader.header()
    reader.float64(13)  # Orientation and its covariance.
    values = reader.float64(12)
    reader.float64(12)  # Linear acceleration and its covariance.
    covariance = values[3:].reshape(3, 3)
    if covariance[0, 0] == -1.0:
        raise MessageError('this Imu says that it measures no angular velocity')
    known = covariance if covariance.any() else None
    return AngularVelocityEvent(stamp_ns, values[:3], known, sensor_frame=frame_id)


def _read_odometry(reader: CdrReader) -> tuple[PoseMessage, VelocityEvent]:
    stamp_ns, frame_id = reader.header()
    child_frame_id = reader.string()
    pose = PoseMessage(
        stamp_ns, frame_id, child_frame_id, *read_pose(reader), read_covariance(reader)
    )
    velocity, covariance = _read_twist(reader), read_covariance(reader)
    return pose, VelocityEvent(stamp_ns, velocity, covariance, sensor_frame=child_frame_id)


def _read_twist(reader: CdrReader) -> FloatArray:
    values = reader.float64(6)
    return np.concatenate((values[..., 3:], values[..., :3]), axis=-1)
