"""Hypotheses: states that take what was seen for different things (:mod:`.interpretations`).

Where two interpretations of an observation put the robot at different places, both are followed,
each with a state of its own, until later observations have made one much more likely than the
other (D. B. Reid, *An algorithm for tracking multiple targets*, 1979). So are states that have the
robot at one place but take what it sees there for different landmarks, as their maps differ. Where
landmarks have ids or are well apart there is nearly always one.
"""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import dataclass, replace
import math
from operator import attrgetter

import numpy as np

from slam_observer_ros.association.interpretations import (
    Interpretation,
    interpretations,
    is_ambiguous,
    may_relabel,
)
from slam_observer_ros.association.joint_compatibility import PRUNING_COST, RESOLUTION
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import (
    FIRST_AUTOMATIC_ID,
    is_automatic,
    ObservationEvent,
    UNKNOWN_ID,
)
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.geometry.matrices import mahalanobis
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state.map_management import disbelieve, note_surroundings
from slam_observer_ros.state.matching import MatchedObservation
from slam_observer_ros.state.state import Slam
from slam_observer_ros.state.step import Outcome, update


@dataclass(frozen=True, slots=True)
class _Child:
    """A hypothesis after an observation, what it took that for, what came of it, and its cost."""

    slam: Slam
    event: ObservationEvent
    outcome: Outcome
    cost: float


