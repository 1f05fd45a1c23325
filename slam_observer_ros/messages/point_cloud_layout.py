"""How observations are laid out as sensor_msgs/PointCloud2 data and PointCloud bytes.

Nodes and recordings share this, so both write the same fields, which RViz and Foxglove display.
"""

from __future__ import annotations

from dataclasses import dataclass
import struct

import numpy as np

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND
from slam_observer_ros.events import MAX_ID, UNKNOWN_ID

ID_NAME = 'id'
POINT_NAMES = ('x', 'y', 'z')
COVARIANCE_NAMES = ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz')
VELOCITY_NAMES = ('vx', 'vy', 'vz')

UNKNOWN_UINT32_ID = MAX_ID + 1
"""How an unknown id is written where ids are uint32: the same bits as -1."""

FLOAT32_ID_LIMIT = 2**24
"""From here on float32 no longer tells neighbouring ids apart."""

POINT_FIELD_UINT32, POINT_FIELD_FLOAT32 = 6, 7
"""Constants of sensor_msgs/PointField."""

_MATRIX_TO_UPPER_TRIANGLE = [0, 1, 2, 4, 5, 8]
_PACK_STAMP = struct.Struct('<BBBBiI')


@dataclass(frozen=True, slots=True)
class CloudField:
    """One sensor_msgs/PointField.

    Attributes
    ----------
    name : str
    offset : int
        Bytes from the start of the point.
    datatype : int
        A PointField constant: 6 is UINT32, 7 FLOAT32.
    count : int
        Elements in the field.

    """

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True, slots=True)
class PointCloud2Layout:
    """What is to be put into a PointCloud2, whatever class makes the message.

    Attributes
    ----------
    fields : tuple of CloudField
    point_step : int
        Bytes a point.
    width : int
        Number of points; the height is 1.
    data : bytes
        The points, little endian.

    """

    fields: tuple[CloudField, ...]
    point_step: int
    width: int
    data: bytes


def point_cloud2_layout(
    ids: IntArray,
    points: FloatArray,
    covariances: FloatArray | None = None,
    velocities: FloatArray | None = None,
) -> PointCloud2Layout:
    """Lay points out for a PointCloud2: x y z float32, id uint32, and what else is given.

    Parameters
    ----------
    ids : IntArray
        (n,) landmark ids; ``UNKNOWN_ID`` becomes 2³² - 1.
    points : FloatArray
        (n, 3) positions, metres.
    covariances : FloatArray or None
        (n, 3, 3) covariances, m².
    velocities : FloatArray or None
        (n, 3) velocities of the landmarks themselves, m/s.

    Raises
    ------
    MessageError
        If an id doesn't fit into a uint32.

    """
    if np.any((ids < UNKNOWN_ID) | (ids > MAX_ID)):
        raise MessageError('landmark ids must lie between 0 and 2³² - 2, or be -1 for unknown')
    columns: dict[str, FloatArray] = dict(zip(POINT_NAMES, points.T, strict=True))
    if covariances is not None:
        upper_triangles = covariances.reshape(-1, 9)[:, _MATRIX_TO_UPPER_TRIANGLE]
        columns |= zip(COVARIANCE_NAMES, upper_triangles.T, strict=True)
    if velocities is not None:
        columns |= zip(VELOCITY_NAMES, velocities.T, strict=True)
    names = [*POINT_NAMES, ID_NAME, *list(columns)[len(POINT_NAMES) :]]
    records = np.empty(
        len(points), dtype=[(name, '<u4' if name == ID_NAME else '<f4') for name in names]
    )
    records[ID_NAME] = ids & UNKNOWN_UINT32_ID
    for name, column in columns.items():
        records[name] = column
    fields = tuple(
        CloudField(name, 4 * index, POINT_FIELD_UINT32 if name == ID_NAME else POINT_FIELD_FLOAT32)
        for index, name in enumerate(names)
    )
    return PointCloud2Layout(fields, records.itemsize, len(points), records.tobytes())


def encode_point_cloud(stamp_ns: int, frame_id: str, ids: IntArray, points: FloatArray) -> bytes:
    """Serialise a sensor_msgs/PointCloud with a channel ``id`` as little-endian CDR.

    An rclpy publisher sends such bytes as they are, without an object per point.

    Parameters
    ----------
    stamp_ns : int
        Time of the observation, nanoseconds.
    frame_id : str
        Frame of the points.
    ids : IntArray
        (n,) landmark ids.
    points : FloatArray
        (n, 3) positions, metres.

    Raises
    ------
    MessageError
        If an id isn't exact in float32.

    """
    if np.any((ids < UNKNOWN_ID) | (ids >= FLOAT32_ID_LIMIT)):
        raise MessageError(f'landmark ids in a PointCloud must lie between -1 and {2**24 - 1}')
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS_PER_SECOND)
    count = struct.pack('<I', len(points))
    return b''.join(
        (
            _PACK_STAMP.pack(0, 1, 0, 0, seconds, nanoseconds),
            _encode_string(frame_id),
            count,
            points.astype('<f4').tobytes(),
            struct.pack('<I', 1),
            _encode_string(ID_NAME),
            count,
            ids.astype('<f4').tobytes(),
        )
    )


def _encode_string(text: str) -> bytes:
    """Serialise a string, with padding so that a 4-byte value may follow."""
    characters = text.encode() + b'\0'
    return struct.pack('<I', len(characters)) + characters + bytes(-len(characters) % 4)
