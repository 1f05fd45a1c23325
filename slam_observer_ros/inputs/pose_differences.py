"""Velocities that no single message holds: from two poses."""

from __future__ import annotations

from collections import deque

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.stamps import NEAR_NS, StrayStamps, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3

POSE_JUMP = 'pose_jump'
"""Reason under which a difference of poses is dropped that no robot can have moved by."""

SKIPPED = 'skipped_pose'
"""Reason under which poses are counted whose motion counts with that of the next one."""

MAX_SPEED = 50.0
"""Beyond this, rad/s or m/s, it was not the robot that moved: its odometry was reset."""

MIN_JUMP = 0.1
"""Rad or m up to which two poses may differ in any time: a stamp may be off."""

SHORT = 0.5
"""Share of the time that so many poses usually take: in less, they were stamped on arrival."""

RECENT = 50
"""Poses over which that time is taken."""

PAUSE_NS = 500_000_000
"""Time without poses that is no interval of bursts, nanoseconds."""


class PoseDifferences:
    """Turns poses of the base in a smooth frame, as odometry gives them, into velocities.

    The velocity from one pose to the next has the stamp of the first: held until the second, it
    leads exactly there. It is known one period late, which the reorder window must cover. Poses
    further apart than ``timeout_ns`` give none.

    A pose whose stamp is not clearly later than that of the one before, as of a coarse clock or in
    a burst that is stamped as it arrives, is skipped: the next velocity leads on from the last one
    that was used, so that no motion is lost and no speed is made up.
    """

    def __init__(self, timeout_ns: int) -> None:
        self._timeout_ns = timeout_ns
        self.clear()

    def clear(self) -> None:
        """Forget the poses, as after a jump of the clock: nothing leads on from them."""
        self._used: tuple[int, FloatArray] | None = None
        self._before_pause: tuple[int, FloatArray] | None = None
        self._stamps_ns: deque[int] = deque(maxlen=RECENT)
        self._skipped = 0  # since the last one that was used
        self._strays = StrayStamps()

    def add(self, stamp_ns: int, pose: FloatArray) -> VelocityEvent | None:
        """Take a pose (4, 4); return the velocity since the last one that was used, if any.

        What is skipped is an InvalidEventError, reason :data:`SKIPPED`. So is a jump, reason
        :data:`POSE_JUMP`; the next velocity is from there.
        """
        last = self._last_before(stamp_ns)
        if last is None:
            self._begin(stamp_ns, pose)
            return None
        duration_ns = stamp_ns - last[0]
        if duration_ns > self._timeout_ns:
            self._begin(stamp_ns, pose, before=last)
            return None
        self._refuse_stamp(stamp_ns, duration_ns)
        motion = se3.log(se3.inverse(last[1]) @ pose)
        self._used = stamp_ns, pose
        _check_plausible(motion, to_s(duration_ns))
        return VelocityEvent(last[0], motion / to_s(duration_ns), is_mean=True)

    def _last_before(self, stamp_ns: int) -> tuple[int, FloatArray] | None:
        """Return the last pose used; the one before a pause if the stamp after it was wrong."""
        used, before = self._used, self._before_pause
        if used is not None and before is not None and before[0] < stamp_ns < used[0]:
            self._begin(*before)
            return before
        if used is not None and stamp_ns < used[0] - NEAR_NS and self._strays.add(stamp_ns):
            return None  # the clock has jumped back
        return used

    def _begin(
        self,
        stamp_ns: int,
        pose: FloatArray,
        before: tuple[int, FloatArray] | None = None,
    ) -> None:
        self.clear()
        self._used, self._before_pause = (stamp_ns, pose), before
        self._stamps_ns.append(stamp_ns)

    def _refuse_stamp(self, stamp_ns: int, duration_ns: int) -> None:
        """Refuse a stamp that is not clearly later than that of the last pose used."""
        stamps_ns = self._stamps_ns
        if stamp_ns > stamps_ns[-1] + PAUSE_NS:
            stamps_ns.clear()
        stamps_ns.append(max(stamp_ns, stamps_ns[-1]) if stamps_ns else stamp_ns)
        usual_ns = (stamps_ns[-1] - stamps_ns[0]) / max(len(stamps_ns) - 1, 1)
        if duration_ns > 0 and duration_ns >= SHORT * (self._skipped + 1) * usual_ns:
            self._skipped = 0
            self._strays.clear()
            return
        self._skipped += 1
        raise InvalidEventError(
            SKIPPED,
            f'its stamp is {to_s(duration_ns):.4f} s after that of the last pose used, where '
            f'{to_s(round(usual_ns)):.4f} s are usual: how it moved counts with the next one',
        )


def _check_plausible(motion: FloatArray, duration_s: float) -> None:
    turn, way = np.linalg.norm(motion.reshape(2, 3), axis=1).tolist()
    if max(turn, way) > max(MAX_SPEED * duration_s, MIN_JUMP):
        raise InvalidEventError(
            POSE_JUMP,
            f"the odometry's pose has jumped, by {way:.2f} m and {turn:.2f} rad in "
            f'{duration_s:.3f} s: it was reset, and how the robot moved meanwhile is not known',
        )
