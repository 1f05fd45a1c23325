"""How likely a point without an id is of a landmark that was not known, by what came lately."""

from __future__ import annotations

import math

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.events import ObservationEvent

MEMORY_S = 60.0
"""Time, seconds, after which what was seen counts for a third."""

RARE_SHARE = 0.0017
"""Share of points that are of new landmarks at which one costs as much as a point at the gate."""

SHARE_AT_FIRST, POINTS_AT_FIRST = 0.05, 10.0
"""The share as it is taken to be before anything was seen, and how many points that counts for."""

LEAST_COST = 9.0
"""What a new landmark costs at least: else many a true pair, beyond 3 σ, would cost more."""


class NewLandmarks:
    """What it costs to take a point for a new landmark; −2 ln of a likelihood.

    On new ground many points are of new landmarks, and one that could only just be of a known one
    is not. Where all is known it hardly ever is a new one.
    """

    def __init__(self) -> None:
        self._points = self._new = 0.0  # of late
        self._stamp_ns: int | None = None

    def cost(self, gate_cost: float) -> float:
        """Return the cost; ``gate_cost`` is that of a point at the gate, and the most."""
        share = (self._new + SHARE_AT_FIRST * POINTS_AT_FIRST) / (self._points + POINTS_AT_FIRST)
        cost = gate_cost - 2.0 * math.log(share / RARE_SHARE)
        return min(max(cost, min(LEAST_COST, gate_cost)), gate_cost)

    def note(self, event: ObservationEvent, confirmed: int) -> None:
        """Count an observation, and how many landmarks it ``confirmed``."""
        if self._stamp_ns is not None:
            decay = math.exp(-max(to_s(event.stamp_ns - self._stamp_ns), 0.0) / MEMORY_S)
            self._points *= decay
            self._new *= decay
        self._stamp_ns = event.stamp_ns
        self._points += len(event.ids)
        self._new += confirmed
