"""From decoded messages to the estimator: time, frames, pauses, and what has to wait."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import time
from typing import TypeAlias, TypeVar

from rclpy.node import Node

from slam_observer_ros.clock_offset import ClockOffset
from slam_observer_ros.errors import TransformError
from slam_observer_ros.estimator import Estimator
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.nodes.frames import BaseFrame
from slam_observer_ros.nodes.settings import ObserverNodeSettings
from slam_observer_ros.recording.detections import TagDetections
from slam_observer_ros.recording.messages import ImuMessage, PoseMessage, VelocityMessage
from slam_observer_ros.recording.point_clouds import ObservationMessage
from slam_observer_ros.velocity_sources import AngularReplacement, PoseDifferences

REPORT_PERIOD_S = 10.0
"""Shortest time between two reports of one kind of drop."""

MAX_WAITING = 1000
"""Most messages that wait for a transform; the oldest go first."""

Measured: TypeAlias = VelocityEvent | ObservationEvent | ImuMessage | PoseMessage | TagDetections
MeasuredT = TypeVar('MeasuredT', VelocityEvent, ObservationEvent, ImuMessage, PoseMessage,
                    TagDetections)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A message whose transform is not known yet."""

    deadline_s: float
    resolve: Callable[[], None]
    give_up: Callable[[TransformError], None]


