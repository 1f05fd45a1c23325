"""How well known points tell where a whole estimate lies: the gauge of SLAM.

Pose and landmarks of an estimate may be moved together by any rigid motion exp(γ) without
changing what is observed. Where some of its landmarks are also known in another frame, with

    r = J γ + ã,        ã ~ N(0, S),

r being the differences and S the covariance of estimate and known points together, γ follows by
generalised least squares, with no guess about γ beforehand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.types import FloatArray


@dataclass(frozen=True, slots=True)
class GaugeFit:
    """The best γ and how sure it is.

    Attributes
    ----------
    gamma : FloatArray
        (d,) rotation vector and translation, as the columns of J have them.
    covariance : FloatArray
        (d, d) covariance of ``gamma``.
    misfit : float
        ãᵀ S⁻¹ ã of what is left; χ² distributed with q − d degrees of freedom.

    """

    gamma: FloatArray
    covariance: FloatArray
    misfit: float


def fit_gauge(J: FloatArray, S: FloatArray, r: FloatArray) -> GaugeFit:
    """Fit γ to differences ``r`` (q,) with Jacobian ``J`` (q, d) and covariance ``S`` (q, q)."""
    whitener = np.linalg.cholesky(S)
    J_white, r_white = np.linalg.solve(whitener, J), np.linalg.solve(whitener, r)
    information = J_white.T @ J_white
    covariance = np.linalg.pinv(information, hermitian=True)
    gamma = covariance @ (J_white.T @ r_white)
    left = r_white - J_white @ gamma
    return GaugeFit(gamma, np.asarray(covariance, dtype=np.float64), float(left @ left))
