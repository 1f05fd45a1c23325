"""What a sensor_msgs/PointCloud or PointCloud2 says of its points before these are decoded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.point_cloud_layout import CloudField, ID_NAME


def read_field(reader: CdrReader) -> CloudField:
    """Read the next sensor_msgs/PointField."""
    return CloudField(reader.string(), reader.uint32(), reader.uint8(), reader.uint32())


class CloudFields(NamedTuple):
    """What a cloud has.

    Attributes
    ----------
    names : tuple of str
        What a PointCloud2 tells of its points: the names of its fields. Of a PointCloud the
        channels, which tell what there is beside where they are. With ``id`` the points have ids.
    points : int
        How many points there are.

    """

    names: tuple[str, ...]
    points: int


def read_fields(raw: Buffer, message_type: str) -> CloudFields:
    """Return what a PointCloud or PointCloud2 has.

    Parameters
    ----------
    raw : Buffer
        The serialised message.
    message_type : str
        ``sensor_msgs/msg/PointCloud`` or ``sensor_msgs/msg/PointCloud2``.

    Raises
    ------
    MessageError
        If the message is malformed.

    """
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


def missing_ids(names: Sequence[str], message_type: str) -> str:
    """Tell what there is instead of ids; empty if there are ids.

    Parameters
    ----------
    names : sequence of str
        From :func:`read_fields`.
    message_type : str
        ``sensor_msgs/msg/PointCloud`` or ``sensor_msgs/msg/PointCloud2``.

    """
    if ID_NAME in names:
        return ''
    kind = 'fields' if message_type.endswith('PointCloud2') else 'channels'
    return f'without ids; {kind} {" ".join(names) or "none"}'
