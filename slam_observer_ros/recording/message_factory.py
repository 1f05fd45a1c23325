"""ROS messages out of numpy, for recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND
from slam_observer_ros.geometry import so3
from slam_observer_ros.messages.point_cloud_layout import PointCloud2Layout


class MessageFactory:
    """Makes messages as rosbags defines them.

    Attributes
    ----------
    typestore : Typestore
        The definitions.

    """

    def __init__(self) -> None:
        self.typestore = get_typestore(Stores.ROS2_JAZZY)

    def make(self, message_type: str, *fields: Any) -> Any:
        """Make a message of a type from its fields in order."""
        return self.typestore.types[message_type](*fields)

    def header(self, stamp_ns: int, frame_id: str) -> object:
        """Make a std_msgs/Header."""
        stamp = self.make('builtin_interfaces/msg/Time', *divmod(stamp_ns, NANOSECONDS_PER_SECOND))
        return self.make('std_msgs/msg/Header', stamp, frame_id)

    def twist(self, body_velocity: FloatArray) -> object:
        """Make a geometry_msgs/Twist of a velocity (6,), angular then linear."""
        components = body_velocity.tolist()
        return self.make(
            'geometry_msgs/msg/Twist',
            self.make('geometry_msgs/msg/Vector3', *components[3:]),
            self.make('geometry_msgs/msg/Vector3', *components[:3]),
        )

    def pose(self, pose: FloatArray) -> object:
        """Make a geometry_msgs/Pose of a transform (4, 4)."""
        return self.make(
            'geometry_msgs/msg/Pose',
            self.make('geometry_msgs/msg/Point', *pose[:3, 3].tolist()),
            self.make('geometry_msgs/msg/Quaternion', *so3.to_quaternion(pose[:3, :3]).tolist()),
        )

    def point_cloud2(self, stamp_ns: int, frame_id: str, layout: PointCloud2Layout) -> object:
        """Make a sensor_msgs/PointCloud2."""
        fields = [
            self.make('sensor_msgs/msg/PointField', f.name, f.offset, f.datatype, f.count)
            for f in layout.fields
        ]
        return self.make(
            'sensor_msgs/msg/PointCloud2',
            self.header(stamp_ns, frame_id),
            1,
            layout.width,
            fields,
            False,
            layout.point_step,
            layout.point_step * layout.width,
            np.frombuffer(layout.data, np.uint8),
            True,
        )
