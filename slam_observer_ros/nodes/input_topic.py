"""One input topic, whose message type is given or found on the topic."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
import time
from typing import Any, TypeAlias

from rclpy.node import Node
from rclpy.qos import qos_check_compatible, QoSCompatibility, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from slam_observer_ros.common.errors import MessageError, ParameterError
from slam_observer_ros.common.findings import fault, Finding
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.estimator.checks import MAX_STAMP_NS
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.nodes.ros_node import (
    is_installed,
    message_class,
    take,
    ThrottledLog,
    with_info,
)
from slam_observer_ros.runs.health import Backlog, of_publishers, of_types, overload

# How long a topic may be without publisher or message before that is logged. Where an announcement
# was lost, as on a busy machine, DDS repeats it after 3 s only.
DISCOVERY_S = 5.0
WELL_S = 1.0  # how long a topic on which messages come is not looked at again
HELD_UP_S = 1.0  # without a look at the topics, due four times a second, a node was held up
MAX_FULL_NAMES = 3  # of message types in a log line
Decoder: TypeAlias = Callable[[Buffer, int], Any]
TRY_S = 2.0  # how long a type that has not come yet is waited for while others are published
KEEP_S = 5.0  # how long a type that has come before must be silent until another one is tried


class TypeChoice:
    """Chooses the type that flows among those that are published on one topic.

    A topic can be heard with one type at a time. A publisher may be silent for ever, as a
    teleoperation that nobody uses, so that being published does not show which type flows.
    """

    def __init__(self) -> None:
        self.chosen = ''  # the type that is listened for; '' before the first
        self._since_s = 0.0
        self._tried: set[str] = set()
        self.have_come: set[str] = set()  # types of which there was a message

    def choose(self, type_name: str, now_s: float) -> bool:
        """Note that a type is listened for; return whether it is for the first time."""
        is_new = type_name not in self._tried
        self.chosen, self._since_s = type_name, now_s
        self._tried.add(type_name)
        return is_new

    def best_of(self, published: Sequence[str], last_s: float, now_s: float) -> str:
        """Return which of the published types to listen for, by the time of the last message."""
        if self.chosen not in published:
            return published[0]
        patience_s = KEEP_S if self.chosen in self.have_come else TRY_S
        if now_s - max(self._since_s, last_s) < patience_s:
            return self.chosen
        return published[(published.index(self.chosen) + 1) % len(published)]


PERIOD_S = 5.0  # over which it is seen how much is dropped


@dataclass(frozen=True, slots=True)
class Waiting:
    """A decoded message that waits to be used.

    ``received_ns`` is when DDS has received it, by the system's time, 0 where it does not say;
    ``receive_ns`` the same by the ROS clock. Both are nanoseconds.
    """

    message: Any
    received_ns: int
    receive_ns: int

    @property
    def sensors(self) -> set[str]:
        """Frames of the sensors whose measurements it has."""
        parts = self.message if isinstance(self.message, Sequence) else [self.message]
        return {part.sensor_frame for part in parts}


class LoadShedding:
    """Uses each sensor's newest message alone once one has waited for ``max_wait_s``."""

    def __init__(self, max_wait_s: float) -> None:
        self._max_wait_s = max_wait_s
        self._recent: deque[tuple[float, int, int]] = deque()
        self.shed = 0  # messages dropped so far

    def newest(self, waiting: Sequence[Waiting], now_ns: int, now_s: float) -> list[Waiting]:
        """Return which waiting messages are used at ``now_ns``, the system's, ``now_s`` steady."""
        oldest_ns = min((each.received_ns for each in waiting if each.received_ns), default=now_ns)
        kept = list(waiting)
        if to_s(now_ns - oldest_ns) > self._max_wait_s:
            kept, seen = [], set[str]()
            for each in reversed(waiting):
                if not each.sensors or each.sensors - seen:  # without any, as on /tf, it is cheap
                    kept.insert(0, each)
                seen |= each.sensors
        shed = len(waiting) - len(kept)
        self.shed += shed
        self._recent.append((now_s, len(waiting), shed))
        self._forget_before(now_s - PERIOD_S)
        return kept

    def problem(self, topic: str, now_s: float) -> str:
        """Report that many messages were dropped lately, and how many would not be; else ''."""
        self._forget_before(now_s - PERIOD_S)
        read, shed = sum(each[1] for each in self._recent), sum(each[2] for each in self._recent)
        return overload(topic, read, shed, now_s - self._recent[0][0] if self._recent else 0.0)

    def _forget_before(self, steady_s: float) -> None:
        while self._recent and self._recent[0][0] < steady_s:
            self._recent.popleft()


