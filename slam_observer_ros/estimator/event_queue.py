"""Puts events in stamp order and refuses stamps that can't be right."""

from __future__ import annotations

from collections import deque
from hashlib import blake2b
import heapq
from itertools import repeat
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.stamps import NEAR_NS, StrayStamps, to_s
from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, Queued, VelocityBlock

Key: TypeAlias = tuple[int, bool, bytes]

RECENT = 1000
"""Events that show how far stamps are ahead of their reception.

They are more than inputs keep while the node is busy: such were received late, and show no delay.
"""

HELD_UP_NS = 250_000_000
"""Stamps far behind, received so soon after one in time, are no sign of a jump of the clock."""

LATENESS_NS = 10_000_000_000  # time over which the lateness of events is observed, nanoseconds

LATENESS_MARGIN = 2
"""Times the lateness of the latest one of that time that an event may have to be put in order."""

MIN_KNOWN = 1024
"""Events that may be known before those too old to come again are looked for and forgotten."""


_LINEAR, _ANGULAR = b'linear', b'angular'

_NO_STAMP_NS = 2**63 - 1  # beyond all stamps


class EventQueue:
    """Holds events back for a reorder window, then returns them in stamp order.

    The window is ``LATENESS_MARGIN`` times as long as the latest event of the last ``LATENESS_NS``
    was late, and ``window_ns`` at most; until so much time has passed it is ``window_ns``. It
    depends on stamps and their order alone, so that a replay has the same.

    Of two events with one stamp the velocity comes first, and two observations are ordered by
    a digest of their ids and points, so the order does not depend on which arrived first. A
    second velocity of one kind and stamp is a duplicate; so is an observation that has the ids
    and points of another one.

    A stamp that is ahead of all others by more than events may be late is kept, but not believed
    at once: one wrong stamp would make all other events too late. It is believed when time has
    got there, or when ``AGREEING_STAMPS`` stamps agree that there was a pause; at once where
    events come that seldom. How long it may be is not limited by ``max_jump_ns`` if nothing was
    received for as long: then it was a silence, not the clock.

    Stamps behind all others are refused. ``AGREEING_STAMPS`` in a row are a jump of the clock if
    the stamps of one kind of event go back: a sensor that is always too late goes on from its own
    last stamp. Right after an event that is in time they are no jump: they were held up on the
    way, and come in a burst.

    An event is returned at most ``window_ns`` behind the newest stamp, and may be
    ``late_limit_ns`` behind that; ``max_jump_ns`` is the longest pause, beyond which stamps are
    refused.
    """

    def __init__(self, window_ns: int, max_jump_ns: int, late_limit_ns: int) -> None:
        self._window = _Window(window_ns)
        self._max_jump_ns = max_jump_ns
        self._reach_ns = window_ns + late_limit_ns
        self._near_ns = max(self._reach_ns, NEAR_NS)
        # How far ahead a stamp may be that is believed at once: never less than at first.
        self._least_usual_ns = self._usual_ns = min(self._near_ns, max_jump_ns)
        self._events = _SortedEvents()
        self._reception = _Reception()
        self._strays = StrayStamps()
        # Newest stamp of each kind of event that was not ahead of all others.
        self._newest_of_kind_ns: dict[str, int] = {}
        # The newest stamp that is taken, believed or not.
        self._lead_ns = 0
        self.newest_ns: int | None = None  # newest stamp that is believed

    def push(self, event: Queued) -> bool:
        """Take an event, or velocities that :meth:`follow`; return whether the clock has jumped.

        Raise :exc:`InvalidEventError` if the stamp is far from all others (``'stamp_jump'``,
        ``'too_late'``), or the event is already known (``'duplicate'``).
        """
        if self.newest_ns is None:
            self.newest_ns = self._lead_ns = event.stamp_ns
        # In time, or little ahead: believed at once.
        ahead_ns = event.stamp_ns - self.newest_ns
        too_late = ahead_ns < -self._reach_ns
        if -self._near_ns <= ahead_ns <= self._usual_ns:
            if too_late:
                raise _refusal(ahead_ns)
            self._events.insert(event, self.newest_ns - self._reach_ns)
            self._note_in_time(event, self.newest_ns)
            return False
        if too_late or self._is_too_early(event):
            # Far away: refused, and counted if it is a sign of a jump.
            is_newest = too_late and self._is_newest_of_kind(event, event.stamp_ns)
            is_no_jump = is_newest or (too_late and self._is_held_up(event))
            if not is_no_jump and self._count_stray(event.stamp_ns, self.newest_ns):
                return True
            raise _refusal(ahead_ns)
        # Ahead, within a pause: kept, not yet believed.
        self._take_ahead(event, self.newest_ns)
        return False

    def passes(self, event: Queued) -> bool:
        """Take an event that need not wait, and nothing waits for; return whether it is one.

        That is what :meth:`push` and :meth:`pop_ready` do with an event that is in time and
        before none, where none has been late.
        """
        newest_ns = self.newest_ns
        if newest_ns is None or self._window.length_ns or self._events.held:
            return False
        if not 0 <= event.stamp_ns - newest_ns <= self._usual_ns:
            return False
        if not self._events.note(_keys(event), newest_ns - self._reach_ns):
            return False
        self._note_in_time(event, newest_ns)
        return True

    def follow(self, velocities: VelocityBlock) -> bool:
        """Return whether velocities are unknown, in time, and each is the newest of all."""
        if self.newest_ns is None:
            return False
        steps_ns = np.diff(velocities.stamps_ns, prepend=self.newest_ns)
        if steps_ns.min() <= 0 or steps_ns.max() > self._least_usual_ns:
            return False
        return self._events.known.isdisjoint(_keys(velocities))

    def pop_ready(self) -> list[Queued]:
        """Return, in order, the events that have left the window."""
        return self._events.pop_until((self.newest_ns or 0) - self._window.length_ns)

    def pop_believed(self) -> list[Queued]:
        """Return, in order, all events but those with a stamp that waits for others."""
        return self._events.pop_until(self.newest_ns or 0)

    def pop_all(self) -> list[Queued]:
        """Return all events that are left, in order."""
        return self._events.pop_all()

    def _note_in_time(self, event: Queued, newest_ns: int) -> None:
        stamp_ns, before_ns = event.stamp_ns, newest_ns
        if isinstance(event, VelocityBlock) and len(event) > 1:
            before_ns, stamp_ns = event.stamps_ns[-2:].tolist()
        if event.receive_ns is not None:
            self._reception.note(event)
        window, newest_of_kind = self._window, self._newest_of_kind_ns
        if window.late or window.length_ns or stamp_ns < before_ns:
            window.note(stamp_ns, before_ns)
        if stamp_ns > newest_of_kind.get(event.kind, -1):
            newest_of_kind[event.kind] = stamp_ns
        if self._strays.last_ns is not None:
            self._strays.clear()
        self._believe(stamp_ns if stamp_ns > before_ns else before_ns, before_ns)

    def _take_ahead(self, event: Queued, newest_ns: int) -> None:
        """Keep an event far ahead; believe its stamp if enough agree."""
        self._events.insert(event, newest_ns - self._reach_ns)
        self._lead_ns = max(self._lead_ns, event.stamp_ns)
        if self._count_stray(event.stamp_ns, newest_ns):
            self._reception.note(event)
            self._believe(self._lead_ns, newest_ns)

    def _believe(self, stamp_ns: int, newest_ns: int) -> None:
        twice_ns = 2 * (stamp_ns - newest_ns)
        if twice_ns > 0:
            usual_ns = twice_ns if twice_ns > self._near_ns else self._near_ns
            self._usual_ns = usual_ns if usual_ns < self._max_jump_ns else self._max_jump_ns
        self.newest_ns = self._lead_ns = stamp_ns

    def _is_too_early(self, event: Queued) -> bool:
        """Return whether a stamp is further ahead than a pause, or silence, can explain."""
        if event.stamp_ns <= self._lead_ns + self._max_jump_ns:
            return False
        expected_ns = self._reception.expected_ns(event)
        return expected_ns is None or event.stamp_ns > expected_ns + self._max_jump_ns

    def _is_newest_of_kind(self, event: Queued, stamp_ns: int) -> bool:
        """Note the stamp if it is the newest of its kind; if not, that kind has gone back."""
        newest_ns = self._newest_of_kind_ns.get(event.kind)
        if newest_ns is not None and stamp_ns <= newest_ns:
            return False
        self._newest_of_kind_ns[event.kind] = stamp_ns
        return True

    def _is_held_up(self, event: Queued) -> bool:
        """Return whether an event was received right after one that was in time."""
        since_ns = self._reception.since_in_time_ns(event)
        return since_ns is not None and 0 <= since_ns < HELD_UP_NS

    def _count_stray(self, stamp_ns: int, newest_ns: int) -> bool:
        """Count a stamp far from the newest one; return whether enough agree with it now."""
        if (last_ns := self._strays.last_ns) is not None:
            same_side = (stamp_ns > newest_ns) == (last_ns > newest_ns)
            if not (same_side and abs(stamp_ns - last_ns) <= self._max_jump_ns):
                self._strays.clear()
        return self._strays.add(stamp_ns)


