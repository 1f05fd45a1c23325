"""One step of the observer: what an observation changes in a state."""

from __future__ import annotations

from typing import NamedTuple, overload

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Change, NormalisedInnovation, Reason, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.flat_arrays import Limits, Observed, Seen
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.sensor_mounting import Sensed, unmeasured_covariances
from slam_observer_ros.models import sensing
from slam_observer_ros.models.motion_noise import beyond_driving
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.tracking.matching import (
    calibrated,
    calibrated_again,
    is_contradiction,
    match,
    positions,
    residuals_of,
    sensitivity,
)
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.tags import (
    correct_by_orientations,
    seen_orientations,
    take_over_orientations,
)

NO_IDS = np.empty(0, dtype=np.int64)


@overload
def step(state: State, event: ObservationEvent) -> Update: ...


@overload
def step(state: State, event: ObservationEvent, may_refuse: bool) -> Update | None: ...


def step(state: State, event: ObservationEvent, may_refuse: bool = False) -> Update | None:
    """One step of the observer (28), from where the velocity has led it (27): the innovation.

    Return what it did; None, with nothing changed, where the gate rejects most of the points, if
    that ``may_refuse``: then the robot may not be where the state has it.
    """
    if state.calibration.corrects_points and event.sensor_frame not in state.calibration.sensors:
        state.add_sensor(event.sensor_frame)
    rows = state.landmarks.rows_of(event.ids)
    # History depends on landmarks that will have to make room.
    if len(_rows_to_forget(state, event, rows)):
        state.forget_past('landmarks had to make room (max_landmarks)')
    if event.orientations is not None and state.gains.tags is not None:
        matched = match(state, event)
        gate = state.settings.rejection_threshold
        are_near = accepted(state.gains.distances(matched.residuals), gate)
        if may_refuse and is_contradiction(~are_near):
            return None
        may_refuse = False
        correct_by_orientations(state, matched, are_near)  # φ_i = log(R_Â Z_i B̂_iᵀ)
    # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°;  (30), (31)  X̂ ← (D, d_i) · X̂
    corrected = correct(state, event, rows, may_refuse)
    if corrected is None:
        return None
    known, innovation = rows >= 0, innovation_of(state, corrected)
    rejected = known & (corrected.out.weights == 0.0)
    ids, r = event.ids[known], corrected.out.r[known]
    moved_ids = _follow_landmarks(state, event, corrected, rejected)
    return state.update(event.stamp_ns, ids, r, rejected[known], moved_ids, innovation)


def _follow_landmarks(
    state: State, event: ObservationEvent, corrected: Corrected, rejected: BoolArray
) -> IntArray:
    """Count, add, relocate and keep what was seen; return ids of landmarks that have moved."""
    rows, shown = corrected.rows, event
    known, some_rejected = rows >= 0, bool(np.count_nonzero(rejected))
    all_known = np.count_nonzero(known) == len(rows)
    if not all_known or some_rejected or event.orientations is not None:
        shown = calibrated(state, event)
    if known.any():
        all_rejected = np.count_nonzero(rejected) == np.count_nonzero(known)
        state.rejected_in_a_row = state.rejected_in_a_row + 1 if all_rejected else 0
        state.was_contradicted = some_rejected and is_contradiction(rejected[known])
    if some_rejected:
        _reject(state, shown.select(rejected), rows[rejected], corrected.out.r[rejected])
    if not all_known:
        rows = _add_new(state, shown, rows)  # y_i° = Â y_i
    kept = rows >= 0
    in_map, at = (shown, rows) if kept.all() else (shown.select(kept), rows[kept])
    if event.orientations is not None:
        take_over_orientations(state, in_map, at)  # B̂_i = R_Â Z_i
    # After the correction it is known better where doubtful landmarks were seen.
    in_doubt = state.landmarks.in_doubt(at, state.settings.max_rejections) & state.is_mapping
    some_in_doubt = bool(np.count_nonzero(in_doubt))
    if state.relinearisation.is_active and len(at):
        has_turns = event.orientations is not None
        turns = seen_orientations(state, in_map, at) if has_turns else None
        state.keep(keyframe(state, event, corrected, rows, turns), some_in_doubt)
    moved_ids = NO_IDS
    if some_in_doubt:
        in_map = calibrated(state, in_map)
        moved_ids = _relocate_moved(state, in_map.select(in_doubt), at[in_doubt])
    _set_velocities(state, in_map, at)  # (19)
    return moved_ids


def _reject(state: State, event: ObservationEvent, rows: IntArray, r: FloatArray) -> None:
    """Count points (m,) that were rejected, off by r (m, 3), against their landmarks.

    But not what is off by the sensor's lasting error, while the robot stands: that is no news.
    """
    state.counts.note(Reason.REJECTED, event.ids, event.stamp_ns)
    if state.observation_noise.stood_s > 0.0:
        far = beyond_driving(event.points, r, state.settings)
        event, rows = event.select(far), rows[far]
    state.landmarks.reject(rows, *positions(state, event))


