"""Noise of velocities, from the settings or from the messages."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, Immutable
from slam_observer_ros.geometry.matrices import limited
from slam_observer_ros.sensor_models.held_velocities import HeldVelocities
from slam_observer_ros.settings.estimator_settings import Settings

MAX_SPEED_ERRORS = np.repeat([50.0, 1000.0], 3)
"""Standard deviations of a velocity (Ω, v), rad/s and m/s, beyond which a message only says
'unknown': no robot turns or moves as fast.
"""

MAX_GAP_ERRORS = np.repeat([np.pi, 1000.0], 3)
"""Standard deviations of a motion in one gap, rad and m, beyond which it is as unknown as it can
be: more would only drown all else that is known in rounding.
"""

SPEED_WINDOW_S = 1.0
"""Time over which a velocity is averaged to tell how large an error in proportion to it is."""

_IDENTITY_6 = np.eye(6)


class MotionNoise(Immutable):
    """How far motions may be off.

    Parameters
    ----------
    settings : Settings
        Noise densities of the velocity, its error in proportion to speed, and how the robot may
        move where no velocity is known.

    """

    def __init__(self, settings: Settings) -> None:
        s = settings
        density = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
        unknown = np.repeat([s.unknown_angular_motion, s.unknown_linear_motion], 3)
        self._density_squared, self._unknown_squared = density**2, unknown**2
        self._scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
        self._has_scale = bool(self._scale.any())

    def covariances(self, held: HeldVelocities) -> FloatArray:
        """Return what k motions may be off by: (k, 6, 6), body frame, rad² and m².

        *A velocity in force* has white noise: of the stated density, and proportional to speed.
        The speed is the mean over :data:`SPEED_WINDOW_S`, or over all of ``held`` if that is
        shorter; in a single message it is noisy itself, and its square too large. The density is
        that of errors which are new in each message. Held for t, longer than the usual T, one of
        them has moved the robot by t/T times as much: its variance is t²/T, not t. Slip goes on as
        before.

        *A velocity with a covariance of its own* has one error for as long as it is held, and
        another in the next message: held for t it has moved the robot by t times the error,
        however many motions that was cut into. Its angular and its linear part may be of two
        messages, one of them without a covariance.

        *In a gap* the robot may do anything that ``unknown_*_motion`` allows, within
        :data:`MAX_GAP_ERRORS`.
        """
        dt_s, some_are_stated = held.dt_s[:, None], held.is_stated.any()
        variances = self._density_squared * _white_s(held)
        if self._has_scale:
            variances += (self._scale * held.averaged(SPEED_WINDOW_S)) ** 2 * dt_s
        if some_are_stated:
            variances[np.repeat(held.is_stated, 3, axis=1)] = 0.0
        if held.gap_s.any():
            variances += np.minimum(self._unknown_squared * held.gap_s[:, None], MAX_GAP_ERRORS**2)
        covariances: FloatArray = variances[:, :, None] * _IDENTITY_6
        if some_are_stated:
            squared = dt_s * (2.0 * held.before_s + dt_s)  # (before + dt)² − before²
            grown_s = np.repeat(np.sqrt(squared), 3, axis=1)
            stated = limited(held.covariances, MAX_SPEED_ERRORS)
            covariances += grown_s[:, :, None] * stated * grown_s[:, None, :]
        return covariances


def _white_s(held: HeldVelocities) -> FloatArray:
    """Return what the variances of motions are, over their density: dt, or more of it.

    (k, 6), or (k, 1) where it is one for all axes.
    """
    dt_s = held.dt_s[:, None]
    until_s = held.before_s + dt_s
    if not (until_s > held.usual_s).any():  # as nearly always
        return dt_s
    grown_s = until_s * np.maximum(until_s / held.usual_s, 1.0)
    grown_s -= held.before_s * np.maximum(held.before_s / held.usual_s, 1.0)
    return np.repeat(grown_s, 3, axis=1)
