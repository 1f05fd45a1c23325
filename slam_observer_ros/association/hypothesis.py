"""One of several hypotheses about pose and map."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np

from slam_observer_ros.association.interpretations import Interpretation
from slam_observer_ros.association.landmark_index import LandmarkIndex
from slam_observer_ros.association.visibility import Visibility
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.state.matching import positions
from slam_observer_ros.state.state import State


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A state, and what only points without an id need of it."""

    state: State
    visibility: Visibility  # what is in view of a sensor that gives no ids
    index: LandmarkIndex = field(default_factory=LandmarkIndex)
    cost: float = 0.0  # −2 ln of its likelihood, over that of the most likely one
    # Where suspects were when they were seen last, and whether they were believed, by their ids.
    verdicts: dict[int, tuple[FloatArray, bool]] = field(default_factory=dict)

    @classmethod
    def of(cls, state: State) -> Hypothesis:
        """Return the only hypothesis there is."""
        return cls(state, Visibility(state.axes.point))

    def with_state(self, state: State) -> Hypothesis:
        """Return another hypothesis, which has had the same landmarks in view."""
        return Hypothesis(
            state, self.visibility.copy(), copy(self.index), self.cost, self.verdicts
        )

    def copy(self) -> Hypothesis:
        """Return an independent copy."""
        return self.with_state(self.state.copy())

    def note(self, taken: Interpretation, event: ObservationEvent) -> None:
        """Remember which suspects of an observation were believed, and where they were."""
        if not len(taken.suspects):
            return
        places, believed = positions(self.state, event)[0], np.isin(event.ids, taken.event.ids)
        self.verdicts = dict(self.verdicts)  # another hypothesis may have the same
        for i in np.flatnonzero(np.isin(event.ids, taken.suspects)).tolist():
            self.verdicts[int(event.ids[i])] = places[i], bool(believed[i])

    def consistent(
        self, possible: list[Interpretation], event: ObservationEvent
    ) -> list[Interpretation]:
        """Return the interpretations that judge points as before, where they were before.

        A point that was left out and one at the same place that is believed are two halves of
        two stories, each of which another hypothesis has followed from the start.
        """
        if not self.verdicts:
            return possible
        event = event.select(np.isin(event.ids, list(self.verdicts)))
        verdicts = [self.verdicts[landmark_id] for landmark_id in event.ids.tolist()]
        points, tolerances_m = positions(self.state, event)
        before = np.reshape([place for place, _ in verdicts], (-1, 3))
        is_there = np.linalg.norm(points - before, axis=1) <= tolerances_m
        believed = np.array([was for _, was in verdicts], dtype=np.bool_)[is_there]
        ids = event.ids[is_there]
        return [
            one
            for one in possible
            if one.slipped is not None or np.array_equal(np.isin(ids, one.event.ids), believed)
        ]
