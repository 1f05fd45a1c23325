"""One step of the observer: all that an observation changes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Change, NormalisedInnovation, Reason, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.flat_arrays import Limits, Seen
from slam_observer_ros.filter.observer import lyapunov
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.sensor_mounting import Sensed, unmeasured_covariances
from slam_observer_ros.models import sensing
from slam_observer_ros.models.motion_noise import beyond_driving
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.tracking.matching import (
    calibrated,
    calibrated_again,
    is_contradiction,
    match,
    positions,
    residuals_of,
    sensitivity,
)
from slam_observer_ros.tracking.state import Association, OLD_NEWS, State
from slam_observer_ros.tracking.tags import (
    correct_by_orientations,
    seen_orientations,
    take_over_orientations,
)

NO_IDS = np.empty(0, dtype=np.int64)

_PLAIN = partial(np.ascontiguousarray, dtype=np.float64)


def step(
    hypotheses: Hypotheses,
    advance: Callable[[ObservationEvent], ObservationEvent],
    event: ObservationEvent,
) -> tuple[ObservationEvent, Update]:
    """Take one step of the observer: use an observation.

    Numbers are the paper's equations, which docs/theory.md explains. ``advance`` moves all states
    along the velocities to the observation; it returns the observation as it is seen from there.
    Return that, too, and what the observation did to the most likely state.
    """
    event = advance(event)  # (27)  X̂ along the velocity, and P with the noise of the motion
    places = hypotheses.judge_slip(event)  # wheels that spin, landmarks that are carried along
    for one in hypotheses.associate(places):  # landmarks of the points: nearly always in one way
        if observe(one):  # (28)–(31)  residuals, gate, weights; the correction of X̂ and P
            update_landmarks(one)  # new ones enter, rejections are counted
            append(one)  # to the history, which is relinearised when it is due
            one.update = follow_moved(one)  # landmarks that have moved, or that move (19)
    return event, hypotheses.update


def observe(one: Association) -> bool:
    """Move a state by the innovation (28)–(31) of the known landmarks that are seen.

    Return whether it was moved. It is not where most of the points are rejected and that
    ``may_refuse``: then the robot may not be where the state has it.
    """
    state, event, rows = one.state, one.event, one.rows
    settings, noise, gains = state.settings, state.observation_noise, state.gains
    if state.calibration.corrects_points and event.sensor_frame not in state.calibration.sensors:
        state.calibrate(event.sensor_frame)
    if event.sensed is not None:
        state.calibrate_ranges(event.sensed.anchors)
    one.known = known = rows >= 0
    # History depends on landmarks that will have to make room.
    if not known.all() and len(_rows_to_forget(state, event, rows)):
        state.forget_past('landmarks had to make room (max_landmarks)')
    may_refuse = one.may_refuse
    if event.orientations is not None and gains.tags is not None:
        matched = match(state, event)
        are_near = accepted(gains.distances(matched.residuals), settings.rejection_threshold)
        if may_refuse and is_contradiction(~are_near):
            one.is_refused = True
            return False
        may_refuse = False
        correct_by_orientations(state, matched, are_near)  # φ_i = log(R_Â Z_i B̂_iᵀ)
    limits = Limits(
        gate=settings.rejection_threshold,
        huber=settings.huber_threshold,
        error_time_s=noise.error_time_s,
        confirmations=settings.confirmations,
        max_rejections=settings.max_rejections,
        may_refuse=may_refuse,
    )
    seen, before = _seen(state, event, rows), state.observer.A.copy()
    # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°;  (30), (31)  X̂ ← (D, d_i) · X̂
    out = gains.observe(seen, noise.figures, limits, state.judges_innovations)
    if out is None:
        one.is_refused = True
        return False
    state.relinearisation.note_correction(before, state.observer.A)
    one.seen, one.out, one.rejected = seen, out, known & (out.weights == 0.0)
    return True


def update_landmarks(one: Association) -> None:
    """Count landmarks that were rejected, add those that are new, and how tags are turned."""
    state, event, known, rejected = one.state, one.event, one.known, one.rejected
    number, rejections = int(np.count_nonzero(known)), int(np.count_nonzero(rejected))
    all_known, has_turns = number == len(known), event.orientations is not None
    if not all_known or rejections or has_turns:
        event = calibrated(state, event)
    if number:
        state.rejected_in_a_row = state.rejected_in_a_row + 1 if rejections == number else 0
        state.was_contradicted = rejections > 0 and is_contradiction(rejected[known])
    if rejections:
        _reject(state, event.select(rejected), one.rows[rejected], one.out.r[rejected])
    if not all_known:
        one.rows = _add_new(state, event, one.rows)  # y_i° = Â y_i
    kept = one.rows >= 0
    one.in_map, one.at = event, one.rows
    if not kept.all():
        one.in_map, one.at = event.select(kept), one.rows[kept]
    if has_turns:
        take_over_orientations(state, one.in_map, one.at)  # B̂_i = R_Â Z_i


def append(one: Association) -> None:
    """Keep what was seen of the map's landmarks, to be linearised again."""
    state, settings = one.state, one.state.settings
    # After the correction it is known better where doubtful landmarks were seen.
    table, some_in_doubt = state.landmarks, False
    one.in_doubt = np.zeros(len(one.at), dtype=np.bool_)
    if state.is_mapping and np.count_nonzero(table.rejections[one.at]):
        one.in_doubt = table.in_doubt(one.at, settings.max_rejections)
        some_in_doubt = bool(np.count_nonzero(one.in_doubt))
    if not (state.relinearisation.is_active and len(one.at)):
        return
    event, seen, out, rows = one.event, one.seen, one.out, one.rows
    sensed, covariances = event.sensed, out.covariances if len(out.covariances) else None
    if seen.sensor is not None:
        number = state.calibration.sensors.index(event.sensor_frame)
        origins = np.zeros_like(seen.arms) if seen.origins is None else seen.origins
        numbers, none = np.full(len(rows), number), np.full(len(rows), -1)
        sensed = Sensed(numbers, origins, seen.arms, none, event.orientations)
    if covariances is not None and seen.directions is not None:
        covariances = covariances + unmeasured_covariances(seen.directions)
    has_turns = event.orientations is not None
    keyframe = Keyframe(
        event.stamp_ns,
        rows,
        out.points,
        out.lines_of_sight,
        covariances,
        out.repeated,
        seen_orientations(state, one.in_map, one.at) if has_turns else None,
        sensed,
        event.kinds,
        None if event.sensor is None and seen.sensor is None else out.origins,
    )
    if len(one.at) < len(rows):
        keyframe = keyframe.select(rows >= 0)
    stands = state.observation_noise.stood_s > 0.0
    # A robot that is parked says nothing more, in place of the drive's observations.
    if stands and not some_in_doubt and keyframe.repeated.min(initial=np.inf) > OLD_NEWS:
        state.counts['parked_observation'] += 1
    else:
        state.relinearisation.add(keyframe, some_in_doubt)


