"""Velocities of the recent past, each held until the next one."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.events import flatten_velocities, VelocityEvent
from slam_observer_ros.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class HeldVelocities:
    """k velocities that cover an interval of time.

    Attributes
    ----------
    body_velocities : FloatArray
        (k, 6) the velocities (Ω, v), rad/s and m/s.
    covariances : list of FloatArray or None
        k covariances (6, 6) of them, None where unknown.
    dt_s : FloatArray
        (k,) seconds that each was held.
    gap_s : FloatArray
        (k,) seconds after each during which no velocity was known, since it had timed out.
    before_s : FloatArray
        (k,) seconds that each had been held for before.

    """

    body_velocities: FloatArray
    covariances: list[FloatArray | None]
    dt_s: FloatArray
    gap_s: FloatArray
    before_s: FloatArray

    def averaged(self, window_s: float) -> FloatArray:
        """Return the mean velocities (k, 6) over windows around the middle of each one.

        As far as they are held here; one that was held for longer than the window is its own mean.
        """
        times_s = np.append(0.0, np.cumsum(self.dt_s))
        motions = np.zeros((len(times_s), 6))
        np.cumsum(self.dt_s[:, None] * self.body_velocities, axis=0, out=motions[1:])
        middles_s = 0.5 * (times_s[:-1] + times_s[1:])
        numbers = np.arange(len(middles_s))
        starts = np.minimum(np.searchsorted(times_s, middles_s - 0.5 * window_s), numbers)
        ends = np.searchsorted(times_s, middles_s + 0.5 * window_s, side='right') - 1
        ends = np.maximum(ends, numbers + 1)
        lengths_s = np.maximum(times_s[ends] - times_s[starts], np.finfo(np.float64).tiny)
        means: FloatArray = (motions[ends] - motions[starts]) / lengths_s[:, None]
        return means


class VelocityHistory:
    """Velocity events in stamp order.

    Parameters
    ----------
    timeout_ns : int
        How long a velocity is held at most, nanoseconds.
    is_planar : bool
        Whether what leaves the plane z = 0 or turns out of it does not count.

    """

    def __init__(self, timeout_ns: int, is_planar: bool = False) -> None:
        self._timeout_ns = timeout_ns
        self._is_planar = is_planar
        self._stamps_ns: list[int] = []
        self._events: list[VelocityEvent] = []

    def append(self, event: VelocityEvent) -> None:
        """Add an event whose stamp is behind none of the others."""
        self._stamps_ns.append(event.stamp_ns)
        self._events.append(event)

    def latest(self, stamp_ns: int) -> FloatArray | None:
        """Return the velocity (6,) in force at ``stamp_ns``; None if none is or it timed out."""
        place = bisect_right(self._stamps_ns, stamp_ns) - 1
        if place < 0 or stamp_ns - self._stamps_ns[place] > self._timeout_ns:
            return None
        return self._counting(self._events[place].body_velocity)

    def held(self, start_ns: int, end_ns: int) -> HeldVelocities:
        """Return the velocities in force from ``start_ns`` to ``end_ns``."""
        first = bisect_right(self._stamps_ns, start_ns) - 1
        last = bisect_left(self._stamps_ns, end_ns)
        events = self._events[max(first, 0) : last]
        if first < 0:
            events.insert(0, VelocityEvent(start_ns - self._timeout_ns, np.zeros(6)))
        stamps = np.array([event.stamp_ns for event in events] + [end_ns], dtype=np.int64)
        begins, ends = np.maximum(stamps[:-1], start_ns), stamps[1:]
        stops = np.minimum(np.maximum(stamps[:-1] + self._timeout_ns, begins), ends)
        return HeldVelocities(
            self._counting(np.array([event.body_velocity for event in events]).reshape(-1, 6)),
            [event.covariance for event in events],
            _seconds(stops - begins),
            _seconds(ends - stops),
            _seconds(begins - stamps[:-1]),
        )

    def mean(self, start_ns: int, end_ns: int) -> FloatArray:
        """Return the mean velocity (6,) over an interval, as far as any is known; else zero."""
        held = self.held(start_ns, end_ns)
        known_s = held.dt_s.sum()
        if known_s == 0.0:
            return np.zeros(6)
        mean: FloatArray = held.dt_s @ held.body_velocities / known_s
        return mean

    def forget_before(self, stamp_ns: int) -> None:
        """Drop velocities that were no longer in force at ``stamp_ns``."""
        first = bisect_right(self._stamps_ns, stamp_ns) - 1
        if first > len(self._stamps_ns) // 2:
            del self._stamps_ns[:first]
            del self._events[:first]

    def _counting(self, body_velocities: FloatArray) -> FloatArray:
        """Return what counts of velocities (…, 6): for all of a step at once, which costs less."""
        return flatten_velocities(body_velocities) if self._is_planar else body_velocities


def _seconds(nanoseconds: IntArray) -> FloatArray:
    return nanoseconds.astype(np.float64) * 1e-9
