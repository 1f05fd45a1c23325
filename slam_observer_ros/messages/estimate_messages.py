"""The estimate as ROS messages, the same for the node and for a recording.

``state_messages`` has those of the state, of which there are many more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.messages.markers import MarkerMessages
from slam_observer_ros.messages.outgoing import OutgoingMessages

PATH_SPACING_NS = 100_000_000
"""Least time between two poses of the path, nanoseconds."""


class EstimateMessages:
    """Makes what says where the robot was and its landmarks are, in ``map_frame``.

    Stamps are nanoseconds, poses (4, 4).
    """

    def __init__(self, messages: OutgoingMessages, map_frame: str) -> None:
        self._messages = messages
        self._map_frame = map_frame
        self.markers = MarkerMessages(messages, map_frame)

    def path_pose(self, stamp_ns: int, pose: FloatArray) -> Any:
        """Make one pose of the path."""
        return self._messages.pose_stamped(stamp_ns, self._map_frame, pose)

    def path(self, stamp_ns: int, poses: Sequence[Any]) -> Any:
        """Make a nav_msgs/Path of what :meth:`path_pose` has made."""
        header = self._messages.header(stamp_ns, self._map_frame)
        return self._messages.make('nav_msgs/msg/Path', header=header, poses=list(poses))

    def landmarks(
        self,
        stamp_ns: int,
        ids: IntArray,
        world_points: FloatArray,
        covariances: FloatArray | None,
        velocities: FloatArray,
    ) -> Any:
        """Make a sensor_msgs/PointCloud2 of landmarks; with velocities if one of them moves."""
        moving = velocities if velocities.any() else None
        return self._messages.point_cloud2(
            stamp_ns, self._map_frame, ids, world_points, covariances, moving
        )

    def value(self, value: float) -> Any:
        """Make a std_msgs/Float64."""
        return self._messages.make('std_msgs/msg/Float64', data=float(value))
