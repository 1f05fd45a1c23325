"""Observations that come when the state has moved on: what would be seen from where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.units import to_s
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import SPATIAL
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.sensor_models.integration import transition, transition_covariance
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.state.state import Slam


def carried_forward(
    slam: Slam, event: ObservationEvent, velocities: VelocityHistory, state_ns: int
) -> ObservationEvent:
    """Return what would be seen at ``state_ns``: Φ⁻¹ (y + v τ), Φ the motion since.

    Its points are as uncertain as any seen from there, and as that motion makes them. Its
    error is one and the same for all m, but is given to each as its own: m would average it
    down. Where velocities of landmarks are estimated, v may be anything that they may be.

    Parameters
    ----------
    slam : Slam
        The state at ``state_ns``.
    event : ObservationEvent
        The observation, of m points, made before.
    velocities : VelocityHistory
        The velocities since then.
    state_ns : int
        Stamp of the state, nanoseconds.

    """
    lag_s, calibration = to_s(state_ns - event.stamp_ns), slam.gains.calibration
    back = se3.inverse(transition(velocities, calibration, event.stamp_ns, state_ns))
    shifts = _landmark_velocities(slam, event, slam.observer.A @ back) * lag_s
    points = event.points + shifts
    # The sensor with it, so that it was measured from as far.
    sensor = shifts if event.sensor is None else event.sensor + shifts
    shifted = replace(event, stamp_ns=state_ns, points=points, sensor=sensor)
    moved = shifted.moved(back)
    Q = transition_covariance(velocities, calibration, slam.motion_noise, event.stamp_ns, state_ns)
    C = back[:3, :3] @ SPATIAL.output_matrix(points)
    shared = len(points) * C @ Q @ transpose(C)
    own = (lag_s * slam.landmark_velocity_error) ** 2 * np.eye(3)
    return replace(moved, covariances=_covariances(slam, moved) + shared + own)


def _landmark_velocities(slam: Slam, event: ObservationEvent, A: FloatArray) -> FloatArray:
    """Return how the landmarks (m, 3) seen move, m/s, along the axes of the body at Â = ``A``.

    As estimated, or else as the observation says, which is made there; zero if neither is.
    """
    velocities = np.zeros_like(event.points)
    if slam.is_fixed:
        return velocities
    if not slam.landmark_velocity_error:
        return velocities if event.velocities is None else event.velocities
    rows = slam.landmarks.rows_of(event.ids)
    velocities[rows >= 0] = slam.observer.u[rows[rows >= 0]]
    return se3.rotate(se3.inverse(A), velocities)


def _covariances(slam: Slam, event: ObservationEvent) -> FloatArray:
    """Return what points that are in time are taken to be off by: (m, 3, 3), body frame, m².

    It moves landmarks whose gains had put that off.
    """
    rows = slam.landmarks.rows_of(event.ids)
    slam.gains.recall(slam.observer, rows)
    return slam.measurement_model.covariances(event, rows)