def _add_new(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Add new landmarks where they were seen, as many as ``max_landmarks`` allows.

    Return the rows (m,) of the points' landmarks then, −1 where one is not in the map.
    """
    is_new = rows < 0
    if not state.is_mapping:
        state.counts.note(Reason.UNMAPPED, event.ids[is_new], event.stamp_ns)
        return rows
    state.forget(_rows_to_forget(state, event, rows), Change.FORGOTTEN, event.stamp_ns)
    ids, event, limit = event.ids, event.select(is_new), state.settings.max_landmarks
    new = len(event.ids)
    m = min(new, max(limit - len(state.landmarks), 0)) if limit else new
    state.counts.note(Reason.UNMAPPED, event.ids[m:], event.stamp_ns)
    if m:
        event = calibrated_again(state, event.select(np.arange(new) < m))
        noise = state.observation_noise.covariances(event)
        state.gains.add(event.points, noise, sensitivity(state, event))
        state.landmarks.add(event.ids, event.stamp_ns)
        state.counts.note(Change.FOUND, event.ids, event.stamp_ns)
    return state.landmarks.rows_of(ids)


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


def _rows_to_forget(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Return landmarks out of view, the least often seen, to be forgotten for the new ones."""
    limit, new = state.settings.max_landmarks, int(np.count_nonzero(rows < 0))
    if limit == 0 or new == 0 or not state.is_mapping:
        return NO_IDS
    excess = len(state.landmarks) + new - limit
    if excess <= 0:
        return NO_IDS
    unseen = state.landmarks.unseen_since(event.stamp_ns)
    return np.sort(unseen[~np.isin(unseen, rows)][:excess])


class Corrected(NamedTuple):
    """An observation as the filter was given it, and its effect."""

    rows: IntArray  # (m,) which landmarks its points are of, −1 for new ones
    seen: Seen
    out: Observed


def correct(
    state: State, event: ObservationEvent, rows: IntArray, may_refuse: bool = False
) -> Corrected | None:
    """Correct a state by the points (m,) of known landmarks ``rows``, −1 where one is new.

    Return None, with nothing changed, where most are rejected and that ``may_refuse``.
    """
    settings, noise = state.settings, state.observation_noise
    limits = Limits(
        gate=settings.rejection_threshold,
        huber=settings.huber_threshold,
        error_time_s=noise.error_time_s,
        confirmations=settings.confirmations,
        max_rejections=settings.max_rejections,
        may_refuse=may_refuse,
    )
    seen, before = _seen(state, event, rows), state.observer.A.copy()
    out = state.gains.observe(seen, noise.figures, limits, state.judges_innovations)
    if out is None:
        return None
    state.relinearisation.note_correction(before, state.observer.A)
    return Corrected(rows, seen, out)


def _seen(state: State, event: ObservationEvent, rows: IntArray) -> Seen:
    """Return points of landmarks ``rows``, −1 for new ones, and what calibrates their sensor.

    Of points that were carried forward, the calibration's effect is given.
    """
    arms, covariances = _plain(event.lines_of_sight), event.covariances
    origins = event.sensor
    calibration = state.calibration
    values, estimated, column, D = None, NO_IDS, 0, None
    directions = event.directions
    if event.sensed is not None:
        expected, known = event.points.copy(), rows >= 0
        expected[known] = state.observer.body_points(rows[known])
        D = sensitivity(state, event, expected)
    elif calibration.corrects_points:
        frame = event.sensor_frame
        values, estimated = calibration.sensor(frame), calibration.of_sensor
        column = calibration.columns(frame).start
        if directions is not None:
            directions = directions @ so3.exp(values[:3]).T
    if state.settings.range_is_depth and event.sensed is None:
        cosines = sensing.cosines(arms, event.sensor_axis)
        arms = arms / cosines[:, None]
        if covariances is not None:
            covariances = covariances / cosines[:, None, None] ** 2
    return Seen(
        event.stamp_ns,
        rows,
        arms,
        None if origins is None else _plain(origins),
        None if covariances is None else _plain(covariances),
        None if directions is None else _plain(directions),
        values,
        estimated,
        column,
        None if D is None else _plain(D),
    )


def _plain(array: FloatArray) -> FloatArray:
    """Return an array that may be of another precision or order as C has it."""
    return np.ascontiguousarray(array, np.float64)


def keyframe(
    state: State,
    event: ObservationEvent,
    corrected: Corrected,
    rows: IntArray,
    turns: SeenOrientations | None,
) -> Keyframe:
    """Return the points as they are kept to be linearised again, of landmarks ``rows`` by now.

    Without those whose landmark is not in the map, −1. ``turns`` are of the others.
    """
    seen, out, sensed = corrected.seen, corrected.out, event.sensed
    if seen.sensor is not None:
        number = state.calibration.sensors.index(event.sensor_frame)
        origins = np.zeros_like(seen.arms) if seen.origins is None else seen.origins
        sensed = Sensed(np.full(len(rows), number), origins, seen.arms, event.orientations)
    covariances = out.covariances if len(out.covariances) else None
    if covariances is not None and seen.directions is not None:
        covariances = covariances + unmeasured_covariances(seen.directions)
    every = Keyframe(
        event.stamp_ns,
        rows,
        out.points,
        out.lines_of_sight,
        covariances,
        out.repeated,
        turns,
        sensed,
        event.kinds,
        None if event.sensor is None and seen.sensor is None else out.origins,
    )
    kept = rows >= 0
    return every if np.count_nonzero(kept) == len(rows) else every.select(kept)


def innovation_of(state: State, corrected: Corrected) -> NormalisedInnovation | None:
    """Return how far off the residuals of known landmarks were, if that was asked for."""
    out, known = corrected.out, corrected.rows >= 0
    if not len(out.judged):
        return None
    weights = out.weights[known]
    if state.errors is None:
        nothing, unlikely = np.zeros(len(weights)), np.full(len(weights), -np.inf)
        return NormalisedInnovation(nothing, weights, None, 0, unlikely, np.ones(len(weights)))
    distances, densities, shares = out.judged[:-1].reshape(3, -1)[:, known]
    nis, used = float(out.judged[-1]), weights > 0.0
    count, directions = int(np.count_nonzero(used)) * state.axes.point, corrected.seen.directions
    if directions is not None:
        count = int(np.count_nonzero(directions[known][used, : state.axes.point].any(axis=2)))
    return NormalisedInnovation(
        distances, weights, nis if used.any() else None, count, densities, shares
    )
