"""The observer's health: /diagnostics, ~/is_localised, and a search for mistakes of the set-up."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from std_msgs.msg import Bool

from slam_observer_ros.common.findings import (
    explained,
    Finding,
    in_brief,
    Level,
    ODOMETRY_CAUSES,
    SUSPICIOUS,
    worst_first,
)
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import Event
from slam_observer_ros.nodes.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.input_topic import InputTopic
from slam_observer_ros.nodes.ros_node import GuardedNode, LATCHED_QOS, ThrottledLog
from slam_observer_ros.runs.health import (
    deviations,
    estimator_values,
    InputNumbers,
    localisation,
    NoiseFit,
    of_all_learnt,
    of_node,
    Progress,
)
from slam_observer_ros.runs.mistakes import Drive, LEAST_DRIVEN_S, leaves_mount_open, Search
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

FOUND_AGAIN = 0.8  # of the error level: near it the robot would be lost and found all the time


class LocalisationStatus:
    """Judges the standard deviations of position and heading; publishes ``~/is_localised``."""

    def __init__(
        self, node: Node, settings: ObserverNodeSettings, estimator: Estimate, noise: NoiseFit
    ) -> None:
        self._node, self._settings, self._estimator = node, settings, estimator
        self._noise = noise
        self._log = ThrottledLog(node)
        self._is_localised: bool | None = None
        self._was_localised = False
        self._publisher = node.create_publisher(Bool, '~/is_localised', LATCHED_QOS)

    def publish(self) -> None:
        """Publish, and log, whether the robot is localised, if that has changed."""
        share = FOUND_AGAIN if self._is_localised is False else 1.0
        level, message = localisation(self._estimator, self._settings, share)
        is_localised = level < Level.ERROR and self._estimator.stamp_ns is not None
        if is_localised == self._is_localised:
            return
        if self._is_localised:
            self._log.warning('lost', f'not localised any more: {message}')
        elif self._was_localised:
            self._log.info('found', 'localised again')
        self._is_localised = is_localised
        self._was_localised |= is_localised
        self._publisher.publish(Bool(data=is_localised))

    @property
    def findings(self) -> list[Finding]:
        """What is wrong with the noise that is stated."""
        return self._noise.findings

    def status(self, hardware_id: str, unexplained: Sequence[Finding]) -> DiagnosticStatus:
        """Return the status for /diagnostics, with those findings that nothing else explains."""
        level, message = localisation(self._estimator, self._settings)
        for finding in self._noise.findings:
            if finding in unexplained and finding.level >= Level.WARNING:
                level = max(level, Level.WARNING)
                message = f'{message}; {finding.what}'
        known = ['unknown'] * 2
        if (known_to := deviations(self._estimator)) is not None:
            known = [f'{each:.3f}' for each in known_to]
        values = {
            'map': self._estimator.map_name or 'none',
            'position, standard deviation [m]': known[0],
            'heading, standard deviation [rad]': known[1],
            'innovations / stated noise': str(self._noise),
        }
        return DiagnosticStatus(
            level=bytes([level]),
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: localisation',
            hardware_id=hardware_id,
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


WINDOW_NS, MOST_EVENTS = to_ns(60.0), 20_000  # time, and events, of late that are looked at
PERIOD_S, SLICE_S = 0.03, 0.01  # how often a search goes on, and how long: no message waits for it

# Time between the starts of two searches, at most: before, most of the events are the same. Where
# less was driven than in that time, new events are as many as old ones sooner.
PAUSE_S = 60.0


class MistakeWatch:
    """Keeps the events of late, and searches them for a mistake while there is reason for that."""

    def __init__(self, node: Node, estimator: Estimate, begin_search: type[Search]) -> None:
        self.findings: list[Finding] = []  # what the last search has named
        self._node = node
        self._estimator, self._begin_search = estimator, begin_search
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._search: Search | None = None
        self._next_s = 0.0
        # A mount shows by no symptom: it is looked at after a minute, and each twice as long.
        self._pause_s = PAUSE_S
        self._mount_s = time.monotonic() + PAUSE_S
        self.timer = node.create_steady_timer(PERIOD_S, self._advance)  # while a search goes on
        self.timer.cancel()

    def note(self, event: Event) -> None:
        """Keep an event as the estimator gets it."""
        self._events.append(event)
        while self._events[0].stamp_ns < event.stamp_ns - WINDOW_NS:
            self._events.popleft()

    def clear(self) -> None:
        """Forget what was of another time."""
        self._events.clear()
        self._search = None

    def look(self, findings: Iterable[Finding], has_slipped: bool) -> None:
        """Begin to search if what was found, or named before, is reason for that."""
        if self._search is not None or time.monotonic() < self._next_s:
            return
        settings, now_s = self._estimator.settings, time.monotonic()
        is_suspicious = has_slipped or any(each.kind in SUSPICIOUS for each in findings)
        named = {each.kind for each in self.findings}
        of_mount_only = not is_suspicious and named <= {'mount_off'}
        if of_mount_only and (now_s < self._mount_s or not leaves_mount_open(settings)):
            return
        if (driven_s := Drive(self._events).driven_s) > LEAST_DRIVEN_S:
            self._next_s = now_s + min(driven_s, PAUSE_S)
            if of_mount_only:
                self._mount_s = now_s + self._pause_s
                self._pause_s *= 2.0
            maps = self._estimator.loaded_maps
            self._search = self._begin_search(
                settings, list(self._events), maps or None, of_mount_only
            )
            self.timer.reset()

    def _advance(self) -> None:
        if self._search is not None and self._search.advance(SLICE_S):
            before = {finding.kind for finding in self.findings}
            self.findings, self._search = self._search.findings, None
            for finding in self.findings:
                if finding.kind not in before:
                    self._node.get_logger().error(finding.text())
        if self._search is None:
            self.timer.cancel()


RECENT = 30  # statuses, of about a second each, over which rejected points are counted


class DiagnosticsPublisher:
    """Publishes what comes in, what is dropped and why, on ``/diagnostics``."""

    def __init__(
        self,
        node: GuardedNode,
        estimator: Estimator,
        feed: EstimatorFeed,
        inputs: Sequence[InputTopic],
        estimate_publisher: EstimatePublisher,
        localisation: LocalisationStatus,
        watch: MistakeWatch,
        hardware_id: str,
    ) -> None:
        self._node, self._hardware_id, self._estimator = node, hardware_id, estimator
        self._feed, self._inputs = feed, inputs
        self._estimate_publisher, self._localisation = estimate_publisher, localisation
        self._watch = watch
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last_time_s = time.monotonic()
        self._seen_s: float | None = None  # when a landmark was seen last
        self._said_empty = False
        self._since_s: dict[str, float] = {}  # when what is wrong was found first
        self._last: dict[str, Counter[str]] = {}  # what was counted so far, by what it is of
        self._recent_counts: deque[Counter[str]] = deque(maxlen=RECENT)

    def publish(self) -> None:
        """Publish the status of the estimate and of the localisation, about once a second."""
        shed = Counter(overload=sum(source.shedding.shed for source in self._inputs))
        unused = self._estimator.dropped + self._feed.dropped + shed
        malformed = Counter({source.topic: source.malformed for source in self._inputs})
        dropped = self._new('dropped', unused + Counter(malformed=malformed.total()))
        new = self._new('used', self._estimator.counts)
        self._recent_counts.append(new)
        now_s = time.monotonic()
        if new['observed_point']:
            self._seen_s = now_s
        unstamped, recent = self._new('unstamped', self._feed.unstamped), self._recent_counts
        is_paused, has_seen = self._feed.is_paused, self._seen_s is not None
        progress = Progress(
            dropped, new, unstamped, sum(recent, Counter()), is_paused=is_paused, has_seen=has_seen
        )
        unreadable = self._new('malformed', malformed)
        numbers = [
            InputNumbers(
                source.name,
                source.topic,
                source.received,
                source.silent_s,
                source.problem,
                source.doubt,
                source.last_malformed if unreadable[source.topic] else None,
            )
            for source in self._inputs
        ]
        symptoms = of_node(self._estimator, numbers, progress)
        for finding in symptoms:
            if finding.kind == 'empty_messages' and not self._said_empty:
                self._said_empty = True
                self._node.get_logger().warning(finding.text())
        of_both = explained([*symptoms, *self._localisation.findings])
        if any(each.kind in ODOMETRY_CAUSES for each in symptoms):
            self._estimator.distrust_odometry()
            self._watch.look([], has_slipped=False)
        else:
            reasons = [*of_both, *of_all_learnt(self._estimator)]
            self._watch.look(reasons, has_slipped=new['slip'] > 0)
        findings = explained([*self._watch.findings, *symptoms])
        problems = worst_first(findings, self._faults())
        self._since_s = {each.kind: self._since_s.get(each.kind, now_s) for each in findings}
        values = self._input_values(now_s - self._last_time_s)
        self._last_time_s = now_s
        values |= estimator_values(self._estimator, unused, findings)
        seen_s = 'never' if self._seen_s is None else f'{now_s - self._seen_s:.0f}'
        values['landmarks seen, age [s]'] = seen_s
        values['processing time, mean [ms]'] = f'{self._feed.take_mean_processing_ms():.3f}'
        values |= {f'problem {i}': problem for i, problem in enumerate(problems, start=1)}
        values |= {f'{kind}, for [s]': f'{now_s - t:.0f}' for kind, t in self._since_s.items()}
        status = DiagnosticStatus(
            level=bytes([progress.level(findings, problems)]),
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: estimate',
            hardware_id=self._hardware_id,
            message=in_brief(problems) or 'running',
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        localisation = self._localisation.status(self._hardware_id, of_both)
        message = DiagnosticArray(status=[status, localisation])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _new(self, what: str, counts: Counter[str]) -> Counter[str]:
        """Return what was counted since the last time."""
        before = self._last.get(what, Counter())
        self._last[what] = counts.copy()
        return counts - before

    def _input_values(self, elapsed_s: float) -> dict[str, str]:
        values = {}
        new = self._new('received', Counter({each.topic: each.received for each in self._inputs}))
        for source in self._inputs:
            age = 'never' if source.age_s is None else f'{source.age_s:.3f}'
            values[f'{source.topic} rate [Hz]'] = f'{new[source.topic] / elapsed_s:.1f}'
            values[f'{source.topic} age [s]'] = age
            values[f'{source.topic} wait [s]'] = f'{source.backlog.wait_s:.3f}'
            if source.malformed:
                values[f'{source.topic} malformed'] = str(source.malformed)
        if (age_s := self._estimate_publisher.odometry_age_s) is not None:
            values['odometry on /tf age [s]'] = f'{age_s:.3f}'
        return values

    def _faults(self) -> list[str]:
        """Return what inputs, clocks and publishers report of themselves, with what to do."""
        output, faults = self._estimate_publisher, [source.problem for source in self._inputs]
        faults += [*self._feed.clock_problems(), output.early_odometry(), output.rivals()]
        return [fault for fault in [*faults, output.problem, self._node.last_failure] if fault]
