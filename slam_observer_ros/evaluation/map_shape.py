"""How well the shape of a map is known, wherever the map lies in the world."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.matrices import diagonal_blocks

_ROUNDING = 1e-9
"""Singular values below this part of the largest are of motions that change no point."""


def shape_covariances(points: FloatArray, joint: FloatArray) -> FloatArray:
    """Return the covariance (n, 3, 3) of each landmark once the map is aligned with the true one.

    A rigid motion of the whole map is no error of its shape: what it explains is taken out of
    ``joint`` (n k, n k), the covariance of the first k coordinates of ``points`` (n, 3), in whose
    axes the result is; metres, m².
    """
    n, k = len(points), len(joint) // len(points)
    motions = _rigid_motions(points - points.mean(axis=0), k)
    # With the projector Π = I − M Mᵀ on what no motion explains, the blocks of Π joint Π.
    explained = joint @ motions
    rows, of_motions = explained.reshape(n, k, -1), motions.reshape(n, k, -1)
    crossed = rows @ of_motions.swapaxes(1, 2)
    both = of_motions @ (motions.T @ explained) @ of_motions.swapaxes(1, 2)
    covariances = np.zeros((n, 3, 3))
    covariances[:, :k, :k] = diagonal_blocks(joint, k) - crossed - crossed.swapaxes(1, 2) + both
    return covariances


def _rigid_motions(centred: FloatArray, k: int) -> FloatArray:
    """Return an orthonormal basis (n k, g) of what small rigid motions do to points (n, 3)."""
    shifts = np.broadcast_to(np.eye(k), (len(centred), k, k))
    turns = -so3.hat(centred)[:, :k, :] if k == 3 else -so3.hat(centred)[:, :2, 2:]
    motions = np.concatenate([shifts, turns], axis=2).reshape(len(centred) * k, -1)
    U, sizes, _ = np.linalg.svd(motions, full_matrices=False)
    return np.asarray(U[:, sizes > _ROUNDING * sizes[0]])
