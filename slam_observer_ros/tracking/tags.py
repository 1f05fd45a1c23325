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
from slam_observer_ros.models.sensing import turn_sensitivity
from slam_observer_ros.tracking.matching import calibrated_again, MatchedObservation
from slam_observer_ros.tracking.state import State

_NORMAL_TURNED = np.diag([1.0, 1.0, -1.0])


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
    seen = _all_seen(state, event, rows, event.orientations)
    if event.sensed is None or event.sensed.orientations is None:
        return seen
    # As the sensor showed them: its calibration will have changed by then.
    Z = event.sensed.orientations
    return replace(seen, Z=Z, flipped=flipped(Z, event.sensed.arms))


def flipped(Z: FloatArray, lines_of_sight: FloatArray) -> FloatArray:
    """Return the other orientations (m, 3, 3) in which tags look nearly the same.

    Mirrored in depth, a plane's image is the same but for perspective; so they are hard to
    distinguish for tags that are small or nearly frontal. A tag is in its x-y plane.
    """
    squared = np.einsum('ij,ij->i', lines_of_sight, lines_of_sight)[:, None, None]
    outer = lines_of_sight[:, :, None] * lines_of_sight[:, None, :]
    mirror = np.eye(3) - 2.0 * outer / np.maximum(squared, np.finfo(np.float64).tiny)
    twins: FloatArray = mirror @ Z @ _NORMAL_TURNED
    return twins


def _seen(
    state: State, event: ObservationEvent, rows: IntArray, Z: FloatArray, are_wanted: BoolArray
) -> SeenOrientations:
    """Return the wanted (m,) orientations in an observation, where it has one."""
    return _all_seen(state, event, rows, Z).select(are_wanted & Z.any(axis=(1, 2)))


def _all_seen(
    state: State, event: ObservationEvent, rows: IntArray, Z: FloatArray
) -> SeenOrientations:
    """Return the orientations (m, 3, 3) in an observation, with their noise."""
    noise = state.observation_noise.orientation_covariances(event, _expected(state, rows, Z))
    unseen_s = state.landmarks.unseen_s(rows, event.stamp_ns)
    repeated = state.observation_noise.repetitions(unseen_s)
    twins, D = flipped(Z, event.lines_of_sight), turn_sensitivity(state.calibration, event)
    if D is not None:
        D = state.observer.A[:3, :3] @ D
    return SeenOrientations(rows, Z, twins, noise, repeated, D)


def _expected(state: State, rows: IntArray, Z: FloatArray) -> FloatArray:
    """Return the orientations (m, 3, 3) expected of tags; of an unknown one, as it is seen.

    By the seen orientation, a tag that only seems to be tilted would be trusted too much.
    """
    tags = state.observer.orientations
    expected: FloatArray = state.observer.A[:3, :3].T @ tags.B[rows]
    return np.where(tags.are_known[rows][:, None, None], expected, Z)
