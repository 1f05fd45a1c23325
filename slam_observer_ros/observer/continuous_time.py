"""The paper's innovation (28)–(31) in continuous time, and the Lyapunov function that it lowers.

Tests hold gains against it; what moves a robot are the gains themselves, of constant.py (the same
in steps of any length) and riccati/ (by a covariance).

Signs are put right: as printed, (30) has no minus and (31) has one too many, and L grows. They
follow from ė_i = Δ e_i + Δ â_i − δ_i, for which (35) holds. Gains k_i, l_i are (m,), errors e_i,
residuals r_i and translations â_i (m, 3) in metres, in the reference frame.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3


def innovation(
    gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (Δ, δ_i): Δ (4, 4) in se(3) moves the pose, δ_i (m, 3) in m/s the landmarks."""
    Delta = -se3.project(_outer_sum(gain_k, e, r))  # (30)
    delta = a @ Delta[:3, :3].T + (gain_l / gain_k)[:, None] * r  # (31)
    return Delta, delta


def lyapunov(gain_k: FloatArray | float, r: FloatArray) -> float:
    """Return L = Σ k_i/2 |r_i|² (34)."""
    return float(0.5 * np.vdot(gain_k * r.T, r.T))


def lyapunov_rate(gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray) -> float:
    """Return dL/dt = −‖P(Σ k_i r_i ē_iᵀ)‖² − Σ l_i |r_i|² under the innovation (35)."""
    projection = se3.project(_outer_sum(gain_k, e, r))
    return float(-np.sum(projection**2) - np.sum(gain_l * np.sum(r * r, axis=-1)))


def _outer_sum(k: FloatArray, e: FloatArray, r: FloatArray) -> FloatArray:
    """Return Σ k_i r_i ē_iᵀ (4, 4), with r_i a direction and ē_i = (e_i, 1) a point."""
    M = np.zeros((4, 4))
    M[:3, :3] = np.einsum('i,ij,ik->jk', k, r, e)
    M[:3, 3] = k @ r
    return M