def follow_moved(one: Association) -> Update:
    """Relocate landmarks that have moved, and let those move that do; return what was done."""
    state, event, known, r = one.state, one.in_map, one.known, one.out.r
    moved_ids = NO_IDS
    if np.count_nonzero(one.in_doubt):
        event = calibrated(state, event)
        moved_ids = _relocate_moved(state, event.select(one.in_doubt), one.at[one.in_doubt])
    if event.velocities is not None or state.observer.have_moved:
        _set_velocities(state, event, one.at)
    observer = state.observer
    return Update(
        event.stamp_ns,
        observer.pose,
        one.event.ids[known],
        r[known].dot(observer.reference_pose[:3, :3].T),
        one.rejected[known],
        lyapunov(state.settings.gain_k, r[known]),
        moved_ids,
        innovation_of(one) if state.judges_innovations else None,
    )


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
    if state.landmark_velocity_stddev:
        return
    velocities = np.zeros((len(rows), 3)) if event.velocities is None else event.velocities
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


def _seen(state: State, event: ObservationEvent, rows: IntArray) -> Seen:
    """Return points of landmarks ``rows``, −1 for new ones, and what calibrates their sensor.

    Of points that were carried forward, the calibration's effect is given.
    """
    origins, covariances, calibration = event.sensor, event.covariances, state.calibration
    # Arrays may be of another precision or order than C has them.
    arms = _PLAIN(event.points if origins is None else event.points - origins)
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
        None if origins is None else _PLAIN(origins),
        None if covariances is None else _PLAIN(covariances),
        None if directions is None else _PLAIN(directions),
        values,
        estimated,
        column,
        None if D is None else _PLAIN(D),
    )


def innovation_of(one: Association) -> NormalisedInnovation:
    """Return how far off the residuals of known landmarks were."""
    state, out, known = one.state, one.out, one.known
    weights = out.weights[known]
    if state.errors is None:
        nothing, unlikely = np.zeros(len(weights)), np.full(len(weights), -np.inf)
        return NormalisedInnovation(nothing, weights, None, 0, unlikely, np.ones(len(weights)))
    distances, densities, shares = out.judged[:-1].reshape(3, -1)[:, known]
    nis, used = float(out.judged[-1]), weights > 0.0
    count, directions = int(np.count_nonzero(used)) * state.axes.point, one.seen.directions
    if directions is not None:
        count = int(np.count_nonzero(directions[known][used, : state.axes.point].any(axis=2)))
    return NormalisedInnovation(
        distances, weights, nis if used.any() else None, count, densities, shares
    )
