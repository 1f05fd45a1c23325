"""Which landmarks the points of an observation are, where the sensor gave no ids.

An *assignment* takes each such point for a known landmark, or for a new one, and so puts the robot
at some pose. Of assignments that agree on the pose, within the sensor's noise, the most likely one
is taken. Assignments that disagree are all returned, for later observations to decide
(:mod:`slam_observer_ros.tracking.hypotheses`).

A point with a new id may be of a landmark that had none so far, but only where the state predicts
that landmark as well as the sensor measures it: a new id suggests a new landmark.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.observer import Observer, Residuals
from slam_observer_ros.filter.robust import accepted, huber_loss
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import SPATIAL
from slam_observer_ros.lie.matrices import (
    cholesky,
    squares_and_log_dets,
    transpose,
    with_blocks,
)
from slam_observer_ros.tracking.joint_compatibility import (
    JointSearch,
    NewCosts,
    Pairing,
    Pairs,
    pruning_cost,
    RESOLUTION,
    unpaired_cost,
)
from slam_observer_ros.tracking.matching import sensitivity
from slam_observer_ros.tracking.state import State

MAX_CANDIDATES = 10  # landmarks that a point may be taken for; the nearest, if there are more

FEW_PAIRS = 200
"""Pairs of a point and a landmark of which each is judged: of more, only those that are near."""

HARDLY_MOVED = 0.5 * RESOLUTION
"""Shift of the points, in standard deviations of the sensor, up to which a correction hardly moves
the robot: then no other assignment has to be looked for.
"""


@dataclass(frozen=True, slots=True)
class Assignment:
    """What the points of an observation are taken for."""

    rows: IntArray  # (m,) row of the landmark that each point is, −1 for a new one
    evidence: FloatArray  # (m,) that this landmark exists; 0 for a new one
    cost: float  # −2 ln of its likelihood; a part that all assignments share is left out
    seen_costs: FloatArray  # (m,) the part of it that says where each landmark was seen


def find_assignments(
    state: State, event: ObservationEvent, new_costs: NewCosts, budget: float, is_alone: bool
) -> list[Assignment]:
    """Return all assignments that put the robot at different poses, the most likely first.

    ``state`` is at the instant of ``event``, an observation of m points. Points without an id
    cost ``new_costs`` if they are of a new landmark. None costs more than ``budget``. Where the
    state ``is_alone``, costs matter only to each other.
    """
    # Pairs of a point and a landmark that pass the gate one by one, and their joint residuals.
    axes, m = state.axes, len(event.ids)
    seen = _Points(state, event)
    at, rows, squares, log_dets, residuals = _candidates(state, seen)
    r, noise = residuals.on(axes)
    # Which points are of a known landmark in any case: nearly always all, and each of one.
    by_noise, log_noise = squares_and_log_dets(noise, r)
    certain = (by_noise <= RESOLUTION**2) & ~seen.is_new_id[at]
    gate_cost = unpaired_cost(state.settings.rejection_threshold)
    none_costs = np.where(seen.has_id, gate_cost, new_costs.each)
    # Nearly always each point may be of one landmark.
    within = set(at.tolist())
    are_single, are_certain = len(within) == len(set(rows.tolist())) == len(at), certain.all()
    if is_alone and are_single and len(at) == m and are_certain:
        evidence = 0.5 * (none_costs[at] - huber_loss(np.sqrt(by_noise)))
        none = np.zeros(m)  # all hypotheses to come share it
        return [Assignment(_taken(m, at, rows, -1), _taken(m, at, evidence, 0.0), 0.0, none)]
    PC, CPC = state.known_errors.predicted(residuals)
    pairs = Pairs(at, rows, r, with_blocks(CPC, noise), noise, PC)
    # The cost of a point that is of no landmark.
    unpaired_costs = np.where(seen.is_new_id, unpaired_cost(RESOLUTION), none_costs)
    # Points outside the search; one of no landmark costs the same whatever it might have been.
    outside, steps = m - len(within), new_costs.steps
    fixed_cost = float(none_costs.sum() - unpaired_costs[list(within)].sum())
    fixed_cost += float(steps[:outside].sum())
    search = JointSearch(
        pairs,
        certain,
        unpaired_costs[at],
        0.0 if are_certain else pruning_cost(event.ids),
        budget - fixed_cost,
        -2.0 * np.log(state.landmarks.existence(rows)),
        steps[outside:],
    )
    # Nearly always they hardly move the robot, all together.
    whole = search.all_pairs() if are_single and len(at) else None
    moves = _PoseMoves(state, seen)
    if whole is not None and (are_certain or _largest(moves.by(whole)) <= HARDLY_MOVED):
        pairings = [whole]
    else:
        pairings = moves.distinct(search.pairings())
    # By how much likelier each pair is than a point of nothing known.
    evidence = none_costs[at] - huber_loss(np.sqrt(squares)) - (log_dets - log_noise)
    evidence = np.maximum(0.5 * evidence, 0.0)
    firsts = -np.linalg.slogdet(2.0 * np.pi * seen.noise[:, : axes.point, : axes.point])[1]
    return [
        Assignment(
            _taken(m, at[each.chosen], rows[each.chosen], -1),
            _taken(m, at[each.chosen], evidence[each.chosen], 0.0),
            each.cost + fixed_cost,
            _taken(m, at[each.chosen], search.seen_costs(each), firsts),
        )
        for each in pairings
    ]


class _PoseMoves:
    """How far pairings move the robot: by the shift of the points, in the sensor's σ."""

    def __init__(self, state: State, seen: _Points) -> None:
        self._axes, self._seen = state.axes, seen

    @cached_property
    def _J(self) -> FloatArray:  # noqa: N802 (points by a pose error)
        axes, seen = self._axes, self._seen
        scale = np.linalg.inv(cholesky(seen.noise[:, : axes.point, : axes.point]))
        return np.asarray(scale @ axes.output_matrix(seen.points))

    def by(self, pairing: Pairing) -> FloatArray:
        """Return how far (m, k) the points move by the correction that a pairing makes."""
        return np.asarray(self._J @ pairing.move)

    def distinct(self, pairings: list[Pairing]) -> list[Pairing]:
        """Return the first pairing of all that put the robot at one pose."""
        if len(pairings) < 2:
            return pairings
        moves = np.array([pairing.move for pairing in pairings]) @ self._J.swapaxes(1, 2)
        off = moves[:, :, None] - moves[:, None]  # (m, b, b, k)
        are_one = np.square(off).sum(axis=3).max(axis=0) <= RESOLUTION**2
        kept = list[int]()
        for i in range(len(pairings)):
            if not are_one[i, kept].any():
                kept.append(i)
        return [pairings[i] for i in kept]


