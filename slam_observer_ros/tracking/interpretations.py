"""What an observation may mean: points without an id, and wheels that may have slipped.

An observation that the gate mostly rejects has several interpretations. It is garbled, its
landmarks have moved, or the robot is not where odometry has it: its wheels slipped, or someone
carried it. A robot that ignored what it sees would then be lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.tracking.assignments import Assignment, find_assignments
from slam_observer_ros.tracking.costs import (
    outlier_cost,
    pairing_cost,
    rejection_cost,
    SLIP_COST,
)
from slam_observer_ros.tracking.joint_compatibility import NewCosts
from slam_observer_ros.tracking.matching import (
    calibrated,
    is_contradiction,
    match,
    MatchedObservation,
)
from slam_observer_ros.tracking.slip import astray, rejects, second_track
from slam_observer_ros.tracking.state import State


def _none() -> IntArray:
    return np.empty(0, dtype=np.int64)


@dataclass(slots=True, eq=False)
class Interpretation:
    """One of the meanings that an observation may have: a landmark or none for each point."""

    event: ObservationEvent  # all ids filled in
    cost: float  # −2 ln of its likelihood, without what all interpretations share
    slipped: State | None = None  # the state, if the robot moved in any way since the last one
    # (j,) landmarks that had no id of their own so far, and the ids that they get.
    named_rows: IntArray = field(default_factory=_none)
    given_ids: IntArray = field(default_factory=_none)
    # (m,) that each point's landmark exists; None if its id says so
    evidence: FloatArray | None = None
    # (m,) the part of the cost that says where each landmark was seen
    seen_costs: FloatArray | None = None


def interpretations(
    state: State,
    event: ObservationEvent,
    new_ids: IntArray,
    new_costs: NewCosts,
    budget: float,
    is_alone: bool = False,
) -> list[Interpretation]:
    """Return what an observation may mean.

    ``state`` is at its instant. Points taken for landmarks not seen
    before get ``new_ids`` (m,), at ``new_costs`` for those without an id.
    Interpretations that cost more than ``budget`` need not be returned. Where there is no other
    state, ``is_alone``, costs are compared with each other only.
    """
    event = calibrated(state, event)
    some_are_unknown = bool((event.ids == UNKNOWN_ID).any())
    if not some_are_unknown:
        matched = match(state, event)
        rejected = rejects(state, matched)
        if is_contradiction(rejected):
            return _rejected_or_slipped(state, matched, event, rejected)
    if some_are_unknown or may_name(state, event.ids):
        found = find_assignments(state, event, new_costs, budget, is_alone)
        possible = [_with_ids(state, event, assignment, new_ids) for assignment in found]
        # In a loaded map a robot that is elsewhere is sought anywhere.
        is_own = bool(is_automatic(state.landmarks.ids).all())
        if is_own and (event.ids == UNKNOWN_ID).all():
            possible += _slips_without_ids(state, event, new_ids, new_costs, found)
        return possible
    cost = pairing_cost(state, len(event.ids), matched.residuals)
    return [Interpretation(event, cost)]


def may_name(state: State, ids: IntArray) -> bool:
    """Return whether one of the ``ids`` (m,) may belong to a landmark which had none so far."""
    table = state.landmarks
    return table.some_without_ids and bool((table.rows_of(ids) < 0).any())


def _rejected_or_slipped(
    state: State,
    matched: MatchedObservation,
    event: ObservationEvent,
    rejected: BoolArray,
) -> list[Interpretation]:
    """Interpret an observation most of whose known landmarks are rejected.

    If a single motion explains all that is seen, this is as unlikely of a garbled message as of a
    robot that has made this motion.
    """
    residuals, m = matched.residuals, len(event.ids)
    cost, is_new_cause = rejection_cost(state, matched, rejected)
    accepted_cost = pairing_cost(state, m - int(np.sum(rejected)), residuals.select(~rejected))
    rejecting = Interpretation(event, accepted_cost + cost)
    after_slip = _after_slip(state, matched, event) if is_new_cause else None
    if after_slip is None:
        return [rejecting]
    if state.was_contradicted:
        return [rejecting, after_slip]
    as_outliers = accepted_cost + float(np.sum(rejected)) * outlier_cost(state)
    # A garbled message also explains points that happen to be where they should be.
    garbled = max(cost, min(after_slip.cost - SLIP_COST, as_outliers))
    return [replace(rejecting, cost=garbled), after_slip]


def _after_slip(
    state: State, matched: MatchedObservation, event: ObservationEvent
) -> Interpretation | None:
    """Take the robot for slipped; return None if that does not explain all of it."""
    if (track := second_track(state, matched, event)) is None:
        return None
    slipped, matched, cost = track
    cost += SLIP_COST + pairing_cost(slipped, len(event.ids), matched.residuals)
    return Interpretation(event, cost, slipped)


def _slips_without_ids(
    state: State,
    event: ObservationEvent,
    new_ids: IntArray,
    new_costs: NewCosts,
    found: list[Assignment],
) -> list[Interpretation]:
    """Take the robot for slipped, where more points are new than a slip is unlikely.

    Not where others explain what is seen so well that nothing is ``found`` within their reach, nor
    where what is found from there passes the gate: that needs no slip.
    """
    new = min((int(np.count_nonzero(one.rows < 0)) for one in found), default=0)
    if not new or not len(state.landmarks):
        return []
    if min(new_costs.of(one.rows < 0) for one in found) <= SLIP_COST:
        return []
    slips: dict[bytes, Interpretation] = {}
    for other in astray(state):
        for assignment in find_assignments(other, event, new_costs, np.inf, False)[:1]:
            is_new, taken_for = assignment.rows < 0, assignment.rows.tobytes()
            if np.sum(is_new) >= new or taken_for in slips:
                continue
            taken = _with_ids(state, event, assignment, new_ids).event
            matched = match(state, taken)
            if not rejects(state, matched).any():
                continue
            slipped = _after_slip(state, matched, taken)
            if slipped is not None:
                spared = np.count_nonzero(is_new) * outlier_cost(state) - new_costs.of(is_new)
                evidence, cost = assignment.evidence, slipped.cost - spared
                slips[taken_for] = replace(slipped, cost=cost, evidence=evidence)
    return list(slips.values())


def _with_ids(
    state: State, event: ObservationEvent, assignment: Assignment, new_ids: IntArray
) -> Interpretation:
    """Interpret m points as an assignment has them; ``new_ids`` (m,) are for new landmarks."""
    rows, has_id = assignment.rows, event.ids != UNKNOWN_ID
    known_ids = np.append(state.landmarks.ids, UNKNOWN_ID)[rows]
    ids = np.where(rows < 0, new_ids, known_ids)
    is_named = has_id
    if has_id.any():
        ids = np.where(has_id, event.ids, ids)
        is_named = has_id & (rows >= 0) & (known_ids != event.ids)
    return Interpretation(
        replace(event, ids=ids),
        assignment.cost,
        named_rows=rows[is_named],
        given_ids=event.ids[is_named],
        evidence=assignment.evidence,
        seen_costs=assignment.seen_costs,
    )
