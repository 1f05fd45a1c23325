"""What an observation may mean: points without an id, and points whose id may be wrong.

After a long blind stretch the gate is wide, and a wrong id passes it. A point that is taken for
the landmark of a wrong id closes a loop where there is none, and throws the pose. So there are two
interpretations: the point is what its id says, or it is an outlier. Later observations decide. The
landmark may be wrong as well, if such a point has put it there.

An observation that the gate mostly rejects has several interpretations, too. It is garbled, its
landmarks have moved, or the robot is not where odometry has it: its wheels slipped, or someone
carried it. A robot that ignored what it sees would then be lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from slam_observer_ros.association.assignments import Assignment, find_assignments
from slam_observer_ros.association.costs import (
    cost_of_staying,
    outlier_cost,
    pairing_cost,
    rejection_cost,
    SLIP_COST,
)
from slam_observer_ros.association.hypothesis import LandmarkIndex, Verdicts
from slam_observer_ros.association.joint_compatibility import joint_cost
from slam_observer_ros.association.slip import slip
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry.matrices import mahalanobis
from slam_observer_ros.observer.observer import Residuals
from slam_observer_ros.observer.robust import accepted, are_far, far_from_the_others
from slam_observer_ros.sensor_models.motion_noise import beyond_driving
from slam_observer_ros.state.matching import (
    Expected,
    is_contradiction,
    match,
    MatchedObservation,
    positions,
)
from slam_observer_ros.state.state import State


def _none() -> IntArray:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Interpretation:
    """One of the meanings that an observation may have: a landmark or none for each point."""

    event: ObservationEvent  # all ids filled in, points taken for outliers left out
    cost: float  # −2 ln of its likelihood, without what all interpretations share
    slipped: State | None = None  # the state, if the robot moved in any way since the last one
    # Points that pass the gate and are left out all the same: their landmarks were seen so seldom
    # that these may be the outliers.
    disbelieved: ObservationEvent | None = None
    suspects: IntArray = field(default_factory=_none)  # ids that may be wrong, left out or not
    # (j,) landmarks that had no id of their own so far, and the ids that they get.
    relabelled_rows: IntArray = field(default_factory=_none)
    relabelled_ids: IntArray = field(default_factory=_none)
    matched: MatchedObservation | None = None  # with the landmarks of these ids, where it is so
    update: Update | None = None  # where the state has already used it so


def interpretations(
    state: State,
    index: LandmarkIndex,
    event: ObservationEvent,
    matched: MatchedObservation,
    new_ids: IntArray,
    new_cost: float,
    budget: float,
    is_alone: bool = False,
) -> list[Interpretation]:
    """Return what an observation may mean.

    ``state`` is that at its instant, ``index`` that of its landmarks, ``matched`` the observation
    with the landmarks that its ids name. Points taken for landmarks not seen before get
    ``new_ids`` (m,), at a cost of ``new_cost`` for one without an id.
    Interpretations that cost more than ``budget`` need not be returned. Where there is no other
    state, ``is_alone``, costs are compared with each other only.
    """
    # Which known landmarks are rejected, and which only pass as the state is uncertain.
    residuals, m = matched.residuals, len(event.ids)
    some_are_unknown = bool((event.ids == UNKNOWN_ID).any())
    rejected = _are_rejected(state, residuals)
    is_contradicted = not some_are_unknown and is_contradiction(rejected)
    sensor_distances = _sensor_distances(state, residuals)
    is_suspect = _suspects(state, residuals, sensor_distances)
    suspects = state.landmarks.ids[residuals.rows[is_suspect]]
    # Points that may be of several landmarks.
    if not is_contradicted and (some_are_unknown or may_relabel(state, matched)):
        found = find_assignments(state, index, event, new_cost, budget, is_alone)
        return _of_suspects(_by_assignments(state, event, new_ids, suspects, found), suspects)
    # All ids are right, or the ids of one or all suspects are wrong, or the robot slipped.
    if is_contradicted:
        trusting, *slipped = _rejected_or_slipped(state, matched, event, rejected)
    else:
        cost = pairing_cost(state, m, residuals)
        trusting, slipped = Interpretation(event, cost, matched=matched), []
    doubted = [*suspects[:, None], suspects] if len(suspects) > 1 else [*suspects[:, None]]
    without = [_without(ids, state, matched, trusting) for ids in doubted]
    return _of_suspects([trusting, *without, *slipped], suspects)


def _of_suspects(found: list[Interpretation], suspects: IntArray) -> list[Interpretation]:
    return [replace(one, suspects=suspects) for one in found] if len(suspects) else found


def as_its_ids_say(
    state: State, event: ObservationEvent, update: Update, expected: Expected | None
) -> Interpretation:
    """Return the only meaning of an observation that a state has used as usual."""
    m = len(event.ids)
    cost = m * outlier_cost(state)
    if expected is not None:
        paired_cost = joint_cost(expected.r, expected.S, expected.R)
        cost = paired_cost + (m - len(expected.r)) * outlier_cost(state)
    return Interpretation(event, cost, update=update)


def _without(
    ids: IntArray,
    state: State,
    matched: MatchedObservation,
    trusting: Interpretation,
) -> Interpretation:
    """Return the interpretation that points with some ids are outliers."""
    event, residuals = trusting.event, matched.residuals
    # It is no cheaper than trusting them …
    out = np.isin(state.landmarks.ids[residuals.rows], ids)
    cost = max(trusting.cost, pairing_cost(state, len(event.ids), residuals.select(~out)))
    # … but for a point that is seen again at one position, of a landmark that was seen so seldom
    # that it may itself be the outlier.
    unconfirmed = out & (state.landmarks.counts[residuals.rows] < state.settings.confirmations)
    again, staying = cost_of_staying(state, matched)
    saved = float(np.sum(outlier_cost(state) - staying[again & unconfirmed]))
    unconfirmed_ids = state.landmarks.ids[residuals.rows[unconfirmed]]
    return Interpretation(
        event.select(~np.isin(event.ids, ids)),
        cost - saved,
        disbelieved=event.select(np.isin(event.ids, unconfirmed_ids)),
    )


def noted(
    verdicts: Verdicts, state: State, taken: Interpretation, event: ObservationEvent
) -> Verdicts:
    """Return the verdicts after an observation that was taken as interpreted.

    Of a landmark that was forgotten there is none.
    """
    if not (verdicts or len(taken.suspects)):
        return verdicts
    points, believed = positions(state, event)[0], np.isin(event.ids, taken.event.ids)
    suspects = np.flatnonzero(np.isin(event.ids, taken.suspects)).tolist()
    judged = verdicts | {int(event.ids[i]): (points[i], bool(believed[i])) for i in suspects}
    ids = np.array(list(judged), dtype=np.int64)
    forgotten = ids[state.landmarks.rows_of(ids) < 0].tolist()
    return {landmark_id: judged[landmark_id] for landmark_id in judged.keys() - {*forgotten}}


def consistent(
    verdicts: Verdicts, state: State, possible: list[Interpretation], event: ObservationEvent
) -> list[Interpretation]:
    """Return the interpretations that judge points as before, where they were before.

    To leave out a point and then believe one at the same place mixes two stories; each of them
    has been followed by another hypothesis from the start.
    """
    if not verdicts:
        return possible
    event = event.select(np.isin(event.ids, list(verdicts)))
    before = [verdicts[landmark_id] for landmark_id in event.ids.tolist()]
    points, tolerances_m = positions(state, event)
    shifts = points - np.reshape([place for place, _ in before], (-1, 3))
    is_there = np.linalg.norm(shifts, axis=1) <= tolerances_m
    ids = event.ids[is_there]
    believed = np.array([was for _, was in before], dtype=np.bool_)[is_there]
    return [
        one
        for one in possible
        if one.slipped is not None or np.array_equal(np.isin(ids, one.event.ids), believed)
    ]


def is_ambiguous(state: State, matched: MatchedObservation) -> bool:
    """Return whether an observation, all of whose points have ids, may mean different things."""
    residuals = matched.residuals
    sensor_distances = _sensor_distances(state, residuals)
    if accepted(sensor_distances, state.settings.rejection_threshold).all():
        return False  # by all of S they are no further off
    some_are_suspect = bool(_suspects(state, residuals, sensor_distances).any())
    return some_are_suspect or is_contradiction(_are_rejected(state, residuals))


def may_relabel(state: State, matched: MatchedObservation) -> bool:
    """Return whether a point's id may be that of a landmark which had none of its own so far."""
    all_are_known = len(matched.known.ids) == len(matched.rows) + matched.left_out
    if all_are_known:
        return False
    return bool(is_automatic(state.landmarks.ids).any())


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
    after_slip = _after_slip(state, matched, event) if is_new_cause else None
    rejecting = Interpretation(event, accepted_cost + cost, matched=matched)
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
    settings = state.settings
    if not (settings.unknown_linear_motion or settings.unknown_angular_motion):
        return None
    stands = state.observation_noise.stood_s > 0.0
    far = beyond_driving(matched.known.points, matched.residuals.r, settings)
    if stands and not far.all():
        return None
    slipped = state.copy()
    cost = slip(slipped, matched)
    matched = match(slipped, event)
    if _are_rejected(slipped, matched.residuals).any():
        return None
    cost += SLIP_COST + pairing_cost(slipped, len(event.ids), matched.residuals)
    return Interpretation(event, cost, slipped, matched=matched)


