"""Events of what sensors measure, once it is known where they are; velocities from poses.

An odometry's poses give velocities from two of them, and show whether its twist says the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
import logging
import math
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError, TransformError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import NEAR_NS, StrayStamps, to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.messages.poses import PoseMessage
from slam_observer_ros.recordings.frames import BaseFrame

POSE_JUMP = 'pose_jump'
"""Reason under which a difference of poses is dropped that no robot can have moved by."""

SKIPPED = 'skipped_pose'
"""Reason under which poses are counted whose motion counts with the next one's."""

MAX_SPEED = 50.0
"""Beyond this, rad/s or m/s, it was not the robot that moved: its odometry was reset."""

MIN_JUMP = 0.1  # rad or m up to which two poses may differ in any time: a stamp may be off

SHORT = 0.5
"""Share of the time that so many poses usually take: in less, they were stamped on arrival."""

RECENT = 50  # poses over which that time is taken
PAUSE_NS = 500_000_000  # time without poses that is no interval of bursts, nanoseconds


class PoseDifferences:
    """Turns poses of the base in a smooth frame, as odometry gives them, into velocities.

    The velocity from one pose to the next has the stamp of the first: held until the second, it
    leads exactly there. It is known one period late, which the reorder window must cover. Poses
    further apart than ``timeout_ns`` give none.

    A pose whose stamp is not clearly later than the one before, as of a coarse clock or in
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
        motion, duration_s = se3.log(se3.inverse(last[1]) @ pose), to_s(duration_ns)
        self._used = stamp_ns, pose
        turn, way = np.linalg.norm(motion.reshape(2, 3), axis=1).tolist()
        if max(turn, way) > max(MAX_SPEED * duration_s, MIN_JUMP):
            raise InvalidEventError(
                POSE_JUMP,
                f"the odometry's pose has jumped, by {way:.2f} m and {turn:.2f} rad in "
                f'{duration_s:.3f} s: it was reset, and how the robot moved meanwhile is not '
                'known',
            )
        return VelocityEvent(last[0], motion / duration_s, is_mean=True)

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
        self, stamp_ns: int, pose: FloatArray, before: tuple[int, FloatArray] | None = None
    ) -> None:
        self.clear()
        self._used, self._before_pause = (stamp_ns, pose), before
        self._stamps_ns.append(stamp_ns)

    def _refuse_stamp(self, stamp_ns: int, duration_ns: int) -> None:
        """Refuse a stamp that is not clearly later than the stamp of the last pose used."""
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
            f'its stamp is {to_s(duration_ns):.4f} s after the stamp of the last pose used, where '
            f'{to_s(round(usual_ns)):.4f} s are usual: how it moved counts with the next one',
        )


MAX_PAUSE_S = 1.0  # between two messages: how the robot moved meanwhile no twist says
WAY_M, TURN_RAD = 0.1, 0.3  # length of a stretch over which both are compared
COS_TURN = math.cos(TURN_RAD)
COMPARED = 10  # stretches of this kind that it takes to say something
TURNED_RAD = 0.5  # a smaller heading does not show whose axes they are
MAX_DISAGREEMENT = 0.25  # squared, relative: half of the way; noise and slip are less
FITS = 0.1  # share of the squared error that is left where another reading is right


class OdometryCheck:
    """Compares ways by twists with ways by poses until it is clear whether they agree.

    Parameters
    ----------
    uses_turn : bool
        Whether turns are compared, too: not where an Imu's take their place.

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
        # Sums of squares over stretches, and their number: of all, and of turned ones.
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
        # Poses that are not filled in, or were reset, say nothing.
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


MAX_WAITING = 1000  # most measurements that wait for a transform; the oldest go first

NO_TRANSFORM = 'no_transform'
"""Reason under which measurements are dropped that can't be brought into the base frame."""

Measured: TypeAlias = Event | PoseMessage  # what a message measures, in the frame that it names
DropError: TypeAlias = TransformError | InvalidEventError  # why a measurement makes no event

logger = logging.getLogger(__name__)


def with_receive_time(measured: Measured, receive_stamp_ns: int) -> Measured:
    """Return a measurement with the time of its reception if its publisher left the stamp out.

    Fiducials keep theirs, which /tf has as well. Where time begins at zero, zero is a stamp.
    """
    is_of_tags = isinstance(measured, ObservationEvent) and measured.families is not None
    if receive_stamp_ns == 0 or is_of_tags or measured.stamp_ns:
        return measured
    return replace(measured, stamp_ns=receive_stamp_ns)


def drop_reason(error: DropError) -> str:
    """Return the key under which what is dropped is counted."""
    return error.reason if isinstance(error, InvalidEventError) else NO_TRANSFORM


