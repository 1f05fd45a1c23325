"""Covariances as users know them, in the world or as seen from the robot.

They follow from covariances of the error ε of Â = exp(ε) A and the errors ã_i of landmarks, in the
reference frame.

Seen from the robot these errors are half turned: with the attitude error w = ε_Ω and
d_i = ξ_i − ε_v, which are normal in the filter's coordinates, a landmark is seen wrongly by
R̂ᵀ J(w) d_i, J the left Jacobian of SO(3), exactly. Where w is not small that is bent like a
banana, and has another covariance than d_i.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.observer import Observer
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import limited, mended, transpose

MAX_POSE_ERRORS = np.repeat([np.pi, 1e3], 3)
"""Standard deviations of a given pose, rad and m, beyond which it is only 'unknown'."""


def of_landmarks(observer: Observer, covariances: FloatArray) -> FloatArray:
    """Return covariances of landmarks along the world's axes, given ã_i's (n, 3, 3)."""
    R = observer.reference_pose[:3, :3]
    world: FloatArray = R @ covariances @ R.T
    return world


def of_configuration(
    observer: Observer, axes: EstimatedAxes, rows: IntArray, P: FloatArray
) -> FloatArray:
    """Return the covariance (m k, m k) of landmarks seen from the robot; ``P`` is of ε and ã_i."""
    # Along the axes of the body: the choice of the world's frame has no part in it.
    m, k, p = len(rows), axes.point, axes.p
    C = axes.output_matrix(observer.points[rows]).reshape(-1, p)
    CP = C @ P[:p] - P[p:]
    seen_covariance = CP[:, :p] @ C.T - CP[:, p:]
    turns = slice(p - k)
    seen_covariance = turned_moment(seen_covariance, CP[:, turns], P[turns, turns])
    blocks = seen_covariance.reshape(m, k, m, k).swapaxes(1, 2)
    R = observer.A[:k, :k]
    return mended((R.T @ blocks @ R).swapaxes(1, 2).reshape(m * k, m * k))


def of_pose(observer: Observer, covariance: FloatArray, A: FloatArray) -> FloatArray:
    """Return the pose's covariance (…, 6, 6) at Â = ``A`` (…, 4, 4), given ε's (…, 6, 6).

    Of its rotation vector and its position along the world's axes, rad² and m².
    """
    turn = turn_to_world(observer, A)
    return mended(turn @ covariance @ transpose(turn))


def of_pose_error(observer: Observer, world: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of ε from :func:`of_pose`'s, limited to MAX_POSE_ERRORS."""
    back = np.linalg.inv(turn_to_world(observer, observer.A))
    covariance: FloatArray = back @ limited(world, MAX_POSE_ERRORS) @ back.T
    return covariance


def of_moved_pose(
    world: FloatArray, pose: FloatArray, motion: FloatArray, noise: FloatArray
) -> FloatArray:
    """Return the covariance (6, 6) of ``pose`` @ ``motion`` (4, 4), given ``world``, the pose's.

    Both are :func:`of_pose`'s; ``noise`` (6, 6) is w's in exp(w) ``motion``, along the
    pose's axes.
    """
    R = pose[:3, :3]
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    lever = np.eye(6)
    lever[3:, :3] = -so3.hat(R @ motion[:3, 3])
    moved: FloatArray = lever @ (world + turn @ noise @ turn.T) @ lever.T
    return moved


def turn_to_world(observer: Observer, A: FloatArray) -> FloatArray:
    """Return the matrix (…, 6, 6) from ε to rotation and shift of the pose along world axes."""
    R = observer.reference_pose[:3, :3]
    turn = np.zeros((*A.shape[:-2], 6, 6))
    turn[..., :3, :3] = turn[..., 3:, 3:] = R
    turn[..., 3:, :3] = -R @ so3.hat(A[..., :3, 3])
    return turn


SMALL_RAD = 0.05  # standard deviation of the attitude below which the covariance of d_i serves

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
    n = len(covariance)
    others = (covariance - G @ G.T).reshape(n // k, k, n)  # n may be 0
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
