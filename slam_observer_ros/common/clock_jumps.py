"""Stray stamps: one is an error, several that agree are a pause or a jump of the clock."""

from __future__ import annotations

AGREEING_STAMPS = 5
"""How many stamps in a row must agree before a pause or a jump of the clock is believed."""

NEAR_NS = 1_000_000_000
"""Stamps nearer than this to the newest one are of no pause or jump, nanoseconds."""


class StrayStamps:
    """Stamps in a row that are far from the newest one, and agree with each other."""

    def __init__(self) -> None:
        self._stamps_ns: set[int] = set()
        self.last_ns: int | None = None

    def add(self, stamp_ns: int) -> bool:
        """Count a stamp; return whether ``AGREEING_STAMPS`` have come, and begin with none again.

        Equal stamps count once: they may be of one message.
        """
        self._stamps_ns.add(stamp_ns)
        self.last_ns = stamp_ns
        is_enough = len(self._stamps_ns) >= AGREEING_STAMPS
        if is_enough:
            self.clear()
        return is_enough

    def clear(self) -> None:
        """Forget them, as one in time or one that does not agree has come."""
        self._stamps_ns.clear()
        self.last_ns = None
