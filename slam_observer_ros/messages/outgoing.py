"""Numpy arrays to ROS messages, each laid out once for what is published and what is recorded.

Stamps are nanoseconds, positions metres, poses (4, 4), body velocities (6,) ordered (Ω, v) in
rad/s and m/s, ids (n,), points (n, 3).
"""

from __future__ import annotations

from collections.abc import Callable
import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import BEARING, MAX_ID, POINT, RANGE, UNKNOWN_ID
from slam_observer_ros.lie import so3
from slam_observer_ros.messages.cdr import encode_string
from slam_observer_ros.messages.clouds import (
    COVARIANCE_NAMES,
    FLOAT32_ID_LIMIT,
    ID_NAME,
    NO_RANGE_NAME,
    POINT_FIELD_FLOAT32,
    POINT_FIELD_UINT32,
    POINT_NAMES,
    RANGE_NAME,
    RANGE_VARIANCE_NAME,
    UNKNOWN_UINT32_ID,
    VELOCITY_NAMES,
)

_MATRIX_TO_UPPER_TRIANGLE = [0, 1, 2, 4, 5, 8]
_PACK_STAMP = struct.Struct('<BBBBiI')


class OutgoingMessages:
    """Makes messages of rclpy's classes or of rosbags', which have the same fields.

    Every float field gets a Python float: rclpy does not check that.

    Parameters
    ----------
    class_of : callable
        Returns the class of a type such as ``geometry_msgs/msg/Pose``.
    octets : callable
        Returns bytes as these classes want them in a field ``uint8[]``.

    """

    def __init__(
        self, class_of: Callable[[str], Callable[..., Any]], octets: Callable[[bytes], Any]
    ) -> None:
        self._class_of = class_of
        self.octets = octets

    def time(self, stamp_ns: int) -> Any:
        """Make a builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
        return self.make('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Make a std_msgs/Header."""
        return self.make('std_msgs/msg/Header', stamp=self.time(stamp_ns), frame_id=frame_id)

    def point(self, position: FloatArray) -> Any:
        """Make a geometry_msgs/Point of a position (3,)."""
        x, y, z = position.tolist()
        return self.make('geometry_msgs/msg/Point', x=x, y=y, z=z)

    def vector(self, components: FloatArray) -> Any:
        """Make a geometry_msgs/Vector3 of its components (3,)."""
        x, y, z = components.tolist()
        return self.make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)

    def quaternion(self, rotation: FloatArray) -> Any:
        """Make a geometry_msgs/Quaternion of a rotation matrix (3, 3)."""
        x, y, z, w = so3.to_quaternion(rotation).tolist()
        return self.make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)

    def pose(self, pose: FloatArray) -> Any:
        """Make a geometry_msgs/Pose."""
        position, orientation = self.point(pose[:3, 3]), self.quaternion(pose[:3, :3])
        return self.make('geometry_msgs/msg/Pose', position=position, orientation=orientation)

    def pose_stamped(self, stamp_ns: int, frame_id: str, pose: FloatArray) -> Any:
        """Make a geometry_msgs/PoseStamped."""
        header = self.header(stamp_ns, frame_id)
        return self.make('geometry_msgs/msg/PoseStamped', header=header, pose=self.pose(pose))

    def transform_stamped(self, stamp_ns: int, parent: str, child: str, pose: FloatArray) -> Any:
        """Make a geometry_msgs/TransformStamped of the pose of ``child`` in ``parent``."""
        transform = self.make(
            'geometry_msgs/msg/Transform',
            translation=self.vector(pose[:3, 3]),
            rotation=self.quaternion(pose[:3, :3]),
        )
        return self.make(
            'geometry_msgs/msg/TransformStamped',
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=transform,
        )

    def twist(self, body_velocity: FloatArray) -> Any:
        """Make a geometry_msgs/Twist."""
        angular, linear = self.vector(body_velocity[:3]), self.vector(body_velocity[3:])
        return self.make('geometry_msgs/msg/Twist', linear=linear, angular=angular)

    def twist_stamped(self, stamp_ns: int, frame_id: str, body_velocity: FloatArray) -> Any:
        """Make a geometry_msgs/TwistStamped."""
        header, twist = self.header(stamp_ns, frame_id), self.twist(body_velocity)
        return self.make('geometry_msgs/msg/TwistStamped', header=header, twist=twist)

    def point_cloud2(
        self,
        stamp_ns: int,
        frame_id: str,
        ids: IntArray,
        points: FloatArray,
        covariances: FloatArray | None = None,
        velocities: FloatArray | None = None,
        kinds: IntArray | None = None,
    ) -> Any:
        """Make a sensor_msgs/PointCloud2: x y z float32, id uint32, and what else is given.

        RViz and Foxglove display these fields. Covariances are (n, 3, 3), m², and velocities of
        the landmarks themselves (n, 3), m/s. ``UNKNOWN_ID`` becomes 2³² - 1; any other id that
        doesn't fit into a uint32 raises a MessageError. Of half points, ``kinds`` (n,), a cloud
        holds ranges alone, or bearings among whole points: others raise a MessageError, too.
        """
        if kinds is not None and len(kinds) and (kinds == RANGE).all():
            columns = _of_ranges(ids, points, covariances)
        else:
            columns = _of_points(ids, points, covariances, velocities, kinds)
        records = _cloud_records(columns)
        fields = [
            self.make(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=4 * index,
                datatype=POINT_FIELD_UINT32 if name in _INTEGERS else POINT_FIELD_FLOAT32,
                count=1,
            )
            for index, name in enumerate(records.dtype.names or ())
        ]
        return self.make(
            'sensor_msgs/msg/PointCloud2',
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(records),
            fields=fields,
            is_bigendian=False,
            point_step=records.itemsize,
            row_step=records.nbytes,
            data=self.octets(records.tobytes()),
            is_dense=True,
        )

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message of a type such as ``geometry_msgs/msg/Pose`` from all its fields."""
        return self._class_of(type_name)(**fields)


def encode_point_cloud(stamp_ns: int, frame_id: str, ids: IntArray, points: FloatArray) -> bytes:
    """Serialise a sensor_msgs/PointCloud with a channel ``id`` as little-endian CDR.

    An rclpy publisher sends such bytes as they are, without an object per point. Raises a
    MessageError if an id isn't exact in float32.
    """
    if np.any((ids < UNKNOWN_ID) | (ids >= FLOAT32_ID_LIMIT)):
        raise MessageError(f'landmark ids in a PointCloud must lie between -1 and {2**24 - 1}')
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
    count = struct.pack('<I', len(points))
    return b''.join(
        (
            _PACK_STAMP.pack(0, 1, 0, 0, seconds, nanoseconds),
            encode_string(frame_id),
            count,
            points.astype('<f4').tobytes(),
            struct.pack('<I', 1),
            encode_string(ID_NAME),
            count,
            ids.astype('<f4').tobytes(),
        )
    )


_INTEGERS = (ID_NAME, NO_RANGE_NAME)
"""Fields that are uint32; the others are float32."""

_Columns: TypeAlias = dict[str, FloatArray | IntArray]


def _of_ids(ids: IntArray) -> _Columns:
    if np.any((ids < UNKNOWN_ID) | (ids > MAX_ID)):
        raise MessageError('landmark ids must lie between 0 and 2³² - 2, or be -1 for unknown')
    return {ID_NAME: ids & UNKNOWN_UINT32_ID}


def _of_points(
    ids: IntArray,
    points: FloatArray,
    covariances: FloatArray | None,
    velocities: FloatArray | None,
    kinds: IntArray | None,
) -> _Columns:
    """Return the fields of whole points, and of bearings among them."""
    columns: _Columns = dict(zip(POINT_NAMES, points.T, strict=True))
    columns |= _of_ids(ids)
    if covariances is not None:
        upper_triangles = covariances.reshape(-1, 9)[:, _MATRIX_TO_UPPER_TRIANGLE]
        columns |= zip(COVARIANCE_NAMES, upper_triangles.T, strict=True)
    if velocities is not None:
        columns |= zip(VELOCITY_NAMES, velocities.T, strict=True)
    if kinds is not None:
        if not np.isin(kinds, (POINT, BEARING)).all():
            raise MessageError('a cloud has no fields for ranges or azimuths beside other points')
        columns[NO_RANGE_NAME] = kinds == BEARING
    return columns


def _of_ranges(ids: IntArray, points: FloatArray, covariances: FloatArray | None) -> _Columns:
    """Return the fields of ranges alone, whose covariance is along their line of sight."""
    ranges = np.linalg.norm(points, axis=1)
    columns: _Columns = _of_ids(ids) | {RANGE_NAME: ranges}
    if covariances is not None:
        along = points / np.maximum(ranges, np.finfo(np.float64).tiny)[:, None]
        columns[RANGE_VARIANCE_NAME] = np.einsum('mi,mij,mj->m', along, covariances, along)
    return columns


def _cloud_records(columns: _Columns) -> NDArray[np.void]:
    """Return one record a point, little endian, every field of four bytes."""
    dtype = [(name, '<u4' if name in _INTEGERS else '<f4') for name in columns]
    records: NDArray[np.void] = np.empty(len(columns[ID_NAME]), dtype=dtype)
    for name, column in columns.items():
        records[name] = column
    return records
