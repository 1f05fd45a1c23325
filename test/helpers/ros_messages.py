"""Builds ROS messages and serialises them with rosbags, apart from the package's decoders.

``OUTGOING`` are the package's own messages, of rosbags' classes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.messages.outgoing import OutgoingMessages

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
STAMP_NS = 1_700_000_000_123_456_789
OUTGOING = OutgoingMessages(
    TYPESTORE.types.__getitem__, lambda data: np.frombuffer(data, np.uint8)
)


def make(message_type: str, *values: object) -> object:
    """Build a message from its fields in order."""
    return TYPESTORE.types[message_type](*values)


def serialise(message: object, little_endian: bool = True) -> bytes:
    """Serialise a message as CDR."""
    message_type = message.__msgtype__  # type: ignore[attr-defined]
    return bytes(TYPESTORE.serialize_cdr(message, message_type, little_endian=little_endian))


def header(frame_id: str, stamp_ns: int = STAMP_NS) -> object:
    """std_msgs/Header."""
    stamp = make('builtin_interfaces/msg/Time', *divmod(stamp_ns, 1_000_000_000))
    return make('std_msgs/msg/Header', stamp, frame_id)


def vector(xyz: Sequence[float]) -> object:
    """geometry_msgs/Vector3."""
    return make('geometry_msgs/msg/Vector3', *xyz)


def twist(body_velocity: Sequence[float]) -> object:
    """geometry_msgs/Twist of an (angular, linear) velocity."""
    return make('geometry_msgs/msg/Twist', vector(body_velocity[3:]), vector(body_velocity[:3]))


def twist_stamped(
    body_velocity: Sequence[float], frame_id: str = 'base_link', stamp_ns: int = STAMP_NS
) -> object:
    """geometry_msgs/TwistStamped of an (angular, linear) velocity."""
    return make('geometry_msgs/msg/TwistStamped', header(frame_id, stamp_ns), twist(body_velocity))


def pose(position: Sequence[float], quaternion: Sequence[float]) -> object:
    """geometry_msgs/Pose."""
    return make(
        'geometry_msgs/msg/Pose',
        make('geometry_msgs/msg/Point', *position),
        make('geometry_msgs/msg/Quaternion', *quaternion),
    )


def odometry(
    body_velocity: Sequence[float],
    covariance: np.ndarray,
    position: Sequence[float] = (1.0, 2.0, 3.0),
    quaternion: Sequence[float] = (0.0, 0.0, 0.6, 0.8),
    frames: tuple[str, str] = ('odom', 'base_link'),
    stamp_ns: int = STAMP_NS,
) -> object:
    """nav_msgs/Odometry with one covariance, in ROS order, for both pose and twist."""
    return make(
        'nav_msgs/msg/Odometry',
        header(frames[0], stamp_ns),
        frames[1],
        make(
            'geometry_msgs/msg/PoseWithCovariance', pose(position, quaternion), covariance.ravel()
        ),
        make('geometry_msgs/msg/TwistWithCovariance', twist(body_velocity), covariance.ravel()),
    )


def imu(
    angular_velocity: Sequence[float],
    covariance: np.ndarray,
    frame_id: str = 'imu',
    stamp_ns: int = STAMP_NS,
) -> object:
    """sensor_msgs/Imu with nothing but an angular velocity."""
    unknown = np.zeros(9)
    return make(
        'sensor_msgs/msg/Imu',
        header(frame_id, stamp_ns),
        make('geometry_msgs/msg/Quaternion', 0.0, 0.0, 0.0, 1.0),
        unknown,
        vector(angular_velocity),
        covariance.ravel(),
        vector([4.0, 5.0, 6.0]),
        unknown,
    )


def point_cloud(
    points: np.ndarray, channels: dict[str, np.ndarray], frame_id: str = 'base_link'
) -> object:
    """sensor_msgs/PointCloud."""
    return make(
        'sensor_msgs/msg/PointCloud',
        header(frame_id),
        [make('geometry_msgs/msg/Point32', *map(float, point)) for point in points],
        [
            make('sensor_msgs/msg/ChannelFloat32', name, values.astype(np.float32))
            for name, values in channels.items()
        ],
    )


def point_cloud2(
    records: np.ndarray,
    frame_id: str = 'base_link',
    row_padding: int = 0,
    is_dense: bool = True,
) -> object:
    """sensor_msgs/PointCloud2 of a structured array (height, width)."""
    datatypes = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
    height, width = records.shape
    fields = [
        make('sensor_msgs/msg/PointField', name, offset, datatypes[dtype.str[1:]], 1)
        for name, (dtype, offset) in records.dtype.fields.items()
    ]
    row_bytes = width * records.dtype.itemsize
    rows = np.frombuffer(records.tobytes(), np.uint8).reshape(height, row_bytes)
    data = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=0xAB)
    is_bigendian = any(dtype.str[0] == '>' for dtype, _ in records.dtype.fields.values())
    return make(
        'sensor_msgs/msg/PointCloud2',
        header(frame_id),
        height,
        width,
        fields,
        is_bigendian,
        records.dtype.itemsize,
        row_bytes + row_padding,
        data.ravel(),
        is_dense,
    )


def transform_stamped(
    frames: tuple[str, str],
    translation: Sequence[float],
    quaternion: Sequence[float],
    stamp_ns: int = STAMP_NS,
) -> object:
    """geometry_msgs/TransformStamped."""
    return make(
        'geometry_msgs/msg/TransformStamped',
        header(frames[0], stamp_ns),
        frames[1],
        make(
            'geometry_msgs/msg/Transform',
            vector(translation),
            make('geometry_msgs/msg/Quaternion', *quaternion),
        ),
    )
