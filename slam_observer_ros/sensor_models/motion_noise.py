"""Noise of velocities, from the settings or from the messages."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry.matrices import limited
from slam_observer_ros.sensor_models.held_velocities import HeldVelocities
from slam_observer_ros.sensor_models.motion_factors import MotionFactors
from slam_observer_ros.settings.estimator_settings import Settings, Vector3

MAX_SPEED_ERRORS = np.repeat([50.0, 1000.0], 3)
"""Standard deviations of a velocity beyond which a message only says 'unknown'.

No robot turns or moves as fast.
"""

MAX_GAP_ERRORS = np.repeat([np.pi, 1000.0], 3)
"""Standard deviations of a motion in one gap, rad and m: it is as unknown as it can be.

More would only drown all else that is known in rounding.
"""

SPEED_WINDOW_S = 1.0
"""Time over which a velocity is averaged, as its error may be in proportion to it."""

_IDENTITY_6 = np.eye(6)


class MotionNoise:
    """How far motions may be off: noise densities of the settings, or covariances of messages.

    Either of them times the ``factors`` that were found for turning and driving.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = s = settings
        self.factors = MotionFactors(settings)
        self._unknown_squared = (
            np.repeat([s.unknown_angular_motion, s.unknown_linear_motion], 3) ** 2
        )
        self._scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
        self._has_scale = bool(self._scale.any())

    def covariances(self, held: HeldVelocities) -> FloatArray:
        """Return what k motions may be off by: (k, 6, 6), rad² and m²."""
        dt_s, some_are_stated = held.dt_s[:, None], np.count_nonzero(held.is_stated)
        # White noise of the stated density, and in proportion to the mean speed: a single message
        # is noisy itself, and its square too large.
        s = self._settings  # which may change
        variances = _squares(s.angular_velocity_noise, s.linear_velocity_noise) * _white_s(held)
        if self._has_scale:
            variances += (self._scale * held.averaged(SPEED_WINDOW_S)) ** 2 * dt_s
        factors = self.factors.applied.repeat(3)
        variances = variances * factors
        if some_are_stated:
            variances[np.repeat(held.is_stated, 3, axis=1)] = 0.0
        # In a gap the robot may do anything that is allowed.
        if np.count_nonzero(held.gap_s):
            variances += np.minimum(self._unknown_squared * held.gap_s[:, None], MAX_GAP_ERRORS**2)
        covariances: FloatArray = variances[:, :, None] * _IDENTITY_6
        # A stated covariance is that of one error for as long as the velocity is held, and of
        # another in the next message: held for t it has moved the robot by t times the error,
        # however many motions that was cut into. Of angular and linear part one may have none.
        if some_are_stated:
            squared = dt_s * (2.0 * held.before_s + dt_s)  # (before + dt)² − before²
            grown_s = np.repeat(np.sqrt(squared), 3, axis=1) * np.sqrt(factors)
            stated = limited(held.covariances, MAX_SPEED_ERRORS)
            covariances += grown_s[:, :, None] * stated * grown_s[:, None, :]
        return covariances

    def is_summed(self, held: HeldVelocities) -> bool:
        """Return whether what one motion may be off by does not depend on others."""
        return not (self._has_scale or _some_last_longer(held))

    def velocity_covariance(self, held: HeldVelocities) -> FloatArray:
        """Return what a single velocity may be off by: (6, 6), rad²/s² and m²/s²."""
        covariance: FloatArray = self.covariances(held)[0] / (held.dt_s[0] + held.gap_s[0]) ** 2
        return covariance


@lru_cache(maxsize=8)
def _squares(angular: Vector3, linear: Vector3) -> FloatArray:
    squares = np.array([*angular, *linear]) ** 2
    squares.setflags(write=False)
    return squares


def _some_last_longer(held: HeldVelocities) -> bool:
    return bool(np.count_nonzero(held.before_s + held.dt_s[:, None] > held.usual_s))


def _white_s(held: HeldVelocities) -> FloatArray:
    """Return variances over their density: (k, 6), or (k, 1) if one for all axes.

    The density is that of errors which are new in each message. Held for t, longer than the
    usual T, one of them has moved the robot by t/T times as much: t²/T, not t. Slip is as before.
    """
    dt_s = held.dt_s[:, None]
    if not _some_last_longer(held):  # as nearly always
        return dt_s
    until_s = held.before_s + dt_s
    grown_s = until_s * np.maximum(until_s / held.usual_s, 1.0)
    grown_s -= held.before_s * np.maximum(held.before_s / held.usual_s, 1.0)
    return np.repeat(grown_s, 3, axis=1)
