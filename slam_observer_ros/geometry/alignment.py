"""Rigid alignment of point sets in closed form (Umeyama 1991, without scale)."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3

_RANK_TOLERANCE = 1e-12
"""Singular values (m²) below this part of the largest carry no direction, only rounding."""

_ROUNDING = 1e-14
"""Offsets from the mean below this part of the largest coordinate are rounding."""


def rigid_alignment(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """Return T (4, 4) with target ≈ T source in least squares, for points (n, 3), n ≥ 1, metres.

    A proper rotation even where a reflection would fit better. What the points leave open stays
    as it is: of all best rotations the one nearest to the identity is returned, so collinear
    points cause no roll about their line, and one point is only shifted. Sets that are both flat
    in z turn about the vertical only, as turned over they would be their own mirror images.
    ``weights`` (n,) > 0 say how much each squared distance counts; all the same by default.
    """
    weights = np.ones(len(source)) if weights is None else weights
    source_centre = np.average(source, axis=0, weights=weights)
    target_centre = np.average(target, axis=0, weights=weights)
    offsets = _offsets(source, source_centre)
    correlation = (weights[:, None] * _offsets(target, target_centre)).T @ offsets
    R = _closest_rotation(correlation)
    return se3.pose(R, target_centre - R @ source_centre)


def _offsets(points: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the offsets from the mean; what is only rounding becomes zero, lest it turn R."""
    offsets = points - centre
    return np.where(np.abs(offsets) > _ROUNDING * np.abs(points).max(), offsets, 0.0)


def _closest_rotation(correlation: FloatArray) -> FloatArray:
    """Maximise tr(Rᵀ C) over rotations R; among equals, take the one nearest to the identity."""
    if not (correlation[2].any() or correlation[:, 2].any()):  # both sets are flat in z
        rotation = np.eye(3)
        rotation[:2, :2] = _procrustes(correlation[:2, :2], handedness=1.0)
        return rotation
    U, sizes, Vt = np.linalg.svd(correlation)
    rank = int(np.sum(sizes > _RANK_TOLERANCE * sizes[0]))
    # R = U diag(1, Q) Vᵀ is optimal for each orthogonal Q that makes det R = 1: one sign where
    # the points span a plane or more, a whole circle of choices about a line.
    fixed = min(rank, 2)
    middle = np.eye(3)
    middle[fixed:, fixed:] = _procrustes(
        (Vt @ U)[fixed:, fixed:].T, handedness=np.linalg.det(U) * np.linalg.det(Vt)
    )
    return np.asarray(U @ middle @ Vt)


def _procrustes(matrix: FloatArray, handedness: float) -> FloatArray:
    """Maximise tr(Qᵀ M) over orthogonal Q whose determinant has the sign of ``handedness``."""
    U, _, Vt = np.linalg.svd(matrix)
    U[:, -1] *= np.sign(handedness * np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(U @ Vt)