def _taken(m: int, at: IntArray, values: Any, other: Any) -> Any:
    """Return values (m,) that are ``other`` but for the points ``at`` (q,)."""
    taken = np.full(m, other)
    taken[at] = values
    return taken


class _Points:
    """The points of an observation in the reference frame, and what their ids say."""

    def __init__(self, state: State, event: ObservationEvent) -> None:
        self.stamp_ns = event.stamp_ns
        self.points = se3.transform(state.observer.A, event.points)  # (m, 3) Â y_i, metres
        # (m, 3, 3) their covariances, m²
        self.noise = state.observer.turned(state.observation_noise.covariances(event))
        # (m,) rows of the landmarks whose ids they have, −1 for none; whether an id is new
        self.known_rows = state.landmarks.rows_of(event.ids)
        # (m, 3, c) how they change with the calibration
        self.D = sensitivity(state, event)
        self.has_id = has_id = event.ids != UNKNOWN_ID
        self.some_have_ids, self.is_new_id = bool(has_id.any()), has_id & (self.known_rows < 0)


def _candidates(
    state: State, seen: _Points
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, Residuals]:
    """Return pairs (q,), (q,) of a point and a landmark that ids allow and that pass the gate.

    And their residuals, how far off each is alone, squared (q,), and ln |S| (q,).
    """
    at, rows = _pairs_near(state, seen)
    if seen.some_have_ids:
        allowed = _may_be(state, seen, at, rows)
        at, rows = at[allowed], rows[allowed]
    residuals = _as_residuals(state.observer, seen, at, rows)
    S = state.known_errors.own_innovation_covariances(residuals)
    squares, log_dets = squares_and_log_dets(S, residuals.on(state.axes)[0])
    near = accepted(np.sqrt(squares), state.settings.rejection_threshold)
    if np.count_nonzero(near) > MAX_CANDIDATES:  # a point keeps its nearest landmarks
        order = np.lexsort((squares, at))
        rank = np.arange(len(at)) - np.searchsorted(at[order], at[order])
        near[order[rank >= MAX_CANDIDATES]] = False
    return at[near], rows[near], squares[near], log_dets[near], residuals.select(near)


