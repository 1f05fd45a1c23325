"""Velocities that no single message holds: from two poses."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.units import to_s
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3

POSE_JUMP = 'pose_jump'
"""Reason under which a difference of poses is dropped that no robot can have moved by."""

MAX_SPEED = 50.0
"""Beyond this, rad/s or m/s, it was not the robot that moved: its odometry was reset."""

MIN_JUMP = 0.1
"""Rad or m up to which two poses may differ in any time: a stamp may be off."""


class PoseDifferences:
    """Turns poses of the base in a smooth frame, as odometry gives them, into velocities.

    The velocity from one pose to the next has the stamp of the first: held until the second, it
    leads exactly there. It is known one period late, which the reorder window must cover. Poses
    further apart than ``timeout_ns`` give none.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self._last: tuple[int, FloatArray] | None = None

    def add(self, stamp_ns: int, pose: FloatArray) -> VelocityEvent | None:
        """Take a pose (4, 4); return the velocity since the one before, if there is one.

        A jump is an InvalidEventError, reason :data:`POSE_JUMP`; the next velocity is from there.
        """
        last, self._last = self._last, (stamp_ns, pose)
        if last is None or not 0 < stamp_ns - last[0] <= self._timeout_ns:
            return None
        motion = se3.log(se3.inverse(last[1]) @ pose)
        duration_s = to_s(stamp_ns - last[0])
        _check_plausible(motion, duration_s)
        return VelocityEvent(last[0], motion / duration_s, is_mean=True)


def _check_plausible(motion: FloatArray, duration_s: float) -> None:
    turn, way = np.linalg.norm(motion.reshape(2, 3), axis=1).tolist()
    if max(turn, way) > max(MAX_SPEED * duration_s, MIN_JUMP):
        raise InvalidEventError(
            POSE_JUMP,
            f"the odometry's pose has jumped, by {way:.2f} m and {turn:.2f} rad in "
            f'{duration_s:.3f} s: it was reset, and how the robot moved meanwhile is not known',
        )
