"""Names a mistake of the set-up while the robot drives, where something does not fit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
import time
from typing import Protocol, TypeAlias

from rclpy.node import Node

from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.events import Event
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.runs.corrections import driven_s, SUSPICIOUS
from slam_observer_ros.settings.estimator_settings import Settings

WINDOW_NS, MOST_EVENTS = to_ns(60.0), 20_000
"""Time, and events, of late that are looked at."""

LEAST_DRIVEN_S = 20.0
"""Driving that says something; the most that a search may then take is left of a minute."""

PERIOD_S, SLICE_S = 0.05, 0.01
"""How often a search goes on, and for how long, so that no message waits for it."""

PAUSE_S = 60.0
"""Time between two searches: before, most of the events are the same."""


class Slices(Protocol):
    """Looks for mistakes of a set-up, a part at a time (``runs/mistakes.py``)."""

    findings: list[Finding]

    def advance(self, seconds: float) -> bool:
        """Go on for some time; return whether ``findings`` are known."""


Begin: TypeAlias = Callable[[Settings, Sequence[Event], Sequence[LandmarkMap] | None], Slices]


class MistakeWatch:
    """Keeps the events of late, and searches them for a mistake while there is reason for that.

    Attributes
    ----------
    findings : list of Finding
        What the last search has named.
    timer : Timer
        It runs only while a search goes on.

    """

    def __init__(self, node: Node, estimator: Estimate, begin_search: Begin) -> None:
        self.findings: list[Finding] = []
        self._node = node
        self._estimator, self._begin_search = estimator, begin_search
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._search: Slices | None = None
        self._next_s = 0.0
        self.timer = node.create_steady_timer(PERIOD_S, self._advance)
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
        is_suspicious = has_slipped or any(each.kind in SUSPICIOUS for each in findings)
        if (is_suspicious or self.findings) and driven_s(self._events) > LEAST_DRIVEN_S:
            maps = self._estimator.loaded_maps
            self._search = self._begin_search(
                self._estimator.settings, list(self._events), maps or None
            )
            self.timer.reset()

    def _advance(self) -> None:
        if self._search is not None and self._search.advance(SLICE_S):
            before = {finding.kind for finding in self.findings}
            self.findings, self._search = self._search.findings, None
            self._next_s = time.monotonic() + PAUSE_S
            for finding in self.findings:
                if finding.kind not in before:
                    self._node.get_logger().error(finding.text())
        if self._search is None:
            self.timer.cancel()
