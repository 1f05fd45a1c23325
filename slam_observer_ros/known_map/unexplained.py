"""Whether points without ids are where a map has landmarks: else the robot was carried."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.state.state import State

MISSING, EXPLAINED = 1.95, -1.1
"""ln of how much likelier a point is where the robot is lost, if the map does not explain it, and
if it does: then 7 points in 10 are of nothing known, else 1 in 10.
"""

MAX_STEP = 3.0
"""What an observation may say at most: its points have errors in common."""

LIMIT = 8.0
"""Sum at which the robot is lost."""


class Unexplained:
    """A cumulative sum of what observations say of a robot that was carried (E. S. Page, 1954)."""

    def __init__(self) -> None:
        self._sum = 0.0

    def is_too_much(self, state: State, event: ObservationEvent, missed: float) -> bool:
        """Add an observation, already used; return whether the pose must be wrong by now.

        Where the map grows points of nothing known are no sign of that, unless in place of them
        other landmarks should have been seen: ``missed``.
        """
        if not (event.ids == UNKNOWN_ID).any():
            return False
        landmarks = state.landmarks
        is_seen = (landmarks.last_seen_ns == event.stamp_ns) & ~landmarks.tentative
        explained = int(np.count_nonzero(is_seen))
        missing: float = max(0, len(event.ids) - explained)
        if state.is_mapping:
            missing = min(missing, missed)
        step = MISSING * missing + EXPLAINED * explained
        self._sum = max(0.0, self._sum + min(max(step, -MAX_STEP), MAX_STEP))
        return self._sum > LIMIT