class InputTopic:
    """Subscribes to a topic, decodes its messages and reports why none come.

    ``name`` is before remapping. ``decoders`` are by full type names, the preferred type first: a
    single one is subscribed to at once (a ParameterError if its package is not installed), of
    several the one that comes on the topic. ``on_message`` is called with each decoded message and
    the ROS time of its reception, nanoseconds. ``qos`` is as ``qos_overrides`` of ROS may change
    it. Once messages have waited for ``max_wait_s`` seconds, only each sensor's newest is used.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        decoders: Mapping[str, Decoder],
        on_message: Callable[[Any, int], None],
        qos: QoSProfile,
        max_wait_s: float = math.inf,
    ) -> None:
        self._node, self._decoders, self._on_message = node, decoders, on_message
        self._qos = qos
        # Whether messages were taken that are still to be used: all else that waits came later.
        self.has_more = False
        self.is_shared = False  # whether several may publish on it, as several sensors
        self.advice: Mapping[str, str] = {}  # parameters by which other types would be read
        # Inputs of which all is read that they received before a message of this one: an executor
        # reads one message of each topic in turn, so after the node was busy a slow topic would
        # run far ahead of a fast one. It still does where the middleware gives no such time.
        self.read_first: Sequence[InputTopic] = ()
        self._received_ns = 0  # by DDS
        self._subscription: Subscription | None = None
        self._types = TypeChoice()
        self._several_types: Finding | None = None
        self._rivals: Finding | None = None
        self.name = name
        self.topic = node.resolve_topic_name(name)
        self.received = 0
        self.malformed = 0  # of these, what could not be decoded
        self.last_malformed: Finding | None = None
        self._fault = ''
        self.backlog = Backlog()
        self.shedding = LoadShedding(max_wait_s)
        self._is_shedding = max_wait_s < math.inf
        self.last_received_s: float | None = None
        self._said_silent = 0, False  # messages so far, and /clock's standing, as it was logged
        self._checked_s = -WELL_S
        self._looked_s = self._resumed_s = time.monotonic()
        self._held_s = 0.0  # how long the node itself was busy before it resumed
        self._clock_ns, self._clock_since_s = 0, self._looked_s
        self._log = ThrottledLog(node, DISCOVERY_S)
        if len(decoders) == 1:
            self._subscribe(next(iter(decoders)))

    @property
    def age_s(self) -> float | None:
        """Steady time since the last message, seconds; None before the first."""
        if self.last_received_s is None:
            return None
        return time.monotonic() - self.last_received_s

    @property
    def silent_s(self) -> float:
        """How long no message came while the node was there to read it, seconds."""
        if self.last_received_s is None:
            return 0.0
        return time.monotonic() - max(self.last_received_s, self._resumed_s)

    @property
    def problem(self) -> str:
        """Why no message comes, or comes late; empty while they come in time."""
        if self._fault:
            return self._fault
        if self.received == 0:
            wanted = self._types.chosen or self._wanted
            return fault('no_message_yet', topic=self.topic, wanted=wanted)
        now_s = time.monotonic()
        if (silent_s := self.silent_s) > DISCOVERY_S:
            if self._clock_stands:
                for_s = now_s - self._clock_since_s
                return fault('clock_stands', topic=self.topic, for_s=for_s)
            return fault('no_message_any_more', topic=self.topic, for_s=silent_s)
        if self._held_s and now_s - self._resumed_s < DISCOVERY_S:
            return fault('busy_node', topic=self.topic, for_s=self._held_s)
        return self.shedding.problem(self.topic, now_s) or self.backlog.problem(self.topic, now_s)

    @property
    def doubt(self) -> Finding | None:
        """What is wrong with publishers, types or content of messages; None if nothing."""
        of_content: Finding | None = getattr(self._decoders.get(self._types.chosen), 'doubt', None)
        return self._several_types or self._rivals or of_content

    def check_publishers(self) -> None:
        """See what the topic carries; subscribe to it, or report why nothing comes.

        While messages come and all was well, that is asked once a second: it takes a while. That
        a topic has fallen silent is logged once, until it is heard again.
        """
        age_s, now_s = self.age_s, time.monotonic()
        # Whether the node was held up, or /clock has stood still, since the last look
        if now_s - self._looked_s > HELD_UP_S and (self.last_received_s or 0.0) <= self._looked_s:
            self._held_s, self._resumed_s = now_s - self._looked_s, now_s
        looked_s, self._looked_s = self._looked_s, now_s
        clock_ns = self._node.get_clock().now().nanoseconds
        if clock_ns != self._clock_ns:
            self._clock_ns, self._clock_since_s = clock_ns, now_s
        is_well = age_s is not None and age_s < WELL_S and not self._fault
        if is_well and now_s < self._checked_s + WELL_S:
            return
        self._checked_s = now_s
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        types = {publisher.topic_type for publisher in publishers}
        usable = [name for name in self._decoders if name in types]
        missing = self._listen_for_one_of(usable, looked_s)
        self._fault = missing or self._find_fault(publishers, usable)
        # Where they publish several types, the finding of that names the cause.
        is_shared = self.is_shared or self._several_types is not None
        self._rivals = None if is_shared else of_publishers(self.topic, publishers)
        # A robot that is parked may be silent for days.
        is_silent = bool(self.received and not self._fault and self.silent_s > DISCOVERY_S)
        silence = self.received, self._clock_stands
        if is_silent and silence == self._said_silent:
            return
        rivals_first = self._rivals and self._rivals.text()
        problem = rivals_first or self.problem or (self.doubt and self.doubt.text())
        if problem and self._log.warning(self.topic, problem) and is_silent:
            self._said_silent = silence

    @property
    def _clock_stands(self) -> bool:
        """Whether /clock, by which the node goes, has stood still for some time."""
        stopped_s = time.monotonic() - self._clock_since_s
        return bool(self._node.get_clock().ros_time_is_active and stopped_s > DISCOVERY_S)

    def begin_looking(self) -> None:
        """Note that topics were not to be looked at up to now."""
        self._looked_s = time.monotonic()

    def _listen_for_one_of(self, usable: list[str], looked_s: float) -> str:
        """Listen for a type that comes; return why no message can be heard, or ''.

        ``looked_s`` is the time of the last look, up to which all that came has been read: a busy
        node may look late, when messages wait.
        """
        if len(usable) > 1:
            usable = [name for name in usable if is_installed(name)] or usable
        self._several_types = None
        if not usable:
            return ''
        chosen = self._types.best_of(usable, self.last_received_s or 0.0, looked_s)
        if len(usable) > 1:
            others = ', '.join(name for name in usable if name != chosen)
            self._several_types = of_types(self.topic, chosen, others)
        if chosen != self._types.chosen and self._subscription is None:
            try:
                self._subscribe(chosen)
            except ParameterError as error:
                return fault('missing_package', topic=self.topic, error=error)
        elif chosen != self._types.chosen:
            # A topic has one type at a time, and the executor lets go of the old one after this.
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
        return ''

    def _subscribe(self, type_name: str) -> None:
        kind = message_class(type_name)
        is_new = self._types.choose(type_name, time.monotonic())
        try:
            self._subscription = self._node.create_subscription(
                kind,
                self.topic,
                with_info(self._receive),
                self._qos,
                raw=True,
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        except RuntimeError as error:  # as rclpy refuses a policy
            raise ParameterError(f"'qos_overrides.{self.topic}.subscription': {error}") from error
        if is_new:
            self._node.get_logger().info(f"listening for {type_name} on '{self.topic}'")

    def read_waiting(self) -> None:
        """Read what waits now, each message after what the other inputs received before it."""
        if not self._is_shedding:
            self.read_until(MAX_STAMP_NS)
        elif (taken := self._take()) is not None:  # and all behind it, but none that comes then
            self._receive(*taken)

    def read_until(self, received_ns: int) -> None:
        """Read what waits, up to what DDS has received at a time, nanoseconds."""
        for _ in range(self._qos.depth):
            if self._received_ns >= received_ns or (taken := self._take()) is None:
                return
            self._receive(*taken)

    def _take(self) -> tuple[bytes, Mapping[str, int]] | None:
        """Take the next message that waits, with what DDS knows of it; None if there is none."""
        return None if self._subscription is None else take(self._subscription)

    def _receive(self, raw: bytes, info: Mapping[str, int]) -> None:
        messages = self._decode(raw, info)
        if self._is_shedding:  # those behind it, too, and then those to be used
            for _ in range(self._qos.depth):
                if (taken := self._take()) is None:
                    break
                messages += self._decode(*taken)
            messages = self.shedding.newest(messages, time.time_ns(), time.monotonic())
        for count, waiting in enumerate(messages, start=1):
            self.has_more = len(messages) > 1
            if waiting.received_ns:
                for other in self.read_first:
                    other.read_until(waiting.received_ns)
            self.has_more = count < len(messages)
            self._on_message(waiting.message, waiting.receive_ns)

    def _decode(self, raw: bytes, info: Mapping[str, int]) -> list[Waiting]:
        """Return a message, decoded, in a list; none if it can't be."""
        self._received_ns = info['received_timestamp']
        # Not now: while the node is busy messages wait, as the system clock shows. A simulated
        # clock only has the present time, and some middlewares give none but zero.
        clock = self._node.get_clock()
        if has_time := self._received_ns > 0:
            self.backlog.add(to_s(time.time_ns() - self._received_ns), time.monotonic())
        is_of_ros = has_time and not clock.ros_time_is_active
        receive_ns = self._received_ns if is_of_ros else int(clock.now().nanoseconds)
        self.received += 1
        self.last_received_s = time.monotonic()
        self._types.have_come.add(self._types.chosen)
        try:
            message = self._decoders[self._types.chosen](raw, receive_ns)
        except MessageError as error:
            self.malformed += 1
            self.last_malformed = self._log.event(
                'malformed_message',
                self.topic,
                f' ({self.malformed} so far)',
                topic=f"'{self.topic}'",
                error=error,
            )
            return []
        return [Waiting(message, self._received_ns, receive_ns)]

    @property
    def _wanted(self) -> str:
        """The types that are read, by their short names where there are many."""
        names = list(self._decoders)
        if len(names) > MAX_FULL_NAMES:
            names = list(dict.fromkeys(name.rpartition('/')[2] for name in names))
        *others, last = names
        return f'{", ".join(others)} or {last}' if others else last

    def _find_fault(self, publishers: list[TopicEndpointInfo], usable: list[str]) -> str:
        """Return why no publisher can be heard; empty if all can."""
        topic, wanted = self.topic, self._wanted
        if not publishers:
            return fault('nothing_published', topic=topic, wanted=wanted)
        if not usable:
            types = sorted({publisher.topic_type for publisher in publishers})
            hint = ''.join(f'; set {self.advice[t]}' for t in types if t in self.advice)
            listed = ', '.join(types)
            return fault('other_type', topic=topic, types=listed, wanted=wanted, hint=hint)
        for publisher in publishers:
            compatibility, reason = qos_check_compatible(publisher.qos_profile, self._qos)
            if compatibility == QoSCompatibility.ERROR:
                reason = reason.strip()
                return fault('other_quality', node=publisher.node_name, topic=topic, reason=reason)
        return ''
