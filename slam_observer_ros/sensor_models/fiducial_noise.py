"""How far the pose of a square tag may be off, as its corners in the image are.

With corners that err by σ px, a focal length f in px and an edge s, at the range r the mean of the
four gives the direction, σ/(2 f), and their spread the range, r² σ/(√2 f s). How the tag is turned
about its normal shows as well as its range; how it is tilted hardly, where it is seen frontally.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.settings.estimator_settings import Settings

_CORNERS = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
_TINY = np.finfo(np.float64).tiny
LEAST_RANGE = 1.0
"""Range, in edges of the tag, nearer than which no camera has all of it in view."""

LARGEST_RANGE = 1e6
"""Range, in edges of the tag, beyond which its corners are one point but for rounding."""

LEAST_NOISE = 1e-6
"""Noise of corners, in focal lengths, beside which less is lost in rounding."""


def orientation_covariances(Z: FloatArray, lines_of_sight: FloatArray, s: Settings) -> FloatArray:
    """Return the covariances (m, 3, 3) of tags' orientations, rad², of tags turned by ``Z``.

    That of least squares, (Jᵀ J)⁻¹ σ² of the corners' derivatives by the pose, without position.
    Of tags whose ``Z`` is zero nothing is known.
    """
    covariances = np.tile(np.pi**2 * np.eye(3), (len(Z), 1, 1))
    are_known = Z.any(axis=(1, 2))
    if are_known.any():
        covariances[are_known] = _of_known(Z[are_known], lines_of_sight[are_known], s)
    return covariances


def _of_known(Z: FloatArray, lines_of_sight: FloatArray, s: Settings) -> FloatArray:
    # The camera looks along the line of sight: its axes U, and the corners q in them.
    range_m = np.linalg.norm(lines_of_sight, axis=1)
    range_m = np.clip(range_m, LEAST_RANGE * s.tag_size, LARGEST_RANGE * s.tag_size)
    U = _looking_along(lines_of_sight)
    arms = s.tag_size * _CORNERS @ (U @ Z).swapaxes(-1, -2)  # (m, 4, 3)
    q = arms + range_m[:, None, None] * np.array([0.0, 0.0, 1.0])
    # f (x, y) / z, by turns and shifts of the tag: dq = dω × arm + dt.
    projected = np.zeros((*q.shape[:2], 2, 3))
    projected[..., 0, 0] = projected[..., 1, 1] = 1.0 / q[..., 2]
    projected[..., 2] = -q[..., :2] / q[..., 2:] ** 2
    J = np.concatenate([projected @ -so3.hat(arms), projected], axis=-1)
    J = s.focal_length * J.reshape(len(Z), 8, 6)
    # What turns are known by once the position is.
    N = J.swapaxes(-1, -2) @ J
    turns = N[:, :3, :3] - N[:, :3, 3:] @ np.linalg.solve(N[:, 3:, 3:], N[:, 3:, :3])
    noise = max(s.pixel_noise, LEAST_NOISE * s.focal_length)
    information = turns / noise**2 + np.eye(3) / np.pi**2  # nothing is off by more
    covariances: FloatArray = U.swapaxes(-1, -2) @ np.linalg.inv(information) @ U
    return covariances


def _looking_along(lines_of_sight: FloatArray) -> FloatArray:
    """Return rotations (m, 3, 3) to axes whose third one is along the line of sight."""
    third = lines_of_sight / np.maximum(
        np.linalg.norm(lines_of_sight, axis=1, keepdims=True), _TINY
    )
    third[~third.any(axis=1)] = (0.0, 0.0, 1.0)
    # Across the axis that it is furthest from.
    first = np.cross(np.eye(3)[np.abs(third).argmin(axis=1)], third)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=1)
