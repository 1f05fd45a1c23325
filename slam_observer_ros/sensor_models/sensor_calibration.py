"""How a sensor is really mounted, and by how much its ranges err: y = o + d + exp(ψ) e^s p.

o is where /tf has the sensor, p = y_m − o from there to a point that it shows at y_m: all in the
body frame. ψ turns the sensor, d moves it, both along the body's axes, and e^s is the factor of
its ranges. Where these are depths along the sensor's axis, p is as long as 1/cos b makes it, at
the angle b off that axis. y changes with all of it by

    D = ∂y/∂(ψ, d, s) = [−[l]× J(ψ), I, l],   l = y − o − d.

A residual takes D at the point that is predicted. At the measured one its noise would be in D as
well: seen too far, a point would weigh more than seen too near, and the scale run away.
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.events import ObservationEvent, Sensed
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.settings.estimator_settings import Settings

NAMES = (
    *(f'sensor_rotation_{axis}' for axis in 'xyz'),
    *(f'sensor_translation_{axis}' for axis in 'xyz'),
    'range_scale',
)
"""Names of ψ, d and e^s."""

UNITS = ('rad',) * 3 + ('m',) * 3 + ('',)

SCALE = NAMES.index('range_scale')

LEAST_COSINE = 0.2
"""Cosine of the angle off its axis, 78°, beyond which no sensor sees depth."""

_ALONG_X = np.array([1.0, 0.0, 0.0])


class SensorCalibration:
    """ψ, d and s of the sensor of one frame, and which of these seven are estimated.

    ``number`` counts the sensors, ``variances`` (c_s,) are those of the estimates at the start.
    """

    def __init__(self, frame: str, number: int, settings: Settings, axes: EstimatedAxes) -> None:
        self.frame, self.number = frame, number
        self._is_depth, self._is_planar = settings.range_is_depth, settings.two_d_mode
        self.nominal = np.append(np.zeros(6), math.log(settings.range_scale))
        self.deviations = np.array(
            [
                *settings.sensor_rotation_stddev,
                *settings.sensor_translation_stddev,
                settings.range_scale_stddev / settings.range_scale,
            ]
        )
        possible = np.append(np.arange(6)[axes.pose], SCALE)
        self.estimated: IntArray = possible[self.deviations[possible] > 0.0]
        self.variances: FloatArray = self.deviations[self.estimated] ** 2
        self._values: FloatArray = self.nominal.copy()
        self.set(self.values)

    @property
    def values(self) -> FloatArray:
        """(c_s,) those of ψ, d and s that are estimated."""
        values: FloatArray = self._values[self.estimated]
        return values

    def set(self, values: FloatArray) -> None:
        """Take ``values`` (c_s,) for the estimates."""
        self._values[self.estimated] = values
        self._rotation, self._scale = so3.exp(self._values[:3]), math.exp(self._values[SCALE])

    def full(self, values: FloatArray) -> FloatArray:
        """Return all of ψ, d and s (…, 7), given those that are estimated (…, c_s)."""
        full = np.tile(self._values, (*values.shape[:-1], 1))
        full[..., self.estimated] = values
        return full

    @property
    def corrects_points(self) -> bool:
        """Whether what the sensor shows is not taken as it comes."""
        return bool(self._is_depth or len(self.estimated) or self._values.any())

    def estimates(self, variances: FloatArray, stated: FloatArray) -> list[CalibrationEstimate]:
        """Return the estimates with ``variances`` (c_s,), and standard deviations at the start."""
        suffix = f'/{self.frame}' if self.frame else ''
        found = []
        for i, variance, error in zip(self.estimated, variances, stated, strict=True):
            value, nominal, factor = self._values[i], self.nominal[i], 1.0
            if i == SCALE:  # of which s is the logarithm
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

    def corrected(self, event: ObservationEvent) -> ObservationEvent:
        """Return what a sensor shows as it is by these estimates, and keep what it showed."""
        origins = np.zeros_like(event.points) if event.sensor is None else event.sensor
        arms = event.points - origins
        if self._is_depth:
            arms = arms / _cosines(arms, event.sensor_axis)[:, None]
        sensed = Sensed(np.full(len(arms), self.number), origins, arms, event.orientations)
        covariances, velocities, R = event.covariances, event.velocities, self._rotation
        if covariances is not None:
            squared = np.einsum('ij,ij->i', arms, arms)
            shown = np.einsum('ij,ij->i', event.lines_of_sight, event.lines_of_sight)
            longer = self._scale**2 * squared / np.maximum(shown, np.finfo(np.float64).tiny)
            covariances = longer[:, None, None] * (R @ covariances @ R.T)
        if velocities is not None:
            velocities = velocities @ R.T
        event = replace(event, covariances=covariances, velocities=velocities, sensed=sensed)
        return self.corrected_again(event)

    def corrected_again(self, event: ObservationEvent) -> ObservationEvent:
        """Return a corrected observation as it is by the estimates now."""
        sensed, Z = event.sensed, event.orientations
        if sensed is None:
            raise TypeError('an observation that was never corrected')
        points = sensed.arms.dot(self._scale * self._rotation.T)
        sensor = sensed.origins + self._values[3:6]
        points += sensor
        if self._is_planar:  # the line of sight keeps its height
            sensor[:, 2] -= points[:, 2]
            points[:, 2] = 0.0
        if sensed.orientations is not None:
            Z = self._rotation @ sensed.orientations
        return replace(event, points=points, sensor=sensor, orientations=Z)

    def sensitivity(self, arms: FloatArray) -> FloatArray:
        """Return D (m, 3, c_s) for points at l = ``arms`` (m, 3) from the sensor."""
        D: FloatArray = sensitivity(self._values, arms)[:, :, self.estimated]
        return D

    def turning(self) -> FloatArray:
        """Return (3, c_s), how what is seen turns with the estimates: J(ψ) for those of ψ."""
        turns = np.zeros((3, 7))
        turns[:, :3] = so3.left_jacobian(self._values[:3])
        estimated: FloatArray = turns[:, self.estimated]
        return estimated


def shown_at(values: FloatArray, sensed: Sensed) -> FloatArray:
    """Return y (m, 3), given ψ, d and s of one sensor (7,), or for each point (m, 7)."""
    R, scales = so3.exp(values[..., :3]), np.exp(values[..., 6:])
    turned = (R @ sensed.arms[:, :, None])[:, :, 0]
    points: FloatArray = sensed.origins + values[..., 3:6] + scales * turned
    return points


def sensitivity(values: FloatArray, arms: FloatArray) -> FloatArray:
    """Return D (m, 3, 7) for points at l = ``arms`` (m, 3); ``values`` as of :func:`shown_at`."""
    D = np.empty((len(arms), 3, 7))
    D[:, :, :3] = -so3.hat(arms) @ so3.left_jacobian(values[..., :3])
    D[:, :, 3:6], D[:, :, 6] = np.eye(3), arms
    return D


def _cosines(arms: FloatArray, axis: FloatArray | None) -> FloatArray:
    """Return cos b (m,) of lines of sight (m, 3) off the sensor's axis (3,), x by default."""
    lengths = np.sqrt(np.einsum('ij,ij->i', arms, arms))
    along = arms.dot(_ALONG_X if axis is None else axis)
    cosines = along / np.maximum(lengths, np.finfo(np.float64).tiny)
    return np.asarray(np.maximum(cosines, LEAST_COSINE))
