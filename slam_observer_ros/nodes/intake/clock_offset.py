"""How far the clock behind a topic's stamps is from this machine's."""

from __future__ import annotations

from collections import deque
from statistics import median_low

from slam_observer_ros.common.units import to_s

SAMPLES = 11
"""Messages whose median offset is looked at: five stragglers in a row change nothing."""


class ClockOffset:
    """Offset of the stamps of one publisher; beyond ``limit_ns`` they are of another clock.

    Attributes
    ----------
    offset_ns : int or None
        Stamp minus time of reception, median of the last messages; None until known.
    correction_ns : int
        What must be added to the stamps to have them in this machine's time; it changes only
        when the stamps so corrected leave the limit, so that their order is kept.

    """

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._recent: deque[int] = deque(maxlen=SAMPLES)
        self.offset_ns: int | None = None
        self.correction_ns = 0

    @property
    def is_off(self) -> bool:
        """Whether the stamps are from another clock."""
        return self.offset_ns is not None and abs(self.offset_ns) > self._limit_ns

    def __str__(self) -> str:
        """Say how far off the stamps are."""
        offset_ns = self.offset_ns or 0
        side = 'ahead of' if offset_ns > 0 else 'behind'
        return f"{to_s(abs(offset_ns)):.3f} s {side} this machine's clock"

    def problem(self, topic: str, is_simulated: bool) -> str:
        """Report how far off the stamps on a topic are; empty if they are right.

        ``is_simulated``: this machine's clock is /clock.
        """
        if not self.is_off:
            return ''
        advice = 'synchronise the clocks, or set use_sim_time (for a recording)'
        if is_simulated:
            advice = 'see whether their publisher uses /clock, and this machine keeps up with it'
        late = ''
        if (self.offset_ns or 0) < 0:
            late = ', or what publishes them is that late: then make it faster; otherwise'
        return f'stamps on {topic} are {self}{late or ":"} {advice}, or set correct_clock_offset'

    def add(self, stamp_ns: int, receive_ns: int) -> None:
        """Take the stamp and the time of reception of a message."""
        self._recent.append(stamp_ns - receive_ns)
        if len(self._recent) < SAMPLES:
            return
        self.offset_ns = median_low(self._recent)
        if abs(self.offset_ns + self.correction_ns) > self._limit_ns:
            self.correction_ns = -self.offset_ns if self.is_off else 0

    def clear(self) -> None:
        """Forget all offsets, as after a jump of this machine's clock."""
        self._recent.clear()
        self.offset_ns = None
        self.correction_ns = 0
