"""The step in numpy: the reference that ``_core.c`` repeats, equation by equation.

A motion, and an observation of any points: of few or many known landmarks, of new ones, which it
leaves out, and of an exact map. The errors are
x = (ε, c̃, ξ_1 … ξ_n), ξ_i = ã_i + [ŷ_i]× ε_Ω, and more of landmarks that turn or move: see
:mod:`.chart`.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrsv

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.arrays import add_symmetric_product, kalman_correction
from slam_observer_ros.filter.chart import slam_exp
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.landmark_table import Landmarks
from slam_observer_ros.filter.robust import accepted_points, AT_ONCE, reweighted
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import axes_of, EstimatedAxes
from slam_observer_ros.lie.matrices import (
    cholesky,
    diagonal_blocks,
    mahalanobis,
    transpose,
    with_blocks,
)
from slam_observer_ros.lie.sensor_mounting import sensitivity as sensor_sensitivity
from slam_observer_ros.models.calibration import calibrated, with_moves
from slam_observer_ros.models.held_velocities import held, Velocities
from slam_observer_ros.models.motion_noise import Factors, learn, motion_noise, MotionFigures
from slam_observer_ros.models.point_noise import (
    point_covariances,
    PointFigures,
    repetition_factors,
    RESOLUTION_M,
    stated_covariances,
)

UNUSUAL, AT_REST, DONE, REJECTS = -1, 0, 1, 2
"""What a step returns; AT_REST where the motion says nothing of the noise of velocities.