class _Window:
    """How long events are held back, by how late events of the recent past were."""

    def __init__(self, longest_ns: int) -> None:
        self._longest_ns = longest_ns
        self._begin_ns: int | None = None
        self.late: deque[tuple[int, int]] = deque()  # when, and by how much: ever less
        self.length_ns = longest_ns

    def note(self, stamp_ns: int, newest_ns: int) -> None:
        """Take the stamp of an event, and the newest one of those before it, nanoseconds."""
        if self._begin_ns is None:
            self._begin_ns = newest_ns
        late = self.late
        if stamp_ns < newest_ns:
            late_ns = newest_ns - stamp_ns
            while late and late[-1][1] <= late_ns:
                late.pop()
            late.append((newest_ns, late_ns))
        oldest_ns = newest_ns - LATENESS_NS
        while late and late[0][0] < oldest_ns:
            late.popleft()
        if self._begin_ns <= oldest_ns:
            latest_ns = late[0][1] if late else 0
            self.length_ns = min(LATENESS_MARGIN * latest_ns, self._longest_ns)


class _SortedEvents:
    """Events in stamp order, each of them once."""

    def __init__(self) -> None:
        self.held: list[tuple[Key, Queued]] = []  # a heap, by the first key of each
        self.known: set[Key] = set()
        self._most_known = MIN_KNOWN

    def insert(self, event: Queued, oldest_ns: int) -> None:
        """Add an event; raise InvalidEventError if it is known. None before ``oldest_ns`` come."""
        keys = _keys(event)
        if not self.note(keys, oldest_ns):
            raise InvalidEventError('duplicate', 'this event is already known')
        heapq.heappush(self.held, (keys[0], event))

    def note(self, keys: list[Key], oldest_ns: int) -> bool:
        """Note events, that are used at once, as known; return whether none of them was."""
        known = self.known
        if not known.isdisjoint(keys):
            return False
        known.update(keys)
        if len(known) > self._most_known:
            # After twice as many as were kept: O(1) for each event.
            self.known = {key for key in self.known if key[0] >= oldest_ns}
            self._most_known = max(2 * len(self.known), MIN_KNOWN)
        return True

    def pop_until(self, stamp_ns: int) -> list[Queued]:
        ready: list[Queued] = []
        while self.held and self.held[0][0][0] <= stamp_ns:
            _, event = heapq.heappop(self.held)
            if isinstance(event, VelocityBlock):
                event = self._cut(event, stamp_ns)
            ready.append(event)
        return ready

    def _cut(self, velocities: VelocityBlock, stamp_ns: int) -> VelocityBlock:
        """Return the velocities until a stamp and before the next event; hold back the others."""
        end: Key = (stamp_ns, True, b'')
        if self.held:
            end = min(end, self.held[0][0])
        has_those_at_end = (end[0], False, _LINEAR) < end
        count = velocities.stamps_ns.searchsorted(end[0], 'right' if has_those_at_end else 'left')
        if count < len(velocities):
            rest = velocities.part(slice(count, None))
            heapq.heappush(self.held, ((rest.stamp_ns, False, _LINEAR), rest))
        return velocities.part(slice(count))

    def pop_all(self) -> list[Queued]:
        return self.pop_until(_NO_STAMP_NS)


