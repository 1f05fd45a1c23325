"""How far the clock behind a topic's stamps is from this machine's."""

from __future__ import annotations

from collections import deque
from statistics import median_low

from slam_observer_ros.common.units import to_s

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
        advice = 'synchronise the clocks, or set use_sim_time (for a recording)'
        if is_simulated:
            advice = 'see whether their publisher uses /clock, and this machine keeps up with it'
        late = ''
        if (self.offset_ns or 0) < 0:
            late = ', or what publishes them is that late: then make it faster; otherwise'
        if self.is_off:
            what = f'stamps on {topic} are {self}{late or ":"}'
            return f'{what} {advice}, or set correct_clock_offset'
        ahead_ns = max(self._recent, default=0)
        if ahead_ns > self._ahead_ns:
            what = f"a stamp on {topic} was {to_s(ahead_ns):.3f} s ahead of this machine's clock"
            return f'{what}: {advice}'
        return ''

    def add(self, stamp_ns: int, receive_ns: int, is_simulated: bool = False) -> None:
        """Take the stamp and the time of reception of a message; by /clock if ``is_simulated``."""
        # /clock stands still between two of its messages.
        self._ahead_ns = self._limit_ns if is_simulated else min(FUTURE_NS, self._limit_ns)
        self._recent.append(stamp_ns - receive_ns)
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
