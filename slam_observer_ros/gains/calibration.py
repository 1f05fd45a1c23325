"""Scale and bias of the velocity as part of the state: V_true = (1 + s) ∘ V + b, by axis."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.axes import Axes
from slam_observer_ros.gains.base import Motion
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray


class Calibration:
    """Estimates of the scale s and the bias b, on the axes whose uncertainty is not zero.

    Parameters
    ----------
    settings : Settings
        Uncertainties at the start and drifts.
    axes : Axes
        Axes of the pose that are estimated at all.

    Attributes
    ----------
    count : int
        c, how many entries of s and b are estimated.
    initial_variances : FloatArray
        (c,) variances at the start.
    drift_covariance : FloatArray
        (c, c) by how much their covariance grows per second.

    """

    def __init__(self, settings: Settings, axes: Axes) -> None:
        scale = np.array([*settings.angular_scale_error, *settings.linear_scale_error])
        bias = np.array([*settings.angular_bias_error, *settings.linear_bias_error])
        self._scaled = axes.pose[scale[axes.pose] > 0.0]
        self._biased = axes.pose[bias[axes.pose] > 0.0]
        self._scale_and_bias: FloatArray = np.repeat([1.0, 0.0], 6)
        self._estimated = np.append(self._scaled, 6 + self._biased)
        self._calibrated = self._estimated % 6
        self.count = len(self._calibrated)
        errors = np.append(scale[self._scaled], bias[self._biased])
        self.initial_variances = errors**2
        self.drift_covariance = np.diag((errors * settings.calibration_drift) ** 2)

    @property
    def values(self) -> FloatArray:
        """(c,) estimates: scale factors 1 + s, then biases b."""
        values: FloatArray = self._scale_and_bias[self._estimated]
        return values

    def apply(self, body_velocities: FloatArray) -> FloatArray:
        """Return (k, 6) velocities (1 + s) ∘ V + b."""
        return body_velocities * self._scale_and_bias[:6] + self._scale_and_bias[6:]

    def sensitivity(self, Ad: FloatArray, motion: Motion) -> FloatArray:
        """Return (p, c), how the pose error grows with the errors of s and b over a motion.

        From ε' = Ad_Â (V ∘ s̃ + b̃); ``Ad`` (k, p, 6) holds the estimated rows of Ad_Â.
        """
        rates = motion.measured_velocities[:, self._calibrated]
        rates[:, len(self._scaled) :] = 1.0
        F: FloatArray = np.einsum('kij,kj,k->ij', Ad[:, :, self._calibrated], rates, motion.dt_s)
        return F

    def shift(self, change: FloatArray) -> None:
        """Add ``change`` (c,) to the estimates."""
        self._scale_and_bias[self._estimated] += change
