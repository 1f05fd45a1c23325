"""The odometry that others publish on /tf: how the robot moves while nothing else says so."""

from __future__ import annotations

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.inputs.frames import TransformSource
from slam_observer_ros.inputs.transform_buffer import ALWAYS_NS
from slam_observer_ros.settings.node_settings import ObserverNodeSettings


class TransformedOdometry:
    """Where the base is in ``odom_frame``, if that is on /tf."""

    def __init__(self, settings: ObserverNodeSettings, transforms: TransformSource) -> None:
        self._frames = settings.odom_frame, settings.base_frame
        self._transforms = transforms

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp, nanoseconds; None if there is no odometry that moves."""
        newest_ns = self._transforms.newest_ns(*self._frames) if self._frames[0] else None
        return None if newest_ns == ALWAYS_NS else newest_ns

    def pose_until(self, stamp_ns: int) -> FloatArray | None:
        """Return the pose (4, 4) of the base at a stamp, or the newest before; None if unknown."""
        newest_ns = self.newest_ns
        if newest_ns is None:
            return None
        try:
            return self._transforms.lookup(*self._frames, min(stamp_ns, newest_ns))
        except TransformError:
            return None

    def motion(self, start_ns: int, end_ns: int) -> FloatArray | None:
        """Return how the base has moved (4, 4) between two stamps; None if that is not known."""
        start, end = self.pose_until(start_ns), self.pose_until(end_ns)
        return None if start is None or end is None else se3.inverse(start) @ end
