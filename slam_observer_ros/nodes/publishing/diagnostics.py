"""The observer's health as a diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from slam_observer_ros.common.findings import Finding, found, in_brief, Level, worst_first
from slam_observer_ros.common.types import is_automatic
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.nodes.guarded_node import GuardedNode
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.publishing.localisation_status import LocalisationStatus
from slam_observer_ros.nodes.publishing.mistake_watch import MistakeWatch
from slam_observer_ros.runs.corrections import explained, ODOMETRY_CAUSES
from slam_observer_ros.runs.health import (
    estimator_values,
    of_all_learnt,
    of_estimate,
    of_left_out,
    of_map_without_ids,
    of_rejections,
    of_stamps,
    of_velocity,
)

SILENT_S = 2.0  # an input without messages for this long is a warning
RECENT = 30  # statuses, of about a second each, over which rejected points are counted
MIN_POINTS = 50  # points that it takes to say how large a share of them is rejected
MANY_EMPTY = 200  # messages without a landmark, that are no detector that waits for one
MANY_UNUSED = 20  # messages, none of which was used, that are no transient of the start

USED_AS = {'twist': 'velocity', 'landmarks': 'observation'}
"""Inputs, and what their messages are counted as when they are used."""


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
        """Judge where the robot is, what came, and what is estimated."""
        findings: list[Finding] = []
        if not self._estimator.is_localised:
            findings.append(found('unknown_pose'))
            # Landmarks that came without an id have one that was given here.
            estimator = self._estimator
            problem = estimator.localisation_problem
            if is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses):
                findings += [problem] if problem else []
        if dropped:  # what came while the node was paused or inactive was not to be used
            findings += [found_so for source in self._inputs for found_so in self._of_use(source)]
        findings += [
            found('silent_input', topic=source.topic)
            for source in self._inputs
            if not source.problem and source.silent_s > SILENT_S
        ]
        if self._feed.is_paused:
            findings.append(found('paused'))
        elif dropped:
            (reason, _), *others = dropped.most_common()
            count = f'{dropped.total()} message{"s" * (dropped.total() != 1)}'
            reasons = f'mostly {reason}' if others else reason
            findings.append(found('dropped_messages', count=count, reasons=reasons))
        findings += self._of_messages()
        findings += self._of_empty_messages() + self._estimator.ids_at_two_places
        findings += of_left_out(new, Level.WARNING)
        self._recent_counts.append(new)
        recent = sum(self._recent_counts, Counter())
        if recent['observed_point'] >= MIN_POINTS:
            findings += of_rejections(recent, 'seen lately ')
        findings += of_velocity(self._estimator) + of_estimate(self._estimator)
        findings += of_map_without_ids(self._estimator, self._estimator.ambiguity)
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

    def _of_use(self, source: InputTopic[Any]) -> list[Finding]:
        """Report an input whose messages come, and not one of them was used so far."""
        kind = USED_AS.get(source.name)
        if kind is None or source.received < MANY_UNUSED or self._feed.is_paused:
            return []
        if self._last_counts[kind]:
            return []
        return [found('unused_input', count=source.received, topic=source.topic)]

    def _of_messages(self) -> list[Finding]:
        """Report inputs whose messages can't be read, have no stamp, or say what can't be."""
        malformed = Counter({source.topic: source.malformed for source in self._inputs})
        unreadable, unstamped = malformed - self._last_malformed, self._feed.unstamped
        said = [source.last_malformed for source in self._inputs if unreadable[source.topic]]
        said += [source.doubt for source in self._inputs]
        findings = [finding for finding in said if finding is not None]
        findings += of_stamps(unstamped - self._last_unstamped)
        self._last_malformed, self._last_unstamped = malformed, unstamped.copy()
        return findings

    def _of_empty_messages(self) -> list[Finding]:
        """Report, and log once, that a detector has not seen anything so far."""
        observations = self._last_counts['observation']
        if self._seen_s is not None or observations < MANY_EMPTY:
            return []
        finding = found('empty_messages', count=observations)
        if not self._said_empty:
            self._said_empty = True
            self._node.get_logger().warning(finding.text())
        return [finding]
