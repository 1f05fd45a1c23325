"""Noise of observed points, from the settings or from the messages: covariances (m, 3, 3), m²."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry.matrices import limited
from slam_observer_ros.sensor_models.fiducial_noise import orientation_covariances
from slam_observer_ros.settings.estimator_settings import Settings

RESOLUTION_M = 1e-4
"""Standard deviation that each coordinate of an observed point has at least.

What claims to be better is lost in rounding beside a pose that may be off by a kilometre.
"""

RELATIVE_RESOLUTION = 1e-6
"""The same as a share of the distance, for points in single precision or better."""

RESOLUTION_RAD = 1e-4
"""The same of an orientation, about each axis."""

MAX_ERROR_M = 1e3
"""Standard deviation of an observed point beyond which a message only says 'unknown'."""

MIN_SHARE = 1e-6
"""Least variance of an observed point in any direction, as a share of its total variance."""

MIN_INTERVAL_S = 1e-3
"""Observations that are less apart count as so far apart: two cameras may see at once."""

_TINY = np.finfo(np.float64).tiny
_IDENTITY = np.eye(3)


class PointFigures(NamedTuple):
    """How far points may be off: variances along and across the line of sight of length r, m²."""

    along_0: float
    along_2: float  # times r²
    along_4: float  # times r⁴
    across_0: float
    across_2: float  # times r²


class ObservationNoise:
    """How far observed points may be off, as ``observation_model`` and its figures say.

    ``error_time_s`` is the correlation time of the errors, see :func:`repetition_factors`.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.error_time_s = settings.observation_correlation_time

    def covariances(
        self, event: ObservationEvent, lines_of_sight: FloatArray | None = None
    ) -> FloatArray:
        """Return what an observation's points may be off by, metres squared.

        All can be inverted, even if a message or a point at the sensor itself says that some
        direction is known exactly. ``lines_of_sight`` (m, 3) lead from the sensor to where points
        of unknown covariance should be; default where they were measured.
        """
        lines_of_sight = event.lines_of_sight if lines_of_sight is None else lines_of_sight
        if event.covariances is None:
            return self.at(lines_of_sight)
        return stated_covariances(event.points, event.covariances, lines_of_sight, self.figures)

    def orientation_covariances(self, event: ObservationEvent, Z: FloatArray) -> FloatArray:
        """Return what an observation's orientations may be off by (m, 3, 3), rad².

        Of rotation vectors along the event's axes; all can be inverted. ``Z`` (m, 3, 3) are the
        orientations that are expected, or measured where none is.
        """
        settings, stated = self._settings, event.orientation_covariances
        if settings.observation_model == 'fiducial':
            modelled = orientation_covariances(Z, event.lines_of_sight, settings)
        else:
            modelled = np.tile(settings.orientation_noise**2 * _IDENTITY, (len(Z), 1, 1))
        if stated is not None:
            is_stated = stated.any(axis=(1, 2))
            modelled[is_stated] = limited(stated[is_stated], np.full(3, np.pi))
        return modelled + RESOLUTION_RAD**2 * _IDENTITY

    def at(self, lines_of_sight: FloatArray) -> FloatArray:
        """Return what the settings say of points along ``lines_of_sight`` (m, 3)."""
        return point_covariances(lines_of_sight, self.figures)

    @property
    def figures(self) -> PointFigures:
        """How far points may be off, as the settings say now."""
        s = self._settings
        if s.observation_model == 'cartesian':
            return PointFigures(s.point_noise**2, 0.0, 0.0, s.point_noise**2, 0.0)
        if s.observation_model == 'range_bearing':
            return PointFigures(
                s.range_noise**2, s.range_scale_noise**2, 0.0, 0.0, s.bearing_noise**2
            )
        squared = (s.pixel_noise / s.focal_length) ** 2
        if s.observation_model == 'stereo':
            parallax = s.disparity_noise / (s.focal_length * s.stereo_baseline)
            return PointFigures(0.0, 0.0, parallax**2, 0.0, squared)
        # The mean of a tag's four corners, and their spread (:mod:`.fiducial_noise`).
        return PointFigures(0.0, 0.0, 0.5 * squared / s.tag_size**2, 0.0, 0.25 * squared)


def stated_covariances(
    points: FloatArray, stated: FloatArray, lines_of_sight: FloatArray, figures: PointFigures
) -> FloatArray:
    """Return covariances (m, 3, 3) of ``points`` as stated, or by the figures where unknown."""
    # Else far points that are said to be exact are lost beside an uncertain heading.
    least = RELATIVE_RESOLUTION**2 * np.einsum('ij,ij->i', points, points)
    covariances = limited(stated, np.full(3, MAX_ERROR_M)) + least[:, None, None] * _IDENTITY
    covariances = _invertible(covariances)
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
    factors: FloatArray = (2.0 - new) / new
    return factors


def _invertible(covariances: FloatArray) -> FloatArray:
    """Return covariances (m, 3, 3) with no direction known exactly."""
    least = RESOLUTION_M**2 + MIN_SHARE * covariances.trace(axis1=1, axis2=2)
    invertible: FloatArray = covariances + least[:, None, None] * _IDENTITY
    return invertible


def point_covariances(lines_of_sight: FloatArray, figures: PointFigures) -> FloatArray:
    """Return covariances (m, 3, 3) of points along ``lines_of_sight`` (m, 3), invertible.

    A point at the sensor itself has no line of sight; it is known as well as its range is.
    """
    squared = np.einsum('ij,ij->i', lines_of_sight, lines_of_sight)
    along = figures.along_0 + (figures.along_2 + figures.along_4 * squared) * squared
    across = figures.across_0 + figures.across_2 * squared
    if np.count_nonzero(squared) < len(squared):
        across = np.where(squared > 0.0, across, along)
    excess = (along - across) / np.maximum(squared, _TINY)
    scaled = excess[:, None] * lines_of_sight
    covariances: FloatArray = scaled[:, :, None] * lines_of_sight[:, None, :]
    # As of _invertible, but with the trace that is known.
    least = RESOLUTION_M**2 + MIN_SHARE * (along + 2.0 * across)
    covariances += (across + least)[:, None, None] * _IDENTITY
    return covariances
