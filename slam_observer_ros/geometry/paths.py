"""Poses one after another: along held velocities, and between two that are known."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.geometry.matrices import transpose


def path(start: FloatArray, twists: FloatArray) -> FloatArray:
    """Return A, A exp(ξ_1), A exp(ξ_1) exp(ξ_2), … along k held velocities, exactly.

    Parameters
    ----------
    start : FloatArray, shape (4, 4)
        Pose A.
    twists : FloatArray, shape (k, 6)
        ξ_i = V_i dt_i, body frame, rad and m.

    Returns
    -------
    FloatArray, shape (k + 1, 4, 4)
        Poses before, between and after the k motions.

    """
    poses = np.concatenate([start[None], se3.exp(twists)])
    reach = 1
    while reach < len(poses):  # log k products of stacks cost less than k of matrices
        poses[reach:] = poses[:-reach] @ poses[reach:]
        reach *= 2
    return poses


def at_poses(pieces: FloatArray) -> FloatArray:
    """Return what belongs to k pieces of a path (k, …) as shares (k + 1, …) of its poses.

    Half of it at either end, so that Σ Ad_A (share) over the poses is that over the pieces by the
    trapezoidal rule.
    """
    shares = np.zeros((len(pieces) + 1, *pieces.shape[1:]))
    shares[:-1] = 0.5 * pieces
    shares[1:] += 0.5 * pieces
    return shares


def summed_noise(Ad: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return ∫ Ad_A Q Ad_Aᵀ along a path (p, p), by the trapezoidal rule.

    Parameters
    ----------
    Ad : FloatArray, shape (k + 1, p, 6)
        Rows of Ad_A at the poses before, between and after k motions.
    covariances : FloatArray, shape (k, 6, 6)
        Covariances Q of the motions, body frame, rad² and m².

    """
    noise: FloatArray = (Ad @ at_poses(covariances) @ transpose(Ad)).sum(axis=0)
    return noise


def interpolate(start: FloatArray, end: FloatArray, share: FloatArray | float) -> FloatArray:
    """Return poses between two: position in a line, rotation about one axis, as tf2 does.

    Parameters
    ----------
    start, end : FloatArray, shape (..., 4, 4)
        The two poses.
    share : FloatArray or float, shape (...)
        How far on the way, from 0 to 1.

    Returns
    -------
    FloatArray, shape (..., 4, 4)
        Poses.

    """
    R, share = start[..., :3, :3], np.asarray(share)[..., None]
    turn = so3.log(transpose(R) @ end[..., :3, :3])
    shift = end[..., :3, 3] - start[..., :3, 3]
    return se3.pose(R @ so3.exp(share * turn), start[..., :3, 3] + share * shift)
