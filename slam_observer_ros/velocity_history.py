"""Velocities of the recent past, of one or two sensors, each held until the next one."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.events import AngularVelocityEvent, flatten_velocities, VelocityEvent
from slam_observer_ros.types import BoolArray, FloatArray, IntArray

_UNKNOWN = np.zeros((6, 6))


@dataclass(frozen=True, slots=True)
class HeldVelocities:
    """k velocities that cover an interval of time.

    Attributes
    ----------
    body_velocities : FloatArray
        (k, 6) the velocities (Ω, v), rad/s and m/s.
    covariances : FloatArray
        (k, 6, 6) covariances of them, zero where unknown.
    is_stated : BoolArray
        (k, 2) whether the covariance of the angular and of the linear part is known.
    dt_s : FloatArray
        (k,) seconds that each was held.
    gap_s : FloatArray
        (k,) seconds after each during which no velocity was known, since it had timed out.
    before_s : FloatArray
        (k, 2) seconds that the angular and the linear part of each had been held for before.

    """

    body_velocities: FloatArray
    covariances: FloatArray
    is_stated: BoolArray
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


@dataclass(frozen=True, slots=True)
class _Joined:
    """The velocity in force from one event to the next, of one message or two.

    ``covariance`` is zero where unknown. ``is_stated`` and ``since_ns``, the messages' stamps, are
    of the angular and the linear part.
    """

    body_velocity: FloatArray
    covariance: FloatArray
    is_stated: tuple[bool, bool]
    since_ns: tuple[int, int]


class VelocityHistory:
    """Velocity events in stamp order, joined with the angular velocities of another sensor.

    Parameters
    ----------
    timeout_ns : int
        How long a velocity is held at most, nanoseconds. Where the other sensor's angular one was
        older when an event came, the velocity's own angular part counts.
    is_planar : bool
        Whether what leaves the plane z = 0 or turns out of it does not count.

    """

    def __init__(self, timeout_ns: int, is_planar: bool = False) -> None:
        self._timeout_ns = timeout_ns
        self._is_planar = is_planar
        self._stamps_ns: list[int] = []
        self._joined: list[_Joined] = []
        self._velocity: VelocityEvent | None = None
        self._angular: AngularVelocityEvent | None = None

    def append(self, event: VelocityEvent | AngularVelocityEvent) -> bool:
        """Add an event whose stamp is behind none of the others; return whether it leads on.

        An angular velocity does not before the first linear one is known: it waits for that.
        """
        if isinstance(event, AngularVelocityEvent):
            self._angular = event
        else:
            self._velocity = event
        if self._velocity is None:
            return False
        angular = self._angular
        if angular is not None and not 0 <= event.stamp_ns - angular.stamp_ns <= self._timeout_ns:
            angular = None
        self._stamps_ns.append(event.stamp_ns)
        self._joined.append(_join(self._velocity, angular))
        return True

    def latest(self, stamp_ns: int) -> FloatArray | None:
        """Return the velocity (6,) in force at ``stamp_ns``; None if none is or it timed out."""
        place = bisect_right(self._stamps_ns, stamp_ns) - 1
        if place < 0 or stamp_ns - self._joined[place].since_ns[1] > self._timeout_ns:
            return None
        return self._counting(self._joined[place].body_velocity)

    def held(self, start_ns: int, end_ns: int) -> HeldVelocities:
        """Return the velocities in force from ``start_ns`` to ``end_ns``."""
        first = bisect_right(self._stamps_ns, start_ns) - 1
        last = bisect_left(self._stamps_ns, end_ns)
        stamps_ns = self._stamps_ns[max(first, 0) : last]
        held = self._joined[max(first, 0) : last]
        if first < 0:
            stamps_ns.insert(0, start_ns)
            held.insert(0, _join(VelocityEvent(start_ns - self._timeout_ns, np.zeros(6)), None))
        stamps = np.array([*stamps_ns, end_ns], dtype=np.int64)
        since = np.array([joined.since_ns for joined in held], dtype=np.int64).reshape(-1, 2)
        begins, ends = np.maximum(stamps[:-1], start_ns), stamps[1:]
        stops = np.minimum(np.maximum(since[:, 1] + self._timeout_ns, begins), ends)
        is_stated = np.array([joined.is_stated for joined in held], dtype=np.bool_).reshape(-1, 2)
        covariances = np.zeros((len(held), 6, 6))
        if is_stated.any():  # to gather zeros would take longer than all the rest
            covariances[:] = [joined.covariance for joined in held]
        return HeldVelocities(
            self._counting(np.array([joined.body_velocity for joined in held]).reshape(-1, 6)),
            covariances,
            is_stated,
            _seconds(stops - begins),
            _seconds(ends - stops),
            _seconds(begins[:, None] - since),
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
            del self._joined[:first]

    def _counting(self, body_velocities: FloatArray) -> FloatArray:
        """Return what counts of velocities (…, 6): for all of a step at once, which costs less."""
        return flatten_velocities(body_velocities) if self._is_planar else body_velocities


def _join(velocity: VelocityEvent, angular: AngularVelocityEvent | None) -> _Joined:
    """Return the velocity, with the other sensor's angular part if it has one."""
    linear_ns, is_linear_stated = velocity.stamp_ns, velocity.covariance is not None
    covariance = _UNKNOWN if velocity.covariance is None else velocity.covariance
    if angular is None:
        stated = (is_linear_stated, is_linear_stated)
        return _Joined(velocity.body_velocity, covariance, stated, (linear_ns, linear_ns))
    joined = np.zeros((6, 6))
    joined[3:, 3:] = covariance[3:, 3:]
    if angular.covariance is not None:
        joined[:3, :3] = angular.covariance
    return _Joined(
        np.concatenate([angular.angular_velocity, velocity.body_velocity[3:]]),
        joined,
        (angular.covariance is not None, is_linear_stated),
        (angular.stamp_ns, linear_ns),
    )


def _seconds(nanoseconds: IntArray) -> FloatArray:
    return nanoseconds.astype(np.float64) * 1e-9
