"""Rigid alignment of point sets: the gauge of SLAM, fixed for comparison with the truth."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.evaluation.errors import EvaluationError
from slam_observer_ros.types import FloatArray

_RANK_TOLERANCE = 1e-12
"""Singular values (m²) below this part of the largest carry no direction, only rounding."""

_ROUNDING = 1e-14
"""Offsets from the mean below this part of the largest coordinate are rounding."""


def align(source: FloatArray, target: FloatArray) -> FloatArray:
    """Find the rigid motion that brings ``source`` closest to ``target`` in least squares.

    Umeyama (1991) without scale: a proper rotation even where a reflection would fit better.
    What the points leave open stays as it is: of all best rotations the one nearest to the
    identity is returned, so collinear points cause no roll about their line, one point is
    only shifted, and no point at all gives the identity. Sets that are both flat in z turn about
    the vertical only, as turned over they would be their own mirror images.

    Parameters
    ----------
    source : FloatArray
        (n, 3) points to be moved, metres.
    target : FloatArray
        (n, 3) points to be met, in the same order, metres.

    Returns
    -------
    FloatArray
        (4, 4) transform T with ``target ≈ T source``.

    Raises
    ------
    EvaluationError
        The shapes aren't (n, 3) and equal, or a coordinate isn't finite.

    """
    _check_points(source, target)
    transform = np.eye(4)
    if len(source) == 0:
        return transform
    correlation = _centred(target).T @ _centred(source)
    transform[:3, :3] = _closest_rotation(correlation)
    transform[:3, 3] = target.mean(axis=0) - transform[:3, :3] @ source.mean(axis=0)
    return transform


def _check_points(source: FloatArray, target: FloatArray) -> None:
    if source.shape != target.shape or source.shape[1:] != (3,):
        raise EvaluationError(
            f'alignment needs two (n, 3) arrays, not {source.shape} and {target.shape}'
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise EvaluationError('alignment needs finite points')


def _centred(points: FloatArray) -> FloatArray:
    """Subtract the mean; offsets that are only its rounding become zero, lest they turn R."""
    offsets = points - points.mean(axis=0)
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
