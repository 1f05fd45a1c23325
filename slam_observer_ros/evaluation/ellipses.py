"""Ellipses of confidence in a plane of the map."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray

CHI_SQUARE_95 = 5.991464547107979
"""Squared half-axis, in standard deviations, of the ellipse that holds 95 % in a plane."""

_CORNERS = 37


def ellipses(covariances: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Return half-axes, metres, and the angle of the first one, rad: (n, 3) for 95 %.

    ``covariances`` (n, 3, 3), m², are projected on two of the world's axes.
    """
    in_plane = covariances[:, axes][:, :, axes]
    variances, directions = np.linalg.eigh(in_plane)
    half = np.sqrt(CHI_SQUARE_95 * np.maximum(variances[:, ::-1], 0.0))
    first = directions[:, :, 1]
    return np.column_stack([half, np.arctan2(first[:, 1], first[:, 0])])


def outlines(points: FloatArray, covariances: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Return the ellipses round points (n, 3) as one line (n · 38, 2), with a break after each."""
    half_a, half_b, angles = ellipses(covariances, axes).T[:, :, None]
    turn = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    a, b = half_a * np.cos(turn), half_b * np.sin(turn)
    offsets = np.stack(
        [
            a * np.cos(angles) - b * np.sin(angles),
            a * np.sin(angles) + b * np.cos(angles),
        ],
        axis=2,
    )
    closed = points[:, None, axes] + offsets
    return np.concatenate([closed, np.full((len(points), 1, 2), np.nan)], axis=1).reshape(-1, 2)
