"""An observation packed into plain arrays for the filter (:mod:`.filter.step`), and its effects.

Of a large map only active landmarks are read; the landmarks seen have become active before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter import core, step
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.flat_arrays import (
    FilterState,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.gains import PlainGains
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.landmark_table import Landmarks
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.sensor_mounting import Sensed
from slam_observer_ros.models import sensing
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.tracking.matching import calibrated, sensitivity
from slam_observer_ros.tracking.state import State

_NO_ENTRIES, NO_IDS, _NO_POINTS = np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 3))


class Corrected(NamedTuple):
    """An observation as the filter was given it, and what came of it."""

    rows: IntArray  # (m,) which landmarks its points are of, −1 for new ones
    seen: Seen
    out: Observed


def correct(
    state: State, event: ObservationEvent, rows: IntArray, may_refuse: bool = False
) -> Corrected | None:
    """Correct a state by the points (m,) of known landmarks ``rows``, −1 where one is new.

    Return None, with nothing changed, where most are rejected and that ``may_refuse``.
    """
    if state.errors is None and (gains := state.gains.plain) is not None:
        return _by_plain_gains(state, gains, event, rows)
    joint, known = state.known_errors.joint, rows[rows >= 0]
    joint.activate(known)
    places = np.full(len(rows), -1)
    places[rows >= 0] = joint.places(known)
    x, seen = state.gains.flat(), _seen(state, event, rows, places)
    settings, columns = state.settings, state.landmarks.columns
    in_arrays = slice(None) if state.observer.is_exact else joint.active
    landmarks = Landmarks(*[column[in_arrays] for column in columns])
    factors = state.motion_noise.factors.flat() if len(known) else None
    out, noise = _room(state, event, x.size), state.observation_noise
    limits = Limits(
        gate=settings.rejection_threshold,
        huber=settings.huber_threshold,
        error_time_s=noise.error_time_s,
        confirmations=settings.confirmations,
        max_rejections=settings.max_rejections,
        may_refuse=may_refuse,
    )
    status = core.observe(x, landmarks, seen, noise.figures, limits, factors, out)
    if status == step.REJECTS:
        return None
    if len(known):
        state.motion_noise.factors.take(factors)
    if isinstance(in_arrays, np.ndarray):  # else they are views, changed in place
        state.observer.a[in_arrays] = x.a
        for column, changed in zip(columns, landmarks, strict=True):
            column[in_arrays] = changed
    _take_over(state, joint, x, out)
    return Corrected(rows, seen, out)


def _by_plain_gains(
    state: State, gains: PlainGains, event: ObservationEvent, rows: IntArray
) -> Corrected:
    known = rows >= 0
    seen, out = _seen(state, event, rows, rows), _room(state, event, 0)
    points = calibrated(state, event).points[known]
    no_noise = np.zeros((len(points), 3, 3))
    dt_s = state.landmarks.unseen_s(rows[known], event.stamp_ns)
    residuals = state.gains.residuals(rows[known], points, no_noise, dt_s, np.ones(len(dt_s)))
    out.r[:], out.weights[:] = 0.0, 0.0
    out.r[known] = residuals.r
    if len(dt_s):
        out.weights[known] = gains.observe(residuals)
        state.landmarks.accept(rows[known], event.stamp_ns)
    return Corrected(rows, seen, out)


def _room(state: State, event: ObservationEvent, size: int) -> Observed:
    """Return room for the results; none for those that nobody asks for."""
    m = len(event.ids)
    judged = np.zeros(3 * m + 1) if state.judges_innovations else _NO_ENTRIES
    return Observed(
        A=np.empty((4, 4)),
        points=np.empty((m, 3)),
        r=np.empty((m, 3)),
        dt_s=np.empty(m),
        lines_of_sight=np.empty((m, 3)),
        origins=np.empty((m, 3)),
        covariances=np.empty((0 if event.covariances is None else m, 3, 3)),
        weights=np.empty(m),
        moved=np.empty(size),
        judged=judged,
    )


def _take_over(state: State, joint: JointCovariance, x: FilterState, out: Observed) -> None:
    """Let a state be as the filter has left it, where that is not in its arrays yet."""
    observer, axes, calibration = state.observer, state.axes, state.calibration
    before = x.A.copy()
    state.relinearisation.note_correction(before, out.A)
    x.A[...] = out.A
    joint.follow(out.moved)
    if calibration.count:
        calibration.shift(out.moved[axes.p : axes.p + calibration.count])
    if x.stride > axes.point:
        chart, moved = joint.chart, joint.active
        of_landmarks = out.moved[x.first :].reshape(-1, x.stride)
        if chart.turn:
            turns = axes.full_turns(of_landmarks[:, axes.point : axes.point + chart.turn])
            observer.orientations.turn(moved, so3.exp(turns))
        if chart.velocity:
            change = axes.full_points(of_landmarks[:, -chart.velocity :])
            observer.correct_velocities(out.A @ se3.inverse(before), moved, change)


def _seen(state: State, event: ObservationEvent, rows: IntArray, places: IntArray) -> Seen:
    """Return points of landmarks ``rows``, at ``places`` of P, and what calibrates their sensor.

    Of points that were carried forward, the calibration's effect is given.
    """
    arms, covariances = _plain(event.lines_of_sight), event.covariances
    origins = event.sensor
    calibration = state.calibration
    values, estimated, column, D = None, NO_IDS, 0, None
    if event.sensed is not None:
        expected, known = event.points.copy(), rows >= 0
        expected[known] = state.observer.body_points(rows[known])
        D = sensitivity(state, event, expected)
    elif calibration.corrects_points:
        frame = event.sensor_frame
        values, estimated = calibration.sensor(frame), calibration.of_sensor
        column = calibration.columns(frame).start
    if state.settings.range_is_depth and event.sensed is None:
        cosines = sensing.cosines(arms, event.sensor_axis)
        arms = arms / cosines[:, None]
        if covariances is not None:
            covariances = covariances / cosines[:, None, None] ** 2
    return Seen(
        event.stamp_ns,
        places,
        arms,
        None if origins is None else _plain(origins),
        None if covariances is None else _plain(covariances),
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
    every = Keyframe(
        event.stamp_ns,
        rows,
        out.points,
        out.lines_of_sight,
        out.covariances if len(out.covariances) else None,
        state.observation_noise.repetitions(out.dt_s),
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
    used = int(np.count_nonzero(weights))
    nis = float(out.judged[-1]) if used else None
    count = used * state.axes.point
    return NormalisedInnovation(distances, weights, nis, count, densities, shares)
