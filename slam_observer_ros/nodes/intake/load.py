"""How long the messages of a busy node wait, and which are dropped."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from slam_observer_ros.common.stamps import to_s

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
            'read; send fewer of them, or make observations cheaper (gains: scheduled, '
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
            'fewer points in each, or make observations cheaper (gains: scheduled, max_landmarks)'
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
