"""The calibration of a sensor of landmarks: its mounting and the scale of its ranges.

What it does to points is in :mod:`slam_observer_ros.geometry.sensor_mounting`: ψ, d and s.
"""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate

NAMES = (
    *(f'sensor_rotation_{axis}' for axis in 'xyz'),
    *(f'sensor_translation_{axis}' for axis in 'xyz'),
    'range_scale',
)
"""Names of ψ, d and e^s."""

UNITS = ('rad',) * 3 + ('m',) * 3 + ('',)

SCALE = NAMES.index('range_scale')


class SensorCalibration:
    """ψ, d and s of the sensor of one frame, and which of these seven are ``estimated`` (c_s,).

    ``number`` counts the sensors. At the start the ``values`` (7,) are as stated, and the
    estimates have ``variances`` (c_s,).
    """

    def __init__(
        self,
        frame: str,
        number: int,
        stated: FloatArray,
        estimated: IntArray,
        variances: FloatArray,
    ) -> None:
        self.frame, self.number = frame, number
        self.estimated, self.variances = estimated, variances
        self._stated, self.values = stated, stated.copy()

    def shift(self, change: FloatArray) -> None:
        """Add ``change`` (c_s,) to the estimates."""
        values: FloatArray = self.values.copy()
        values[self.estimated] += change
        self.values = values

    def estimates(self, variances: FloatArray, stated: FloatArray) -> list[CalibrationEstimate]:
        """Return the estimates with ``variances`` (c_s,), and standard deviations at the start."""
        suffix = f'/{self.frame}' if self.frame else ''
        found = []
        for i, variance, error in zip(self.estimated, variances, stated, strict=True):
            value, nominal, factor = self.values[i], self._stated[i], 1.0
            if i == SCALE:  # s is its logarithm
                value, nominal = math.exp(value), math.exp(nominal)
                factor = value
            found.append(
                CalibrationEstimate(
                    NAMES[i] + suffix,
                    float(value),
                    float(factor * np.sqrt(variance)),
                    UNITS[i],
                    nominal=float(nominal),
                    stated=float(factor * error),
                )
            )
        return found
