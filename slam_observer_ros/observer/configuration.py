"""The Cartesian errors of the map as the robot sees it; the filter's are half turned.

With the attitude error w = ε_Ω and d_i = ξ_i − ε_v, which are normal in the filter's coordinates,
a landmark is seen wrongly by R̂ᵀ J(w) d_i, J the left Jacobian of SO(3), exactly. Where
w is not small this error is bent like a banana, and has another covariance than d_i.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.matrices import transpose

SMALL_RAD = 0.05
"""Standard deviation of the attitude below which the covariance of d_i serves."""

_NODES = np.sqrt(3.0) * np.array([-1.0, 0.0, 1.0])
_WEIGHTS = np.array([1.0, 4.0, 1.0]) / 6.0
"""Of Gauss and Hermite: right for polynomials of w up to the fifth degree."""


def turned_moment(
    covariance: FloatArray, with_turns: FloatArray, of_turns: FloatArray
) -> FloatArray:
    """Return the second moment (m k, m k) of J(w) d_i, of the best Gaussian around the estimate.

    From the covariances (m k, m k) of d_i, (m k, q) of d_i with w, and (q, q) of w.
    """
    q = len(of_turns)
    if not of_turns.trace() >= q * SMALL_RAD**2:  # or unknown
        return covariance
    k = 3 if q == 3 else 2
    scales, axes = np.linalg.eigh(of_turns)
    root = axes * np.sqrt(np.maximum(scales, 0.0))
    # d_i = G z + a part that is independent of z, w = root z, z of unit variance.
    G = with_turns @ np.linalg.pinv(root).T
    others = (covariance - G @ G.T).reshape(-1, k, len(covariance))
    moment = np.zeros_like(covariance)
    for z, weight in zip(product(_NODES, repeat=q), product(_WEIGHTS, repeat=q), strict=True):
        w = np.zeros(3)
        w[3 - q :] = root @ z
        J = so3.left_jacobian(w)[:k, :k]
        turned = (J @ others).reshape(covariance.shape)  # rows, then columns
        turned = (J @ transpose(turned).reshape(others.shape)).reshape(covariance.shape)
        mean = ((G @ z).reshape(-1, k) @ J.T).ravel()
        moment += np.prod(weight) * (turned + np.outer(mean, mean))
    return moment
