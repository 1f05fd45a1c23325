"""Points that calibrated sensors showed, as they are by a calibration that is yet to be found."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import Sensed
from slam_observer_ros.geometry import so3
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.sensor_calibration import sensitivity, shown_at


class SensedPoints:
    """M points; the last ``count`` entries c_s of the calibration are those of their sensors."""

    def __init__(self, calibration: Calibration, sensed: Sensed) -> None:
        self._sensed, self._calibration = sensed, calibration
        self._first = calibration.of_velocity
        self.count = calibration.count - self._first
        sensors = calibration.sensors.values()
        self._points = [np.flatnonzero(sensed.sensors == sensor.number) for sensor in sensors]

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
        turns = np.zeros((len(self._sensed.arms), 3, 7))
        turns[:, :, :3] = so3.left_jacobian(self._values(calibrations)[:, :3])
        return self._estimated(turns)

    def _values(self, calibrations: FloatArray) -> FloatArray:
        """Return ψ, d and s (M, 7) of each point's sensor."""
        values = np.empty((len(calibrations), 7))
        for sensor, at in zip(self._calibration.sensors.values(), self._points, strict=True):
            columns = self._calibration.columns(sensor)
            values[at] = sensor.full(calibrations[at, columns])
        return values

    def _estimated(self, D: FloatArray) -> FloatArray:
        """Return the columns (M, 3, c_s) of D (M, 3, 7) that are estimated, of its own sensor."""
        estimated = np.zeros((len(D), 3, self.count))
        for sensor, at in zip(self._calibration.sensors.values(), self._points, strict=True):
            columns = np.arange(self.count + self._first)[self._calibration.columns(sensor)]
            own = D[at][:, :, sensor.estimated]
            estimated[np.ix_(at, np.arange(3), columns - self._first)] = own
        return estimated
