"""Rigid alignment of point sets: the gauge of SLAM, fixed for comparison with the truth."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.evaluation.errors import EvaluationError
from slam_observer_ros.geometry.alignment import rigid_alignment
from slam_observer_ros.types import FloatArray


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
    if len(source) == 0:
        return np.eye(4)
    return rigid_alignment(source, target, np.ones(len(source)))


def _check_points(source: FloatArray, target: FloatArray) -> None:
    if source.shape != target.shape or source.shape[1:] != (3,):
        raise EvaluationError(
            f'alignment needs two (n, 3) arrays, not {source.shape} and {target.shape}'
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise EvaluationError('alignment needs finite points')
