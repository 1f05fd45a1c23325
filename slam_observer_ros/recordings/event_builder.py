"""Events of what several sensors measure, as soon as it is known where the sensors are."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
import logging
from typing import TypeAlias

from slam_observer_ros.common.errors import InvalidEventError, TransformError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.messages.poses import PoseMessage
from slam_observer_ros.recordings.frames import BaseFrame
from slam_observer_ros.recordings.odometry import PoseDifferences

MAX_WAITING = 1000
"""Most measurements that wait for a transform; the oldest go first."""

NO_TRANSFORM = 'no_transform'
"""Reason under which measurements are dropped that can't be brought into the base frame."""

Measured: TypeAlias = Event | PoseMessage
"""What a message measures, in the frame that it names."""

DropError: TypeAlias = TransformError | InvalidEventError
"""Why a measurement makes no event."""

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
            velocity = self._difference(measured)
            if velocity is None:
                return []
            measured = replace(velocity, sensor_frame=measured.child_frame_id)
        return self._attempt(measured, now_ns + self._transform_timeout_ns, now_ns)

    def passes_on(self, frame_id: str) -> bool:
        """Return whether velocities in a frame become events as they are, and nothing waits."""
        is_decided = frame_id not in self._taken_as_base
        return is_decided and not self._waiting and self._base_frame.is_base(frame_id)

    def retry(self, now_ns: int) -> list[Event]:
        """Return the events of what has waited long enough, or for what is known by now."""
        waiting, self._waiting = self._waiting, deque()
        return [
            event
            for measured, deadline_ns, _ in waiting
            for event in self._attempt(measured, deadline_ns, now_ns)
        ]

    def finish(self) -> list[Event]:
        """Return the events of what still waits, when nothing more will come."""
        waiting, self._waiting = self._waiting, deque()
        return [
            event
            for measured, deadline_ns, _ in waiting
            for event in self._attempt(measured, deadline_ns, deadline_ns)
        ]

    def clear(self) -> None:
        """Drop what waits, as after a jump of the clock."""
        self._waiting.clear()
        self._poses.clear()

    def _difference(self, message: PoseMessage) -> VelocityEvent | None:
        try:
            return self._poses.add(message.stamp_ns, message.pose)
        except InvalidEventError as error:
            self._on_drop(error)
            return None

    def _attempt(self, measured: Event, deadline_ns: int, now_ns: int) -> list[Event]:
        try:
            return [self._event(measured, now_ns)]
        except TransformError as error:
            if now_ns < deadline_ns:
                self._wait(measured, deadline_ns, error)
                return []
            return self._give_up(measured, deadline_ns, error)

    def _wait(self, measured: Event, deadline_ns: int, error: TransformError) -> None:
        if len(self._waiting) == MAX_WAITING:
            *_, reason = self._waiting.popleft()
            text = f'more than {MAX_WAITING} measurements wait for their transforms: {reason}'
            self._on_drop(TransformError(text))
        self._waiting.append((measured, deadline_ns, error))

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