REJECTS where the gate lets less than half of the points pass, if that may be refused, and UNUSUAL
for what only numpy does: a motion with a gap, one of landmarks that move, or an observation that
rounding has left without digits. Nothing has changed then.
"""

_PLANAR = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
LOG_ROOT_2_PI = 0.5 * math.log(2.0 * math.pi)


# A motion: (27)


def advance(
    x: FilterState,
    velocities: Velocities,
    interval: Interval,
    figures: MotionFigures,
    out: Advanced,
) -> int:
    """Move X̂ along velocities (27), with what that does to P."""
    start_ns, end_ns = interval.start_ns - interval.delay_ns, interval.end_ns - interval.delay_ns
    pieces, axes = held(velocities, start_ns, end_ns), axes_of(x.is_planar)
    V, dt_s = _counting(pieces.body_velocities, x.is_planar), pieces.dt_s
    # (27)  Â ← Â exp(V dt), V = M V_measured + b
    path = se3.path(x.A, calibrated(x.rates, V) * dt_s[:, None])
    out.A[:] = path[-1]
    out.A[:3, :3] = so3.normalise(path[-1, :3, :3])
    # ε ← ε + F c̃ + w,  w ~ N(0, Σ Ad_Â Q Ad_Âᵀ)
    Ad = se3.adjoint(path)[:, axes.pose]
    # White noise: held longer than usual, one error has moved the robot by so much more.
    usual_s = pieces.usual_s + max(to_s(-interval.delay_ns), 0.0)
    Q, stated = motion_noise(replace(pieces, body_velocities=V, usual_s=usual_s), figures)
    out.variances[:] = Q.sum(axis=0)
    _summed_noise(Ad, se3.at_poses(Q), out)
    if stated is not None:
        out.variances[:] += np.diagonal(stated.sum(axis=0))
        _add_summed(Ad, se3.at_poses(stated), out)
    _write_sensitivity(x, Ad, V, dt_s, velocities, interval, out)
    _move_errors(x, out)
    of_c = slice(axes.p, axes.p + len(x.drift))
    x.P[of_c, of_c] += x.drift * to_s(interval.end_ns - interval.start_ns)
    return DONE if V.any() and dt_s.all() else AT_REST


def slip(x: FilterState, A: FloatArray, covariance: FloatArray, out: Advanced) -> None:
    """Let the robot be at Â = ``A`` (4, 4), by a motion that odometry has not seen.

    Its ``covariance`` (6, 6) is in the body frame there, rad² and m².
    """
    Ad = se3.adjoint(A)[axes_of(x.is_planar).pose]
    out.A[:], out.noise[:] = A, Ad.dot(covariance).dot(Ad.T)
    out.variances[:] = covariance.diagonal()
    out.of_turning[:] = out.sensitivity[:] = out.at_end[:] = 0.0
    _move_errors(x, out)


def _move_errors(x: FilterState, out: Advanced) -> None:
    """Let x become x + J (F c̃ + w): ξ_i grows by [ŷ_i]× times the turn that is added to ε."""
    axes, F, (p, c) = axes_of(x.is_planar), out.sensitivity, out.sensitivity.shape
    P, of_c = x.P, slice(p, p + c)
    JT = np.zeros((p, len(P)))
    JT[:, :p] = np.eye(p)
    if x.stride:  # an exact map has no errors
        of_landmarks = JT[:, x.first : x.size].reshape(p, -1, x.stride)
        of_landmarks[:, :, : axes.point] = -axes.turn_matrix(x.y_ref + x.a).transpose(2, 0, 1)
        if x.u is not None:
            of_landmarks[:, :, -axes.point :] = -axes.turn_matrix(x.u).transpose(2, 0, 1)
    half = (0.5 * (out.noise + F.dot(P[of_c, of_c]).dot(F.T))).dot(JT)
    if c:
        half += F.dot(P[of_c])
    add_symmetric_product(P, x.size, JT, half)


def _counting(V: FloatArray, is_planar: bool) -> FloatArray:
    """Return what counts of velocities (…, 6)."""
    return V * _PLANAR if is_planar else V


def _summed_noise(Ad: FloatArray, shares: FloatArray, out: Advanced) -> None:
    """Write Σ Ad_Â Q Ad_Âᵀ by the trapezoidal rule, ``shares`` (k + 1, 6) of Q at the poses."""
    p = len(out.noise)
    flat = Ad.swapaxes(0, 1).reshape(p, -1)
    out.noise[:] = (flat * shares.ravel()).dot(flat.T)
    shares[:, 3:] = 0.0
    out.of_turning[:] = (flat * shares.ravel()).dot(flat.T)


def _add_summed(Ad: FloatArray, shares: FloatArray, out: Advanced) -> None:
    """Add Σ Ad_Â Q Ad_Âᵀ, ``shares`` (k + 1, 6, 6) of Q; what both kinds share is half theirs."""
    p = len(out.noise)
    flat = Ad.swapaxes(0, 1).reshape(p, -1)
    out.noise[:] += (Ad @ shares).swapaxes(0, 1).reshape(p, -1).dot(flat.T)
    shares[:, :, 3:] = 0.0
    half = 0.5 * (Ad @ shares).swapaxes(0, 1).reshape(p, -1).dot(flat.T)
    out.of_turning[:] += half + half.T


def _write_sensitivity(
    x: FilterState,
    Ad: FloatArray,
    V: FloatArray,
    dt_s: FloatArray,
    velocities: Velocities,
    interval: Interval,
    out: Advanced,
) -> None:
    """Write F (p, c): ε' = Ad_Â (M̃ V + b̃), and of a delay what its two ends differ by."""
    F = out.sensitivity
    F[:] = 0.0
    of_rates = x.estimated[x.estimated < x.rates.size]
    if len(of_rates):
        rows, columns = of_rates // 7, of_rates % 7
        shares = se3.at_poses(with_moves(V)[:, columns] * dt_s[:, None])
        F[:, : len(rows)] = (Ad[:, :, rows] * shares[:, None, :]).sum(axis=0)
    if interval.reach_ns:
        at_start = interval.at_start
        if at_start is None:
            at_start = _mean_about(interval.start_ns, velocities, interval, x.is_planar)
        out.at_end[:] = _mean_about(interval.end_ns, velocities, interval, x.is_planar)
        before, after = calibrated(x.rates, at_start), calibrated(x.rates, out.at_end)
        F[:, len(x.estimated) - 1] = Ad[0].dot(before) - Ad[-1].dot(after)


def _mean_about(
    stamp_ns: int, velocities: Velocities, interval: Interval, is_planar: bool
) -> FloatArray:
    """Return the mean velocity (6,) about a stamp, as far as its delay may reach."""
    centre_ns = stamp_ns - interval.delay_ns
    start_ns, end_ns = centre_ns - interval.reach_ns, centre_ns + interval.reach_ns
    first = int(velocities.stamps_ns.searchsorted(start_ns, 'right')) - 1
    last = int(velocities.stamps_ns.searchsorted(end_ns, 'left'))
    stamps_ns = np.append(velocities.stamps_ns[first:last], end_ns)
    begins_ns = np.maximum(stamps_ns[:-1], start_ns)
    timed_out_ns = velocities.since_ns[first:last, 1] + velocities.timeout_ns
    held_s = to_s(np.minimum(np.maximum(timed_out_ns, begins_ns), stamps_ns[1:]) - begins_ns)
    known_s = held_s.sum()
    if not known_s:
        return np.zeros(6)
    return _counting(held_s.dot(velocities.body_velocities[first:last]) / known_s, is_planar)


# An observation: (28) to (31)


