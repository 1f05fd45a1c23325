"""Which landmarks the points of an observation are, where the sensor gave no ids.

An *assignment* takes each such point for a landmark, or for a new one. What matters is where it
puts the robot: of those that agree on that, within the sensor's noise, the most likely one is
taken. Those that disagree are all returned, for later observations to decide
(:mod:`slam_observer_ros.association.hypotheses`).

A point with a new id may be of a landmark that had none so far, but only where the state predicts
that landmark as well as the sensor measures it: a new id suggests a new landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.association.joint_compatibility import (
    columns_of,
    JointSearch,
    Pairs,
    PRUNING_COST,
    RESOLUTION,
    unpaired_cost,
)
from slam_observer_ros.association.landmark_index import LandmarkIndex
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import is_automatic, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import SPATIAL
from slam_observer_ros.geometry.matrices import cholesky, mahalanobis, transpose, with_blocks
from slam_observer_ros.observer.filter import Filter
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.state.matching import sensitivity
from slam_observer_ros.state.state import State

MAX_CANDIDATES = 10
"""Landmarks that a point may be taken for; the nearest, if there are more."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """What the points of an observation are taken for."""

    rows: IntArray  # (m,) row of the landmark that each point is, −1 for a new one
    cost: float  # −2 ln of its likelihood, up to what all assignments share


def find_assignments(
    state: State, index: LandmarkIndex, event: ObservationEvent, budget: float
) -> list[Assignment]:
    """Return all assignments that put the robot at different poses, the most likely first.

    ``state`` is that at the instant of ``event``, an observation of m points, ``index`` that of
    its landmarks. None costs more than ``budget``.
    """
    # Pairs of a point and a landmark that pass the gate one by one, and their joint residuals.
    axes, m = state.axes, len(event.ids)
    seen = _Points(state, event)
    at, rows = _candidates(state, index, seen)
    residuals = _as_residuals(state.filter, seen, at, rows)
    PC, CPC = state.filter.predicted(residuals)
    r, noise = residuals.on(axes)
    pairs = Pairs(at, rows, r, with_blocks(CPC, noise), noise)
    # What it costs that a point is of no landmark, and which are of one in any case.
    certain = (mahalanobis(r, noise) <= RESOLUTION) & ~seen.is_new_id[at]
    gate_cost = unpaired_cost(state.settings.rejection_threshold)
    unpaired_costs = np.where(seen.is_new_id, unpaired_cost(RESOLUTION), gate_cost)
    # Points outside the search; one of no landmark costs the same whatever it might have been.
    fixed_cost = m * gate_cost - float(unpaired_costs[np.unique(at)].sum())
    margin = 0.0 if certain.all() else PRUNING_COST
    search = JointSearch(pairs, certain, unpaired_costs[at], margin, budget - fixed_cost)
    # Of the pairings that put the robot at one pose, the cheapest, which comes first.
    scale = np.linalg.inv(cholesky(seen.noise[:, : axes.point, : axes.point]))
    J = scale @ axes.output_matrix(seen.points)  # how a pose error moves the points, in σ
    assignments: list[Assignment] = []
    moves: list[FloatArray] = []
    for pairing in search.pairings():
        move = J @ PC[:, columns_of(pairing.chosen, axes.point)] @ (pairing.L.T @ pairing.z)
        if all(_largest(move - other) > RESOLUTION for other in moves):
            found = np.full(m, -1)
            found[at[pairing.chosen]] = rows[pairing.chosen]
            assignments.append(Assignment(found, pairing.cost + fixed_cost))
            moves.append(move)
    return assignments


class _Points:
    """The points of an observation in the reference frame, and what their ids say."""

    def __init__(self, state: State, event: ObservationEvent) -> None:
        self.points = se3.transform(state.observer.A, event.points)  # (m, 3) Â y_i, metres
        # (m, 3, 3) their covariances, m²
        self.noise = state.observer.turned(state.observation_noise.covariances(event))
        # (m,) rows of the landmarks whose ids they have, −1 for none; whether an id is new
        self.known_rows = state.landmarks.rows_of(event.ids)
        # (m, 3, c) how they change with the calibration
        self.D = sensitivity(state, event)
        self.is_new_id = (event.ids != UNKNOWN_ID) & (self.known_rows < 0)


def _candidates(state: State, index: LandmarkIndex, seen: _Points) -> tuple[IntArray, IntArray]:
    """Return pairs (q,), (q,) of a point and a landmark that ids allow and that pass the gate."""
    at, rows = _pairs_near(state, index, seen)
    allowed = _may_be(state, seen, at, rows)
    at, rows = at[allowed], rows[allowed]
    distances = state.filter.distances(_as_residuals(state.filter, seen, at, rows))
    # Each pair passes the gate alone; a point keeps its nearest landmarks.
    order = np.lexsort((distances, at))
    rank = np.arange(len(at)) - np.searchsorted(at[order], at[order])
    passes = distances[order] <= state.settings.rejection_threshold
    near = order[(rank < MAX_CANDIDATES) & passes]
    return at[near], rows[near]


def _pairs_near(state: State, index: LandmarkIndex, seen: _Points) -> tuple[IntArray, IntArray]:
    """Return pairs (q,), (q,) of a point and a landmark, all that may pass the gate among them."""
    of_pose, of_landmarks = state.filter.pose_covariance(), state.filter.landmark_covariances()
    if of_pose is None or of_landmarks is None:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    C = SPATIAL.output_matrix(seen.points)
    of_points = C @ of_pose @ transpose(C) + seen.noise
    spread_m = _spread_m(of_points) + np.max(_spread_m(of_landmarks), initial=0.0)
    if seen.D is not None:
        deviations = np.sqrt(state.filter.calibration_variances)
        spread_m = spread_m + np.linalg.norm(seen.D, axis=1) @ deviations
    reach_m = state.settings.rejection_threshold * spread_m
    return index.near(state.filter.points, seen.points, reach_m)


def _may_be(state: State, seen: _Points, at: IntArray, rows: IntArray) -> BoolArray:
    """Return which pairs (q,) of a point and a landmark the ids of the points allow."""
    is_automatic_id = is_automatic(state.landmarks.ids)
    others = ~np.isin(rows, seen.known_rows) & (~seen.is_new_id[at] | is_automatic_id[rows])
    known_rows = seen.known_rows[at]
    return np.asarray(np.where(known_rows >= 0, rows == known_rows, others))


def _as_residuals(filter_: Filter, seen: _Points, at: IntArray, rows: IntArray) -> Residuals:
    """Return the residuals if the points ``at`` (q,) were of the landmarks ``rows`` (q,)."""
    a = filter_.translations(rows)
    e = seen.points[at] - a
    r, D = e - filter_.observer.y_ref[rows], None if seen.D is None else seen.D[at]
    return Residuals(rows, e, r, a, seen.noise[at], np.zeros(len(rows)), D)


def _largest(vectors: FloatArray) -> float:
    """Return the largest norm of vectors (m, k)."""
    return float(np.sqrt((vectors * vectors).sum(axis=1).max()))


def _spread_m(covariances: FloatArray) -> FloatArray:
    """Return a bound on the standard deviation (m,) in any direction, of (m, 3, 3), metres."""
    return np.asarray(np.sqrt(np.trace(covariances, axis1=1, axis2=2)))
