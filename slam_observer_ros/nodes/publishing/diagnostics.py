"""The observer's health as a diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from slam_observer_ros.common.findings import Finding, in_brief, Level, worst_first
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.nodes.guarded_node import GuardedNode
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.publishing.localisation_status import LocalisationStatus
from slam_observer_ros.nodes.publishing.mistake_watch import MistakeWatch
from slam_observer_ros.runs.corrections import explained, ODOMETRY_CAUSES
from slam_observer_ros.runs.health import estimator_values, of_all_learnt
from slam_observer_ros.runs.live_health import InputNumbers, of_node, Progress

RECENT = 30  # statuses, of about a second each, over which rejected points are counted


class DiagnosticsPublisher:
    """Publishes what comes in, what is dropped and why, on ``/diagnostics``."""

    def __init__(
        self,
        node: GuardedNode,
        estimator: Estimator,
        feed: EstimatorFeed,
        inputs: Sequence[InputTopic[Any]],
        estimate_publisher: EstimatePublisher,
        localisation: LocalisationStatus,
        watch: MistakeWatch,
        hardware_id: str,
    ) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._estimator = estimator
        self._feed = feed
        self._inputs = inputs
        self._estimate_publisher = estimate_publisher
        self._localisation = localisation
        self._watch = watch
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last_time_s = time.monotonic()
        self._seen_s: float | None = None  # when a landmark was seen last
        self._said_empty = False
        self._since_s: dict[str, float] = {}  # when what is wrong was found first
        self._last_received = {source.topic: 0 for source in inputs}
        self._last_dropped: Counter[str] = Counter()
        self._last_malformed: Counter[str] = Counter()
        self._last_unstamped: Counter[str] = Counter()
        self._last_counts: Counter[str] = Counter()
        self._recent_counts: deque[Counter[str]] = deque(maxlen=RECENT)

    def publish(self) -> None:
        """Publish the status of the estimate and of the localisation, about once a second."""
        dropped, new = self._progress()
        symptoms = self._findings(dropped, new)
        of_both = explained([*symptoms, *self._localisation.findings])
        disturbs = any(each.kind in ODOMETRY_CAUSES for each in symptoms)
        if disturbs:
            self._estimator.distrust_odometry()
            self._watch.look([], has_slipped=False)
        else:
            reasons = [*of_both, *of_all_learnt(self._estimator)]
            self._watch.look(reasons, has_slipped=new['slip'] > 0)
        findings = explained([*self._watch.findings, *symptoms])
        level = max((finding.level for finding in findings), default=Level.NOTE)
        used = new['velocity'] + new['observation']
        if dropped and not used and not self._feed.is_paused:
            level = Level.ERROR
        problems = worst_first(findings, self._faults())
        if problems:
            level = max(level, Level.WARNING)
        now_s = time.monotonic()
        self._since_s = {each.kind: self._since_s.get(each.kind, now_s) for each in findings}
        values = self._input_values() | self._estimator_values(findings)
        values |= {f'problem {i}': problem for i, problem in enumerate(problems, start=1)}
        values |= {f'{kind}, for [s]': f'{now_s - t:.0f}' for kind, t in self._since_s.items()}
        status = DiagnosticStatus(
            level=bytes([level]),
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: estimate',
            hardware_id=self._hardware_id,
            message=in_brief(problems) or 'running',
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        of_fit = [each for each in self._localisation.findings if each in of_both]
        localisation = self._localisation.status(self._hardware_id, of_fit)
        message = DiagnosticArray(status=[status, localisation])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def _input_values(self) -> dict[str, str]:
        now_s = time.monotonic()
        elapsed_s = now_s - self._last_time_s
        self._last_time_s = now_s
        values = {}
        for source in self._inputs:
            new = source.received - self._last_received[source.topic]
            self._last_received[source.topic] = source.received
            age = 'never' if source.age_s is None else f'{source.age_s:.3f}'
            values[f'{source.topic} rate [Hz]'] = f'{new / elapsed_s:.1f}'
            values[f'{source.topic} age [s]'] = age
            values[f'{source.topic} wait [s]'] = f'{source.backlog.wait_s:.3f}'
            if source.malformed:
                values[f'{source.topic} malformed'] = str(source.malformed)
        if (age_s := self._estimate_publisher.odometry_age_s) is not None:
            values['odometry on /tf age [s]'] = f'{age_s:.3f}'
        return values

    def _estimator_values(self, findings: Sequence[Finding]) -> dict[str, str]:
        values = estimator_values(self._estimator, self._dropped(), findings)
        age_s = 'never' if self._seen_s is None else f'{time.monotonic() - self._seen_s:.0f}'
        values['landmarks seen, age [s]'] = age_s
        values['processing time, mean [ms]'] = f'{self._feed.take_mean_processing_ms():.3f}'
        return values

    def _progress(self) -> tuple[Counter[str], Counter[str]]:
        """Return why messages were dropped since the last time, and what else was counted."""
        dropped = self._dropped()
        dropped['malformed'] += sum(source.malformed for source in self._inputs)
        counts = self._estimator.counts
        since_last = dropped - self._last_dropped, counts - self._last_counts
        self._last_dropped, self._last_counts = dropped, counts
        if since_last[1]['observed_point']:
            self._seen_s = time.monotonic()
        return since_last

    def _dropped(self) -> Counter[str]:
        """Return why messages that could be read were not used."""
        shed = Counter(overload=sum(source.shedding.shed for source in self._inputs))
        return self._estimator.dropped + self._feed.dropped + shed

    def _findings(self, dropped: Counter[str], new: Counter[str]) -> list[Finding]:
        """Return what is wrong by what was counted since the last time."""
        malformed = Counter({source.topic: source.malformed for source in self._inputs})
        unreadable, unstamped = malformed - self._last_malformed, self._feed.unstamped
        inputs = [
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
        self._recent_counts.append(new)
        progress = Progress(
            dropped,
            new,
            unstamped - self._last_unstamped,
            sum(self._recent_counts, Counter()),
            is_paused=self._feed.is_paused,
            has_seen=self._seen_s is not None,
        )
        self._last_malformed, self._last_unstamped = malformed, unstamped.copy()
        findings = of_node(self._estimator, inputs, progress)
        for finding in findings:
            if finding.kind == 'empty_messages' and not self._said_empty:
                self._said_empty = True
                self._node.get_logger().warning(finding.text())
        return findings

    def _faults(self) -> list[str]:
        """Return what inputs, clocks and publishers report of themselves, with what to do."""
        faults = [source.problem for source in self._inputs]
        faults += self._feed.clock_problems()
        faults.append(self._estimate_publisher.early_odometry())
        faults.append(self._estimate_publisher.rivals())
        faults.append(self._estimate_publisher.problem)
        faults.append(self._node.last_failure)
        return [fault for fault in faults if fault]