class _Residuals(NamedTuple):
    """What points of m known landmarks say against the state, reference frame, k axes."""

    at: IntArray  # (m,) which of the points seen
    columns: IntArray  # (m k,) theirs in P; none in an exact map
    points: FloatArray  # (m, 3) ŷ_i
    r: FloatArray  # (m, 3) r_i (29)
    R: FloatArray  # (m, k, k) covariances of the points seen
    D: FloatArray | None  # (m, k, c) how r_i changes with the calibration; None if it does not
    repeated: FloatArray  # (m,) by how much R grows, as errors last
    # (m, k, k) unit vectors along which points are measured, as rows, others zero; None: all
    directions: FloatArray | None
    axes: EstimatedAxes

    @property
    def flat(self) -> FloatArray:
        """(m k,) all residuals, as far as points are measured."""
        return self.measured(self.r[:, : self.axes.point].ravel())

    @property
    def degrees(self) -> IntArray:
        """(m,) along how many directions points are measured."""
        if self.directions is None:
            return np.full(len(self.at), self.axes.point)
        degrees: IntArray = np.asarray(self.directions.any(axis=2)).sum(axis=1)
        return degrees

    def measured(self, along_axes: FloatArray) -> FloatArray:
        """Return rows (m k, …) along the estimated axes as they are along what is measured.

        Rows of what is not measured are zero: with a variance of 1 they say nothing.
        """
        if self.directions is None:
            return along_axes
        of_points = along_axes.reshape(len(self.at), self.axes.point, -1)
        return (self.directions @ of_points).reshape(along_axes.shape)

    def output_matrix(self, chord: float) -> FloatArray:
        """Return C (m k, q) of r_i = C_i (ε, c̃) − ξ_i, ``chord`` of the way from ŷ_i to y.

        In an exact map ξ_i = [ŷ_i]× ε_Ω, which is a part of C_i then.
        """
        origins = chord * self.r
        C = self.axes.output_matrix(origins if len(self.columns) else self.points + origins)
        C = C if self.D is None else np.concatenate([C, self.D], axis=2)
        return C.reshape(len(self.at) * self.axes.point, -1)

    def changed(self, dx: FloatArray) -> _Residuals:
        """Return them as they are after the state was moved by exp(dx), to first order."""
        C = self.output_matrix(0.0)
        change = C.dot(dx[: C.shape[1]])
        if len(self.columns):
            change -= dx[self.columns]
        r = self.r.copy()
        r[:, : self.axes.point] += change.reshape(len(r), -1)
        return self._replace(r=r)

    def select(self, wanted: BoolArray | slice) -> _Residuals:
        """Return the part of them for ``wanted`` (m,) landmarks."""
        columns = self.columns
        if len(columns):
            columns = columns.reshape(len(self.at), -1)[wanted].ravel()
        return _Residuals(
            self.at[wanted],
            columns,
            self.points[wanted],
            self.r[wanted],
            self.R[wanted],
            None if self.D is None else self.D[wanted],
            self.repeated[wanted],
            None if self.directions is None else self.directions[wanted],
            self.axes,
        )


def observe(
    x: FilterState,
    landmarks: Landmarks,
    seen: Seen,
    figures: PointFigures,
    limits: Limits,
    factors: Factors | None,
    out: Observed,
) -> int:
    """Move X̂ by the innovation (28)–(31), and P with it, by all points that pass the gate.

    Without ``factors`` nothing is learnt of the noise of the motion. Of many points, one block
    after the other costs less than all at once, and leaves the same. The state moves only then:
    all are linearised at the same point.
    """
    residuals, stated = _residuals(x, landmarks, seen, figures, limits, out)
    axes, k, dx = residuals.axes, residuals.axes.point, np.zeros(len(x.P))
    out.weights[:] = 0.0
    for start in range(0, len(residuals.at), AT_ONCE):
        block = residuals.select(slice(start, start + AT_ONCE))
        block = block.changed(dx) if start else block
        predicted, S = _predicted(x, block)
        r = block.flat.reshape(-1, k)
        passed = accepted_points(r, S, limits.gate)
        if limits.may_refuse and start == 0 and 2 * np.count_nonzero(passed) < len(passed):
            return REJECTS
        if factors is not None and start == 0:
            C = axes.output_matrix(block.points + 0.5 * block.r)
            C = block.measured(C.reshape(-1, axes.p)).reshape(C.shape)
            learn(factors, r, S, C, block.degrees, limits.gate)
        weights = np.zeros(len(passed))
        used = np.flatnonzero(np.repeat(passed, k))
        if len(out.judged):
            _write_judged(block, S, passed, out.judged)
        if len(used):
            block = block.select(passed)
            weights[passed] = reweighted(
                r[passed], predicted[np.ix_(used, used)], block.R, limits.huber
            )
            dx += _correct(x, block, weights[passed])
        out.weights[residuals.at[start : start + AT_ONCE]] = weights
    # (28)  X̂ ← exp(−K r) · X̂:  Â ← exp(ε) Â,  ŷ_i ← exp(ε_Ω) ŷ_i + J(ε_Ω) ξ_i
    parts = dx[x.first : x.size].reshape(-1, max(x.stride, 1))
    X = slam_exp(axes.full_pose(dx[: axes.p]), axes.full_points(parts[:, :k]))
    R_D = X.A[:3, :3]
    out.A[:] = X.A.dot(x.A)
    if x.stride:
        x.a[:] = x.a.dot(R_D.T) + (X.a + (x.y_ref.dot(R_D.T) - x.y_ref))
    out.moved[:] = dx[: x.size]
    _record(x, landmarks, seen, limits, out)
    if stated is not None:
        out.covariances[:] = stated_covariances(out.points, stated, out.lines_of_sight, figures)
    return DONE


