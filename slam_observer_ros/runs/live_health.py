"""The judge of a running node: what is wrong with its inputs, their clocks, /tf and its place.

Nodes hand over what they count and measure, and show what is found here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
import math
from statistics import median_low
from typing import Any

import numpy as np

from slam_observer_ros.common.findings import fault, Finding, found, Level
from slam_observer_ros.common.stamps import is_of_1970, to_s
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.settings.node_settings import ObserverNodeSettings


def deviations(estimator: Estimate) -> tuple[float, float] | None:
    """Return standard deviations of position, in its worst direction, m, and of heading, rad.

    None if they are not known, and infinite if the covariance is not finite.
    """
    covariance = None if estimator.stamp_ns is None else estimator.pose_covariance
    if covariance is None:
        return None
    if not np.isfinite(covariance).all():
        return np.inf, np.inf
    variances_m2 = np.linalg.eigvalsh(covariance[3:, 3:])
    return math.sqrt(max(variances_m2[-1], 0.0)), math.sqrt(max(covariance[2, 2], 0.0))


def localisation(
    estimator: Estimate, limits: ObserverNodeSettings, share: float = 1.0
) -> tuple[Level, str]:
    """Judge, in words too, how well the pose is known.

    The robot is lost from a share of the error level on.
    """
    if estimator.stamp_ns is None:
        return Level.WARNING, 'no estimate yet'
    if not estimator.is_localised:
        return Level.ERROR, 'the pose in the loaded map is not known'
    if estimator.is_contradicted:
        return Level.ERROR, found('contradicted_pose').what
    if estimator.map_name and estimator.ambiguity is not None:
        return Level.ERROR, 'what is seen fits several places of the map'
    if (known := deviations(estimator)) is None:
        return Level.NOTE, 'localised; the gains know no standard deviation'
    worst, reasons = Level.NOTE, []
    for name, value, unit, (warn, lost) in (
        ('position', known[0], 'm', limits.position_limits),
        ('heading', known[1], 'rad', limits.heading_limits),
    ):
        error = share * lost
        if value > min(warn, error):
            worst = max(worst, Level.ERROR if value > error else Level.WARNING)
            reasons.append(f'{name} uncertain: σ = {value:.2f} {unit}')
    return worst, '; '.join(reasons) or 'localised'


def of_publishers(topic: str, publishers: Sequence[Any]) -> Finding | None:
    """Report who publishes on a topic, by rclpy's TopicEndpointInfo, if more than one does."""
    if len(publishers) < 2:
        return None
    names = sorted(f'{p.node_namespace.rstrip("/")}/{p.node_name}' for p in publishers)
    return found('several_publishers', count=len(names), names=', '.join(names), topic=topic)


def of_types(topic: str, heard: str, others: str) -> Finding:
    """Report that types beside the one that is heard are published on a topic."""
    return found('several_types', topic=topic, heard=heard, others=others)


def of_twist(topic: str, problem: str) -> Finding:
    """Report that an odometry's twist is not how its poses move; without problem, that it is 0."""
    return found('wrong_twist' if problem else 'zero_twist', topic=topic, problem=problem)


BEHIND_S = 0.3
"""Messages that wait for less, as while a map is loaded, are no matter."""

LASTING_S = 2.0
"""How long messages have to wait for more than that before it is reported."""


class Backlog:
    """Distinguishes a program that can't keep up with a topic from one busy for a moment.

    ``wait_s`` is how long the last message has waited, seconds.
    """

    def __init__(self) -> None:
        self.wait_s = 0.0
        self._last_s = 0.0
        self._behind_since_s: float | None = None

    def add(self, wait_s: float, now_s: float) -> None:
        """Take how long a message that is read now, at a steady time, has waited, seconds.

        That is less than zero if the clock was set meanwhile.
        """
        is_long_ago = now_s - self._last_s > LASTING_S
        self.wait_s, self._last_s = max(wait_s, 0.0), now_s
        if self.wait_s <= BEHIND_S:
            self._behind_since_s = None
        elif self._behind_since_s is None or is_long_ago:
            self._behind_since_s = now_s

    def problem(self, topic: str, now_s: float) -> str:
        """Report that messages have waited for long and still do; empty if not."""
        since_s, last_s = self._behind_since_s, self._last_s
        if since_s is None or last_s - since_s < LASTING_S or now_s - last_s > LASTING_S:
            return ''
        return fault('slow_node', topic=topic, wait_s=self.wait_s)


