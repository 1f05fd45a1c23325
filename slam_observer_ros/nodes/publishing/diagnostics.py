"""The observer's health as a diagnostic_msgs/DiagnosticArray."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from slam_observer_ros.estimates import (
    MAX_REJECTED,
    MAX_REJECTED_ORIENTATIONS,
    point_share,
    UNUSED_POINTS,
)
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import is_automatic
from slam_observer_ros.nodes.guarded_node import GuardedNode
from slam_observer_ros.nodes.intake.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.intake.input_topic import InputTopic
from slam_observer_ros.nodes.publishing.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.publishing.localisation_status import LocalisationStatus
from slam_observer_ros.runs.health import estimator_values, estimator_warnings

SILENT_S = 2.0  # an input without messages for this long is a warning
RECENT = 30  # statuses, of about a second each, over which rejected points are counted
MIN_POINTS = 50  # points that it takes to say how large a share of them is rejected
MANY_EMPTY = 200  # messages without a landmark, that are no detector that waits for one
MANY_UNUSED = 20  # messages, none of which was used, that are no transient of the start

USED_AS = {'twist': 'velocity', 'landmarks': 'observation'}
"""Inputs, and what their messages are counted as when they are used."""

LEFT_OUT = (
    'rejected_landmark',
    'unknown_id',
    'repeated_id',
    'reserved_id',
    'impossible_id',
    'unweighed_point',
)
"""Points not used for something that is wrong; those that are not in a known map may be right."""


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
        hardware_id: str,
    ) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._estimator = estimator
        self._feed = feed
        self._inputs = inputs
        self._estimate_publisher = estimate_publisher
        self._localisation = localisation
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._last_time_s = time.monotonic()
        self._seen_s: float | None = None  # when a landmark was seen last
        self._said_empty = False
        self._last_received = {source.topic: 0 for source in inputs}
        self._last_dropped: Counter[str] = Counter()
        self._last_counts: Counter[str] = Counter()
        self._recent_counts: deque[Counter[str]] = deque(maxlen=RECENT)

    def publish(self) -> None:
        """Publish the status of the estimate and of the localisation, about once a second."""
        dropped, new = self._progress()
        # What came while the node was paused or inactive was not to be used.
        unused = [self._unused_warning(source) for source in self._inputs] if dropped else []
        unused = [warning for warning in unused if warning]
        warnings = unused + self._warnings(dropped, new)
        used = new['velocity'] + new['observation']
        level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        none_is_used = bool(dropped) and not used and not self._feed.is_paused
        if none_is_used or unused:
            level = DiagnosticStatus.ERROR
        values = self._input_values() | self._estimator_values()
        status = DiagnosticStatus(
            level=level,
            name=f'{self._node.get_fully_qualified_name().lstrip("/")}: estimate',
            hardware_id=self._hardware_id,
            message='; '.join(warnings) or 'running',
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status, self._localisation.status(self._hardware_id)])
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

    def _estimator_values(self) -> dict[str, str]:
        values = estimator_values(self._estimator, self._dropped())
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

    def _warnings(self, dropped: Counter[str], new: Counter[str]) -> list[str]:
        warnings = [self._input_warning(source) for source in self._inputs]
        warnings += self._feed.clock_problems()
        warnings.append(self._estimate_publisher.early_odometry())
        warnings.append(self._estimate_publisher.rivals())
        if self._feed.is_paused:
            warnings.append('paused')
        elif dropped:
            (reason, _), *others = dropped.most_common()
            reasons = f'mostly {reason}' if others else reason
            plural = 's' * (dropped.total() != 1)
            warnings.append(f'{dropped.total()} message{plural} dropped ({reasons})')
        warnings.append(self._empty_warning())
        warnings.append(self._points_warning(new))
        warnings += self._rejection_warnings(new)
        warnings += estimator_warnings(self._estimator)
        warnings.append(self._estimate_publisher.problem)
        warnings.append(self._node.last_failure)
        if not self._estimator.is_localised:
            warnings.append('the pose in the loaded map is not known yet: no pose is published')
            warnings.append(self._places_warning())
        return [warning for warning in warnings if warning]

    def _unused_warning(self, source: InputTopic[Any]) -> str:
        """Report an input whose messages come, and not one of them was used so far."""
        kind = USED_AS.get(source.name)
        if kind is None or source.received < MANY_UNUSED or self._feed.is_paused:
            return ''
        if self._last_counts[kind]:
            return ''
        return f"none of {source.received} messages on '{source.topic}' was used"

    def _empty_warning(self) -> str:
        """Report, and log once, that a detector has not seen anything so far."""
        observations = self._last_counts['observation']
        if self._seen_s is not None or observations < MANY_EMPTY:
            return ''
        if not self._said_empty:
            self._said_empty = True
            self._node.get_logger().warning(
                f'no landmark in the first {observations} messages: are there any in view, and is '
                'the detector set up for them?'
            )
        return f'no landmark in {observations} messages so far'

    def _places_warning(self) -> str:
        """Report where in a map points without ids fit."""
        # Landmarks that came without an id have one that was given here.
        if not is_automatic(self._estimator.landmark_ids).any():
            return ''
        return f'{self._estimator.localisation_problem} on initialpose'

    def _rejection_warnings(self, new: Counter[str]) -> list[str]:
        """Report that more points or orientations were rejected of late than are outliers."""
        self._recent_counts.append(new)
        recent = sum(self._recent_counts, Counter())
        if recent['observed_point'] < MIN_POINTS:
            return []
        points, orientations = (
            point_share(recent, f'rejected_{what}') for what in ('landmark', 'orientation')
        )
        warnings = []
        if points > MAX_REJECTED:
            warnings.append(f'{100.0 * points:.0f} % of the points seen lately were rejected')
        if orientations > MAX_REJECTED_ORIENTATIONS:
            warnings.append(
                f'the orientations of {100.0 * orientations:.0f} % of the tags seen lately were '
                'rejected: has the map other tag axes than the detector?'
            )
        return warnings

    @staticmethod
    def _points_warning(new: Counter[str]) -> str:
        """Report points left out since the last time: most of them, or for their ids."""
        left_out = {name: new[name] for name in LEFT_OUT if new[name]}
        of_wrong_ids = new['repeated_id'] + new['reserved_id'] + new['impossible_id']
        if not (of_wrong_ids or 2 * sum(left_out.values()) > new['observed_point']):
            return ''
        reasons = ', '.join(f'{count} {UNUSED_POINTS[name]}' for name, count in left_out.items())
        return f'of {new["observed_point"]} points seen {reasons}'

    @staticmethod
    def _input_warning(source: InputTopic[Any]) -> str:
        if source.problem:
            return source.problem
        if (source.age_s or 0.0) > SILENT_S:
            return f"no message on '{source.topic}'"
        return ''