class EventBuilder:
    """Makes events in the base frame of measurements, in the order in which these come.

    What needs a transform that is not known yet waits for it. After the timeout velocities are
    taken as they are until their transform is known, fiducials that /tf never had are
    directions, where their camera is known, and all else is dropped:
    ``on_drop`` is called with the reason, and :func:`drop_reason` gives the key to count it by.
    Poses further apart than the velocity's timeout give no velocity.
    """

    def __init__(
        self,
        base_frame: BaseFrame,
        transform_timeout_s: float,
        velocity_timeout_s: float,
        on_drop: Callable[[DropError], None],
    ) -> None:
        self._base_frame = base_frame
        self._transform_timeout_ns = to_ns(transform_timeout_s)
        self._on_drop = on_drop
        self._poses = PoseDifferences(to_ns(velocity_timeout_s))
        # With the time until which each waits, and what it waits for.
        self._waiting: deque[tuple[Event, int, TransformError]] = deque()
        self._taken_as_base: dict[str, tuple[int, VelocityEvent]] = {}

    @property
    def is_waiting(self) -> bool:
        """Whether a measurement waits for its transform."""
        return bool(self._waiting)

    def add(self, measured: Measured, now_ns: int) -> list[Event]:
        """Take a measurement; return the event that comes of it, unless it has to wait.

        Of poses, an odometry's, the differences are used. ``now_ns`` is the time of reception by
        any clock that goes on steadily.
        """
        if isinstance(measured, PoseMessage):
            try:
                velocity = self._poses.add(measured.stamp_ns, measured.pose)
            except InvalidEventError as error:
                self._on_drop(error)
                return []
            if velocity is None:
                return []
            measured = replace(velocity, sensor_frame=measured.child_frame_id)
        return self._attempt(measured, now_ns + self._transform_timeout_ns, now_ns)

    def passes_on(self, frame_id: str) -> bool:
        """Return whether velocities in a frame become events as they are, and nothing waits."""
        is_decided = frame_id not in self._taken_as_base
        return is_decided and not self._waiting and self._base_frame.is_base(frame_id)

    def retry(self, now_ns: int | None) -> list[Event]:
        """Return the events of what has waited long enough, or for what is known by now.

        None is the time at which nothing more will come: all has waited long enough.
        """
        waiting, self._waiting = self._waiting, deque()
        return [
            event
            for measured, deadline_ns, _ in waiting
            for event in self._attempt(
                measured, deadline_ns, deadline_ns if now_ns is None else now_ns
            )
        ]

    def clear(self) -> None:
        """Drop what waits, as after a jump of the clock."""
        self._waiting.clear()
        self._poses.clear()

    def _attempt(self, measured: Event, deadline_ns: int, now_ns: int) -> list[Event]:
        try:
            return [self._event(measured, now_ns)]
        except TransformError as error:
            if now_ns >= deadline_ns:
                return self._give_up(measured, deadline_ns, error)
            if len(self._waiting) == MAX_WAITING:
                *_, reason = self._waiting.popleft()
                text = f'more than {MAX_WAITING} measurements wait for their transforms: {reason}'
                self._on_drop(TransformError(text))
            self._waiting.append((measured, deadline_ns, error))
            return []

    def _event(self, measured: Event, now_ns: int) -> Event:
        if isinstance(measured, ObservationEvent):
            return self._base_frame.observation(measured)
        if isinstance(measured, VelocityEvent):
            is_of_base = self._is_taken_as_base(measured, now_ns)
            return measured if is_of_base else self._base_frame.velocity(measured)
        return self._base_frame.angular_velocity(measured)

    def _is_taken_as_base(self, event: VelocityEvent, now_ns: int) -> bool:
        """Return whether velocities of this frame still do not wait for their transform.

        A transform that moves arrives after the velocity of its instant. So the same velocity is
        looked up again and again, for as long as it would have waited; then a newer one is.
        """
        frame_id = event.sensor_frame
        if frame_id not in self._taken_as_base:
            return False
        deadline_ns, looked_up = self._taken_as_base[frame_id]
        if now_ns >= deadline_ns:
            deadline_ns, looked_up = now_ns + self._transform_timeout_ns, event
            self._taken_as_base[frame_id] = deadline_ns, looked_up
        try:
            self._base_frame.velocity(looked_up)
        except TransformError:
            return True
        del self._taken_as_base[frame_id]
        logger.info(
            "Velocities in frame '%s' are brought into '%s' from now on: its transform is known.",
            frame_id,
            self._base_frame.name,
        )
        return False

    def _give_up(self, measured: Event, deadline_ns: int, error: TransformError) -> list[Event]:
        if isinstance(measured, ObservationEvent) and self._base_frame.give_up_poses(measured):
            try:
                return [self._base_frame.observation(measured)]
            except TransformError as unplaced:
                error = unplaced
        if not isinstance(measured, VelocityEvent):
            self._on_drop(error)
            return []
        self._taken_as_base[measured.sensor_frame] = deadline_ns, measured
        frame, base_frame = measured.sensor_frame, self._base_frame.name
        finding = found('velocity_frame', frame=frame, base_frame=base_frame, error=error)
        logger.warning('%s', finding)
        return [measured]
