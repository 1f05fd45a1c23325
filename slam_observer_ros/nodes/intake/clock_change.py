"""To which run messages belong that come around a jump of /clock, as of a recording in a loop."""

from __future__ import annotations

import time
from typing import TypeAlias

from slam_observer_ros.inputs.event_builder import Measured

Received: TypeAlias = tuple[str, Measured, int]
"""The name of an input, what it measures, and the time of its reception, nanoseconds."""

AROUND_S = 0.5
"""How much earlier or later than /clock messages of its run may come, by a steady clock."""

MAX_HELD = 10_000
"""Messages that may wait for /clock to jump."""


class ClockChange:
    """Holds messages of the next run until /clock has jumped, and finds those of the last one.

    Topics come in no order. Before the jump what is too late to be used may be of the next run.
    After it what is nearer to the time before is of the last one.
    """

    def __init__(self) -> None:
        self._held: list[Received] = []
        self._held_since_s = 0.0
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

    def end(self) -> list[Received]:
        """Return what is of the next run, which is used from now on."""
        self._is_jumping = False
        return self._take()

    def hold(self, received: Received, stamp_ns: int, usable_from_ns: int) -> bool:
        """Keep a message of the next run, or what may be one; return whether it is kept.

        ``stamp_ns`` is its stamp by /clock, ``usable_from_ns`` that before which it is too late.
        """
        if self._is_jumping:
            is_next = not self._is_before_jump(stamp_ns, received[2])
        else:
            is_next = stamp_ns < usable_from_ns
        if not is_next or len(self._held) >= MAX_HELD:
            return False
        if not self._held:
            self._held_since_s = time.monotonic()
        self._held.append(received)
        return True

    def is_over(self, stamp_ns: int, receive_ns: int) -> bool:
        """Return whether a message is of the last run, and comes after its end."""
        return not self._is_jumping and self._is_before_jump(stamp_ns, receive_ns)

    def take_overdue(self) -> list[Received]:
        """Return what was held for too long: the clock does not jump, it was just late."""
        is_overdue = self._held and time.monotonic() - self._held_since_s > AROUND_S
        return self._take() if is_overdue else []

    def _take(self) -> list[Received]:
        held, self._held = self._held, []
        return held

    def _is_before_jump(self, stamp_ns: int, receive_ns: int) -> bool:
        is_around = time.monotonic() - self._jumped_s < AROUND_S
        return is_around and stamp_ns > receive_ns + self._back_ns // 2