class _Reception:
    """When events that were believed were received, beside their stamps."""

    def __init__(self) -> None:
        self._ahead_ns: deque[int] = deque(maxlen=RECENT)
        self._last_ns: int | None = None

    def note(self, event: Queued) -> None:
        if event.receive_ns is None:
            return
        if isinstance(event, VelocityBlock):
            self._ahead_ns.extend((event.stamps_ns - event.receive_ns).tolist())
            self._last_ns = int(event.receive_ns[-1])
        else:
            self._ahead_ns.append(event.stamp_ns - event.receive_ns)
            self._last_ns = event.receive_ns

    def expected_ns(self, event: Queued) -> int | None:
        """Return the newest stamp that can be received when this event was; None if unknown."""
        received_ns = _received_ns(event)
        if received_ns is None or not self._ahead_ns:
            return None
        return received_ns + max(self._ahead_ns)

    def since_in_time_ns(self, event: Queued) -> int | None:
        """Return how long after the last one noted an event was received; None if unknown."""
        received_ns = _received_ns(event)
        if received_ns is None or self._last_ns is None:
            return None
        return received_ns - self._last_ns


def _received_ns(event: Queued) -> int | None:
    """Return when an event was received, of several the first."""
    received_ns = event.receive_ns
    return int(received_ns[0]) if isinstance(received_ns, np.ndarray) else received_ns


def _keys(event: Queued) -> list[Key]:
    """Return what no other event has; of several velocities what each has, in order."""
    if isinstance(event, VelocityBlock):
        return list(zip(event.stamps_ns.tolist(), repeat(False), repeat(_LINEAR)))
    if isinstance(event, ObservationEvent):
        # Keys outlive their events, which may be clouds of many points.
        content = event.ids.tobytes() + event.points.tobytes()
        return [(event.stamp_ns, True, blake2b(content, digest_size=16).digest())]
    of_kind = _ANGULAR if isinstance(event, AngularVelocityEvent) else _LINEAR
    return [(event.stamp_ns, False, of_kind)]


def _refusal(ahead_ns: int) -> InvalidEventError:
    reason, side = ('stamp_jump', 'ahead of') if ahead_ns > 0 else ('too_late', 'behind')
    message = f"stamp is {to_s(abs(ahead_ns)):.3f} s {side} the newest event's"
    return InvalidEventError(reason, message)
