"""The usual step in numpy: the reference that ``_core.c`` repeats, equation by equation.

It takes a motion along velocities without a gap, and an observation whose points are all of known
landmarks that are not doubtful. Anything else is UNUSUAL, and nothing is changed then: the
filters' own methods go on from there, also where orientations of tags are seen. The caller leaves
out points that are rejected, or of new landmarks.

The errors are x = (ε, c̃, ξ_1 … ξ_n), ξ_i = ã_i + [ŷ_i]× ε_Ω, and ω_i of tags: see :mod:`.chart`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf, dpotrs

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import (
    add_symmetric_product,
    subtract_square,
)
from slam_observer_ros.filter.chart import slam_exp
from slam_observer_ros.filter.flat_arrays import (
    Advanced,
    FilterState,
    Interval,
    Landmarks,
    Limits,
    Observed,
    Seen,
)
from slam_observer_ros.filter.robust import (
    accepted,
    huber_weights,
    REWEIGHTINGS,
)
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import axes_of, EstimatedAxes
from slam_observer_ros.lie.matrices import (
    diagonal_blocks,
    loses_digits,
    mahalanobis,
    with_blocks,
)
from slam_observer_ros.lie.sensor_mounting import sensitivity as sensor_sensitivity
from slam_observer_ros.models.calibration import calibrated, with_moves
from slam_observer_ros.models.motion_noise import (
    Factors,
    motion_variances,
    MotionFigures,
    score,
    stated_motion_covariances,
)
from slam_observer_ros.models.motion_noise import (
    learnt as learnt_factors,
)
from slam_observer_ros.models.observation_noise import (
    point_covariances,
    PointFigures,
    repetition_factors,
    RESOLUTION_M,
    stated_covariances,
)
from slam_observer_ros.models.velocity_history import Velocities

UNUSUAL, AT_REST, DONE, REJECTS = -1, 0, 1, 2
"""What a step returns; AT_REST where the motion says nothing of the noise of velocities.

REJECTS where the gate does not let all points pass: nothing is changed then, but weights say which
ones it rejects, and what all of them show of the noise is learnt.
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
    pieces = _pieces(velocities, interval)
    if pieces is None:
        return UNUSUAL
    rows, dt_s, before_s = pieces
    V = _counting(velocities.body_velocities[rows], x.is_planar)
    axes, (p, c) = axes_of(x.is_planar), out.sensitivity.shape
    # (27)  Â ← Â exp(V dt), V = M V_measured + b
    path = se3.path(x.A, calibrated(x.rates, V) * dt_s[:, None])
    out.A[:] = path[-1]
    out.A[:3, :3] = so3.normalise(path[-1, :3, :3])
    # ε ← ε + F c̃ + w,  w ~ N(0, Σ Ad_Â Q Ad_Âᵀ)
    Ad = se3.adjoint(path)[:, axes.pose]
    # White noise: held longer than usual, one error has moved the robot by so much more.
    usual_s = np.array([velocities.usual_angular_s, velocities.usual_linear_s])
    usual_s += max(to_s(-interval.delay_ns), 0.0)
    Q = motion_variances(V, dt_s, before_s, usual_s, figures)
    is_stated, stated = velocities.is_stated[rows], None
    if np.count_nonzero(is_stated):
        Q[np.repeat(is_stated, 3, axis=1)] = 0.0
        stated = stated_motion_covariances(
            velocities.covariances[rows], dt_s, before_s, figures.factors
        )
    out.variances[:] = Q.sum(axis=0)
    _summed_noise(Ad, se3.at_poses(Q), out)
    if stated is not None:
        out.variances[:] += np.diagonal(stated.sum(axis=0))
        _add_summed(Ad, se3.at_poses(stated), out)
    F = _sensitivity(x, Ad, V, dt_s, velocities, interval, out)
    # x ← x + J (F c̃ + w); ξ_i grows by [ŷ_i]× times the turn that is added to ε
    P, of_c = x.P, slice(p, p + c)
    JT = np.zeros((p, len(P)))
    JT[:, :p] = np.eye(p)
    of_landmarks = JT[:, x.first : x.size].reshape(p, -1, x.stride)
    of_landmarks[:, :, : axes.point] = -axes.turn_matrix(x.y_ref + x.a).transpose(2, 0, 1)
    half = (0.5 * (out.noise + F.dot(P[of_c, of_c]).dot(F.T))).dot(JT)
    if c:
        half += F.dot(P[of_c])
    add_symmetric_product(P, x.size, JT, half)
    P[of_c, of_c] += x.drift * to_s(interval.end_ns - interval.start_ns)
    return DONE if V.any() and dt_s.all() else AT_REST


