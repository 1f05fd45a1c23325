"""A state packed into plain arrays for the filter (:mod:`.filter.step`), and what comes of it.

Of a large map only active landmarks are read; the landmarks seen have become active before.
Motions along velocities with a gap are None here: :meth:`.State.motion` integrates them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter import core, step
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
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
from slam_observer_ros.models.velocity_history import Velocities, VelocityHistory
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.tracking.covariances import of_pose
from slam_observer_ros.tracking.matching import calibrated, sensitivity
from slam_observer_ros.tracking.state import State

_NO_ENTRIES, NO_IDS, _NO_POINTS = np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 3))


def advance(
    state: State, velocities: VelocityHistory, start_ns: int, end_ns: int
) -> FloatArray | None:
    """Move a state on between two stamps (27); return the variances (6,) of the motion by axis."""
    joint = _at_rest(state)
    if joint is None:
        return None
    x = _estimate(state, joint)
    status, out = _advanced(state, x, velocities.flat(), start_ns, end_ns)
    if status == step.UNUSUAL:
        return None
    joint.note_motion()
    duration_s = to_s(end_ns - start_ns)
    state.relinearisation.move_on(x.A, out.A, out.noise, out.sensitivity, duration_s)
    of_driving = out.noise - out.of_turning
    is_rest = status == step.AT_REST
    state.motion_noise.factors.move(None if is_rest else np.array([out.of_turning, of_driving]))
    x.A[...] = out.A
    if state.calibration.delay_error_ns:
        state.end_velocity = out.at_end
    return out.variances


def pose_after(
    state: State, velocities: VelocityHistory, start_ns: int, end_ns: int
) -> tuple[FloatArray, FloatArray | None] | None:
    """As :meth:`.State.pose_after`."""
    found = _led_to(state, [velocities.flat()], start_ns, [end_ns])
    if found is None:
        return None
    (A,), (covariance,) = found
    return _in_world(state, A, covariance)


def poses_until(
    state: State, velocities: VelocityHistory, start_ns: int, stamps_ns: IntArray
) -> tuple[FloatArray, FloatArray | None] | None:
    """As :meth:`.State.poses_until`."""
    known_then = velocities.flat_then(stamps_ns)
    found = _led_to(state, known_then, start_ns, stamps_ns.tolist())
    return None if found is None else _in_world(state, *found)


def _led_to(
    state: State, velocities: Sequence[Velocities], start_ns: int, ends_ns: Sequence[int]
) -> tuple[FloatArray, FloatArray] | None:
    """Return Â (s, 4, 4) and covariances (s, 6, 6) of ε to which :func:`advance` would lead.

    Until each instant along the velocities known then.
    """
    errors, axes = state.errors, state.axes
    if errors is None or core.COMPILED is None:  # in numpy :meth:`.State.motion` costs less
        return None
    # Landmarks have no part in it.
    now = errors.joint.of_robot
    P, p, figures = now.copy(), axes.p, state.motion_noise.figures
    x = _estimate(state, errors.joint)._replace(
        y_ref=_NO_POINTS, a=_NO_POINTS, P=P, size=len(P), first=len(P)
    )
    A, covariances = np.empty((len(ends_ns), 4, 4)), np.zeros((len(ends_ns), 6, 6))
    out = _room_for_motion(state)
    for row, (known, end_ns) in enumerate(zip(velocities, ends_ns, strict=True)):
        P[...] = now
        interval = _interval(state, start_ns, end_ns)
        if core.advance(x, known, interval, figures, out) == step.UNUSUAL:
            return None
        A[row], covariances[row, axes.pose, axes.pose] = out.A, P[:p, :p]
    return A, covariances


def _in_world(
    state: State, A: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    observer = state.observer
    return observer.reference_pose @ A, of_pose(observer, covariance, A)


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
    x, seen = _estimate(state, joint), _seen(state, event, rows, places)
    settings, columns = state.settings, state.landmarks.columns
    in_arrays = _in_arrays(state, joint)
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


def _at_rest(state: State) -> JointCovariance | None:
    """Return P, where landmarks are at rest."""
    errors = state.errors
    if errors is None or errors.joint.chart.velocity or state.observer.have_moved:
        return None
    return errors.joint


def _in_arrays(state: State, joint: JointCovariance) -> IntArray | slice:
    """Return which landmarks the filter is given: those in P, all of an exact map."""
    return slice(None) if state.observer.is_exact else joint.active


def _estimate(state: State, joint: JointCovariance) -> FilterState:
    """Return the estimate as plain arrays."""
    observer, matrix, rows = state.observer, joint._matrix, _in_arrays(state, joint)
    return FilterState(
        observer.A,
        observer.y_ref[rows],
        observer.a[rows],
        matrix._storage,
        matrix._size,
        joint.first,
        0 if observer.is_exact else joint.chart.stride,
        state.settings.two_d_mode,
        state.calibration.rates,
        state.calibration.velocity_places,
        state.calibration.drift_covariance,
    )


def _advanced(
    state: State, x: FilterState, velocities: Velocities, start_ns: int, end_ns: int
) -> tuple[int, Advanced]:
    """Move ``x`` on along velocities (27); return whether that was usual, and what it did."""
    interval, out = _interval(state, start_ns, end_ns), _room_for_motion(state)
    return core.advance(x, velocities, interval, state.motion_noise.figures, out), out


def _interval(state: State, start_ns: int, end_ns: int) -> Interval:
    calibration = state.calibration
    return Interval(
        start_ns,
        end_ns,
        calibration.delay_ns,
        calibration.delay_error_ns,
        state.end_velocity,
    )


def _room_for_motion(state: State) -> Advanced:
    p, c = state.axes.p, state.calibration.count
    return Advanced(
        np.empty((4, 4)),
        np.empty((p, p)),
        np.empty((p, p)),
        np.empty((p, c)),
        np.empty(6),
        np.empty(6),
    )


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
