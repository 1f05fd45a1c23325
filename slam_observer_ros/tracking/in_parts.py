"""Observations that the usual step uses: nearly always whole, else in parts.

Points that are rejected are counted afterwards, over the same arrays, and points of new landmarks
entered, as :mod:`.step` does it.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, IntArray, is_automatic
from slam_observer_ros.estimates import NormalisedInnovation, Update
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.step import DONE, REJECTS
from slam_observer_ros.tracking import usual
from slam_observer_ros.tracking.matching import (
    calibrated,
    enter,
    Expected,
    is_contradiction,
    keyframe_of,
    reject,
)
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.usual import Corrected, NO_IDS


def observe(
    state: State, event: ObservationEvent, with_expected: bool = False
) -> tuple[Update, Expected | None] | None:
    """Let a state use an observation (28)–(31) made at its instant.

    Return what that did, and ``with_expected`` what was expected of the points used. Return None,
    with nothing changed, where the usual step is not possible.
    """
    rows = state.landmarks.rows_of(event.ids)
    known = rows >= 0
    if not usual.is_usual(state, event):
        return None
    if not len(rows) or np.count_nonzero(known) < len(rows):
        return _in_parts(state, event, rows, known, None, with_expected)
    of_all = usual.correct(state, event, rows, with_expected)
    if of_all is None:
        return None
    if of_all.status == DONE:  # as nearly always
        return usual.finish(state, event, of_all), usual.expected(state, of_all.out)
    return _in_parts(state, event, rows, known, of_all, with_expected)


def _in_parts(
    state: State,
    event: ObservationEvent,
    rows: IntArray,
    known: BoolArray,
    of_all: Corrected | None,
    with_expected: bool,
) -> tuple[Update, Expected | None] | None:
    """Use the points of ``known`` (m,) landmarks, as far as they are not rejected.

    ``of_all`` is what the kernel made of them, if it was asked already.
    """
    if not _may_enter(state, event.ids[~known]):
        return None
    shown, used = calibrated(state, event), known.copy()  # by the calibration before the step
    new = shown.select(~known)
    of_used = None
    if np.count_nonzero(known):
        if of_all is None:
            of_all = usual.correct(state, event.select(known), rows[known], with_expected)
        of_used = of_all
        if of_all is not None and of_all.status == REJECTS:
            used[known] = of_all.out.weights > 0.0
            if not _may_leave_out(state, rows[known], ~used[known]):
                return None
            of_used = usual.correct(state, event.select(used), rows[used], with_expected, of_all)
        if of_all is None or of_used is None or of_used.status == REJECTS:
            return None
    rejected = known & ~used
    if of_all is not None and np.count_nonzero(rejected):
        reject(state, shown.select(rejected), rows[rejected], of_all.out.r[rejected[known]])
    if len(new.ids):
        enter(state, new, state.observation_noise.covariances(new))
    past = state.relinearisation
    if past.is_active:
        state.keep(keyframe_of(state, shown, state.landmarks.rows_of(event.ids)))
    expected = None if of_used is None else usual.expected(state, of_used.out)
    return _update(state, event, known, rejected[known], of_all, of_used), expected


def _may_enter(state: State, new_ids: IntArray) -> bool:
    """Return whether points are of new landmarks beyond doubt, and the map has room for them."""
    if not len(new_ids):
        return True
    table, limit = state.landmarks, state.settings.max_landmarks
    return (
        state.is_mapping
        and not (limit and len(table) + len(new_ids) > limit)
        and not np.count_nonzero(new_ids == UNKNOWN_ID)
        and not np.count_nonzero(is_automatic(table.ids))
    )


def _may_leave_out(state: State, rows: IntArray, rejected: BoolArray) -> bool:
    """Return whether few of the points (m,) are rejected, and no landmark becomes doubtful by it.

    The ``rejected`` ones are counted as such once more.
    """
    most = state.settings.max_rejections
    in_doubt = state.landmarks.in_doubt(rows[rejected], most, further=1)
    return not np.count_nonzero(in_doubt) and not is_contradiction(rejected)


def _update(
    state: State,
    event: ObservationEvent,
    known: BoolArray,
    rejected: BoolArray,
    of_all: Corrected | None,
    of_used: Corrected | None,
) -> Update:
    """Return what an observation did; of its ``known`` landmarks some are ``rejected`` (m,)."""
    ids, stamp_ns = event.ids[known], event.stamp_ns
    if of_all is None or of_used is None:
        judges, none = state.judges_innovations, np.empty(0)
        nothing = NormalisedInnovation(none, none, None, 0, none, none) if judges else None
        return state.update(stamp_ns, ids, np.empty((0, 3)), rejected, NO_IDS, nothing)
    innovation = usual.innovation(state, of_used.out)
    if innovation is not None and of_used is not of_all:
        distances, _, shares = of_all.out.judged[:-1].reshape(3, -1)
        weights, log_densities = np.zeros(len(ids)), np.full(len(ids), -np.inf)
        weights[~rejected], log_densities[~rejected] = (
            innovation.weights,
            innovation.log_densities,
        )
        innovation = NormalisedInnovation(
            distances,
            weights,
            innovation.nis,
            innovation.degrees_of_freedom,
            log_densities,
            shares,
        )
    return state.update(stamp_ns, ids, of_all.out.r, rejected, NO_IDS, innovation)