def _pieces(
    velocities: Velocities, interval: Interval
) -> tuple[slice, FloatArray, FloatArray] | None:
    """Return k velocities, for how long each is held, and (k, 2) was before; None for gaps."""
    start_ns, end_ns = interval.start_ns - interval.delay_ns, interval.end_ns - interval.delay_ns
    first = int(velocities.stamps_ns.searchsorted(start_ns, 'right')) - 1
    last = max(int(velocities.stamps_ns.searchsorted(end_ns, 'left')), first + 1)
    bounds_ns = np.append(velocities.stamps_ns[first:last], end_ns)
    if end_ns < start_ns or first < 0:
        return None
    bounds_ns[0], since_ns = start_ns, velocities.since_ns[first:last]
    if (since_ns[:, 1] + velocities.timeout_ns < bounds_ns[1:]).any():
        return None
    return slice(first, last), to_s(np.diff(bounds_ns)), to_s(bounds_ns[:-1, None] - since_ns)


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


def _sensitivity(
    x: FilterState,
    Ad: FloatArray,
    V: FloatArray,
    dt_s: FloatArray,
    velocities: Velocities,
    interval: Interval,
    out: Advanced,
) -> FloatArray:
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
    return F


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
    """What m points say against the state, in the reference frame, on k estimated axes."""

    columns: IntArray  # (m k,) theirs in P
    points: FloatArray  # (m, 3) ŷ_i
    r: FloatArray  # (m, 3) r_i (29)
    R: FloatArray  # (m, k, k) covariances of the points seen
    stated: FloatArray | None  # (m, 3, 3) the same in the body frame, where it was stated
    D: FloatArray | None  # (m, k, c) how r_i changes with the calibration; None if it does not
    repeated: FloatArray  # (m,) by how much R grows, as errors last
    axes: EstimatedAxes

    @property
    def flat(self) -> FloatArray:
        """(m k,) all residuals."""
        return self.r[:, : self.axes.point].ravel()

    def output_matrix(self, chord: float) -> FloatArray:
        """Return C (m k, q) of r_i = C_i (ε, c̃) − ξ_i, ``chord`` of the way from ŷ_i to y."""
        C = self.axes.output_matrix(chord * self.r)
        C = C if self.D is None else np.concatenate([C, self.D], axis=2)
        return C.reshape(len(self.columns), -1)


class _Judged(NamedTuple):
    """What P predicts of residuals, and how far they are off by that."""

    predicted: FloatArray  # (m k, m k) C P Cᵀ
    S: FloatArray  # (m k, m k) with the noise of the points
    L: FloatArray  # (m k, m k) L Lᵀ = S
    S_inv_r: FloatArray  # (m k,)
    distances: FloatArray | None  # (m,) Mahalanobis distance of each; None if it does not matter


