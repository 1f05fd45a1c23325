"""Small matrices, of which a filter handles several at each observation."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgesv

from slam_observer_ros.geometry import so3
from slam_observer_ros.types import FloatArray


def solve(S: FloatArray, right: FloatArray) -> FloatArray:
    """Return S⁻¹ b for S (q, q) and b (q, …), as `numpy.linalg.solve` does at twice the cost.

    Raises
    ------
    LinAlgError
        If S is singular.

    """
    if not right.size:  # which SciPy does not take
        return right
    _, _, solution, is_singular = dgesv(S, right)
    if is_singular:
        raise np.linalg.LinAlgError('Singular matrix')
    return np.asarray(solution, dtype=np.float64)


def symmetric(P: FloatArray) -> FloatArray:
    """Return P (…, q, q) without the skew part that rounding has left in it."""
    half: FloatArray = 0.5 * (P + so3.transpose(P))
    return half