def _pairs_near(state: State, seen: _Points) -> tuple[IntArray, IntArray]:
    """Return pairs (q,), (q,) of a point and a landmark, all that may pass the gate among them."""
    m, landmarks = len(seen.points), state.observer.points
    if m * len(landmarks) <= FEW_PAIRS:
        everything = np.arange(len(landmarks))
        return np.repeat(np.arange(m), len(landmarks)), np.tile(everything, m)
    errors = state.known_errors
    of_pose, of_landmarks = errors.pose_covariance(), errors.landmark_covariances()
    C = SPATIAL.output_matrix(seen.points)
    of_points = C @ of_pose @ transpose(C) + seen.noise
    spread_m = _spread_m(of_points) + np.max(_spread_m(of_landmarks), initial=0.0)
    if seen.D is not None:
        deviations = np.sqrt(state.gains.calibration_variances)
        spread_m = spread_m + np.linalg.norm(seen.D, axis=1) @ deviations
    reach_m = state.settings.rejection_threshold * spread_m
    near = [
        np.flatnonzero(np.square(landmarks - point).sum(axis=1) <= reach**2)
        for point, reach in zip(seen.points, reach_m.tolist(), strict=True)
    ]
    return np.repeat(np.arange(m), [len(rows) for rows in near]), np.concatenate(near)


def _may_be(state: State, seen: _Points, at: IntArray, rows: IntArray) -> BoolArray:
    """Return which pairs (q,) of a point and a landmark the ids of the points allow."""
    is_automatic_id = is_automatic(state.landmarks.ids)
    others = ~np.isin(rows, seen.known_rows) & (~seen.is_new_id[at] | is_automatic_id[rows])
    known_rows = seen.known_rows[at]
    return np.asarray(np.where(known_rows >= 0, rows == known_rows, others))


def _as_residuals(observer: Observer, seen: _Points, at: IntArray, rows: IntArray) -> Residuals:
    """Return the residuals if the points ``at`` (q,) were of the landmarks ``rows`` (q,)."""
    a = observer.translations(rows)
    e = seen.points[at] - a
    r, D = e - observer.y_ref[rows], None if seen.D is None else seen.D[at]
    return Residuals(rows, e, r, a, seen.noise[at], np.zeros(len(rows)), np.ones(len(rows)), D)


def _largest(vectors: FloatArray) -> float:
    """Return the largest norm of vectors (m, k)."""
    return float(np.sqrt((vectors * vectors).sum(axis=1).max()))


def _spread_m(covariances: FloatArray) -> FloatArray:
    """Return a bound on the standard deviation (m,) in any direction, of (m, 3, 3), metres."""
    return np.asarray(np.sqrt(np.trace(covariances, axis1=1, axis2=2)))
