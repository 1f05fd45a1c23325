"""What a cloud without ids has in their place: mostly, a field of another name."""

from __future__ import annotations

from collections.abc import Sequence

from slam_observer_ros.messages.point_cloud_layout import ID_NAME


def missing_ids(names: Sequence[str], message_type: str) -> str:
    """Tell what there is instead of ids; empty if there are ids.

    Parameters
    ----------
    names : sequence of str
        From :func:`slam_observer_ros.messages.point_clouds.field_names`.
    message_type : str
        ``sensor_msgs/msg/PointCloud`` or ``sensor_msgs/msg/PointCloud2``.

    """
    if ID_NAME in names:
        return ''
    kind = 'fields' if message_type.endswith('PointCloud2') else 'channels'
    return f'without ids; {kind} {" ".join(names) or "none"}'
