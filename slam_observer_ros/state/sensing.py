"""What sensors show, as it is by what is known of how they are mounted and err."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.state.state import State


def corrected(state: State, event: ObservationEvent) -> ObservationEvent:
    """Return an observation corrected by the calibration of its sensor, unless it is already."""
    calibration = state.filter.calibration
    if not calibration.corrects_points or event.sensed is not None:
        return event
    if event.sensor_frame not in calibration.sensors:
        state.add_sensor(event.sensor_frame)
    return calibration.sensors[event.sensor_frame].corrected(event)


def corrected_again(state: State, event: ObservationEvent) -> ObservationEvent:
    """Return an observation as it is by what is known of its sensor now, after a correction."""
    if event.sensed is None or not state.filter.calibration.calibrates_sensors:
        return event
    return state.filter.calibration.sensors[event.sensor_frame].corrected_again(event)


def sensitivity(
    state: State, event: ObservationEvent, points: FloatArray | None = None
) -> FloatArray | None:
    """Return R̂ D_i (m, 3, c) at ``points`` (m, 3), body frame, or where an observation has them.

    None where no calibration of the sensor is estimated.
    """
    calibration = state.filter.calibration
    if event.sensed is None or event.sensor is None or not calibration.calibrates_sensors:
        return None
    sensor = calibration.sensors[event.sensor_frame]
    arms = (event.points if points is None else points) - event.sensor
    D = np.zeros((len(arms), 3, calibration.count))
    D[:, :, calibration.columns(sensor)] = state.observer.A[:3, :3] @ sensor.sensitivity(arms)
    return D


def turning(state: State, event: ObservationEvent) -> FloatArray | None:
    """Return (3, c), how orientations seen turn with the calibration, reference frame; or None."""
    calibration = state.filter.calibration
    if event.sensed is None or not calibration.calibrates_sensors:
        return None
    sensor = calibration.sensors[event.sensor_frame]
    D = np.zeros((3, calibration.count))
    D[:, calibration.columns(sensor)] = state.observer.A[:3, :3] @ sensor.turning()
    return D
