"""Whose clock stamps are of: another machine's, or another run's of /clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from statistics import median_low
import time
from typing import TypeAlias

from slam_observer_ros.common.stamps import to_s

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


Use: TypeAlias = Callable[[], None]
"""Uses a message that was held."""

AROUND_S = 0.5
"""How much later than /clock messages of the run before may come, by a steady clock."""

MAX_LOOKS = 25
"""How often a node looks whether /clock has jumped, every 20 ms, before it uses what it holds.

Not a time: a node that was held up itself has not seen yet what has come meanwhile.
"""

MAX_HELD = 10_000
"""Messages that may wait for /clock to jump."""


class ClockChange:
    """Holds messages of the next run until /clock has jumped, and finds those of the last one.

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
