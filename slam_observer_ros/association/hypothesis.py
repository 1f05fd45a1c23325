"""One of several hypotheses about pose and map."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

from slam_observer_ros.association.landmark_index import LandmarkIndex
from slam_observer_ros.association.visibility import Visibility
from slam_observer_ros.state.state import State


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A state, and what only points without an id need of it."""

    state: State
    visibility: Visibility  # what is in view of a sensor that gives no ids
    index: LandmarkIndex = field(default_factory=LandmarkIndex)
    cost: float = 0.0  # −2 ln of its likelihood, over that of the most likely one

    @classmethod
    def of(cls, state: State) -> Hypothesis:
        """Return the only hypothesis there is."""
        return cls(state, Visibility(state.axes.point))

    def with_state(self, state: State) -> Hypothesis:
        """Return another hypothesis, which has had the same landmarks in view."""
        return Hypothesis(state, self.visibility.copy(), copy(self.index), self.cost)

    def copy(self) -> Hypothesis:
        """Return an independent copy."""
        return self.with_state(self.state.copy())