def _residuals(
    x: FilterState,
    landmarks: Landmarks,
    seen: Seen,
    figures: PointFigures,
    limits: Limits,
    out: Observed,
) -> tuple[_Residuals, FloatArray | None]:
    """Return the residuals (29) of known landmarks, and what is stated of all points seen."""
    axes, R_hat, x_hat = axes_of(x.is_planar), x.A[:3, :3], x.A[:3, 3]
    k, at = axes.point, np.flatnonzero(seen.rows >= 0)
    out.points[:], out.origins[:], stated = located(seen, x.is_planar)
    rows, y, origins = seen.rows[at], out.points[at], out.origins[at]
    points = x.y_ref.take(rows, axis=0) + x.a.take(rows, axis=0)
    # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°
    r = y.dot(R_hat.T) + x_hat - points
    # The noise at the range where a landmark should be, in the measured direction.
    expected = (points - x_hat).dot(R_hat)
    is_sure = _are_sure(landmarks, rows, 0, limits)
    ranges_2 = _squares(np.where(is_sure[:, None], expected, y) - origins)
    stretch = np.sqrt(ranges_2 / np.maximum(_squares(y - origins), RESOLUTION_M**2))
    towards = stretch[:, None] * (y - origins)
    covariances = (
        point_covariances(towards, figures)
        if stated is None
        else stated_covariances(y, stated[at], towards, figures)
    )
    # How r_i changes with the sensor that saw the point.
    D = None if seen.D is None else seen.D[at, :k]
    if seen.sensor is not None and len(seen.of_sensor):
        D = np.zeros((len(r), k, len(x.drift)))
        of_sensor = sensor_sensitivity(seen.sensor, expected - origins)[:, :, seen.of_sensor]
        D[:, :, seen.column : seen.column + len(seen.of_sensor)] = (R_hat @ of_sensor)[:, :k]
    out.r[:], out.repeated[:] = 0.0, 1.0
    out.r[at] = r
    dt_s = landmarks.unseen_s(rows, seen.stamp_ns)
    out.repeated[at] = repeated = repetition_factors(dt_s, limits.error_time_s)
    columns = x.first + np.arange(k) + x.stride * rows[:, None]
    R, directions = (R_hat @ covariances @ R_hat.T)[:, :k, :k], None
    if seen.directions is not None:
        directions = np.ascontiguousarray((seen.directions[at] @ R_hat.T)[:, :k, :k])
        unmeasured = np.asarray(~directions.any(axis=2))
        R = directions @ R @ transpose(directions) + unmeasured[:, :, None] * np.eye(k)
    residuals = _Residuals(
        at,
        columns.ravel() if x.stride else np.empty(0, dtype=np.int64),
        points,
        r,
        R,
        D,
        repeated,
        directions,
        axes,
    )
    return residuals, stated


def _are_sure(
    landmarks: Landmarks, rows: IntArray, further: BoolArray | int, limits: Limits
) -> BoolArray:
    """Return which landmarks (m,) are surer than a point seen, with ``further`` rejections."""
    is_confirmed = landmarks.counts.take(rows) >= limits.confirmations
    return is_confirmed & ~landmarks.in_doubt(rows, limits.max_rejections, further)


