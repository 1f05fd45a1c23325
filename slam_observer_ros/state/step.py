"""One step of the observer: what an observation changes in a state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.state.map_management import (
    add_new,
    make_room,
    note_velocities,
    relocate_moved,
)
from slam_observer_ros.state.matching import (
    is_contradiction,
    keyframe_of,
    MatchedObservation,
    positions,
)
from slam_observer_ros.state.state import State


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a state made of an observation.

    Attributes
    ----------
    ids : IntArray
        (m,) ids of the landmarks seen that were known before.
    residuals : FloatArray
        (m, 3) their residuals before the correction, metres, reference frame.
    rejected : BoolArray
        (m,) which of them were too far off to be used.
    moved_ids : IntArray
        Landmarks that it showed to have moved.

    """

    ids: IntArray
    residuals: FloatArray
    rejected: BoolArray
    moved_ids: IntArray


def step(state: State, matched: MatchedObservation) -> Outcome:
    """One step of the observer (28), from where the velocity has led it (27): the innovation."""
    residuals = matched.residuals  # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°
    make_room(state, matched)
    weights = _correct(state, residuals)  # (30), (31)  X̂ ← (D, d_i) · X̂
    rejected = weights == 0.0
    _count(state, matched, rejected)
    event, rows = add_new(state, matched)
    moved_ids = _relinearise(state, event, rows)
    note_velocities(state, event, rows)
    return Outcome(matched.known.ids, residuals.r, rejected, moved_ids)


def _correct(state: State, residuals: Residuals) -> FloatArray:
    """Correct the state; return the weights (m,), 0 for a rejected landmark."""
    if not len(residuals.rows):
        return np.empty(0)
    before = state.observer.A
    weights = state.filter.correct(residuals)
    if state.relinearisation is not None:
        state.relinearisation.note_correction(before, state.observer.A)
    return weights


def _count(state: State, matched: MatchedObservation, rejected: BoolArray) -> None:
    """Count which known landmarks (m,) were accepted, and which rejected."""
    event, rows, count = matched.known, matched.residuals.rows, int(np.count_nonzero(rejected))
    state.counts['unmapped_landmark'] += matched.left_out
    if not len(rows):
        return
    state.rejected_in_a_row = state.rejected_in_a_row + 1 if count == len(rows) else 0
    state.was_contradicted = is_contradiction(rejected)
    state.landmarks.accept(rows[~rejected], event.stamp_ns)
    if count:
        state.landmarks.reject(rows[rejected], *positions(state, event.select(rejected)))
        state.counts['rejected_landmark'] += count


def _relinearise(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Linearise the past again, if it is time; take landmarks for moved if that explains nothing.

    Now that the state is corrected, it is known better than before from where they were seen.
    Return the ids of those that have moved.
    """
    in_doubt = state.landmarks.in_doubt(rows, state.settings.max_rejections) & state.is_mapping
    some_are = bool(in_doubt.any())
    past = state.relinearisation
    if past is not None and past.is_active:
        past.add(keyframe_of(state, event, rows), some_are)
    if some_are:
        return relocate_moved(state, event.select(in_doubt), rows[in_doubt])
    return np.empty(0, dtype=np.int64)
