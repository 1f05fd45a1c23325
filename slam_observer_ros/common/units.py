"""Units of time: int nanoseconds inside, float seconds for people and for physics."""

from __future__ import annotations

from typing import overload

from slam_observer_ros.common.types import FloatArray, IntArray

NANOSECONDS_PER_SECOND = 1_000_000_000


def to_ns(seconds: float) -> int:
    """Return a time in nanoseconds, rounded."""
    return round(seconds * NANOSECONDS_PER_SECOND)


@overload
def to_s(nanoseconds: int) -> float: ...


@overload
def to_s(nanoseconds: IntArray) -> FloatArray: ...


def to_s(nanoseconds: int | IntArray) -> float | FloatArray:
    """Return a time, or an array (...,) of times, in seconds."""
    return nanoseconds / NANOSECONDS_PER_SECOND
