"""How often the state is published."""

from __future__ import annotations

import time

SLACK = 0.5
"""Part of the period by which a state of the input that sets the pace may come early, as inputs
jitter, and by which those of others wait for it."""


class Pace:
    """Allows a state at most at a rate, at the times at which one input gives them.

    That is the one that gave the last. What others give in between comes out with its next: it
    would take the turn of that, which would then wait for the one after it.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz
        self._due_s = 0.0  # by a steady clock
        self._source = ''

    def is_due(self, source: str) -> bool:
        """Return whether a state may be published now, which an input gave; '' for none."""
        slack_s = SLACK * self._period_s
        sets_pace = bool(source) and source == self._source
        return time.monotonic() >= self._due_s + (-slack_s if sets_pace else slack_s)

    def note(self, source: str) -> None:
        """Take that a state is published now, which an input gave."""
        self._source = source or self._source
        # One that is late for a moment puts off no other.
        earliest_s = time.monotonic() + SLACK * self._period_s
        self._due_s = max(self._due_s + self._period_s, earliest_s)
