"""How landmarks that are known in another frame determine where a whole estimate lies in it.

A rigid motion exp(γ) of pose and landmarks together changes no observation: it is the gauge of
SLAM. Seen from another frame, with γ unknown, the error of an estimate is x + G γ, where
x ~ N(0, P) as before. Landmarks known there, up to noise of covariance R, differ by
r = H (x + G γ) + noise. With S = H P Hᵀ + R and J = H G, generalised least squares give
γ = Λ Jᵀ S⁻¹ r with Λ = (Jᵀ S⁻¹ J)⁻¹, and a Kalman filter gives x from the rest of r. So no large
number has to stand for 'unknown'.
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

    The module's docstring explains ``P`` (N, N), ``G`` (N, d), ``PH`` = P Hᵀ (N, q), ``S`` (q, q)
    and ``J`` (q, d); ``r`` (q,) is the estimate minus the known coordinates.
    """
    S = S + JITTER_M2 * np.eye(len(r))
    # γ by generalised least squares, then a Kalman filter's gain for the rest.
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
