"""One step of the observer: what an observation changes in a state.

Orientations of tags that are seen are used before their positions, as a position is linear in the
heading's error only if that is small: a tag's orientation corrects it directly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Change, Reason, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.models.sensing import turn_sensitivity
from slam_observer_ros.tracking.matching import (
    calibrated_again,
    enter,
    Expected,
    is_contradiction,
    keyframe_of,
    mapped,
    MatchedObservation,
    reject,
    residuals_of,
    sensitivity,
)
from slam_observer_ros.tracking.state import State


def step(state: State, matched: MatchedObservation) -> Update:
    """One step of the observer (28), from where the velocity has led it (27): the innovation."""
    matched = correct_by_orientations(state, matched)  # φ_i = log(R_Â Z_i B̂_iᵀ)
    residuals = matched.residuals  # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°
    _drop_history_if_full(state, matched)
    expected = Expected.of(state.gains, residuals) if state.judges_innovations else None
    weights = _correct(state, residuals)  # (30), (31)  X̂ ← (D, d_i) · X̂
    rejected = weights == 0.0
    _count(state, matched, rejected)
    event, rows = _add_new(state, matched)  # y_i° = Â y_i
    take_over_orientations(state, event, rows)  # B̂_i = R_Â Z_i
    moved_ids = _relinearise(state, event, rows)
    _set_velocities(state, event, rows)  # (19)
    innovation = None
    if expected is not None:
        innovation = expected.judge(weights, 1.0 / residuals.repeated)
    ids, stamp_ns = matched.known.ids, matched.event.stamp_ns
    return state.update(stamp_ns, ids, residuals.r, rejected, moved_ids, innovation)


def _correct(state: State, residuals: Residuals) -> FloatArray:
    """Correct the state; return the weights (m,), 0 for a rejected landmark."""
    if not len(residuals.rows):
        return np.empty(0)
    before = state.observer.A.copy()
    weights = state.gains.observe(residuals)
    state.relinearisation.note_correction(before, state.observer.A)
    return weights


def _count(state: State, matched: MatchedObservation, rejected: BoolArray) -> None:
    """Count which known landmarks (m,) were accepted, and which rejected."""
    event, rows, count = matched.known, matched.residuals.rows, int(np.count_nonzero(rejected))
    state.counts.note(Reason.UNMAPPED, matched.left_out, event.stamp_ns)
    if not len(rows):
        return
    state.rejected_in_a_row = state.rejected_in_a_row + 1 if count == len(rows) else 0
    state.was_contradicted = is_contradiction(rejected)
    state.landmarks.accept(rows[~rejected] if count else rows, event.stamp_ns)
    if count:
        reject(state, event.select(rejected), rows[rejected], matched.residuals.r[rejected])


def _relinearise(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Relinearise, if it is time; relocate doubtful landmarks that this does not explain."""
    # After the correction it is known better where they were seen.
    in_doubt = state.landmarks.in_doubt(rows, state.settings.max_rejections) & state.is_mapping
    some_are = bool(np.count_nonzero(in_doubt))
    past = state.relinearisation
    if past.is_active:
        turns = seen_orientations(state, event, rows)
        state.keep(keyframe_of(state, event, rows, turns), some_are)
    if some_are:
        return _relocate_moved(state, event.select(in_doubt), rows[in_doubt])
    return np.empty(0, dtype=np.int64)


def _drop_history_if_full(state: State, matched: MatchedObservation) -> None:
    """Drop the history before landmarks are forgotten for new ones: it depends on them."""
    if len(_rows_to_forget(state, matched)):
        state.forget_past('landmarks had to make room (max_landmarks)')


def _add_new(state: State, matched: MatchedObservation) -> tuple[ObservationEvent, IntArray]:
    """Add new landmarks; return the points of landmarks in the map by now, and their rows."""
    event, rows = matched.event, matched.rows
    if len(matched.known.ids) == len(rows):
        return event, rows
    is_new = rows < 0
    state.forget(_rows_to_forget(state, matched), Change.FORGOTTEN, event.stamp_ns)
    enter(state, event.select(is_new), matched.covariances[is_new])
    return mapped(state, event)


def _relocate_moved(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Relocate doubtful landmarks that are still far off; return ids of landmarks that moved."""
    event = calibrated_again(state, event)
    noise = state.observation_noise.covariances(event)
    residuals = residuals_of(state, event, rows, noise)
    gate = state.settings.rejection_threshold
    far = ~accepted(state.gains.distances(residuals), gate)
    moved = far & (state.landmarks.counts[rows] >= state.settings.confirmations)
    state.counts.note(Change.MOVED, event.ids[moved], event.stamp_ns)
    if far.any():
        moved_to = event.select(far)
        state.relocate(rows[far], moved_to.points, noise[far], sensitivity(state, moved_to))
        state.landmarks.take_for_new(rows[far], event.stamp_ns)
        take_over_orientations(state, moved_to, rows[far])
    return event.ids[moved]


def _set_velocities(state: State, event: ObservationEvent, rows: IntArray) -> None:
    """Let landmarks move as the sensor says; by one that says nothing they are static."""
    velocities = event.velocities
    if velocities is None and state.observer.have_moved:
        velocities = np.zeros((len(rows), 3))
    if velocities is None or state.landmark_velocity_stddev:
        return
    used = state.landmarks.rejections[rows] == 0
    state.observer.set_landmark_velocities(rows[used], velocities[used])


def _rows_to_forget(state: State, matched: MatchedObservation) -> IntArray:
    """Return landmarks out of view, the least often seen, to be forgotten for the new ones."""
    limit, new = state.settings.max_landmarks, len(matched.rows) - len(matched.residuals.rows)
    excess = len(state.landmarks) + new - limit
    if limit == 0 or new == 0 or excess <= 0:
        return np.empty(0, dtype=np.int64)
    unseen = state.landmarks.unseen_since(matched.event.stamp_ns)
    return np.sort(unseen[~np.isin(unseen, matched.rows)][:excess])


_NORMAL_TURNED = np.diag([1.0, 1.0, -1.0])


def correct_by_orientations(state: State, matched: MatchedObservation) -> MatchedObservation:
    """Correct a state by known orientations; return the observation with its residuals since.

    Of points that are too far off to be used orientations are not, either. An orientation that is
    rejected leaves its landmark a point, as seen this time.
    """
    gains, event, rows = state.gains.tags, matched.known, matched.residuals.rows
    if gains is None or event.orientations is None or not len(rows):
        return matched
    gains.learn_motion_noise(matched.residuals)
    tags, gate = state.observer.orientations, state.settings.rejection_threshold
    are_near = accepted(state.gains.distances(matched.residuals), gate)
    seen = _seen(state, event, rows, event.orientations, are_near & tags.are_known[rows])
    if not len(seen.rows):
        return matched
    before = state.observer.A.copy()
    weights, are_unclear = gains.correct_by_orientations(seen)
    state.relinearisation.note_correction(before, state.observer.A)
    judged = ~are_unclear
    tags.count(seen.rows[judged], weights[judged] > 0.0)
    state.counts['rejected_orientation'] += int(np.sum(weights[judged] == 0.0))
    covariances = matched.covariances[matched.rows >= 0]
    event = calibrated_again(state, event)
    residuals = residuals_of(state, event, rows, covariances)
    return replace(matched, known=event, residuals=residuals)


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
