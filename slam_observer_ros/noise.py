"""Noise of velocities and observations, from the settings or from the messages."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray, Immutable
from slam_observer_ros.velocity_history import HeldVelocities

RESOLUTION_M = 1e-6
"""Standard deviation that no coordinate of an observed point falls short of, metres."""

RELATIVE_RESOLUTION = 1e-6
"""The same as a share of the distance, for messages with points in single precision or better."""

LEAST_SHARE = 1e-6
"""Least variance of an observed point in any direction, as a share of its total variance."""

LARGEST_SPEED_ERRORS = np.repeat([50.0, 1000.0], 3)
"""Standard deviations of a velocity (Ω, v), rad/s and m/s, beyond which a message only says
'unknown': no robot turns or moves as fast.
"""

SPEED_WINDOW_S = 1.0
"""Time over which a velocity is averaged to tell how large an error in proportion to it is."""

_TINY = np.finfo(np.float64).tiny
_IDENTITY = np.eye(3)
_IDENTITY_6 = np.eye(6)


class NoiseModel(Immutable):
    """Covariances in physical units.

    Parameters
    ----------
    settings : Settings
        Noise figures of the sensors.

    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        s = settings
        density = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
        unknown = np.repeat([s.unknown_angular_motion, s.unknown_linear_motion], 3)
        self._density_squared, self._unknown_squared = density**2, unknown**2
        self._scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
        self._has_scale = bool(self._scale.any())

    def motion(self, held: HeldVelocities) -> FloatArray:
        """Return the covariances (k, 6, 6) of k body-frame motions, rad² and m².

        While a velocity is in force its error is white noise: of the stated density and
        proportional to speed. The speed is that of a second's motion, or of all of ``held`` where
        that is less: in a single message it is noisy itself, and its square the larger the more
        messages there are. Where the message has
        a covariance its error is the same as long as it is held, and another one in the next
        message: what was held for t has moved the robot by t times the error, however many
        motions that was cut into. The angular and the linear part may be of two messages, of
        which one is held for longer, or has no covariance. In a gap the robot may do anything
        that ``unknown_*_motion`` allows.
        """
        rates = self._density_squared
        if self._has_scale:
            rates = rates + (self._scale * held.averaged(SPEED_WINDOW_S)) ** 2
        dt_s = held.dt_s[:, None]
        white = rates * dt_s * np.repeat(~held.is_stated, 3, axis=1)
        in_gaps = self._unknown_squared * held.gap_s[:, None]
        covariances: FloatArray = (white + in_gaps)[:, :, None] * _IDENTITY_6
        if held.is_stated.any():
            squared = dt_s * (2.0 * held.before_s + dt_s)  # (before + dt)² − before²
            grown_s = np.repeat(np.sqrt(squared), 3, axis=1)
            stated = limited(held.covariances, LARGEST_SPEED_ERRORS)
            covariances += grown_s[:, :, None] * stated * grown_s[:, None, :]
        return covariances

    def observation(self, event: ObservationEvent, sights: FloatArray | None = None) -> FloatArray:
        """Return the covariances (m, 3, 3) of an observation's points, body frame, m².

        All of them can be inverted, even if a message or a point at the sensor itself says that
        some direction is known exactly. ``sights`` (m, 3) lead from the sensor to where points of
        unknown covariance should be; default where they were measured.
        """
        sights = event.sights if sights is None else sights
        if event.covariances is None:
            return self.at(sights)
        # Else far points that are said to be exact are lost beside an uncertain heading.
        squared_m2 = np.einsum('ij,ij->i', event.points, event.points)
        least = RELATIVE_RESOLUTION**2 * squared_m2
        covariances = _invertible(event.covariances + least[:, None, None] * _IDENTITY)
        unknown = ~event.covariances.any(axis=(1, 2))
        if unknown.any():
            covariances[unknown] = self.at(sights[unknown])
        return covariances

    def at(self, sights: FloatArray) -> FloatArray:
        """Return what the settings say of points that a message has no covariances for.

        ``sights`` (m, 3) lead to them from the sensor, metres, body frame.
        """
        s = self._settings
        if s.observation_model == 'cartesian':
            each = np.broadcast_to(s.point_noise**2 * _IDENTITY, (len(sights), 3, 3))
            return _invertible(each)
        range_squared = np.einsum('ij,ij->i', sights, sights)
        if s.observation_model == 'stereo':
            parallax = s.disparity_noise / (s.stereo_focal_length * s.stereo_baseline)
            along = (range_squared * parallax) ** 2
            across = range_squared * (s.pixel_noise / s.stereo_focal_length) ** 2
        else:
            along = s.range_noise**2 + range_squared * s.range_scale_noise**2
            across = range_squared * s.bearing_noise**2
        return _invertible(_along_and_across(sights, range_squared, along, across))


def limited(covariances: FloatArray, largest: FloatArray) -> FloatArray:
    """Return covariances (..., d, d) without variances that would drown all others in rounding.

    Standard deviations are at most ``largest`` (d,); the correlations stay.
    """
    # Rounding may have left a variance a hair below zero.
    deviations = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
    scales = largest / np.maximum(deviations, largest)
    scaled: FloatArray = covariances * scales[..., :, None] * scales[..., None, :]
    return scaled


def _invertible(covariances: FloatArray) -> FloatArray:
    """Return covariances (m, 3, 3) of which no direction is known exactly, m²."""
    least = RESOLUTION_M**2 + LEAST_SHARE * np.einsum('ijj->i', covariances)
    invertible: FloatArray = covariances + least[:, None, None] * _IDENTITY
    return invertible


def _along_and_across(
    sights: FloatArray, range_squared: FloatArray, along: FloatArray, across: FloatArray
) -> FloatArray:
    """Return covariances (m, 3, 3) with given variances along and across the line of sight.

    A point at the sensor itself has no line of sight; it is known as well as its range is.
    """
    across = np.where(range_squared > 0.0, across, along)
    excess = (along - across) / np.maximum(range_squared, _TINY)
    outer = sights[:, :, None] * sights[:, None, :]
    spread: FloatArray = excess[:, None, None] * outer
    return spread + across[:, None, None] * _IDENTITY
