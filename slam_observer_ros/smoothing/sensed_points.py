"""Points that calibrated sensors showed, as they are by a calibration that is yet to be found."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.sensor_mounting import Sensed, sensitivity, shown_at, turning


class SensedPoints:
    """M points; the last ``count`` entries c_s of the calibration are those of their sensors.

    ``stated`` (s, 7) has the values of s sensors, and ``columns`` (s, 7) where in the calibration
    (c,) those are that are estimated, −1 for others.
    """

    def __init__(self, sensed: Sensed, stated: FloatArray, columns: IntArray, c: int) -> None:
        self._sensed = sensed
        self._stated, self._columns = stated[sensed.sensors], columns[sensed.sensors]
        self._are_estimated = self._columns >= 0
        self._first = int(np.min(columns, where=columns >= 0, initial=c))
        self.count = c - self._first

    def shown(self, calibrations: FloatArray) -> FloatArray:
        """Return y (M, 3), metres, body frame, with one calibration for each point (M, c)."""
        return shown_at(self._values(calibrations), self._sensed)

    def sensitivity(self, calibrations: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return D (M, 3, c_s), for points that should be at ``predicted`` (M, 3), body frame."""
        values = self._values(calibrations)
        arms = predicted - self._sensed.origins - values[:, 3:6]
        return self._estimated(sensitivity(values, arms))

    def turned(self, calibrations: FloatArray, Z: FloatArray) -> FloatArray:
        """Return orientations exp(ψ) Z (M, 3, 3), body frame, that the sensors showed as Z."""
        rotated: FloatArray = so3.exp(self._values(calibrations)[:, :3]) @ Z
        return rotated

    def turning(self, calibrations: FloatArray) -> FloatArray:
        """Return J(ψ) (M, 3, c_s): how orientations turn with the calibration."""
        return self._estimated(turning(self._values(calibrations)))

    def _values(self, calibrations: FloatArray) -> FloatArray:
        """Return ψ, d and s (M, 7) of each point's sensor."""
        if not self.count:
            return self._stated
        estimated = np.take_along_axis(calibrations, np.maximum(self._columns, 0), axis=1)
        return np.where(self._are_estimated, estimated, self._stated)

    def _estimated(self, D: FloatArray) -> FloatArray:
        """Return the columns (M, 3, c_s) of D (M, 3, 7) that are estimated, of its own sensor."""
        estimated = np.zeros((len(D), 3, self.count))
        rows, parts = np.nonzero(self._are_estimated)
        estimated[rows, :, self._columns[rows, parts] - self._first] = D[rows, :, parts]
        return estimated