def observe(
    x: FilterState,
    landmarks: Landmarks,
    seen: Seen,
    figures: PointFigures,
    limits: Limits,
    factors: Factors | None,
    out: Observed,
) -> int:
    """Move X̂ by the innovation (28)–(31), and P with it.

    Without ``factors`` nothing is learnt of the noise of the motion.
    """
    if x.stride != axes_of(x.is_planar).point:
        return UNUSUAL
    residuals = _residuals(x, landmarks, seen, figures, limits, out)
    judged = None if residuals is None else _judged(x, residuals, limits)
    if residuals is None or judged is None:
        return UNUSUAL
    if len(out.judged):
        _write_judged(residuals, judged, out.judged)
    learnt = None if factors is None else _learnt(factors, residuals, judged.S, limits.gate)
    if factors is not None and learnt is None:
        return UNUSUAL
    if judged.distances is not None and not accepted(judged.distances, limits.gate).all():
        out.weights[:] = accepted(judged.distances, limits.gate)
        _take_over(factors, learnt)
        return REJECTS
    weights = _weights(residuals, judged, limits)
    dx = None if weights is None else _correct(x, residuals, weights)
    if weights is None or dx is None:
        return UNUSUAL
    # (28)  X̂ ← exp(−K r) · X̂:  Â ← exp(ε) Â,  ŷ_i ← exp(ε_Ω) ŷ_i + J(ε_Ω) ξ_i
    axes = residuals.axes
    X = slam_exp(axes.full_pose(dx[: axes.p]), axes.full_points(dx[x.first :]))
    R_D = X.A[:3, :3]
    out.A[:] = X.A.dot(x.A)
    x.a[:] = x.a.dot(R_D.T) + (X.a + (x.y_ref.dot(R_D.T) - x.y_ref))
    out.moved[:] = dx[: x.first]
    out.weights[:] = weights
    _take_over(factors, learnt)
    if len(out.expected):
        out.expected[:] = np.append(judged.S, residuals.R)
    _record(x, landmarks, seen, limits, out)
    if residuals.stated is not None:
        out.covariances[:] = stated_covariances(
            out.points, residuals.stated, out.lines_of_sight, figures
        )
    return DONE


def _residuals(
    x: FilterState,
    landmarks: Landmarks,
    seen: Seen,
    figures: PointFigures,
    limits: Limits,
    out: Observed,
) -> _Residuals | None:
    """Return the residuals (29); None where a landmark is doubtful."""
    rows = seen.rows
    counts, rejections = landmarks.counts.take(rows), landmarks.rejections.take(rows)
    if np.count_nonzero(rejections >= np.minimum(counts + 1, limits.max_rejections)):
        return None
    axes, R_hat, x_hat = axes_of(x.is_planar), x.A[:3, :3], x.A[:3, 3]
    k = axes.point
    y, origins, stated = _calibrated(seen, x.is_planar)
    points = x.y_ref.take(rows, axis=0) + x.a.take(rows, axis=0)
    # (29)  e_i = Â y_i − â_i,  r_i = e_i − y_i°
    r = y.dot(R_hat.T) + x_hat - points
    # The noise at the range where a landmark should be, in the measured direction.
    expected = (points - x_hat).dot(R_hat)
    is_sure = counts >= limits.confirmations
    ranges_2 = _squares(np.where(is_sure[:, None], expected, y) - origins)
    stretch = np.sqrt(ranges_2 / np.maximum(_squares(y - origins), RESOLUTION_M**2))
    towards = stretch[:, None] * (y - origins)
    covariances = (
        point_covariances(towards, figures)
        if stated is None
        else stated_covariances(y, stated, towards, figures)
    )
    # How r_i changes with the sensor that saw the point.
    D = None
    if seen.sensor is not None and len(seen.of_sensor):
        D = np.zeros((len(r), k, len(x.drift)))
        of_sensor = sensor_sensitivity(seen.sensor, expected - origins)[:, :, seen.of_sensor]
        D[:, :, seen.column : seen.column + len(seen.of_sensor)] = (R_hat @ of_sensor)[:, :k]
    out.points[:], out.r[:], out.origins[:] = y, r, origins
    out.dt_s[:] = dt_s = _unseen_s(landmarks, rows, seen.stamp_ns)
    return _Residuals(
        (x.first + np.arange(k) + k * rows[:, None]).ravel(),
        points,
        r,
        (R_hat @ covariances @ R_hat.T)[:, :k, :k],
        stated,
        D,
        repetition_factors(dt_s, limits.error_time_s),
        axes,
    )


