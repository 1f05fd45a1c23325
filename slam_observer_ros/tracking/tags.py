"""How tags are turned: what an observation of their orientations changes in a state.

These are used before positions, as a position is linear in the heading's error only if that is
small: a tag's orientation corrects it directly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.tracking.matching import (
    all_orientations,
    calibrated_again,
    flipped,
    MatchedObservation,
)
from slam_observer_ros.tracking.state import State


def correct_by_orientations(
    state: State, matched: MatchedObservation, are_near: BoolArray
) -> None:
    """Correct a state by known orientations.

    Of points that are not near enough (m,) to be used orientations are not, either. An orientation
    that is rejected leaves its landmark a point, as seen this time.
    """
    gains, event, rows = state.gains.tags, matched.known, matched.residuals.rows
    if gains is None or event.orientations is None or not len(rows):
        return
    gains.learn_motion_noise(matched.residuals)
    tags = state.observer.orientations
    seen = _seen(state, event, rows, event.orientations, are_near & tags.are_known[rows])
    if not len(seen.rows):
        return
    before = state.observer.A.copy()
    weights, are_unclear = gains.correct_by_orientations(seen)
    state.relinearisation.note_correction(before, state.observer.A)
    judged = ~are_unclear
    tags.count(seen.rows[judged], weights[judged] > 0.0)
    state.counts['rejected_orientation'] += int(np.sum(weights[judged] == 0.0))


def take_over_orientations(state: State, event: ObservationEvent, rows: IntArray) -> None:
    """Take over orientations of landmarks ``rows`` (m,) that have none yet, or a wrong one.

    An orientation is wrong if it was rejected, all in a row, more often than it was seen, or
    ``max_rejections`` times.
    """
    gains, tags, Z = state.gains.tags, state.observer.orientations, event.orientations
    if gains is None or Z is None or state.observer.is_exact:
        return
    in_doubt = tags.in_doubt(rows, state.settings.max_rejections) & state.is_mapping
    is_used = state.landmarks.rejections[rows] == 0
    event = calibrated_again(state, event)
    Z = Z if event.orientations is None else event.orientations
    seen = _seen(state, event, rows, Z, is_used & (in_doubt | ~tags.are_known[rows]))
    if not len(seen.rows):
        return
    replaced = seen.rows[tags.are_known[seen.rows]]
    if len(replaced):
        state.relinearisation.forget_orientations(replaced)
    gains.add_orientations(seen)


def seen_orientations(
    state: State, event: ObservationEvent, rows: IntArray
) -> SeenOrientations | None:
    """Return how tags of landmarks ``rows`` (m,) are turned, zero for none; None of points."""
    if event.orientations is None:
        return None
    seen = all_orientations(state, event, rows, event.orientations)
    if event.sensed is None or event.sensed.orientations is None:
        return seen
    # As the sensor showed them: its calibration will have changed by then.
    Z = event.sensed.orientations
    return replace(seen, Z=Z, flipped=flipped(Z, event.sensed.arms))


def _seen(
    state: State, event: ObservationEvent, rows: IntArray, Z: FloatArray, are_wanted: BoolArray
) -> SeenOrientations:
    """Return the wanted (m,) orientations in an observation, where it has one."""
    return all_orientations(state, event, rows, Z).select(are_wanted & Z.any(axis=(1, 2)))
