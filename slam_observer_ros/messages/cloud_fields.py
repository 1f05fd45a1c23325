"""What a sensor_msgs/PointCloud or PointCloud2 says of its points before these are decoded."""

from __future__ import annotations

from collections.abc import Sequence

from slam_observer_ros.messages.cdr import Buffer, CdrReader
from slam_observer_ros.messages.point_cloud_layout import CloudField, ID_NAME


def read_field(reader: CdrReader) -> CloudField:
    """Read the next sensor_msgs/PointField."""
    return CloudField(reader.string(), reader.uint32(), reader.uint8(), reader.uint32())


def field_names(raw: Buffer, message_type: str) -> tuple[str, ...]:
    """Return what a PointCloud2 tells of its points, or a PointCloud beside where they are.

    Parameters
    ----------
    raw : Buffer
        The serialised message.
    message_type : str
        ``sensor_msgs/msg/PointCloud`` or ``sensor_msgs/msg/PointCloud2``.

    Returns
    -------
    tuple of str
        Names of the fields, or of the channels; with ``id`` the points have ids.

    Raises
    ------
    MessageError
        If the message is malformed.

    """
    reader = CdrReader(raw)
    reader.header()
    if message_type.endswith('PointCloud2'):
        reader.uint32(), reader.uint32()
        return tuple(read_field(reader).name for _ in range(reader.uint32()))
    reader.float32(3 * reader.uint32())
    names = []
    for _ in range(reader.uint32()):
        names.append(reader.string())
        reader.float32(reader.uint32())
    return tuple(names)


def has_points(raw: Buffer, message_type: str) -> bool:
    """Return whether there is a point in a PointCloud or PointCloud2.

    Raises
    ------
    MessageError
        If the message is malformed.

    """
    reader = CdrReader(raw)
    reader.header()
    height = 1 if message_type.endswith('PointCloud') else reader.uint32()
    return height * reader.uint32() > 0


def missing_ids(names: Sequence[str], message_type: str) -> str:
    """Tell what there is instead of ids; empty if there are ids.

    Parameters
    ----------
    names : sequence of str
        From :func:`field_names`.
    message_type : str
        ``sensor_msgs/msg/PointCloud`` or ``sensor_msgs/msg/PointCloud2``.

    """
    if ID_NAME in names:
        return ''
    kind = 'fields' if message_type.endswith('PointCloud2') else 'channels'
    return f'without ids; {kind} {" ".join(names) or "none"}'