def _calibrated(seen: Seen, is_planar: bool) -> tuple[FloatArray, FloatArray, FloatArray | None]:
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


def _unseen_s(landmarks: Landmarks, rows: IntArray, stamp_ns: int) -> FloatArray:
    """Return how long landmarks (m,) have not been seen, seconds; by another sensor just now."""
    last_ns = landmarks.last_seen_ns.take(rows)
    last_ns = np.where(last_ns == stamp_ns, landmarks.seen_before_ns.take(rows), last_ns)
    return np.where(last_ns < 0, np.inf, to_s(stamp_ns - last_ns))


def _judged(x: FilterState, residuals: _Residuals, limits: Limits) -> _Judged | None:
    """Return S = C P Cᵀ + R, factored; None if it is indefinite.

    C is taken in the middle between ŷ_i and the point seen: turning moves at right angles to it.
    """
    C, P, axes = residuals.output_matrix(0.5), x.P, residuals.axes
    q = C.shape[1]
    seen_P = P.take(residuals.columns, axis=0)
    to_state = seen_P[:, :q]
    predicted = C.dot(P[:q, :q].dot(C.T) - to_state.T) - to_state.dot(C.T)
    predicted += seen_P.take(residuals.columns, axis=1)
    S = with_blocks(predicted, residuals.R)
    L, is_indefinite = dpotrf(S, lower=1)
    if is_indefinite:
        return None
    S_inv_r, distances = dpotrs(L, residuals.flat, lower=1)[0], None
    # No residual is further out than all of them together are.
    if residuals.flat.dot(S_inv_r) > limits.gate**2:
        distances = mahalanobis(residuals.r[:, : axes.point], diagonal_blocks(S, axes.point))
    return _Judged(predicted, S, L, S_inv_r, distances)


def _learnt(
    factors: Factors, residuals: _Residuals, S: FloatArray, gate: float
) -> tuple[FloatArray, FloatArray] | None:
    """Return F̄ (2, 2) and θ (2,) by these residuals, too; None if S is indefinite."""
    axes, k = residuals.axes, residuals.axes.point
    C = axes.output_matrix(residuals.points + 0.5 * residuals.r).reshape(-1, axes.p)
    # As the likelihood at θ has it, which may be less than is applied.
    ratios = np.exp(factors.logs) / factors.applied
    N = ratios[:, None, None] * factors.shares
    if np.count_nonzero(ratios != 1.0):
        S = S + C.dot((N - factors.shares).sum(axis=0)).dot(C.T)
    r = residuals.flat
    while True:
        L, is_indefinite = dpotrf(S, lower=1)
        if is_indefinite:
            return None
        solved = dpotrs(L, np.column_stack([r, C]), lower=1)[0]
        squared, m = float(r.dot(solved[:, 0])), len(r) // k
        if squared <= gate**2:
            break
        passed = accepted(mahalanobis(r.reshape(m, k), diagonal_blocks(S, k)), gate)
        if not m < 2 * np.count_nonzero(passed) < 2 * m:
            break
        used = np.flatnonzero(np.repeat(passed, k))  # some few are left out
        S, C, r = S[np.ix_(used, used)], C[used], r[used]
    u, G = C.T.dot(solved[:, 0]), C.T.dot(solved[:, 1:])
    return learnt_factors(factors.logs, factors.information, *score(u, G, N, squared, len(solved)))


def _take_over(factors: Factors | None, learnt: tuple[FloatArray, FloatArray] | None) -> None:
    if factors is None or learnt is None:
        return
    factors.information[:], factors.logs[:] = learnt
    if factors.least < math.inf:
        factors.applied[:] = np.exp(np.maximum(factors.logs, factors.least))


