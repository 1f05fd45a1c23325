"""What may be: states that read what was seen differently (:mod:`slam_observer_ros.readings`).

Where two readings of an observation put the robot at different places, both are followed, each
with a state of its own, until later observations have made one much more likely than the other
(D. B. Reid, *An algorithm for tracking multiple targets*, 1979). So are states that have the robot
at one place but take what it sees there for different landmarks, as their maps differ. Where
landmarks have ids or are well apart there is nearly always one.
"""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.association import MARGIN
from slam_observer_ros.events import FIRST_AUTOMATIC_ID, is_automatic, ObservationEvent
from slam_observer_ros.readings import are_one, is_plain, readings
from slam_observer_ros.settings import Settings
from slam_observer_ros.slam import Slam
from slam_observer_ros.types import FloatArray, IntArray
from slam_observer_ros.velocity_history import VelocityHistory


@dataclass(frozen=True, slots=True)
class _Followed:
    """A state after an observation, what it took that for, and what it returned."""

    cost: float
    slam: Slam
    reading: ObservationEvent
    seen: tuple[IntArray, FloatArray]


class Hypotheses:
    """States that are all possible, the most likely first.

    Parameters
    ----------
    slam : Slam
        The state at the start.
    settings : Settings
        ``max_hypotheses``.

    """

    def __init__(self, slam: Slam, settings: Settings) -> None:
        self._states = [slam]
        self._costs = [0.0]
        self._limit = settings.max_hypotheses
        self._next_id = FIRST_AUTOMATIC_ID

    def __len__(self) -> int:
        """Return how many states are followed."""
        return len(self._states)

    @property
    def best(self) -> Slam:
        """The most likely state."""
        return self._states[0]

    def decide(self) -> Slam:
        """Give up all states but the most likely one, and return that."""
        self._states, self._costs = self._states[:1], [0.0]
        return self.best

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move all states, which are those of ``start_ns``, on to ``end_ns``."""
        for slam in self._states:
            slam.advance(velocities, start_ns, end_ns)

    def observe(self, event: ObservationEvent) -> tuple[IntArray, FloatArray]:
        """Use an observation made at the states' instant; return what the best one makes of it.

        Ids and residuals are those of :meth:`slam_observer_ros.slam.Slam.observe`.
        """
        if len(self._states) == 1:
            sighting = self.best.look(event)
            if is_plain(self.best, event, sighting):
                return self.best.observe(event, sighting)
        possible = self._possible(event)
        least = possible[0][0]
        uses = Counter(number for _, number, _ in possible)
        followed: list[_Followed] = []
        for cost, number, reading in possible:
            uses[number] -= 1
            slam = deepcopy(self._states[number]) if uses[number] else self._states[number]
            seen = slam.observe(reading)
            slam.counts['rejected_landmark'] += len(event.ids) - len(reading.ids)
            if not any(_are_one(slam, reading, other) for other in followed):
                followed.append(_Followed(cost - least, slam, reading, seen))
            if len(followed) == self._limit:
                break
        self._costs = [one.cost for one in followed]
        self._states = [one.slam for one in followed]
        return followed[0].seen

    def _possible(self, event: ObservationEvent) -> list[tuple[float, int, ObservationEvent]]:
        """Return what each state may take an observation for: cost, number of the state, reading.

        A point has the same id in all of them that take it for a new landmark.
        """
        for slam in self._states:
            slam.forget_unsupported(event.stamp_ns)
            given = slam.landmarks.ids[is_automatic(slam.landmarks.ids)]  # of a loaded map, too
            self._next_id = max(self._next_id, int(np.max(given, initial=0)) + 1)
        new_ids = self._next_id + np.arange(len(event.ids))
        possible: list[tuple[float, int, ObservationEvent]] = []
        worst = math.inf
        for number, (slam, cost) in enumerate(zip(self._states, self._costs, strict=True)):
            for reading, rise in readings(slam, event, new_ids, worst - cost):
                possible.append((cost + rise, number, reading))
                worst = min(worst, cost + rise + MARGIN)
        possible.sort(key=lambda reading: reading[:2])
        return [reading for reading in possible if reading[0] <= worst]


def _are_one(slam: Slam, reading: ObservationEvent, other: _Followed) -> bool:
    """Return whether a state has the robot and the landmarks seen where another one has them."""
    same_ids = np.array_equal(reading.ids, other.reading.ids)
    return same_ids and are_one(slam, other.slam, reading)
