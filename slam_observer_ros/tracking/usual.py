"""A state packed into plain arrays for the usual step, and its results written back.

Functions return None, with no estimate changed, where anything is unusual: see
:mod:`.observer.step`.
Of a large map only active landmarks are read; the landmarks seen have become active before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import NormalisedInnovation, Update
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter import core, step
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Landmarks,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.robust import AT_ONCE
from slam_observer_ros.lie.matrices import diagonal_blocks, mahalanobis
from slam_observer_ros.lie.sensor_mounting import Sensed
from slam_observer_ros.models import sensing
from slam_observer_ros.models.motion_noise import Factors
from slam_observer_ros.models.velocity_history import Velocities, VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.tracking.covariances import of_pose
from slam_observer_ros.tracking.matching import Expected
from slam_observer_ros.tracking.state import State

MOST_WORK = 1e7
"""Multiplications of a correction of P beyond which BLAS, in the general way, takes less time."""

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
    if errors is None or core.COMPILED is None:  # in numpy the general way costs less
        return None
    # Landmarks have no part in it.
    now = errors.joint.of_robot
    P, p, figures = now.copy(), axes.p, state.motion_noise.figures
    x = _estimate_of(state, _NO_POINTS, _NO_POINTS, P, (len(P), len(P), errors.joint.chart.stride))
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
    """Points of known landmarks as the kernel was given them, and its results."""

    status: int  # DONE, or REJECTS: then nothing has changed
    rows: IntArray  # (m,) which landmarks
    seen: Seen
    out: Observed
    factors: Factors | None  # as learnt of the noise of the motion


def finish(state: State, event: ObservationEvent, corrected: Corrected) -> Update:
    """Keep a keyframe of an observation that has corrected a state by all its points.

    The past may be relinearised by that.
    """
    past, out = state.relinearisation, corrected.out
    if past.is_active:
        state.keep(keyframe(state, event, corrected))
    none_rejected = np.zeros(len(event.ids), dtype=np.bool_)
    judged = innovation(state, out)
    return state.update(event.stamp_ns, event.ids, out.r, none_rejected, NO_IDS, judged)


def is_usual(state: State, event: ObservationEvent) -> bool:
    """Return whether a state is a map of points at rest, and the observation has points alone.

    It must be of the state's instant, by a sensor that is known.
    """
    calibration, joint = state.calibration, _at_rest(state)
    return (
        event.velocities is None
        and event.orientations is None
        and event.sensed is None  # late, and carried forward
        and not (calibration.corrects_points and event.sensor_frame not in calibration.sensors)
        and joint is not None
        and joint.chart.stride == state.axes.point
    )


def correct(
    state: State,
    event: ObservationEvent,
    rows: IntArray,
    with_expected: bool = False,
    of_all: Corrected | None = None,
) -> Corrected | None:
    """Correct a state by points of known landmarks ``rows`` (m,), but keep no keyframe.

    The observation :func:`is_usual`, or it is the part of one that ``of_all`` has not rejected.
    With ``with_expected`` the results have what was expected of the points.
    """
    m, k, joint = len(rows), state.axes.point, state.known_errors.joint
    if not 0 < m <= AT_ONCE or m * k * len(joint.P) ** 2 > MOST_WORK:
        return None
    joint.activate(rows)
    x, seen = _estimate(state, joint), _seen(state, event, joint.places(rows))
    landmarks = Landmarks(*(column[joint.active] for column in _columns(state)))
    factors = state.motion_noise.factors.flat() if of_all is None else None
    out = _room(state, event, x, with_expected)
    noise = state.observation_noise
    figures, limits = noise.figures, _limits(state.settings, noise.error_time_s)
    status = core.observe(x, landmarks, seen, figures, limits, factors, out)
    if status == step.UNUSUAL:
        return None
    if status == step.DONE:
        state.motion_noise.factors.take(factors if of_all is None else of_all.factors)
        _take_over(state, joint, x, landmarks, out)
    return Corrected(status, rows, seen, out, factors)


def _columns(state: State) -> tuple[IntArray, ...]:
    """Return the columns of the landmark table that the kernel reads and changes."""
    table = state.landmarks
    return table.counts, table.rejections, table.last_seen_ns, table.seen_before_ns


def _room(state: State, event: ObservationEvent, x: FilterState, with_expected: bool) -> Observed:
    """Return room for the results; none for those that nobody asks for."""
    m, k = len(event.ids), state.axes.point
    return Observed(
        A=np.empty((4, 4)),
        points=np.empty((m, 3)),
        r=np.empty((m, 3)),
        dt_s=np.empty(m),
        lines_of_sight=np.empty((m, 3)),
        origins=np.empty((m, 3)),
        covariances=np.empty((0 if event.covariances is None else m, 3, 3)),
        weights=np.empty(m),
        moved=np.empty(x.first),
        judged=np.empty(3 * m + 1) if state.judges_innovations else _NO_ENTRIES,
        expected=np.empty(m * (m + 1) * k * k) if with_expected else _NO_ENTRIES,
    )


def _limits(settings: Settings, error_time_s: float) -> Limits:
    return Limits(
        gate=settings.rejection_threshold,
        huber=settings.huber_threshold,
        error_time_s=error_time_s,
        confirmations=settings.confirmations,
        max_rejections=settings.max_rejections,
    )


def _take_over(
    state: State, joint: JointCovariance, x: FilterState, landmarks: Landmarks, out: Observed
) -> None:
    """Let a state be as the kernel has left it: x, the landmarks' columns, what has moved."""
    state.relinearisation.note_correction(x.A, out.A)
    x.A[...] = out.A
    columns = (state.observer.a, *_columns(state))
    for column, changed in zip(columns, (x.a, *landmarks), strict=True):
        joint.write_active(column, changed)
    joint.follow(out.moved)
    calibration, p = state.calibration, state.axes.p
    if calibration.count:
        calibration.shift(out.moved[p : p + calibration.count])
    state.rejected_in_a_row, state.was_contradicted = 0, False


