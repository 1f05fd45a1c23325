"""The paper's innovation (28)–(31) in continuous time: what the constant gains integrate.

Tests hold :mod:`slam_observer_ros.observer.constant` against it.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3


def paper_innovation(
    gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the paper's innovation (Δ, δ_i) in continuous time, with the signs put right.

    As printed, (30) lacks a minus and (31) has one too many: with the printed signs L grows. The
    signs here follow from ė_i = Δ e_i + Δ â_i − δ_i, for which (35) holds.

    Parameters
    ----------
    gain_k, gain_l : FloatArray
        (m,) gains k_i and l_i.
    e, r : FloatArray
        (m, 3) errors (29) and residuals, metres.
    a : FloatArray
        (m, 3) â_i, metres.

    Returns
    -------
    Delta : FloatArray
        (4, 4) Δ ∈ se(3).
    delta : FloatArray
        (m, 3) δ_i, m/s.

    """
    Delta = -se3.project(_outer_sum(gain_k, e, r))  # (30)
    delta = a @ Delta[:3, :3].T + (gain_l / gain_k)[:, None] * r  # (31)
    return Delta, delta


def lyapunov_rate(gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray) -> float:
    """Return dL/dt under the paper's innovation: −‖P(Σ k_i r_i ē_iᵀ)‖² − Σ l_i |r_i|² (35).

    Parameters are those of :func:`paper_innovation`.
    """
    projection = se3.project(_outer_sum(gain_k, e, r))
    return float(-np.sum(projection**2) - np.sum(gain_l * np.sum(r * r, axis=-1)))


def _outer_sum(k: FloatArray, e: FloatArray, r: FloatArray) -> FloatArray:
    """Return Σ k_i r_i ē_iᵀ (4, 4), with r_i a direction and ē_i = (e_i, 1) a point."""
    M = np.zeros((4, 4))
    M[:3, :3] = np.einsum('i,ij,ik->jk', k, r, e)
    M[:3, 3] = k @ r
    return M
