"""Late observations: what would be seen from where the state is now."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import SPATIAL
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.sensor_models.integration import transition, transition_covariance
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.state.matching import point_covariances
from slam_observer_ros.state.state import State


def carried_forward(
    state: State, event: ObservationEvent, velocities: VelocityHistory, state_ns: int
) -> ObservationEvent:
    """Return what would be seen at ``state_ns``: Φ⁻¹ (y + v τ), Φ the motion since ``event``.

    Its points are as uncertain as any seen from there, and as that motion makes them. Its
    error is one and the same for all m, but is given to each as its own: m would average it
    down. Where velocities of landmarks are estimated, v may be anything that they may be.
    """
    # The motion of the robot since then, and that of the landmarks.
    interval = (event.stamp_ns, state_ns)
    lag_s, calibration = to_s(state_ns - event.stamp_ns), state.calibration
    back = se3.inverse(transition(velocities, calibration, *interval))
    shifts = _landmark_velocities(state, event, state.observer.A @ back) * lag_s
    points = event.points + shifts
    # The sensor with it, so that it was measured from as far.
    sensor = shifts if event.sensor is None else event.sensor + shifts
    shifted = replace(event, stamp_ns=state_ns, points=points, sensor=sensor)
    moved = shifted.moved(back)
    # What both add to the noise.
    Q = transition_covariance(velocities, calibration, state.motion_noise, *interval)
    C = back[:3, :3] @ SPATIAL.output_matrix(points)
    shared = len(points) * C @ Q @ transpose(C)
    rows = state.landmarks.rows_of(event.ids)
    own = (lag_s * state.landmark_velocity_stddev) ** 2 * np.eye(3)
    moved = replace(moved, covariances=point_covariances(state, moved, rows) + shared + own)
    if moved.orientations is None:
        return moved
    R, turns = (
        back[:3, :3],
        state.observation_noise.orientation_covariances(moved, moved.orientations),
    )
    turns = turns + len(points) * R @ Q[:3, :3] @ R.T
    return replace(moved, orientation_covariances=turns)


def _landmark_velocities(state: State, event: ObservationEvent, A: FloatArray) -> FloatArray:
    """Return how the landmarks (m, 3) seen move, m/s, along the axes of the body at Â = ``A``."""
    velocities = np.zeros_like(event.points)
    if not state.landmark_velocity_stddev:  # not estimated: as the sensor says
        return velocities if event.velocities is None else event.velocities
    rows = state.landmarks.rows_of(event.ids)
    velocities[rows >= 0] = state.observer.u[rows[rows >= 0]]
    return se3.rotate(se3.inverse(A), velocities)
