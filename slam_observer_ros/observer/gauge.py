"""How landmarks that are known in another frame tell where a whole estimate lies in it.

Pose and landmarks of an estimate may be moved together by any rigid motion exp(γ) without
changing what is observed: that is the gauge of SLAM. If nothing is known of γ beforehand, the
error of an estimate, seen from the other frame, is x + G γ, with x ~ N(0, P) as before. Landmarks
known there, up to noise of covariance R, show the differences

    r = H (x + G γ) + noise,        S = H P Hᵀ + R,        J = H G.

Generalised least squares give γ = Λ Jᵀ S⁻¹ r with Λ = (Jᵀ S⁻¹ J)⁻¹, and then x follows as in a
Kalman filter from what γ leaves of r. No large number has to stand for 'unknown'.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry.matrices import symmetric

JITTER_M2 = 1e-12
"""Added to variances, so that S can be inverted where both sides are exact."""


def gauge_information(J: FloatArray, S: FloatArray) -> FloatArray:
    """Return Λ⁻¹ = Jᵀ S⁻¹ J (d, d), what landmarks say of γ, for J (q, d) and S (q, q)."""
    information: FloatArray = J.T @ _solve(S, J)
    return information


def anchor(
    P: FloatArray, G: FloatArray, PH: FloatArray, S: FloatArray, J: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Bring an estimate of unknown gauge to where known landmarks show it to be.

    Parameters
    ----------
    P : FloatArray
        (N, N) covariance of the error x.
    G : FloatArray
        (N, d) how x changes when the whole estimate is moved.
    PH, S, J : FloatArray
        (N, q) P Hᵀ, (q, q) H P Hᵀ + R and (q, d) H G, with H x the errors of the known
        landmarks' coordinates.
    r : FloatArray
        (q,) estimate minus known coordinates.

    Returns
    -------
    x : FloatArray
        (N,) error of the estimate, the gauge's included.
    P : FloatArray
        (N, N) its covariance now.

    """
    S = S + JITTER_M2 * np.eye(len(r))
    information = gauge_information(J, S)
    gamma = np.linalg.solve(information, J.T @ _solve(S, r))
    K = _solve(S, PH.T).T
    B = G - K @ J
    after = P - K @ PH.T + B @ np.linalg.solve(information, B.T)
    return G @ gamma + K @ (r - J @ gamma), symmetric(after)


def _solve(S: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(cho_solve(cho_factor(S), right), dtype=np.float64)
