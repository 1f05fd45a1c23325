"""How landmarks that are known in another frame determine where a whole estimate lies in it.

Pose and landmarks may be moved together by any rigid motion exp(γ) without changing what is
observed: the gauge of SLAM. If nothing is known of γ beforehand, the error of an estimate, seen
from the other frame, is x + G γ, with x ~ N(0, P) as before. Landmarks known there, up to noise of
covariance R, differ by r = H (x + G γ) + noise. With S = H P Hᵀ + R and J = H G, generalised least
squares give γ = Λ Jᵀ S⁻¹ r, Λ = (Jᵀ S⁻¹ J)⁻¹, and x follows as in a Kalman filter from what γ
leaves of r. No large number has to stand for 'unknown'.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry.matrices import definite, symmetric

JITTER_M2 = 1e-12
"""Added to variances, so that S can be inverted where both sides are exact."""


def gauge_information(J: FloatArray, S: FloatArray) -> FloatArray:
    """Return Λ⁻¹ = Jᵀ S⁻¹ J (d, d), what landmarks say of γ, for J (q, d) and S (q, q)."""
    information: FloatArray = J.T @ _solve(S, J)
    return information


def anchor(
    P: FloatArray, G: FloatArray, PH: FloatArray, S: FloatArray, J: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the error x + G γ (N,) of an estimate, and the covariance (N, N) after it.

    ``P`` (N, N), ``G`` (N, d), ``PH`` = P Hᵀ (N, q), ``S`` (q, q), ``J`` (q, d) are those of the
    module's docstring, ``r`` (q,) is estimate minus known coordinates.
    """
    S = S + JITTER_M2 * np.eye(len(r))
    # γ by generalised least squares, then a Kalman filter's gain for what it leaves.
    information = gauge_information(J, S)
    gamma = np.linalg.solve(information, J.T @ _solve(S, r))
    K = _solve(S, PH.T).T
    # The error of γ adds to what remains of P.
    B = G - K @ J
    after = P - K @ PH.T + B @ np.linalg.solve(information, B.T)
    return G @ gamma + K @ (r - J @ gamma), symmetric(after)


def _solve(S: FloatArray, right: FloatArray) -> FloatArray:
    try:
        factor = cho_factor(S)
    except np.linalg.LinAlgError:
        factor = cho_factor(definite(S))
    return np.asarray(cho_solve(factor, right), dtype=np.float64)
