"""The fields of clouds: their names, and which ones a cloud has, without decoding it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from slam_observer_ros.events import MAX_ID
from slam_observer_ros.messages.cdr import Buffer, CdrReader

ID_NAME = 'id'
POINT_NAMES = ('x', 'y', 'z')
COVARIANCE_NAMES = ('cov_xx', 'cov_xy', 'cov_xz', 'cov_yy', 'cov_yz', 'cov_zz')
VELOCITY_NAMES = ('vx', 'vy', 'vz')

UNKNOWN_UINT32_ID = MAX_ID + 1
"""How an unknown id is written where ids are uint32: the same bits as -1."""

FLOAT32_ID_LIMIT = 2**24
"""From here on float32 can't distinguish neighbouring ids."""

POINT_FIELD_UINT32, POINT_FIELD_FLOAT32 = 6, 7
"""Constants of sensor_msgs/PointField."""


@dataclass(frozen=True, slots=True)
class CloudField:
    """One sensor_msgs/PointField; ``offset`` in bytes from the start of the point."""

    name: str
    offset: int
    datatype: int
    count: int = 1


class CloudFields(NamedTuple):
    """The names of a PointCloud2's fields, or of a PointCloud's channels, and how many points."""

    names: tuple[str, ...]
    points: int


def read_field(reader: CdrReader) -> CloudField:
    """Read the next sensor_msgs/PointField."""
    return CloudField(reader.string(), reader.uint32(), reader.uint8(), reader.uint32())


def read_fields(raw: Buffer, message_type: str) -> CloudFields:
    """Return what a sensor_msgs/msg/PointCloud or PointCloud2 has; MessageError if malformed."""
    reader = CdrReader(raw)
    reader.header()
    if message_type.endswith('PointCloud2'):
        points = reader.uint32() * reader.uint32()
        return CloudFields(tuple(read_field(reader).name for _ in range(reader.uint32())), points)
    points = reader.uint32()
    reader.float32(3 * points)
    names = []
    for _ in range(reader.uint32()):
        names.append(reader.string())
        reader.float32(reader.uint32())
    return CloudFields(tuple(names), points)


def skip_cloud(reader: CdrReader) -> None:
    """Pass over a sensor_msgs/PointCloud2 inside another message."""
    reader.header()
    reader.uint32()  # height
    reader.uint32()  # width
    for _ in range(reader.uint32()):
        read_field(reader)
    reader.uint8()  # is_bigendian
    reader.uint32()  # point_step
    reader.uint32()  # row_step
    reader.data(reader.uint32())
    reader.uint8()  # is_dense


def missing_ids(names: Sequence[str], message_type: str) -> str:
    """Describe what a cloud has instead of ids; empty if there are ids among its ``names``."""
    if ID_NAME in names:
        return ''
    kind = 'fields' if message_type.endswith('PointCloud2') else 'channels'
    return f'without ids; {kind} {" ".join(names) or "none"}'