class Hypotheses:
    """Hypotheses of where everything is, each a state of its own, the most likely first.

    Parameters
    ----------
    slam : Slam
        The state at the start.

    """

    def __init__(self, slam: Slam) -> None:
        self._states = [slam]
        self._costs = [0.0]
        self._limit = slam.settings.max_hypotheses
        self._next_id = FIRST_AUTOMATIC_ID
        self._some_have_ids = False

    def __len__(self) -> int:
        """Return how many hypotheses there are."""
        return len(self._states)

    @property
    def best(self) -> Slam:
        """The most likely state."""
        return self._states[0]

    def prune_to_best(self) -> Slam:
        """Give up all hypotheses but the most likely one, and return its state."""
        self._states, self._costs = self._states[:1], [0.0]
        return self.best

    def pose_covariance_after(
        self, velocities: VelocityHistory, start_ns: int, end_ns: int
    ) -> FloatArray | None:
        """Return the covariance (6, 6) of the most likely pose at ``end_ns``, which may be wrong.

        Σ w_i (P_i + d_i d_iᵀ), with w_i the likelihoods of the hypotheses, moved on from
        ``start_ns``, and d_i how far their poses are then from that of the first. Coordinates are
        those of :meth:`.Slam.pose_after`. None where the gains know none.
        """
        pose, own = self.best.pose_after(velocities, start_ns, end_ns)
        likelihoods, total = np.exp(-0.5 * np.array(self._costs)), own
        weights = likelihoods / likelihoods.sum()
        for slam, weight in zip(self._states[1:], weights[1:].tolist(), strict=True):
            other, covariance = slam.pose_after(velocities, start_ns, end_ns)
            if total is None or own is None or covariance is None:
                return None
            d = _difference(pose, other)
            total = total + weight * (covariance - own + np.outer(d, d))
        return total

    def advance(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move all hypotheses, which are those of ``start_ns``, on to ``end_ns``."""
        for slam in self._states:
            slam.advance(velocities, start_ns, end_ns)

    def change_settings(self, settings: Settings) -> None:
        """Use other values of the settings that may change, in all hypotheses."""
        for slam in self._states:
            slam.change_settings(settings)

    def restart_time(self) -> None:
        """Let all hypotheses go on from where they are at any other time."""
        for slam in self._states:
            slam.restart_time()

    def forget(self, landmark_id: int) -> bool:
        """Remove a landmark from all maps; return whether the most likely one had it."""
        rows = [slam.landmarks.rows_of(np.array([landmark_id])) for slam in self._states]
        for slam, row in zip(self._states, rows, strict=True):
            if row[0] >= 0:
                slam.remove(row)
        return bool(rows[0][0] >= 0)

    def observe(self, event: ObservationEvent) -> Outcome:
        """Use an observation made at their instant; return what comes of it for the best one."""
        is_unknown = event.ids == UNKNOWN_ID
        self._some_have_ids = self._some_have_ids or not is_unknown.all()
        matches = [slam.match(event) for slam in self._states]
        if len(self._states) == 1 and not is_unknown.any():
            is_clear = self._limit == 1 or not is_ambiguous(self.best, matches[0])
            if is_clear and not may_relabel(self.best, matches[0]):
                return update(self.best, matches[0])
        children = self._children(event, self._possible(event, matches))
        self._costs = [child.cost - children[0].cost for child in children]
        self._states = [child.slam for child in children]
        return children[0].outcome

    def _children(
        self, event: ObservationEvent, possible: list[tuple[int, Interpretation]]
    ) -> list[_Child]:
        """Let hypotheses use an observation as what it may be; return what they become.

        The most likely comes first. Of those that become one, the first stands for all.
        """
        uses = Counter(number for number, taken in possible if taken.slipped is None)
        children: list[_Child] = []
        for number, taken in possible:
            slam = taken.slipped
            if slam is None:
                uses[number] -= 1
                slam = deepcopy(self._states[number]) if uses[number] else self._states[number]
            child = self._child(slam, taken, event)
            if not any(are_one(slam, taken.event, other.slam, other.event) for other in children):
                children.append(child)
            if len(children) == self._limit:
                break
        return sorted(children, key=attrgetter('cost'))

    def _child(self, slam: Slam, taken: Interpretation, event: ObservationEvent) -> _Child:
        """Let a state use an observation as one interpretation has it; return what comes of it."""
        slam.landmarks.renumber(taken.relabelled_rows, taken.relabelled_ids)
        outcome = update(slam, slam.match(taken.event))
        if taken.disbelieved is not None:
            disbelieve(slam, taken.disbelieved)
        cost = taken.cost
        if (event.ids == UNKNOWN_ID).any():
            cost += note_surroundings(slam, taken.event, self._some_have_ids)
        slam.counts['rejected_landmark'] += len(event.ids) - len(taken.event.ids)
        return _Child(slam, taken.event, outcome, cost)

    def _possible(
        self, event: ObservationEvent, matches: list[MatchedObservation]
    ) -> list[tuple[int, Interpretation]]:
        """Return what each hypothesis may take an observation for, by its number.

        The cheapest comes first; the cost is that of the hypothesis as well. A point has the same
        id in all of them that take it for a new landmark.
        """
        for slam in self._states:
            given = slam.landmarks.ids[is_automatic(slam.landmarks.ids)]  # of a loaded map, too
            self._next_id = max(self._next_id, int(np.max(given, initial=0)) + 1)
        new_ids = self._next_id + np.arange(len(event.ids))
        possible: list[tuple[int, Interpretation]] = []
        worst = math.inf
        before = zip(self._states, self._costs, matches, strict=True)
        for number, (slam, cost, matched) in enumerate(before):
            for taken in interpretations(slam, event, matched, new_ids, worst - cost):
                possible.append((number, replace(taken, cost=cost + taken.cost)))
                worst = min(worst, cost + taken.cost + PRUNING_COST)
        possible.sort(key=lambda pair: pair[1].cost)
        return [(number, taken) for number, taken in possible if taken.cost <= worst]


def _difference(pose: FloatArray, other: FloatArray) -> FloatArray:
    """Return rotation vector and shift (6,) from one pose to another, along the world's axes."""
    turn = so3.log(other[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([turn, other[:3, 3] - pose[:3, 3]])


def are_one(
    slam: Slam, event: ObservationEvent, other: Slam, other_event: ObservationEvent
) -> bool:
    """Return whether two hypotheses, by the points seen, are at one place with one map there.

    That is so if they have the points, and each landmark that either takes one of them for, at
    the same places: which was which this once does not matter then.
    """
    if not np.array_equal(event.points, other_event.points):  # one leaves some out
        return False
    here, there = slam.observer.pose, other.observer.pose
    noise = here[:3, :3] @ slam.observation_noise.covariances(event) @ here[:3, :3].T
    shifts = [se3.transform(here, event.points) - se3.transform(there, event.points)]
    if not np.array_equal(event.ids, other_event.ids):
        for ids in (event.ids, other_event.ids):
            rows, other_rows = slam.landmarks.rows_of(ids), other.landmarks.rows_of(ids)
            if (rows < 0).any() or (other_rows < 0).any():
                return False
            shifts.append(slam.world_points[rows] - other.world_points[other_rows])
    distances = mahalanobis(np.concatenate(shifts), np.tile(noise, (len(shifts), 1, 1)))
    return len(distances) > 0 and bool(np.max(distances) <= RESOLUTION)
