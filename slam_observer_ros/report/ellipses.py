"""Ellipses of confidence in a plane of the map."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray

CHI_SQUARE_95 = 5.991464547107979
"""Squared half-axis, in standard deviations, of the ellipse that holds 95 % in a plane."""


def ellipses(covariances: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Return half-axes, metres, and the angle of the first one, rad: (n, 3) for 95 %.

    ``covariances`` (n, 3, 3), m², are projected on two of the world's axes.
    """
    in_plane = covariances[:, axes][:, :, axes]
    variances, directions = np.linalg.eigh(in_plane)
    half = np.sqrt(CHI_SQUARE_95 * np.maximum(variances[:, ::-1], 0.0))
    first = directions[:, :, 1]
    return np.column_stack([half, np.arctan2(first[:, 1], first[:, 0])])