class Intake:
    """Hands what comes in to the estimator, in the base frame and in this machine's time.

    While the observer is paused all that comes in is dropped.

    Parameters
    ----------
    node : Node
        Node that logs.
    settings : ObserverNodeSettings
        Frames, timeouts and clocks.
    estimator : Estimator
        Where events go.
    base_frame : BaseFrame
        Brings measurements into the base frame.

    Attributes
    ----------
    dropped : Counter
        Messages that did not become events, by reason.
    clocks : dict of str to ClockOffset
        How far off the stamps are, by input.
    is_active : bool
        Whether what comes in is looked at at all.
    is_paused : bool
        Whether all that comes in is dropped and counted.

    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        estimator: Estimator,
        base_frame: BaseFrame,
    ) -> None:
        timeout_ns = round(estimator.settings.velocity_timeout * 1e9)
        self._node = node
        self._settings = settings
        self._estimator = estimator
        self._base_frame = base_frame
        self._poses = PoseDifferences(timeout_ns)
        self._joined = AngularReplacement(timeout_ns)
        self._waiting: deque[_Waiting] = deque(maxlen=MAX_WAITING)
        self._frames_taken_as_base: set[str] = set()
        self._quiet_until_s: dict[str, float] = {}
        self._processing_s = 0.0
        self._processed = 0
        self.dropped: Counter[str] = Counter()
        self.clocks = {
            name: ClockOffset(round(settings.max_clock_offset * 1e9))
            for name in ('twist', 'imu', 'landmarks')
        }
        self.is_active = False
        self.is_paused = False

    def add_velocity(self, message: VelocityMessage, receive_ns: int) -> None:
        """Take a velocity."""
        event = self._timed(message.event, 'twist', receive_ns)
        if event is not None:
            self._place_velocity(replace(message, event=event))

    def add_pose(self, message: PoseMessage, receive_ns: int) -> None:
        """Take an odometry's pose; the velocity comes from its differences."""
        timed = self._timed(message, 'twist', receive_ns)
        event = None if timed is None else self._poses.add(timed.stamp_ns, timed.pose)
        if event is not None:
            self._place_velocity(VelocityMessage(message.child_frame_id, event))

    def add_imu(self, message: ImuMessage, receive_ns: int) -> None:
        """Take an angular velocity."""
        timed = self._timed(message, 'imu', receive_ns)
        if timed is not None:
            self._try(lambda: self._use_imu(timed), self._drop_untransformed)

    def add_observation(self, message: ObservationMessage, receive_ns: int) -> None:
        """Take landmarks."""
        event = self._timed(message.event, 'landmarks', receive_ns)
        if event is not None:
            timed = replace(message, event=event)
            self._try(
                lambda: self._use(self._base_frame.observation(timed)), self._drop_untransformed
            )

    def add_observations(self, messages: Sequence[ObservationMessage], receive_ns: int) -> None:
        """Take landmarks of several cameras."""
        for message in messages:
            self.add_observation(message, receive_ns)

    def add_tags(self, message: TagDetections, receive_ns: int) -> None:
        """Take fiducials whose positions are on /tf, at the stamps of their message there."""
        if self._is_usable('landmarks', message.stamp_ns, receive_ns):
            self._try(lambda: self._use(self._base_frame.tags(message)), self._drop_untransformed)

    def retry(self) -> None:
        """Try again what waits for a transform; call it often."""
        waiting, self._waiting = self._waiting, deque(maxlen=MAX_WAITING)
        for message in waiting:
            self._attempt(message)

    def forget(self) -> None:
        """Drop what waits, and what is known of clocks, as after a jump of the clock."""
        self._waiting.clear()
        for clock in self.clocks.values():
            clock.clear()

    def take_mean_processing_ms(self) -> float:
        """Return the mean time that an event took since this was asked last, milliseconds."""
        mean_s = self._processing_s / max(self._processed, 1)
        self._processing_s, self._processed = 0.0, 0
        return mean_s * 1e3

    def _place_velocity(self, message: VelocityMessage) -> None:
        def use() -> None:
            self._use(self._joined.add_velocity(self._base_frame.velocity(message)))

        def use_untransformed(error: TransformError) -> None:
            self._frames_taken_as_base.add(message.frame_id)
            self._node.get_logger().warning(
                f"velocities in frame '{message.frame_id}' are taken to be those of "
                f"'{self._settings.base_frame}': {error}"
            )
            self._use(self._joined.add_velocity(message.event))

        if message.frame_id in self._frames_taken_as_base:
            self._use(self._joined.add_velocity(message.event))
        else:
            self._try(use, use_untransformed)

    def _use_imu(self, message: ImuMessage) -> None:
        turned = self._base_frame.angular_velocity(message)
        event = self._joined.add_angular(
            turned.stamp_ns, turned.angular_velocity, turned.covariance
        )
        if event is not None:
            self._use(event)

    def _use(self, event: Event) -> None:
        start_s = time.perf_counter()
        self._estimator.add(event)
        self._processing_s += time.perf_counter() - start_s
        self._processed += 1

    def _try(self, resolve: Callable[[], None], give_up: Callable[[TransformError], None]) -> None:
        deadline_s = time.monotonic() + self._settings.transform_timeout
        self._attempt(_Waiting(deadline_s, resolve, give_up))

    def _attempt(self, message: _Waiting) -> None:
        try:
            message.resolve()
        except TransformError as error:
            if time.monotonic() < message.deadline_s:
                self._waiting.append(message)
            else:
                message.give_up(error)

    def _drop_untransformed(self, error: TransformError) -> None:
        self._drop('no_transform', f"no transform to '{self._settings.base_frame}': {error}")

    def _timed(self, measured: MeasuredT, source: str, receive_ns: int) -> MeasuredT | None:
        """Return the measurement in this machine's time; None if it can't be used."""
        stamp_ns = measured.stamp_ns or receive_ns  # 0: the publisher left it out
        if not self._is_usable(source, stamp_ns, receive_ns):
            return None
        if self._settings.correct_clock_offset:
            stamp_ns += self.clocks[source].correction_ns
        return replace(measured, stamp_ns=stamp_ns)

    def _is_usable(self, source: str, stamp_ns: int, receive_ns: int) -> bool:
        if not self.is_active:
            return False
        if self.is_paused:
            self.dropped['paused'] += 1
            return False
        if receive_ns == 0:
            self._drop('no_clock', 'use_sim_time is set and /clock has not begun')
            return False
        clock = self.clocks[source]
        clock.add(stamp_ns, receive_ns)
        if self._settings.correct_clock_offset and clock.offset_ns is None:
            self.dropped['clock_unknown'] += 1
            return False
        if clock.is_off:
            self._warn(source, clock.trouble(source))
        return True

    def _drop(self, reason: str, text: str) -> None:
        self.dropped[reason] += 1
        self._warn(reason, f'dropped a message ({reason}, {self.dropped[reason]} so far): {text}')

    def _warn(self, topic: str, text: str) -> None:
        now_s = time.monotonic()
        if now_s >= self._quiet_until_s.get(topic, now_s):
            self._quiet_until_s[topic] = now_s + REPORT_PERIOD_S
            self._node.get_logger().warning(text)