def _sensor_distances(state: State, residuals: Residuals) -> FloatArray:
    """Return how far off points (m,) are by the sensor's noise alone, quick to compute."""
    return mahalanobis(*residuals.on(state.axes))


def _are_rejected(state: State, residuals: Residuals) -> BoolArray:
    """Return which points (m,) the gate rejects."""
    gate = state.settings.rejection_threshold
    return ~accepted(state.gains.distances(residuals), gate)


def _suspects(state: State, residuals: Residuals, sensor_distances: FloatArray) -> BoolArray:
    """Return which points (m,) only pass the gate as the state is so uncertain."""
    gate = state.settings.rejection_threshold
    far = are_far(sensor_distances, gate)
    if far.any():
        r, noise = residuals.on(state.axes)
        far &= far_from_the_others(r, state.known_errors.predicted(residuals)[1], noise, gate)
    return far


def _by_assignments(
    state: State,
    event: ObservationEvent,
    new_ids: IntArray,
    suspects: IntArray,
    found: list[Assignment],
) -> list[Interpretation]:
    """Interpret points that may be of landmarks without an id."""
    # An id is believed until something contradicts it: an interpretation without a suspect costs
    # no less than one with all of them.
    outliers = [np.isin(event.ids, suspects) & (assignment.rows < 0) for assignment in found]
    pairs = list(zip(found, outliers, strict=True))
    trusting = min((assignment.cost for assignment, out in pairs if not out.any()), default=0.0)
    interpreted = []
    for assignment, out in pairs:
        cost = max(assignment.cost, trusting) if out.any() else assignment.cost
        interpretation = _with_ids(state, event, assignment, new_ids)
        interpreted.append(
            replace(interpretation, event=interpretation.event.select(~out), cost=cost)
        )
    return interpreted


def _with_ids(
    state: State, event: ObservationEvent, assignment: Assignment, new_ids: IntArray
) -> Interpretation:
    """Interpret m points as an assignment has them; ``new_ids`` (m,) are for new landmarks."""
    rows, has_id = assignment.rows, event.ids != UNKNOWN_ID
    known_ids = np.append(state.landmarks.ids, UNKNOWN_ID)[rows]
    ids = np.where(has_id, event.ids, np.where(rows < 0, new_ids, known_ids))
    is_relabelled = has_id & (rows >= 0) & (known_ids != event.ids)
    return Interpretation(
        replace(event, ids=ids),
        assignment.cost,
        relabelled_rows=rows[is_relabelled],
        relabelled_ids=event.ids[is_relabelled],
    )
