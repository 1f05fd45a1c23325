"""The message types that are read, live and recorded, and what decodes each of them.

Of types that are equally right, where a live topic carries several, the first one is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.detections import decode_detections, decode_pose_array
from slam_observer_ros.messages.fiducial_arrays import (
    decode_aruco_detection,
    decode_aruco_markers,
    decode_isaac_apriltags,
)
from slam_observer_ros.messages.measurement import Measurement
from slam_observer_ros.messages.point_clouds import decode_point_cloud, decode_point_cloud2
from slam_observer_ros.messages.poses_and_velocities import (
    decode_odometry_pose,
    decode_odometry_twist,
    decode_pose_stamped,
    decode_pose_with_covariance_stamped,
    decode_transform_stamped,
    decode_twist,
    decode_twist_stamped,
    decode_twist_with_covariance_stamped,
    PoseMessage,
)

ODOMETRY = 'nav_msgs/msg/Odometry'  # a velocity and a pose
IMU = 'sensor_msgs/msg/Imu'  # an angular velocity
TRANSFORMS = 'tf2_msgs/msg/TFMessage'  # poses of sensors, and landmarks if they are fiducials
APRILTAGS = 'apriltag_msgs/msg/AprilTagDetectionArray'  # ids of fiducials that /tf has
POSE_ARRAY = 'geometry_msgs/msg/PoseArray'  # landmarks without ids; it may hold other things

VelocityDecoder: TypeAlias = Callable[[Buffer, int], Measurement[VelocityEvent]]
"""From the serialised message and its receive time, which only unstamped messages use."""

ObservationDecoder: TypeAlias = Callable[[Buffer, int], Measurement[ObservationEvent]]
"""As :data:`VelocityDecoder`, for landmarks."""

PoseDecoder: TypeAlias = Callable[[Buffer], PoseMessage]

VELOCITY_DECODERS: dict[str, VelocityDecoder] = {
    'geometry_msgs/msg/TwistStamped': decode_twist_stamped,
    'geometry_msgs/msg/TwistWithCovarianceStamped': decode_twist_with_covariance_stamped,
    'geometry_msgs/msg/Twist': decode_twist,
    ODOMETRY: decode_odometry_twist,
}
"""Types that give a velocity."""

CLOUD_DECODERS: dict[str, ObservationDecoder] = {
    'sensor_msgs/msg/PointCloud2': decode_point_cloud2,
    'sensor_msgs/msg/PointCloud': decode_point_cloud,
}
"""Clouds, which give landmarks, measured or true."""

DETECTION_DECODERS: dict[str, ObservationDecoder] = {
    POSE_ARRAY: decode_pose_array,
    'vision_msgs/msg/Detection3DArray': decode_detections,
    'isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray': decode_isaac_apriltags,
    'aruco_opencv_msgs/msg/ArucoDetection': decode_aruco_detection,
    'ros2_aruco_interfaces/msg/ArucoMarkers': decode_aruco_markers,
    'aruco_interfaces/msg/ArucoMarkers': decode_aruco_markers,
}
"""Types, beside clouds, that give landmark observations by themselves."""

POSE_DECODERS: dict[str, PoseDecoder] = {
    'geometry_msgs/msg/PoseStamped': decode_pose_stamped,
    'geometry_msgs/msg/PoseWithCovarianceStamped': decode_pose_with_covariance_stamped,
    'geometry_msgs/msg/TransformStamped': decode_transform_stamped,
    ODOMETRY: decode_odometry_pose,
}
"""Types that give a pose."""