MIN_PERIOD_S = 2.0
"""Time over which it is seen how much is dropped: who was busy for a moment does keep up."""

MANY_SHED = 0.1
"""Share of the messages from which on it is reported."""


def overload(topic: str, read: int, shed: int, period_s: float) -> str:
    """Report that many messages of a period were dropped, and how many would not be; else ''."""
    if period_s < MIN_PERIOD_S or shed <= MANY_SHED * read:
        return ''
    rate_hz, used_hz = read / period_s, (read - shed) / period_s
    return fault('overload', topic=topic, rate_hz=rate_hz, used_hz=used_hz)


SAMPLES = 11
"""Messages whose median offset is looked at: five stragglers in a row change nothing."""

FUTURE_NS = 50_000_000
"""Stamps that are further ahead of their reception can only be of another clock, nanoseconds."""


class ClockOffset:
    """Offset of the stamps of one publisher, by which they may be of another clock.

    Behind this machine's by more than ``limit_ns``, or ahead of it by ``FUTURE_NS``: a message can
    be late, but not early.

    Attributes
    ----------
    offset_ns : int or None
        Stamp minus time of reception, median of the last messages; None until known.
    correction_ns : int
        What must be added to the stamps to have them in this machine's time; it changes only
        when the stamps so corrected leave the limit, so that their order is kept.

    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = self._ahead_ns = limit_ns
        self._recent: deque[int] = deque(maxlen=SAMPLES)
        self.offset_ns: int | None = None
        self.correction_ns = 0
        self._counts_from_start = False

    @property
    def is_off(self) -> bool:
        """Whether the stamps are from another clock."""
        return self.offset_ns is not None and not self._is_near(self.offset_ns)

    def __str__(self) -> str:
        """Say how far off the stamps are."""
        offset_ns = self.offset_ns or 0
        side = 'ahead of' if offset_ns > 0 else 'behind'
        return f"{to_s(abs(offset_ns)):.3f} s {side} this machine's clock"

    def problem(self, topic: str, is_simulated: bool) -> str:
        """Report how far off the stamps on a topic are, or one of late; empty if they are right.

        ``is_simulated``: this machine's clock is /clock.
        """
        if self.is_off and self._counts_from_start:
            simulation = 'whose /clock is another' if is_simulated else 'set use_sim_time'
            return fault('stamps_of_1970', topic=topic, simulation=simulation)
        advice = 'synchronise the clocks, or set use_sim_time (for a recording)'
        if is_simulated:
            advice = 'see whether their publisher uses /clock, and this machine keeps up with it'
        if self.is_off:
            late = ':'
            if (self.offset_ns or 0) < 0:
                late = ', or what publishes them is that late: then make it faster; otherwise'
            return fault('stamps_off', topic=topic, off=self, late=late, advice=advice)
        ahead_ns = max(self._recent, default=0)
        if ahead_ns > self._ahead_ns:
            return fault('stamp_ahead', topic=topic, ahead_s=to_s(ahead_ns), advice=advice)
        return ''

    def add(self, stamp_ns: int, receive_ns: int, is_simulated: bool = False) -> None:
        """Take the stamp and the time of reception of a message; by /clock if ``is_simulated``."""
        # /clock stands still between two of its messages.
        self._ahead_ns = self._limit_ns if is_simulated else min(FUTURE_NS, self._limit_ns)
        self._recent.append(stamp_ns - receive_ns)
        self._counts_from_start = is_of_1970(stamp_ns) and not is_of_1970(receive_ns)
        if len(self._recent) < SAMPLES:
            return
        self.offset_ns = median_low(self._recent)
        if not self._is_near(self.offset_ns + self.correction_ns):
            self.correction_ns = -self.offset_ns if self.is_off else 0

    def _is_near(self, offset_ns: int) -> bool:
        return -self._limit_ns <= offset_ns <= self._ahead_ns

    def clear(self) -> None:
        """Forget all offsets, as after a jump of this machine's clock."""
        self._recent.clear()
        self.offset_ns = None
        self.correction_ns = 0
