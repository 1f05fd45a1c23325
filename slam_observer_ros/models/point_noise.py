"""Noise of points: covariances (m, 3, 3), m², by figures or as stated, and errors that last."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie.matrices import limited

# Standard deviation that each coordinate of an observed point has at least. A smaller one is lost
# in rounding beside a pose that may be off by a kilometre.
RESOLUTION_M = 1e-4
RELATIVE_RESOLUTION = 1e-6  # the same as a share of the distance, for single precision or better
MAX_ERROR_M = 1e3  # standard deviation of a point beyond which a message only says 'unknown'

# Least variance of an observed point in any direction, as a share of its total variance. But no
# more than (1 mm)², as of a bearing whose depth may be anywhere within a kilometre.
MIN_SHARE, MOST_SHARE_M2 = 1e-6, 1e-6
MIN_INTERVAL_S = 1e-3  # observations that are less apart count so: two cameras may see at once
_TINY = np.finfo(np.float64).tiny
_IDENTITY = np.eye(3)


class PointFigures(NamedTuple):
    """How far points may be off: variances along and across the line of sight of length r, m²."""

    along_0: float
    along_2: float  # times r²
    along_4: float  # times r⁴
    across_0: float
    across_2: float  # times r²


def stated_covariances(
    points: FloatArray, stated: FloatArray, lines_of_sight: FloatArray, figures: PointFigures
) -> FloatArray:
    """Return covariances (m, 3, 3) of ``points`` as stated, or by the figures where unknown."""
    # Else far points that are said to be exact are lost beside an uncertain heading.
    least = RELATIVE_RESOLUTION**2 * np.einsum('ij,ij->i', points, points)
    covariances: FloatArray = limited(stated, np.full(3, MAX_ERROR_M))
    covariances = covariances + least[:, None, None] * _IDENTITY
    # No direction is known exactly.
    shares = MIN_SHARE * covariances.trace(axis1=1, axis2=2)
    least = RESOLUTION_M**2 + np.minimum(shares, MOST_SHARE_M2)
    covariances = covariances + least[:, None, None] * _IDENTITY
    unknown = ~stated.any(axis=(1, 2))
    if unknown.any():
        covariances[unknown] = point_covariances(lines_of_sight[unknown], figures)
    return covariances


def repetition_factors(dt_s: FloatArray, error_time_s: float) -> FloatArray:
    """Return by what factors (m,) the variances of observations grow if their errors last.

    An error with the correlation time t_e is c = e^(−dt/t_e) times what it was ``dt_s`` (m,)
    before, or infinitely long ago, plus new noise. n observations of one thing then weigh as much
    as one, and n − 1 whose variance is (1 + c)/(1 − c) times as large: exactly so if they come at
    a steady rate. With t_e = 0 all errors are new.
    """
    if error_time_s == 0.0:
        return np.ones(len(dt_s))
    new = -np.expm1(-np.maximum(dt_s, MIN_INTERVAL_S) / error_time_s)  # 1 − c
    return (2.0 - new) / new


def point_covariances(lines_of_sight: FloatArray, figures: PointFigures) -> FloatArray:
    """Return covariances (m, 3, 3) of points along ``lines_of_sight`` (m, 3), invertible.

    A point at the sensor itself has no line of sight; it is known as well as its range is.
    """
    squared, most = np.einsum('ij,ij->i', lines_of_sight, lines_of_sight), MAX_ERROR_M**2
    along = figures.along_0 + (figures.along_2 + figures.along_4 * squared) * squared
    along = np.minimum(along, most)
    across = np.minimum(figures.across_0 + figures.across_2 * squared, most)
    if np.count_nonzero(squared) < len(squared):
        across = np.where(squared > 0.0, across, along)
    excess = (along - across) / np.maximum(squared, _TINY)
    scaled = excess[:, None] * lines_of_sight
    covariances: FloatArray = scaled[:, :, None] * lines_of_sight[:, None, :]
    # As of stated ones, but with the trace that is known.
    shares = MIN_SHARE * (along + 2.0 * across)
    least = RESOLUTION_M**2 + np.minimum(shares, MOST_SHARE_M2)
    covariances += (across + least)[:, None, None] * _IDENTITY
    return covariances
