"""Covariances as users know them, in the world or as seen from the robot, from the filter's.

The filter knows the error ε of Â = exp(ε) A and the errors ã_i of the landmarks, in the reference
frame. Functions return None where it knows none.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.matrices import limited, transpose
from slam_observer_ros.observer.observer import Observer

MAX_POSE_ERRORS = np.repeat([np.pi, 1e3], 3)
"""Standard deviations of a given pose, rad and m, beyond which it is only 'unknown'."""


def of_landmarks(observer: Observer, covariances: FloatArray | None) -> FloatArray | None:
    """Return those of landmarks along the world's axes, given ``covariances`` of ã_i (n, 3, 3)."""
    if covariances is None:
        return None
    R = observer.reference_pose[:3, :3]
    world: FloatArray = R @ covariances @ R.T
    return world


def of_pose(observer: Observer, covariance: FloatArray | None, A: FloatArray) -> FloatArray | None:
    """Return the pose's covariance (…, 6, 6) at Â = ``A`` (…, 4, 4), given that of ε (…, 6, 6).

    Of its rotation vector and its position along the world's axes, rad² and m².
    """
    if covariance is None:
        return None
    turn = _turn_to_world(observer, A)
    world: FloatArray = turn @ covariance @ transpose(turn)
    return world


def of_pose_error(observer: Observer, world: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of ε from :func:`of_pose`'s, limited to MAX_POSE_ERRORS."""
    back = np.linalg.inv(_turn_to_world(observer, observer.A))
    covariance: FloatArray = back @ limited(world, MAX_POSE_ERRORS) @ back.T
    return covariance


def of_moved_pose(
    world: FloatArray, pose: FloatArray, motion: FloatArray, noise: FloatArray
) -> FloatArray:
    """Return the covariance (6, 6) of ``pose`` @ ``motion`` (4, 4), given ``world``, the pose's.

    Both are :func:`of_pose`'s; ``noise`` (6, 6) is that of w in exp(w) ``motion``, along the
    pose's axes.
    """
    R = pose[:3, :3]
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    lever = np.eye(6)
    lever[3:, :3] = -so3.hat(R @ motion[:3, 3])
    moved: FloatArray = lever @ (world + turn @ noise @ turn.T) @ lever.T
    return moved


def _turn_to_world(observer: Observer, A: FloatArray) -> FloatArray:
    """Return the matrix (…, 6, 6) from ε to rotation and shift of the pose along world axes."""
    R = observer.reference_pose[:3, :3]
    turn = np.zeros((*A.shape[:-2], 6, 6))
    turn[..., :3, :3] = turn[..., 3:, 3:] = R
    turn[..., 3:, :3] = -R @ so3.hat(A[..., :3, 3])
    return turn
