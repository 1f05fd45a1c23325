"""Numpy arrays to ROS messages; every float field gets a Python float."""

from __future__ import annotations

from array import array

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Twist, Vector3
import numpy as np
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.point_cloud_layout import point_cloud2_layout


def time_message(stamp_ns: int) -> Time:
    """Return a stamp in nanoseconds as a message."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_message(stamp_ns: int, frame_id: str) -> Header:
    """Return the header of a message in a frame."""
    return Header(stamp=time_message(stamp_ns), frame_id=frame_id)


def point_message(position: FloatArray) -> Point:
    """Return a position (3,) in metres as a message."""
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


def vector_message(vector: FloatArray) -> Vector3:
    """Return a vector (3,) as a message."""
    x, y, z = vector.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion_message(rotation: FloatArray) -> Quaternion:
    """Return a rotation matrix (3, 3) as a message."""
    x, y, z, w = so3.to_quaternion(rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def pose_message(pose: FloatArray) -> Pose:
    """Return a pose (4, 4) as a message."""
    return Pose(position=point_message(pose[:3, 3]), orientation=quaternion_message(pose[:3, :3]))


def transform_message(pose: FloatArray) -> Transform:
    """Return a pose (4, 4) as a transform message."""
    return Transform(
        translation=vector_message(pose[:3, 3]), rotation=quaternion_message(pose[:3, :3])
    )


def twist_message(body_velocity: FloatArray) -> Twist:
    """Return a body velocity (6,), ordered (Ω, v), as a message."""
    return Twist(
        linear=vector_message(body_velocity[3:]), angular=vector_message(body_velocity[:3])
    )


def pose_covariance_field(covariance: FloatArray | None) -> FloatArray:
    """Return the 36 numbers of a pose covariance field.

    Parameters
    ----------
    covariance : FloatArray or None
        (6, 6) covariance of (rotation vector, position) about the fixed axes, rad² and m²; the
        message wants the position first. None, unknown, is marked by −1 in the first place as in
        sensor_msgs/Imu.

    """
    if covariance is None:
        return unknown_covariance_field()
    order = [3, 4, 5, 0, 1, 2]
    field: FloatArray = covariance[order][:, order].ravel()
    return field


def unknown_covariance_field() -> FloatArray:
    """Return 36 numbers that mark a covariance as unknown: −1 in the first place."""
    field = np.zeros(36)
    field[0] = -1.0
    return field


def point_cloud2_message(
    stamp_ns: int,
    frame_id: str,
    ids: IntArray,
    points: FloatArray,
    covariances: FloatArray | None = None,
    velocities: FloatArray | None = None,
) -> PointCloud2:
    """Return landmarks as a PointCloud2 with fields x, y, z, id and what else is given.

    Parameters
    ----------
    stamp_ns : int
        Time of validity, nanoseconds.
    frame_id : str
        Frame of the points.
    ids : IntArray
        (n,) landmark ids.
    points : FloatArray
        (n, 3) positions, metres.
    covariances : FloatArray or None
        (n, 3, 3) covariances, m².
    velocities : FloatArray or None
        (n, 3) velocities of the landmarks themselves, m/s.

    Raises
    ------
    MessageError
        If an id does not fit into a uint32.

    """
    layout = point_cloud2_layout(ids, points, covariances, velocities)
    return PointCloud2(
        header=header_message(stamp_ns, frame_id),
        height=1,
        width=layout.width,
        fields=[
            PointField(
                name=field.name, offset=field.offset, datatype=field.datatype, count=field.count
            )
            for field in layout.fields
        ],
        is_bigendian=False,
        point_step=layout.point_step,
        row_step=len(layout.data),
        data=array('B', layout.data),
        is_dense=True,
    )
