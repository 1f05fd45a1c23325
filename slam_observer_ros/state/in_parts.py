"""Observations of which the usual step can use a part: the rest is rejected, or of new landmarks.

That is counted and entered over the same arrays, as :mod:`.step` does it.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, IntArray
from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.events import is_automatic, ObservationEvent, UNKNOWN_ID
from slam_observer_ros.observer.step import REJECTS
from slam_observer_ros.state import usual
from slam_observer_ros.state.matching import (
    corrected,
    enter,
    is_contradiction,
    keyframe_of,
    point_covariances,
    positions,
)
from slam_observer_ros.state.state import State
from slam_observer_ros.state.usual import Corrected, NO_IDS, Outcome


def observe(state: State, event: ObservationEvent, is_weighed: bool = False) -> Outcome | None:
    """As :func:`.usual.observe`; None, with nothing changed, where that is not possible either."""
    rows = state.landmarks.rows_of(event.ids)
    known = rows >= 0
    if not usual.takes(state, event) or not _may_enter(state, event.ids[~known]):
        return None
    shown, used = corrected(state, event), known.copy()  # by the calibration before the step
    new = shown.select(~known)
    noise = point_covariances(state, new, rows[~known])
    of_all = of_used = None
    if np.count_nonzero(known):
        of_all = of_used = usual.correct(state, event.select(known), rows[known], is_weighed)
        if of_all is not None and of_all.status == REJECTS:
            used[known] = of_all.out.weights > 0.0
            if not _may_leave_out(state, rows[known], ~used[known]):
                return None
            of_used = usual.correct(state, event.select(used), rows[used], is_weighed, of_all)
        if of_all is None or of_used is None or of_used.status == REJECTS:
            return None
    rejected = known & ~used
    if np.count_nonzero(rejected):
        state.landmarks.reject(rows[rejected], *positions(state, shown.select(rejected)))
        state.counts['rejected_landmark'] += int(np.count_nonzero(rejected))
    if len(new.ids):
        enter(state, new, noise)
    past = state.relinearisation
    if past is not None and past.is_active:
        past.add(keyframe_of(state, shown, state.landmarks.rows_of(event.ids)), in_doubt=False)
    return _outcome(state, event.ids[known], rejected[known], of_all, of_used)


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
    """Return whether a few of the points (m,) are rejected, and their landmarks not yet in doubt.

    They are ``rejected`` once more then.
    """
    table, some = state.landmarks, rows[rejected]
    needed = np.minimum(table.counts[some] + 1, state.settings.max_rejections)
    are_in_doubt = table.rejections[some] + 1 >= needed
    return not np.count_nonzero(are_in_doubt) and not is_contradiction(rejected)


def _outcome(
    state: State,
    ids: IntArray,
    rejected: BoolArray,
    of_all: Corrected | None,
    of_used: Corrected | None,
) -> Outcome:
    """Return what points of known landmarks (m,) say, of which some are ``rejected`` (m,)."""
    if of_all is None or of_used is None:
        judges, none = state.judges_innovations, np.empty(0)
        nothing = NormalisedInnovation(none, none, None, 0, none, none) if judges else None
        return Outcome(ids, np.empty((0, 3)), rejected, NO_IDS, nothing)
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
    return Outcome(
        ids, of_all.out.r, rejected, NO_IDS, innovation, usual.weighed(state, of_used.out)
    )