def _weights(residuals: _Residuals, judged: _Judged, limits: Limits) -> FloatArray | None:
    """Return Huber's weights (m,) of what the correction leaves of the residuals, R S⁻¹ r."""
    R, (m, k, _) = residuals.R, residuals.R.shape
    weights = huber_weights(judged.S_inv_r.reshape(m, k), R, np.ones(m), limits.huber)
    for _ in range(REWEIGHTINGS - 1):
        if np.count_nonzero(weights == 1.0) == m:
            break
        S = with_blocks(judged.predicted, R / weights[:, None, None])
        L, is_indefinite = dpotrf(S, lower=1)
        if is_indefinite:
            return None
        S_inv_r = dpotrs(L, residuals.flat, lower=1)[0]
        weights = huber_weights(S_inv_r.reshape(m, k), R, weights, limits.huber)
    return weights


def _correct(x: FilterState, residuals: _Residuals, weights: FloatArray) -> FloatArray | None:
    """Return −K r, K = P Hᵀ S⁻¹ (30), (31), and let P become P − K H P; None if S is indefinite.

    Or if digits are lost, see :func:`loses_digits`. H takes C at ŷ_i: so no observation says
    anything of the gauge.
    """
    C, P, columns = residuals.output_matrix(0.0), x.P, residuals.columns
    q = C.shape[1]
    HP = C.dot(P[:q]) - P.take(columns, axis=0)
    HPH = HP[:, :q].dot(C.T) - HP.take(columns, axis=1)
    S = with_blocks(HPH, residuals.R * (residuals.repeated / weights)[:, None, None])
    L, is_indefinite = dpotrf(S, lower=1)
    if is_indefinite:
        return None
    # W = L⁻¹ H P:  P − Wᵀ W,  K r = Wᵀ L⁻¹ r
    W = dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
    errors = np.append(np.arange(residuals.axes.p + len(x.drift)), np.arange(x.first, x.size))
    if loses_digits(P.diagonal()[errors], W[:, errors], L):
        return None
    subtract_square(P, x.size, W)
    dx: FloatArray = -dtrsv(L, residuals.flat, lower=1).dot(W[:, : x.size])
    return dx


def _write_judged(residuals: _Residuals, judged: _Judged, out: FloatArray) -> None:
    """Write how far off each residual was, its density given those before it, shares and NIS."""
    k, m = residuals.axes.point, len(residuals.r)
    distances, densities, shares = out[: 3 * m].reshape(3, m)
    distances[:] = mahalanobis(residuals.r[:, :k], diagonal_blocks(judged.S, k))
    white = dtrsv(judged.L, residuals.flat, lower=1)
    each = 0.5 * white**2 + np.log(np.diagonal(judged.L)) + LOG_ROOT_2_PI
    densities[:] = -each.reshape(m, k).sum(axis=1)
    shares[:] = 1.0 / residuals.repeated
    out[3 * m] = white.dot(white)


def _record(
    x: FilterState, landmarks: Landmarks, seen: Seen, limits: Limits, out: Observed
) -> None:
    """Note that landmarks were seen, and where they should have been by the corrected state."""
    rows = seen.rows
    landmarks.counts[rows] += 1
    landmarks.rejections[rows] = 0
    last_ns = landmarks.last_seen_ns.take(rows)
    is_later = last_ns < seen.stamp_ns
    landmarks.seen_before_ns[rows[is_later]] = last_ns[is_later]
    landmarks.last_seen_ns[rows[is_later]] = seen.stamp_ns
    points = x.y_ref.take(rows, axis=0) + x.a.take(rows, axis=0)
    expected = (points - out.A[:3, 3]).dot(out.A[:3, :3])
    is_sure = landmarks.counts.take(rows) >= limits.confirmations
    out.lines_of_sight[:] = np.where(is_sure[:, None], expected, out.points) - out.origins


def _squares(vectors: FloatArray) -> FloatArray:
    """Return the squared lengths (m,) of vectors (m, 3)."""
    squares: FloatArray = np.einsum('ij,ij->i', vectors, vectors)
    return squares
