"""Velocities that no single message holds: from two poses."""

from __future__ import annotations

from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.types import FloatArray
from slam_observer_ros.units import to_s


class PoseDifferences:
    """Turns poses of the base in a smooth frame, as odometry gives them, into velocities.

    The velocity from one pose to the next has the stamp of the first: held until the second, it
    leads exactly there. It is known one period late, which the reorder window must cover.

    Parameters
    ----------
    timeout_ns : int
        Poses further apart than this give no velocity, nanoseconds.

    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._last: tuple[int, FloatArray] | None = None

    def add(self, stamp_ns: int, pose: FloatArray) -> VelocityEvent | None:
        """Take a pose (4, 4); return the velocity since the one before, if there is one."""
        last, self._last = self._last, (stamp_ns, pose)
        if last is None or not 0 < stamp_ns - last[0] <= self._timeout_ns:
            return None
        motion = se3.log(se3.inverse(last[1]) @ pose)
        return VelocityEvent(last[0], motion / to_s(stamp_ns - last[0]))
