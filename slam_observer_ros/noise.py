"""Noise of velocities and observations, from the settings or from the messages."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray
from slam_observer_ros.velocity_history import HeldVelocities

RESOLUTION_M = 1e-6
"""Standard deviation that no coordinate of an observed point falls short of, metres."""

RELATIVE_RESOLUTION = 1e-6
"""The same as a share of the distance, for messages with points in single precision or better."""

LEAST_SHARE = 1e-6
"""Least variance of an observed point in any direction, as a share of its total variance."""

_IDENTITY = np.eye(3)


class NoiseModel:
    """Covariances in physical units.

    Parameters
    ----------
    settings : Settings
        Noise figures of the sensors.

    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        s = settings
        self._density = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
        self._scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
        self._unknown = np.repeat([s.unknown_angular_motion, s.unknown_linear_motion], 3)

    def motion(self, held: HeldVelocities) -> FloatArray:
        """Return the covariances (k, 6, 6) of k body-frame motions, rad² and m².

        While a velocity is in force its error is white noise: of the stated density and
        proportional to speed, or, where the message has a covariance, independent from one
        message to the next. In a gap the robot may do anything that ``unknown_*_motion`` allows.
        """
        rates = self._density**2 + (self._scale * held.body_velocities) ** 2
        variances = rates * held.dt_s[:, None] + self._unknown**2 * held.gap_s[:, None]
        covariances = variances[:, :, None] * np.eye(6)
        for i, given in enumerate(held.covariances):
            if given is not None:
                gap = np.diag(self._unknown**2 * held.gap_s[i])
                covariances[i] = given * held.dt_s[i] ** 2 + gap
        return covariances

    def observation(self, event: ObservationEvent) -> FloatArray:
        """Return the covariances (m, 3, 3) of an observation's points, body frame, m².

        All of them can be inverted, even if a message or a point at the sensor itself says that
        some direction is known exactly.
        """
        covariances = self._stated(event)
        least = RESOLUTION_M**2 + LEAST_SHARE * np.einsum('ijj->i', covariances)
        invertible: FloatArray = covariances + least[:, None, None] * _IDENTITY
        return invertible

    def _stated(self, event: ObservationEvent) -> FloatArray:
        """Return the covariances (m, 3, 3) as message or settings have them, m²."""
        if event.covariances is not None:
            # Else far points that are said to be exact are lost beside an uncertain heading.
            squared_m2 = np.einsum('ij,ij->i', event.points, event.points)
            least = RELATIVE_RESOLUTION**2 * squared_m2
            given: FloatArray = event.covariances + least[:, None, None] * _IDENTITY
            return given
        s = self._settings
        if s.observation_model == 'cartesian':
            return np.broadcast_to(s.point_noise**2 * _IDENTITY, (len(event.points), 3, 3))
        range_m = np.sqrt(np.einsum('ij,ij->i', event.points, event.points))
        if s.observation_model == 'stereo':
            along = range_m**2 * s.disparity_noise / (s.stereo_focal_length * s.stereo_baseline)
            across = range_m * s.pixel_noise / s.stereo_focal_length
        else:
            along = np.hypot(s.range_noise, range_m * s.range_scale_noise)
            across = range_m * s.bearing_noise
        return _along_and_across(event.points, range_m, along, across)


def _along_and_across(
    points: FloatArray, range_m: FloatArray, along: FloatArray, across: FloatArray
) -> FloatArray:
    """Return covariances (m, 3, 3) with standard deviations along and across the line of sight.

    A point at the sensor itself has no line of sight; it is known as well as its range is.
    """
    across = np.where(range_m > 0.0, across, along)
    sight: FloatArray = points / np.maximum(range_m, np.finfo(np.float64).tiny)[:, None]
    outer = sight[:, :, None] * sight[:, None, :]
    spread = (along**2 - across**2)[:, None, None] * outer
    return spread + (across**2)[:, None, None] * _IDENTITY
