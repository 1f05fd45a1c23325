"""Puts events in stamp order and refuses stamps that can't be right."""

from __future__ import annotations

import heapq
from typing import TypeAlias

from slam_observer_ros.errors import InvalidEventError
from slam_observer_ros.events import Event, ObservationEvent

Key: TypeAlias = tuple[int, bool, bytes]

CONFIRMATIONS = 5
"""How many events in a row must agree before a jump of the clock is believed."""

LEAST_KNOWN = 1024
"""Events that may be known before those too old to come again are looked for and forgotten."""


class EventQueue:
    """Holds events back for a reorder window, then gives them out in stamp order.

    Of two events with one stamp the velocity comes first, and two observations are ordered by
    their ids and points, so the order does not depend on which arrived first. A second velocity
    of one kind and stamp is a duplicate; so is an observation that has the ids and points of
    another one.

    Parameters
    ----------
    window_ns : int
        How far behind the newest stamp an event is given out, nanoseconds.
    max_jump_ns : int
        How far ahead of the newest stamp an event may be, nanoseconds.
    late_limit_ns : int
        How far behind the window an event may be, nanoseconds.

    """

    def __init__(self, window_ns: int, max_jump_ns: int, late_limit_ns: int) -> None:
        self._window_ns = window_ns
        self._max_jump_ns = max_jump_ns
        self._late_limit_ns = late_limit_ns
        self._heap: list[tuple[Key, Event]] = []
        self._known: set[Key] = set()
        self._most_known = LEAST_KNOWN
        self._strays = 0
        self._stray_ns = 0
        self.newest_ns: int | None = None

    def push(self, event: Event) -> bool:
        """Take an event; return whether it shows that the clock has jumped.

        Raises
        ------
        InvalidEventError
            If the stamp is far from all others (``'stamp_jump'``, ``'too_late'``), or the event
            is already known (``'duplicate'``).

        """
        jumped = self._check(event.stamp_ns)
        if not jumped:
            self._insert(event)
        return jumped

    def pop_ready(self) -> list[Event]:
        """Give out, in order, the events that have left the window."""
        ready_ns = (self.newest_ns or 0) - self._window_ns
        ready = []
        while self._heap and self._heap[0][0][0] <= ready_ns:
            ready.append(heapq.heappop(self._heap)[1])
        return ready

    def pop_all(self) -> list[Event]:
        """Give out all events that are left, in order."""
        events = [event for _, event in sorted(self._heap)]
        self._heap.clear()
        return events

    def _insert(self, event: Event) -> None:
        stamp_ns = event.stamp_ns
        if isinstance(event, ObservationEvent):
            key = (stamp_ns, True, event.ids.tobytes() + event.points.tobytes())
        else:
            key = (stamp_ns, False, type(event).__name__.encode())
        if key in self._known:
            raise InvalidEventError('duplicate', 'an event with this stamp is already known')
        self._known.add(key)
        heapq.heappush(self._heap, (key, event))
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.newest_ns = stamp_ns
        if len(self._known) > self._most_known:
            self._forget_old()

    def _forget_old(self) -> None:
        """Forget events so old that they would be refused as too late; O(1) for each event."""
        oldest_ns = (self.newest_ns or 0) - self._window_ns - self._late_limit_ns
        self._known = {key for key in self._known if key[0] >= oldest_ns}
        self._most_known = max(2 * len(self._known), LEAST_KNOWN)

    def _check(self, stamp_ns: int) -> bool:
        """Return whether ``stamp_ns`` confirms a jump; raise if it is the first to claim one."""
        if self.newest_ns is None:
            return False
        ahead_ns = stamp_ns - self.newest_ns
        too_early = ahead_ns > self._max_jump_ns
        too_late = ahead_ns < -(self._window_ns + self._late_limit_ns)
        if not (too_early or too_late):
            self._strays = 0
            return False
        agrees = abs(stamp_ns - self._stray_ns) <= self._max_jump_ns
        self._strays = self._strays + 1 if agrees else 1
        self._stray_ns = stamp_ns
        if self._strays >= CONFIRMATIONS:
            self._strays = 0
            return True
        reason = 'stamp_jump' if too_early else 'too_late'
        side = 'ahead of' if too_early else 'behind'
        raise InvalidEventError(
            reason, f"stamp is {abs(ahead_ns) / 1e9:.3f} s {side} the newest event's"
        )
