"""Time: int nanoseconds inside, float seconds for people and physics; and stamps that jump."""

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


AGREEING_STAMPS = 5  # in a row, until a pause or a jump of the clock is believed
NEAR_NS = 1_000_000_000  # stamps nearer than this to the newest one are of no jump


YEAR_NS = 365 * 24 * 3600 * NANOSECONDS_PER_SECOND


def is_of_1970(stamp_ns: int) -> bool:
    """Return whether a stamp is of 1970, as one that counts from the start of something is.

    So do the clocks of a simulation, of a microcontroller and of a machine since it was booted.
    """
    return stamp_ns < YEAR_NS


def is_due(stamp_ns: int, last_ns: int | None, period_ns: int) -> bool:
    """Return whether what was done at a stamp is to be done again, a period later.

    It is, too, if it has not been done so far, or stamps have gone back.
    """
    return last_ns is None or not 0 <= stamp_ns - last_ns < period_ns


def due_rows(stamps_ns: IntArray, last_ns: int | None, period_ns: int) -> list[int]:
    """Return the rows of increasing stamps (s,) at which it :func:`is_due`, one after another."""
    rows = []
    row = 0
    if last_ns is not None and stamps_ns[0] >= last_ns:
        row = int(stamps_ns.searchsorted(last_ns + period_ns))
    while row < len(stamps_ns):
        rows.append(row)
        row = int(stamps_ns.searchsorted(stamps_ns[row] + period_ns))
    return rows


class StrayStamps:
    """Stamps in a row that are far from the newest one, and agree with each other."""

    def __init__(self) -> None:
        self._stamps_ns: set[int] = set()
        self.last_ns: int | None = None

    def add(self, stamp_ns: int) -> bool:
        """Count a stamp, once if it is repeated; clear them and return True if enough agree."""
        self._stamps_ns.add(stamp_ns)
        self.last_ns = stamp_ns
        is_enough = len(self._stamps_ns) >= AGREEING_STAMPS
        if is_enough:
            self.clear()
        return is_enough

    def clear(self) -> None:
        """Forget them, as a stamp has come that does not agree."""
        self._stamps_ns.clear()
        self.last_ns = None