def located(seen: Seen, is_planar: bool) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return points y (m, 3) by the calibration of their sensor, and where that was (m, 3).

    And their covariances (m, 3, 3) where these are stated.
    """
    origins = np.zeros_like(seen.arms) if seen.origins is None else seen.origins
    if seen.sensor is None:
        return seen.arms + origins, origins, seen.covariances
    # y = o + d + exp(ψ) e^s p
    origins = origins + seen.sensor[3:6]
    turn = math.exp(seen.sensor[6]) * so3.exp(seen.sensor[:3])
    y = seen.arms.dot(turn.T) + origins
    stated = None if seen.covariances is None else turn @ seen.covariances @ turn.T
    if is_planar:  # the line of sight keeps its height
        origins[:, 2] -= y[:, 2]
        y[:, 2] = 0.0
    return y, origins, stated


def _predicted(x: FilterState, residuals: _Residuals) -> tuple[FloatArray, FloatArray]:
    """Return C P Cᵀ of the residuals, and S with the noise of the points, both (m k, m k).

    C is taken in the middle between ŷ_i and the point seen: turning moves at right angles to it.
    """
    C, P, columns = residuals.output_matrix(0.5), x.P, residuals.columns
    q = C.shape[1]
    if len(columns):
        seen_P = P.take(columns, axis=0)
        to_state = seen_P[:, :q]
        predicted = C.dot(P[:q, :q].dot(C.T) - to_state.T) - to_state.dot(C.T)
        predicted += seen_P.take(columns, axis=1)
    else:
        predicted = C.dot(P[:q, :q]).dot(C.T)
    if residuals.directions is not None:
        predicted = residuals.measured(residuals.measured(predicted).T.copy())
    return predicted, with_blocks(predicted, residuals.R)


def _correct(x: FilterState, residuals: _Residuals, weights: FloatArray) -> FloatArray:
    """Return −K r, K = P Hᵀ S⁻¹ (30), (31), and let P become P − K H P.

    H takes C at ŷ_i: so no observation says anything of the gauge.
    """
    C, P, columns = residuals.output_matrix(0.0), x.P, residuals.columns
    q = C.shape[1]
    HP = C.dot(P[:q])
    if len(columns):
        HP -= P.take(columns, axis=0)
    HP = residuals.measured(HP)
    HPH = HP[:, :q].dot(C.T)
    if len(columns):
        HPH -= HP.take(columns, axis=1)
    if residuals.directions is not None:
        HPH = residuals.measured(HPH.T.copy())
    S = with_blocks(HPH, residuals.R * (residuals.repeated / weights)[:, None, None])
    errors = np.append(np.arange(residuals.axes.p + len(x.drift)), np.arange(x.first, x.size))
    return -kalman_correction(P, x.size, errors, HP, S, residuals.flat)


def _write_judged(
    residuals: _Residuals, S: FloatArray, passed: BoolArray, out: FloatArray
) -> None:
    """Write how far off each residual was, its density given those before it, shares and NIS.

    Of those that are not used there is no density, and they have no part in the NIS.
    """
    k = residuals.axes.point
    distances, densities, shares = out[:-1].reshape(3, -1)
    r = residuals.flat
    distances[residuals.at] = mahalanobis(r.reshape(-1, k), diagonal_blocks(S, k))
    shares[residuals.at] = 1.0 / residuals.repeated
    densities[residuals.at] = -math.inf
    used = np.flatnonzero(np.repeat(passed, k))
    if len(used):
        L = cholesky(S[np.ix_(used, used)])
        white = dtrsv(L, r[used], lower=1)
        each = 0.5 * white**2 + np.log(np.diagonal(L)) + LOG_ROOT_2_PI
        unmeasured = LOG_ROOT_2_PI * (k - residuals.degrees[passed])
        densities[residuals.at[passed]] = unmeasured - each.reshape(-1, k).sum(axis=1)
        out[-1] += white.dot(white)


def _record(
    x: FilterState, landmarks: Landmarks, seen: Seen, limits: Limits, out: Observed
) -> None:
    """Note which landmarks were seen, and where they should have been by the corrected state."""
    is_used = out.weights > 0.0
    landmarks.accept(seen.rows[is_used], seen.stamp_ns)
    out.lines_of_sight[:] = out.points - out.origins
    at = np.flatnonzero(seen.rows >= 0)
    at = at[_are_sure(landmarks, seen.rows[at], ~is_used[at], limits)]
    points = x.y_ref.take(seen.rows[at], axis=0) + x.a.take(seen.rows[at], axis=0)
    out.lines_of_sight[at] = (points - out.A[:3, 3]).dot(out.A[:3, :3]) - out.origins[at]


def _squares(vectors: FloatArray) -> FloatArray:
    """Return the squared lengths (m,) of vectors (m, 3)."""
    squares: FloatArray = np.einsum('ij,ij->i', vectors, vectors)
    return squares