def _at_rest(state: State) -> JointCovariance | None:
    """Return P, where landmarks are estimated, and are at rest."""
    errors = state.errors
    if errors is None or not errors.joint.is_at_rest or state.observer.have_moved:
        return None
    return errors.joint


def _estimate(state: State, joint: JointCovariance) -> FilterState:
    """Return the estimate as plain arrays, of landmarks :func:`_at_rest`."""
    observer, matrix, active = state.observer, joint._matrix, joint.active
    return _estimate_of(
        state,
        observer.y_ref[active],
        observer.a[active],
        matrix._storage,
        (matrix._size, joint.first, joint.chart.stride),
    )


def _estimate_of(
    state: State, y_ref: FloatArray, a: FloatArray, P: FloatArray, sizes: tuple[int, int, int]
) -> FilterState:
    calibration = state.calibration
    return FilterState(
        state.observer.A,
        y_ref,
        a,
        P,
        *sizes,
        state.settings.two_d_mode,
        calibration.rates,
        calibration.velocity_places,
        calibration.drift_covariance,
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


def _seen(state: State, event: ObservationEvent, places: IntArray) -> Seen:
    """Return points of landmarks at ``places`` of P, and what of their sensor is calibrated."""
    arms, covariances = _plain(event.lines_of_sight), event.covariances
    origins = event.sensor
    calibration = state.calibration
    values, estimated, column = None, NO_IDS, 0
    if calibration.corrects_points:
        frame = event.sensor_frame
        values, estimated = calibration.sensor(frame), calibration.of_sensor
        column = calibration.columns(frame).start
    if state.settings.range_is_depth:
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
    )


def _plain(array: FloatArray) -> FloatArray:
    """Return an array that may be of another precision or order as C has it."""
    return np.ascontiguousarray(array, np.float64)


def keyframe(state: State, event: ObservationEvent, corrected: Corrected) -> Keyframe:
    """Return the points as they are kept to be linearised again."""
    seen, out, sensed = corrected.seen, corrected.out, None
    if seen.sensor is not None:
        number = state.calibration.sensors.index(event.sensor_frame)
        origins = np.zeros_like(seen.arms) if seen.origins is None else seen.origins
        sensed = Sensed(np.full(len(seen.arms), number), origins, seen.arms)
    stated = out.covariances if len(out.covariances) else None
    return Keyframe(
        event.stamp_ns,
        corrected.rows,
        out.points,
        out.lines_of_sight,
        stated,
        state.observation_noise.repetitions(out.dt_s),
        None,
        sensed,
    )


def innovation(state: State, out: Observed) -> NormalisedInnovation | None:
    """Return how far off the residuals were, if that was asked for."""
    if not len(out.judged):
        return None
    m = len(out.weights)
    distances, densities, shares = out.judged[:-1].reshape(3, m)
    nis = float(out.judged[-1])
    return NormalisedInnovation(
        distances, out.weights, nis, m * state.axes.point, densities, shares
    )


def expected(state: State, out: Observed) -> Expected | None:
    """Return what was expected of the residuals, if that was asked for."""
    if not len(out.expected):
        return None
    m, k = len(out.r), state.axes.point
    r, S, R = out.r[:, :k], out.expected[: (m * k) ** 2], out.expected[(m * k) ** 2 :]
    S = S.reshape(m * k, m * k)
    return Expected(r, mahalanobis(r, diagonal_blocks(S, k)), R.reshape(m, k, k), S)
