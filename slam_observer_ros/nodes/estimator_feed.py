"""From decoded messages to the estimator's events: time, frames, pauses, and what has to wait."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
import time
from typing import TypeAlias

from rclpy.node import Node

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityEvent
from slam_observer_ros.messages.clouds import scan_problem
from slam_observer_ros.nodes.ros_node import described, ThrottledLog
from slam_observer_ros.recordings.event_builder import (
    drop_reason,
    DropError,
    EventBuilder,
    Measured,
    with_receive_time,
)
from slam_observer_ros.recordings.frames import BaseFrame
from slam_observer_ros.runs.health import ClockOffset
from slam_observer_ros.settings.node_settings import ObserverNodeSettings, ON_TF

# Inputs by the events that come of them; each has stamps of a clock of its own.
SOURCES: dict[type[Event], str] = {
    VelocityEvent: 'twist',
    AngularVelocityEvent: 'imu',
    ObservationEvent: 'landmarks',
}


MAX_SENSORS = 100  # frames whose clocks are looked at: somebody may publish under ever new names
Use: TypeAlias = Callable[[], None]  # uses a message that was held
AROUND_S = 0.5  # how much later than /clock messages of the run before may come, by a steady clock

# How often a node looks whether /clock has jumped, every 20 ms, before it uses what it holds. Not
# a time: a node that was held up itself has not seen yet what has come meanwhile.
MAX_LOOKS = 25
MAX_HELD = 10_000  # messages that may wait for /clock to jump


class ClockChange:
    """Holds messages of the next run until /clock has jumped, and finds the last run's.

    Topics come in no order. Before the jump what is too late to be used may be of the next run.
    After it what is nearer to the time before is of the last one.
    """

    def __init__(self) -> None:
        self._held: list[Use] = []
        self._looks = 0  # since it holds anything
        self._is_jumping = False
        self._jumped_s = -AROUND_S
        self._back_ns = 0

    @property
    def is_holding(self) -> bool:
        """Whether a message waits for /clock to jump."""
        return bool(self._held)

    def begin(self, back_ns: int) -> None:
        """Take that /clock has jumped back, nanoseconds; until the end the last run is used up."""
        self._is_jumping = True
        self._jumped_s = time.monotonic()
        self._back_ns = back_ns

    def end(self) -> list[Use]:
        """Return what is of the next run, which is used from now on."""
        self._is_jumping = False
        return self._take()

    def hold(self, use: Use, stamp_ns: int, receive_ns: int, usable_from_ns: int) -> bool:
        """Keep a message of the next run, or what may be one; return whether it is kept.

        ``stamp_ns`` is its stamp by /clock, ``usable_from_ns`` that before which it is too late.
        """
        if self._is_jumping:
            is_next = not self._is_before_jump(stamp_ns, receive_ns)
        else:
            is_next = stamp_ns < usable_from_ns
        if not is_next or len(self._held) >= MAX_HELD:
            return False
        if not self._held:
            self._looks = 0
        self._held.append(use)
        return True

    def is_over(self, stamp_ns: int, receive_ns: int) -> bool:
        """Return whether a message is of the last run, and comes after its end."""
        return not self._is_jumping and self._is_before_jump(stamp_ns, receive_ns)

    def take_overdue(self) -> list[Use]:
        """Return what was held for too long: the clock does not jump, it was just late."""
        self._looks += 1
        return self._take() if self._looks > MAX_LOOKS else []

    def _take(self) -> list[Use]:
        held, self._held = self._held, []
        return held

    def _is_before_jump(self, stamp_ns: int, receive_ns: int) -> bool:
        is_around = time.monotonic() - self._jumped_s < AROUND_S
        return is_around and stamp_ns > receive_ns + self._back_ns // 2


class EstimatorFeed:
    """Gives what comes in to the estimator, in the base frame and in this machine's time.

    ``on_events`` is called after events were used, with the name of the input that gave them, ''
    for several; ``on_waiting`` when something begins to wait: :meth:`retry` is to be called often
    from then on; ``note_event`` with each event that the estimator gets.
    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        estimator: Estimator,
        base_frame: BaseFrame,
        on_events: Callable[[str], None],
        on_waiting: Callable[[], None],
        note_event: Callable[[Event], None],
    ) -> None:
        self._node, self._settings, self._estimator = node, settings, estimator
        self._builder = EventBuilder(
            base_frame,
            settings.transform_timeout,
            estimator.settings.velocity_timeout,
            self._drop_measured,
        )
        self._change = ClockChange()
        self._log = ThrottledLog(node)
        self._processing_s = 0.0
        self._processed = 0
        self.dropped: Counter[str] = Counter()  # messages that became no events, by reason
        self.unstamped: Counter[str] = Counter()  # messages without a stamp, by topic
        # How far off the stamps are, by input
        self.clocks = {
            name: ClockOffset(to_ns(settings.max_clock_offset)) for name in SOURCES.values()
        }
        # By input and frame: each camera's machine may have another time.
        self._sensor_clocks: dict[tuple[str, str], ClockOffset] = {}
        # As they are after remapping, for the log.
        self._topics = {name: f"'{node.resolve_topic_name(name)}'" for name in self.clocks}
        if settings.landmarks_type == ON_TF:
            self._topics['landmarks'] = f"'{node.resolve_topic_name('/tf')}'"
        self.is_active = False  # else all that comes in is ignored
        self.is_paused = False  # whether all that comes in is dropped and counted
        self.on_events, self._on_waiting = on_events, on_waiting
        self._note_event = note_event

    @property
    def is_waiting(self) -> bool:
        """Whether something waits for a transform, or for /clock to jump."""
        return self._builder.is_waiting or self._change.is_holding

    def add(self, name: str, measured: Measured, receive_ns: int) -> None:
        """Take what an input measures; without a stamp it has the time of its reception."""
        if not (self.is_active and self._is_of_another_run(name, measured, receive_ns)):
            self._use(name, measured, receive_ns)
        if self.is_waiting:
            self._on_waiting()

    def begin_clock_jump(self, back_ns: int) -> None:
        """Use until the end only what is of before /clock jumped back, and keep the others."""
        self._change.begin(back_ns)

    def end_clock_jump(self) -> None:
        """Use what has been kept."""
        for use in self._change.end():
            use()

    def _is_of_another_run(self, name: str, measured: Measured, receive_ns: int) -> bool:
        """Return whether a message is of before a jump of /clock, or waits for one."""
        is_corrected, clock = self._settings.correct_clock_offset, self.clocks[name]
        if not self._is_simulated or (is_corrected and clock.offset_ns is None):
            return False
        timed = with_receive_time(measured, receive_ns)
        stamp_ns = timed.stamp_ns + (clock.correction_ns if is_corrected else 0)
        use = partial(self._use, name, timed, receive_ns)
        window, late = self._estimator.settings.reorder_window, self._estimator.settings.late_limit
        # Before this an event would be refused as too late.
        usable_from_ns = (self._estimator.newest_stamp_ns or 0) - to_ns(window + late)
        if self._change.hold(use, stamp_ns, receive_ns, usable_from_ns):
            return True
        if self._change.is_over(stamp_ns, receive_ns):
            self.dropped['last_run'] += 1
            return True
        return False

    def _use(self, name: str, measured: Measured, receive_ns: int) -> None:
        timed = with_receive_time(measured, receive_ns)
        if not self._is_usable(name, timed, receive_ns):
            return
        if timed is not measured:
            topic = self._topics[name]
            self.unstamped[topic] += 1
            count = self.unstamped[topic]
            self._log.event('zero_stamps', f'stamps of {topic}', topics=topic, count=count)
        self._give(self._builder.add(timed, time.monotonic_ns()), name)

    def add_observation(self, measured: ObservationEvent, receive_ns: int) -> None:
        """Take landmarks, unless they are a lidar's scan."""
        if self.is_active and (problem := scan_problem(measured)):
            self._drop('scan', problem)
            return
        count, most = len(measured.ids), self._estimator.settings.max_points
        if count > most:
            topic = self._topics['landmarks']
            subject = f'points of {topic}'
            self._log.event('surplus_point', subject, source=topic, count=count, most=most)
        self.add('landmarks', measured, receive_ns)

    def add_observations(self, measured: Sequence[ObservationEvent], receive_ns: int) -> None:
        """Take landmarks of several cameras."""
        for each in measured:
            self.add_observation(each, receive_ns)

    def retry(self) -> None:
        """Try again what waits for a transform, or for /clock to jump."""
        for use in self._change.take_overdue():
            use()
        self._give(self._builder.retry(time.monotonic_ns()), '')

    def clear(self) -> None:
        """Drop what waits, and what is known of clocks, as after a jump of the clock."""
        self._builder.clear()
        for clock in (*self.clocks.values(), *self._sensor_clocks.values()):
            clock.clear()

    def clock_problems(self) -> list[str]:
        """Report the sensors with stamps of another clock that are not corrected."""
        problems = [self._clock_problem(*sensor) for sensor in self._sensor_clocks]
        return [problem for problem in problems if problem]

    def _clock_problem(self, name: str, frame_id: str) -> str:
        frames = [frame for other, frame in self._sensor_clocks if other == name]
        whose = f" in frame '{frame_id}'" if len(frames) > 1 else ''
        clock = self._sensor_clocks[name, frame_id]
        return clock.problem(f'{self._topics[name]}{whose}', self._is_simulated)

    @property
    def _is_simulated(self) -> bool:
        return bool(self._node.get_clock().ros_time_is_active)

    def take_mean_processing_ms(self) -> float:
        """Return the mean time an event took, milliseconds, since this was asked last."""
        mean_s = self._processing_s / max(self._processed, 1)
        self._processing_s, self._processed = 0.0, 0
        return mean_s * 1e3

    def _give(self, events: list[Event], name: str) -> None:
        # Not corrected before: what places the sensor on /tf has, as a rule, stamps of the same
        # clock. All before the first is used: if that shows a jump of the clock, offsets go.
        is_corrected, now_ns = self._settings.correct_clock_offset, time.monotonic_ns()
        corrections_ns = [
            self.clocks[SOURCES[type(each)]].correction_ns if is_corrected else 0
            for each in events
        ]
        for measured, correction_ns in zip(events, corrections_ns, strict=True):
            stamp_ns = measured.stamp_ns + correction_ns
            event = replace(measured, stamp_ns=stamp_ns, receive_ns=now_ns)
            start_s = time.perf_counter()
            self._note_event(event)
            try:
                self._estimator.add(event)
            except Exception as error:  # noqa: BLE001  # whatever it is, the next one may be used
                self._drop('internal_error', described(error))
            self._processing_s += time.perf_counter() - start_s
            self._processed += 1
        if events:
            self.on_events(name)

    def _drop_measured(self, error: DropError) -> None:
        is_unplaced = isinstance(error, TransformError)
        why = f"no transform to '{self._settings.base_frame}': " if is_unplaced else ''
        self._drop(drop_reason(error), f'{why}{error}')

    def _is_usable(self, name: str, measured: Measured, receive_ns: int) -> bool:
        if not self.is_active:
            return False
        if self.is_paused:
            self.dropped['paused'] += 1
            return False
        if receive_ns == 0:
            self._drop('no_clock', 'use_sim_time is set and /clock has not begun')
            return False
        if not self._settings.correct_clock_offset:
            self._check_clock(name, measured, receive_ns)
            return True
        self._follow_clock(name, measured.stamp_ns, receive_ns)
        if self.clocks[name].offset_ns is None:
            self._drop('clock_unknown', f'the clock of {self._topics[name]} is not known yet')
            return False
        return True

    def _check_clock(self, name: str, measured: Measured, receive_ns: int) -> None:
        """Compare a stamp with this machine's clock, and report if that is another one."""
        sensor = name, measured.sensor_frame
        if sensor not in self._sensor_clocks:
            if len(self._sensor_clocks) >= MAX_SENSORS:
                return
            self._sensor_clocks[sensor] = ClockOffset(to_ns(self._settings.max_clock_offset))
        self._sensor_clocks[sensor].add(measured.stamp_ns, receive_ns, self._is_simulated)
        if problem := self._clock_problem(*sensor):
            self._log.warning(f'clock of {sensor}', problem)

    def _follow_clock(self, name: str, stamp_ns: int, receive_ns: int) -> None:
        """Find out by how much an input's stamps are to be corrected."""
        clock = self.clocks[name]
        before_ns = clock.correction_ns
        clock.add(stamp_ns, receive_ns, self._is_simulated)
        if clock.correction_ns != before_ns:
            outcome = 'corrected from now on' if clock.correction_ns else 'not corrected any more'
            topic = self._topics[name]
            self._node.get_logger().info(f'stamps on {topic} are {clock}, and {outcome}')

    def _drop(self, reason: str, text: str) -> None:
        self.dropped[reason] += 1
        note = f' ({self.dropped[reason]} so far)'
        self._log.event('dropped_message', reason, note, reason=reason, error=text)
