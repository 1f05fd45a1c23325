"""Covariances as users know them, in the world or as seen from the robot.

They are made of those of the error ε of Â = exp(ε) A and the errors ã_i of the landmarks, in the
reference frame.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import limited, transpose
from slam_observer_ros.observer.configuration import turned_moment
from slam_observer_ros.observer.observer import Observer

MAX_POSE_ERRORS = np.repeat([np.pi, 1e3], 3)
"""Standard deviations of a given pose, rad and m, beyond which it is only 'unknown'."""


def of_landmarks(observer: Observer, covariances: FloatArray) -> FloatArray:
    """Return those of landmarks along the world's axes, given ``covariances`` of ã_i (n, 3, 3)."""
    R = observer.reference_pose[:3, :3]
    world: FloatArray = R @ covariances @ R.T
    return world


def of_configuration(
    observer: Observer, axes: EstimatedAxes, rows: IntArray, P: FloatArray
) -> FloatArray:
    """Return that of landmarks (m k, m k) as seen from the robot; ``P`` is of ε and ã_i."""
    # Along the axes of the body: the choice of the world's frame has no part in it.
    m, k, p = len(rows), axes.point, axes.p
    C = axes.output_matrix(observer.points[rows]).reshape(-1, p)
    CP = C @ P[:p] - P[p:]
    seen_covariance = CP[:, :p] @ C.T - CP[:, p:]
    turns = slice(p - k)
    seen_covariance = turned_moment(seen_covariance, CP[:, turns], P[turns, turns])
    blocks = seen_covariance.reshape(m, k, m, k).swapaxes(1, 2)
    R = observer.A[:k, :k]
    seen: FloatArray = (R.T @ blocks @ R).swapaxes(1, 2).reshape(m * k, m * k)
    return seen


def of_pose(observer: Observer, covariance: FloatArray, A: FloatArray) -> FloatArray:
    """Return the pose's covariance (…, 6, 6) at Â = ``A`` (…, 4, 4), given that of ε (…, 6, 6).

    Of its rotation vector and its position along the world's axes, rad² and m².
    """
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
