"""Messages that come late: stamped by another clock, or as a busy node lets them wait."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median_low
import time
from typing import Any, TypeAlias

from slam_observer_ros.common.stamps import is_of_1970, to_s

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
            return (
                f'stamps on {topic} are of 1970: they count from the start of a driver or machine '
                '(let it stamp with the time of ROS, or set correct_clock_offset), or are of a '
                f'simulation ({"whose /clock is another" if is_simulated else "set use_sim_time"})'
            )
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
    """Holds messages of the next run until /clock has jumped, and finds the last run's.

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


BEHIND_S = 0.3  # messages that wait for less, as while a map is loaded, are no matter
LASTING_S = 2.0  # how long messages have to wait for more than that before it is reported


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
        return (
            f"the node does not keep up: messages on '{topic}' wait {self.wait_s:.1f} s to be "
            'read; send fewer of them, or make observations cheaper ('
            'max_landmarks)'
        )


PERIOD_S = 5.0  # over which it is seen how much is dropped
MIN_PERIOD_S = 2.0  # a program that was busy for a moment does keep up
MANY_SHED = 0.1  # share of the messages from which on it is reported


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
    """Drops old messages once one has waited too long, so that an estimate does not age.

    Parameters
    ----------
    max_wait_s : float
        How long messages may wait to be read, seconds. If one has waited longer, only the newest
        of each sensor is used.

    Attributes
    ----------
    shed : int
        Messages dropped so far.

    """

    def __init__(self, max_wait_s: float) -> None:
        self._max_wait_s = max_wait_s
        self._recent: deque[tuple[float, int, int]] = deque()
        self.shed = 0

    def newest(self, waiting: Sequence[Waiting], now_ns: int, now_s: float) -> list[Waiting]:
        """Return which of the messages that wait, in order of reception, are to be used.

        ``now_ns`` is the system's time, by which they were received, ``now_s`` a steady one.
        """
        oldest_ns = min((each.received_ns for each in waiting if each.received_ns), default=now_ns)
        kept = list(waiting)
        if to_s(now_ns - oldest_ns) > self._max_wait_s:
            kept = _newest_of_each_sensor(waiting)
        shed = len(waiting) - len(kept)
        self.shed += shed
        self._recent.append((now_s, len(waiting), shed))
        self._forget_before(now_s - PERIOD_S)
        return kept

    def problem(self, topic: str, now_s: float) -> str:
        """Report that many messages were dropped lately, and how many would not be; else ''."""
        self._forget_before(now_s - PERIOD_S)
        read, shed = (sum(each[i] for each in self._recent) for i in (1, 2))
        period_s = now_s - self._recent[0][0] if self._recent else 0.0
        if period_s < MIN_PERIOD_S or shed <= MANY_SHED * read:
            return ''
        rate_hz, used_hz = read / period_s, (read - shed) / period_s
        return (
            f"the node does not keep up: of {rate_hz:.1f} messages a second on '{topic}' "
            f'it uses {used_hz:.1f}, the newest (dropped: overload); send no more than that, or '
            'fewer points in each, or make observations cheaper (max_landmarks)'
        )

    def _forget_before(self, steady_s: float) -> None:
        while self._recent and self._recent[0][0] < steady_s:
            self._recent.popleft()


def _newest_of_each_sensor(waiting: Sequence[Waiting]) -> list[Waiting]:
    """Return the messages without those all of whose sensors have newer ones."""
    kept: list[Waiting] = []
    seen: set[str] = set()
    for each in reversed(waiting):
        sensors = each.sensors
        if not sensors or sensors - seen:  # without any it costs nothing, as on /tf
            kept.append(each)
        seen |= sensors
    return kept[::-1]
