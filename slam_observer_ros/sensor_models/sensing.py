"""What sensors show, as it is by the calibration of the sensor that showed it."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.sensor_mounting import Sensed, sensitivity, turning
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.settings.estimator_settings import Settings

LEAST_COSINE = 0.2
"""Cosine of the angle off its axis, 78°, beyond which no sensor sees depth."""

_ALONG_X = np.array([1.0, 0.0, 0.0])
_TINY = np.finfo(np.float64).tiny


def corrected(
    calibration: Calibration, settings: Settings, event: ObservationEvent
) -> ObservationEvent:
    """Return an observation as it is by the calibration of its sensor; keep what that showed.

    Points of a depth that is taken for a range are as much further off as 1/cos b makes them, at
    the angle b off the sensor's axis.
    """
    frame = event.sensor_frame
    values, number = calibration.sensor(frame), calibration.sensors.index(frame)
    origins = np.zeros_like(event.points) if event.sensor is None else event.sensor
    arms = event.points - origins
    if settings.range_is_depth:
        arms = arms / cosines(arms, event.sensor_axis)[:, None]
    sensed = Sensed(np.full(len(arms), number), origins, arms, event.orientations)
    covariances, velocities, R = event.covariances, event.velocities, so3.exp(values[:3])
    if covariances is not None:
        squared = np.einsum('ij,ij->i', arms, arms)
        shown = np.einsum('ij,ij->i', event.lines_of_sight, event.lines_of_sight)
        longer = math.exp(2.0 * values[6]) * squared / np.maximum(shown, _TINY)
        covariances = longer[:, None, None] * (R @ covariances @ R.T)
    if velocities is not None:
        velocities = velocities @ R.T
    event = replace(event, covariances=covariances, velocities=velocities, sensed=sensed)
    return corrected_again(calibration, event)


def corrected_again(calibration: Calibration, event: ObservationEvent) -> ObservationEvent:
    """Return a corrected observation as it is by the calibration now."""
    sensed, Z = event.sensed, event.orientations
    if sensed is None:
        return event
    values = calibration.sensor(event.sensor_frame)
    R, scale = so3.exp(values[:3]), math.exp(values[6])
    sensor = sensed.origins + values[3:6]
    points = sensed.arms.dot(scale * R.T) + sensor
    if calibration.axes.point == 2:  # the line of sight keeps its height
        sensor[:, 2] -= points[:, 2]
        points[:, 2] = 0.0
    if sensed.orientations is not None:
        Z = R @ sensed.orientations
    return replace(event, points=points, sensor=sensor, orientations=Z)


def point_sensitivity(
    calibration: Calibration, event: ObservationEvent, points: FloatArray
) -> FloatArray | None:
    """Return D (m, 3, c) at ``points`` (m, 3) of a corrected observation, body frame; or None."""
    if event.sensed is None or event.sensor is None or not calibration.calibrates_sensors:
        return None
    frame, D = event.sensor_frame, np.zeros((len(points), 3, calibration.count))
    of_sensor = sensitivity(calibration.sensor(frame), points - event.sensor)
    D[:, :, calibration.columns(frame)] = of_sensor[:, :, calibration.of_sensor]
    return D


def turn_sensitivity(calibration: Calibration, event: ObservationEvent) -> FloatArray | None:
    """Return (3, c), how orientations seen turn with the calibration, body frame; or None."""
    if event.sensed is None or not calibration.calibrates_sensors:
        return None
    frame, D = event.sensor_frame, np.zeros((3, calibration.count))
    of_sensor = turning(calibration.sensor(frame))
    D[:, calibration.columns(frame)] = of_sensor[:, calibration.of_sensor]
    return D


def cosines(arms: FloatArray, axis: FloatArray | None) -> FloatArray:
    """Return cos b (m,) of lines of sight (m, 3) off the sensor's axis (3,), x by default."""
    lengths = np.sqrt(np.einsum('ij,ij->i', arms, arms))
    along = arms.dot(_ALONG_X if axis is None else axis)
    return np.asarray(np.maximum(along / np.maximum(lengths, _TINY), LEAST_COSINE))
