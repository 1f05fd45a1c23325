"""Poses one after another: along held velocities, and between two that are known."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3, so3


def path(start: FloatArray, twists: FloatArray) -> FloatArray:
    """Return A, A exp(ξ_1), A exp(ξ_1) exp(ξ_2), … (k + 1, 4, 4) from A = ``start`` on, exactly.

    The ``twists`` ξ_i = V_i dt_i (k, 6) are motions along held velocities, body frame.
    """
    poses = np.concatenate([start[None], se3.exp(twists)])
    reach = 1
    while reach < len(poses):  # log k products of stacks cost less than k of matrices
        poses[reach:] = poses[:-reach] @ poses[reach:]
        reach *= 2
    return poses


def at_poses(pieces: FloatArray) -> FloatArray:
    """Return what belongs to k pieces of a path (k, …) as shares (k + 1, …) of its poses.

    Half at either end: Σ Ad_A (share) over poses is that over pieces by the trapezoidal rule.
    """
    shares = np.zeros((len(pieces) + 1, *pieces.shape[1:]))
    shares[:-1] = 0.5 * pieces
    shares[1:] += 0.5 * pieces
    return shares


def summed_noise(Ad: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return ∫ Ad_A Q Ad_Aᵀ along a path (p, p), by the trapezoidal rule.

    From rows of Ad_A (k + 1, p, 6) at its poses, and Q (k, 6, 6) of its motions, body frame.
    """
    noise: FloatArray = (Ad @ at_poses(covariances) @ Ad.swapaxes(-1, -2)).sum(axis=0)
    return noise


def interpolate(start: FloatArray, end: FloatArray, share: FloatArray | float) -> FloatArray:
    """Return poses at a ``share`` (…), 0 to 1, of the way between two, as tf2 has them.

    Positions are in a line, rotations about one axis.
    """
    R, share = start[..., :3, :3], np.asarray(share)[..., None]
    turn = so3.log(R.swapaxes(-1, -2) @ end[..., :3, :3])
    shift = end[..., :3, 3] - start[..., :3, 3]
    return se3.pose(R @ so3.exp(share * turn), start[..., :3, 3] + share * shift)
