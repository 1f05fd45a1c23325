"""The motion between two stamps: velocities as the calibration has them, with their noise."""

from __future__ import annotations

from functools import reduce

import numpy as np

from slam_observer_ros.gains.calibration import Calibration
from slam_observer_ros.gains.motion import Motion
from slam_observer_ros.geometry import se3
from slam_observer_ros.noise import NoiseModel
from slam_observer_ros.observer import Observer
from slam_observer_ros.types import FloatArray
from slam_observer_ros.velocity_history import HeldVelocities, VelocityHistory


def transition(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> FloatArray:
    """Return exp(V_1 dt_1) … exp(V_k dt_k) (4, 4), how the body moves from stamp to stamp."""
    held = _held(velocities, calibration, start_ns, end_ns)
    V = calibration.apply(held.body_velocities)
    return reduce(np.matmul, se3.exp(V * held.dt_s[:, None]), np.eye(4))


def motion(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: NoiseModel,
    observer: Observer,
    start_ns: int,
    end_ns: int,
) -> Motion:
    """Return how the observer's Â moves on from ``start_ns``, the stamp that it belongs to."""
    held = _held(velocities, calibration, start_ns, end_ns)
    return Motion(
        path=observer.path(calibration.apply(held.body_velocities), held.dt_s),
        measured_velocities=held.body_velocities,
        dt_s=held.dt_s,
        gap_s=held.gap_s,
        covariances=noise.motion(held),
        at_ends=_at_ends(velocities, calibration, start_ns, end_ns),
    )


def _held(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> HeldVelocities:
    delay_ns = calibration.delay_ns
    return velocities.held(start_ns - delay_ns, end_ns - delay_ns)


def _at_ends(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> FloatArray:
    """Return the mean velocities (2, 6) around both stamps, as far as their delay may reach.

    The velocity at the very stamp would pass its own noise off as a turn to tell time by. In a
    mean there is less noise. What is yet to come of it, the latest velocity stands in for.
    """
    reach_ns = calibration.delay_error_ns
    if not reach_ns:
        return np.zeros((2, 6))
    at_ns = (start_ns - calibration.delay_ns, end_ns - calibration.delay_ns)
    return np.array([velocities.mean(t_ns - reach_ns, t_ns + reach_ns) for t_ns in at_ns])
