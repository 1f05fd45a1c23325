"""The paper's gains: constant k_i and l_i; (28)–(31) integrated so that any step is stable.

The explicit Euler step of (28)–(31) is stable only below dt ≈ 2/Σ k_i(1 + |e_i|²/2). Here the pose
is moved by an exponential integrator of the linearised flow. With gains k_i (m,), errors e_i and
residuals r_i (m, 3), J_i = [−[e_i]×, I], g = Σ k_i J_iᵀ r_i and H = Σ k_i J_iᵀ J_i, that is

    ξ = −U diag((1 − e^{−λ dt})/λ) Uᵀ g,      H = U diag(λ) Uᵀ,

one Gauss–Newton step for dt → ∞, and down the same L as the paper's Δ dt for dt → 0. The landmarks
close the share 1 − e^{−(l/k) dt} of what remains. See docs/theory.md, Discrete time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.flat_arrays import Limits, Observed, Seen
from slam_observer_ros.filter.gains import Gains, room_for
from slam_observer_ros.filter.observer import lyapunov
from slam_observer_ros.filter.step import located
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes, SPATIAL
from slam_observer_ros.models.calibration import SENSOR_STDDEVS, VELOCITY_STDDEVS
from slam_observer_ros.models.point_noise import PointFigures

PAPER_METRIC = np.array([0.5, 0.5, 0.5, 1.0, 1.0, 1.0])
"""Diagonal M of Δ = −M g that the projection (10) implies: it halves the skew part."""


class ConstantGains(Gains):
    """Constant gains k (30) and l (31), the same for every landmark.

    The ``step_mode`` 'paper' turns about the reference's origin with the metric of (10), and so
    converges to the paper's equation (:func:`.innovation`) for dt → 0; 'exponential' turns
    about the centroid of the e_i, where rotation and translation do not compete. In
    ``two_d_mode`` all turns are about z.
    """

    ignores = (
        *VELOCITY_STDDEVS,
        *SENSOR_STDDEVS,
        'motion_noise_factor',
        'calibration_drift',
        'landmark_velocity_stddev',
        'observation_correlation_time',
        'use_tag_orientation',
        'orientation_noise',
    )

    def observe(
        self, seen: Seen, figures: PointFigures, limits: Limits, is_judged: bool
    ) -> Observed:
        """Move the state by the innovation (28)–(31) of all that is seen: nothing is rejected."""
        known, out = seen.rows >= 0, room_for(seen, 0, is_judged)
        out.points[:], out.origins[:], _ = located(seen, self.axes.is_planar)
        rows, landmarks = seen.rows[known], self.observer.landmarks
        out.r[:], out.weights[:] = 0.0, known
        if len(rows):
            dt_s = landmarks.unseen_s(rows, seen.stamp_ns)
            out.r[known] = self.correct(rows, out.points[known], dt_s)
            landmarks.accept(rows, seen.stamp_ns)
        return out

    def correct(self, rows: IntArray, points: FloatArray, dt_s: FloatArray) -> FloatArray:
        """Integrate the innovation (30), (31) over the times since landmarks were seen before.

        Of landmarks ``rows`` (m,) seen at ``points`` (m, 3), body frame, ``dt_s`` (m,) before.
        Return their residuals (m, 3) until then.
        """
        # The gains, and how long they act.
        tuning, (e, r) = self._tuning, self.observer.errors(rows, points)
        gain_l = 0.0 if self.observer.is_exact else tuning.gain_l
        k = np.full(len(r), tuning.gain_k)
        step = paper_step if tuning.step_mode == 'paper' else centroid_step
        dt_s = np.minimum(dt_s, tuning.max_innovation_time)
        # One time for the pose: were the r_i to act for different ones, L (34) might grow.
        D = safe_step(partial(step, axes=self.axes), k, e, r, float(np.mean(dt_s)))  # (30)
        # What the pose's step leaves of each residual is closed in part by its landmark.
        remaining = se3.transform(D, e) - e + r
        shares = -np.expm1(-gain_l / tuning.gain_k * dt_s)
        d = shares[:, None] * remaining  # (31) but for Δ â_i, which moving by D brings with it
        self.observer.correct(D, rows, d)
        return r

    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Put the known landmarks where they are known to be."""
        self.observer.correct(np.eye(4), rows, -r)


def centroid_step(
    k: FloatArray, e: FloatArray, r: FloatArray, dt_s: float, axes: EstimatedAxes = SPATIAL
) -> FloatArray:
    """Return the pose's step D (4, 4), turning about the gain-weighted centroid of the e_i."""
    total = np.sum(k)
    centre = k @ e / total if total > 0.0 else np.zeros(3)
    return _step_about(centre, np.ones(6), k, e, r, dt_s, axes)


def paper_step(
    k: FloatArray, e: FloatArray, r: FloatArray, dt_s: float, axes: EstimatedAxes = SPATIAL
) -> FloatArray:
    """Return the pose's step D (4, 4) that tends to exp(Δ dt), Δ as in (30), for dt → 0."""
    return _step_about(np.zeros(3), PAPER_METRIC, k, e, r, dt_s, axes)


def safe_step(
    step: Callable[[FloatArray, FloatArray, FloatArray, float], FloatArray],
    k: FloatArray,
    e: FloatArray,
    r: FloatArray,
    dt_s: float,
) -> FloatArray:
    """Return ``step``'s D for the longest dt / 2^j at which L does not grow."""
    # The flow itself never raises L (35), so a short enough step does not either: only large turns
    # of few landmarks ever need j > 0.
    rounding = np.finfo(float).eps * (np.max(np.abs(e), initial=0.0) + 1.0)
    bound = lyapunov(k, r) * (1.0 + 1e-12) + lyapunov(k, np.full_like(r, rounding))
    D = step(k, e, r, dt_s)
    while lyapunov(k, se3.transform(D, e) - e + r) > bound:
        dt_s /= 2.0
        D = step(k, e, r, dt_s)
    return D


def _step_about(
    centre: FloatArray,
    metric: FloatArray,
    k: FloatArray,
    e: FloatArray,
    r: FloatArray,
    dt_s: float,
    axes: EstimatedAxes,
) -> FloatArray:
    """Return the exponential step D (4, 4) about ``centre`` with the diagonal ``metric``."""
    # Gradient and Gauss–Newton matrix, in the coordinates in which the metric is I.
    J = axes.output_matrix(e - centre)
    root, r = np.sqrt(metric[axes.pose]), r[:, : axes.point]
    g = root * np.einsum('i,ijk,ij->k', k, J, r)
    H = root[:, None] * np.einsum('i,ijk,ijl->kl', k, J, J) * root
    # The flow along each eigenvector for dt, as a turn about the centre.
    rates, U = np.linalg.eigh(H)
    # (1 − e^{−λ dt})/λ, and its limit dt at λ = 0
    positive = np.maximum(rates, np.finfo(float).tiny)
    held_s = np.where(rates > 0.0, -np.expm1(-positive * dt_s) / positive, dt_s)
    xi = axes.full_pose(-root * (U @ (held_s * (U.T @ g))))
    R = so3.exp(xi[:3])
    return se3.pose(R, centre - R @ centre + xi[3:])
