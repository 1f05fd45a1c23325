"""The estimate as ROS messages, the same for the node and for a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.messages.markers import MarkerMessages
from slam_observer_ros.messages.outgoing import OutgoingMessages

PATH_SPACING_NS = 100_000_000
"""Least time between two poses of the path, nanoseconds."""


class EstimateMessages:
    """Makes what says where the robot and its landmarks are, in ``map_frame``.

    Stamps are nanoseconds, poses (4, 4) of ``base_frame``, body velocities (6,) ordered (Ω, v),
    and covariances (6, 6), None if unknown.
    """

    def __init__(self, messages: OutgoingMessages, map_frame: str, base_frame: str) -> None:
        self._messages = messages
        self._map_frame, self._base_frame = map_frame, base_frame
        self.markers = MarkerMessages(messages, map_frame)

    def pose(self, stamp_ns: int, pose: FloatArray, covariance: FloatArray | None) -> Any:
        """Make a geometry_msgs/PoseWithCovarianceStamped."""
        return self._messages.make(
            'geometry_msgs/msg/PoseWithCovarianceStamped',
            header=self._messages.header(stamp_ns, self._map_frame),
            pose=self._messages.pose_with_covariance(pose, covariance),
        )

    def odometry(
        self, uncertain: Any, body_velocity: FloatArray, covariance: FloatArray | None
    ) -> Any:
        """Make a nav_msgs/Odometry of what :meth:`pose` has made."""
        return self._messages.make(
            'nav_msgs/msg/Odometry',
            header=uncertain.header,
            child_frame_id=self._base_frame,
            pose=uncertain.pose,
            twist=self._messages.twist_with_covariance(body_velocity, covariance),
        )

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

    def transform(self, stamp_ns: int, pose: FloatArray) -> Any:
        """Make a tf2_msgs/TFMessage of the base in the map."""
        transform = self._messages.transform_stamped(
            stamp_ns, self._map_frame, self._base_frame, pose
        )
        return self._messages.make('tf2_msgs/msg/TFMessage', transforms=[transform])
