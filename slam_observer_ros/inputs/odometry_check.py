"""Whether the twist of an odometry says the same as its poses: both come in one message."""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.messages.poses import PoseMessage

MAX_PAUSE_S = 1.0  # between two messages: how the robot moved meanwhile no twist says
WAY_M, TURN_RAD = 0.1, 0.3  # length of a stretch over which both are compared
COS_TURN = math.cos(TURN_RAD)
COMPARED = 10  # stretches of this kind that it takes to say something
TURNED_RAD = 0.5  # a smaller heading does not show whose axes they are
MAX_DISAGREEMENT = 0.25  # squared, relative: half of the way; noise and slip are less
FITS = 0.1  # share of the squared error that is left where another reading is right
MAX_SPEED = 50.0  # m/s; beyond it the poses were reset


class OdometryCheck:
    """Compares ways by twists with ways by poses until it is clear whether they agree.

    Parameters
    ----------
    uses_turn : bool
        Whether turns are compared, too: not where those of an Imu take their place.

    Attributes
    ----------
    problem : str
        What the twist is, as the poses show; empty if they agree, or it is not known yet.
    is_decided : bool
        Whether that won't change any more.

    """

    def __init__(self, uses_turn: bool = True) -> None:
        self._uses_turn = uses_turn
        self.problem = ''
        self.is_decided = False
        self._last: tuple[int, FloatArray] | None = None  # stamp, twist
        # Sums of squares over stretches, and their number: of all, and of those that are turned.
        self._all, self._turned = _Sums(), _Sums()
        self._start = self._by_twist = np.eye(4)
        self._along_frame = np.zeros(3)
        self._duration_s = 0.0

    def add(self, message: PoseMessage, event: VelocityEvent) -> None:
        """Take pose and twist of a message."""
        if self.is_decided or message.problem:
            return
        stamp_ns, V, pose = event.stamp_ns, event.body_velocity, message.pose
        if not np.isfinite(V).all():
            return
        last, self._last = self._last, (stamp_ns, V)
        dt_s = 0.0 if last is None else to_s(stamp_ns - last[0])
        if last is None or not 0.0 < dt_s <= MAX_PAUSE_S:
            self._begin(pose)
            return
        self._by_twist = self._by_twist @ se3.exp(dt_s * last[1])
        self._along_frame = self._along_frame + dt_s * last[1][3:]
        self._duration_s += dt_s
        self._compare(message, pose)

    def _begin(self, pose: FloatArray) -> None:
        self._start = pose
        self._by_twist, self._along_frame = np.eye(4), np.zeros(3)
        self._duration_s = 0.0

    def _compare(self, message: PoseMessage, pose: FloatArray) -> None:
        by_poses = se3.inverse(self._start) @ pose
        motions = by_poses, self._by_twist
        if not any(_is_long(motion) for motion in motions):
            return
        # Poses that are not filled in say nothing, and nor do those that were reset.
        has_moved = bool((pose != self._start).any())
        if has_moved and np.linalg.norm(by_poses[:3, 3]) < MAX_SPEED * self._duration_s:
            R = self._start[:3, :3]
            along_frame = R.T @ self._along_frame
            is_turned = np.linalg.norm(so3.log(R)) > TURNED_RAD
            for sums in (self._all, self._turned) if is_turned else (self._all,):
                sums.add(by_poses, self._by_twist, along_frame)
            self._decide(message)
        self._begin(pose)

    def _decide(self, message: PoseMessage) -> None:
        for sums in (self._turned, self._all):
            if sums.count >= COMPARED and (
                problem := sums.problem(message.frame_id, self._uses_turn)
            ):
                self.problem, self.is_decided = problem, True
                return
        self.is_decided = self._turned.count >= COMPARED


def _is_long(motion: FloatArray) -> bool:
    cosine = 0.5 * (float(np.trace(motion)) - 2.0)
    return _square(motion[:3, 3]) > WAY_M**2 or cosine < COS_TURN


def _square(vector: FloatArray) -> float:
    return float(vector.dot(vector))


class _Sums:
    """Squares of ways (m) and turns (rad), and of what twists make of them less these."""

    def __init__(self) -> None:
        self.count = 0
        self._way = self._way_error = self._frame_error = 0.0
        self._turn = self._turn_error = 0.0

    def add(self, by_poses: FloatArray, by_twist: FloatArray, along_frame: FloatArray) -> None:
        self.count += 1
        way, twist_way = by_poses[:3, 3], by_twist[:3, 3]
        turn, twist_turn = so3.log(by_poses[:3, :3]), so3.log(by_twist[:3, :3])
        self._way += max(_square(way), _square(twist_way))
        self._way_error += _square(way - twist_way)
        self._frame_error += _square(way - along_frame)
        self._turn += max(_square(turn), _square(twist_turn))
        self._turn_error += _square(turn - twist_turn)

    def problem(self, frame_id: str, uses_turn: bool) -> str:
        if self._way_error > MAX_DISAGREEMENT * self._way > 0.0:
            if self._frame_error < FITS * self._way_error:
                return f"is along the axes of '{frame_id}' by its poses, not of child_frame_id"
            return 'does not say the way of its poses (units, signs, axes)'
        has_turned = MAX_DISAGREEMENT * self._turn > self.count * (0.1 * TURN_RAD) ** 2
        if uses_turn and has_turned and self._turn_error > MAX_DISAGREEMENT * self._turn:
            return 'does not say the turn of its poses (rad/s)'
        return ''
