"""The motion between two stamps: velocities as the calibration has them, with their noise."""

from __future__ import annotations

from functools import reduce
from itertools import accumulate

import numpy as np

from slam_observer_ros.geometry import se3
from slam_observer_ros.matrices import transpose
from slam_observer_ros.motion.calibration import Calibration
from slam_observer_ros.motion.motion import Motion
from slam_observer_ros.motion.noise import MotionNoise
from slam_observer_ros.motion.velocity_history import HeldVelocities, VelocityHistory
from slam_observer_ros.observer import Observer
from slam_observer_ros.types import FloatArray


def transition(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> FloatArray:
    """Return exp(V_1 dt_1) … exp(V_k dt_k) (4, 4), how the body moves from stamp to stamp."""
    held = _held(velocities, calibration, start_ns, end_ns)
    V = calibration.apply(held.body_velocities)
    return reduce(np.matmul, se3.exp(V * held.dt_s[:, None]), np.eye(4))


def transition_covariance(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    start_ns: int,
    end_ns: int,
) -> FloatArray:
    """Return that (6, 6) of w in exp(w) Φ, Φ the :func:`transition`: body frame at its start."""
    held = _held(velocities, calibration, start_ns, end_ns)
    motions = se3.exp(calibration.apply(held.body_velocities) * held.dt_s[:, None])
    starts = list(accumulate(motions[:-1], np.matmul, initial=np.eye(4)))
    Ad = se3.adjoint(np.array(starts))
    covariance: FloatArray = (Ad @ noise.covariances(held) @ transpose(Ad)).sum(axis=0)
    return covariance


def motion(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    observer: Observer,
    start_ns: int,
    end_ns: int,
    at_start: FloatArray | None,
) -> Motion:
    """Return how the observer's Â moves on from ``start_ns``, the stamp that it belongs to.

    ``at_start`` (6,) is the mean velocity around that stamp which the motion before this one
    ended with, or None if there was none. As each motion begins like the last one ended, what the
    delay's error does to all of them depends on their two ends alone.
    """
    held = _held(velocities, calibration, start_ns, end_ns)
    if at_start is None:
        at_start = _around(velocities, calibration, start_ns)
    return Motion(
        path=observer.path(calibration.apply(held.body_velocities), held.dt_s),
        measured_velocities=held.body_velocities,
        dt_s=held.dt_s,
        gap_s=held.gap_s,
        covariances=noise.covariances(held),
        at_ends=np.array([at_start, _around(velocities, calibration, end_ns)]),
    )


def _held(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> HeldVelocities:
    delay_ns = calibration.delay_ns
    return velocities.held(start_ns - delay_ns, end_ns - delay_ns)


def _around(velocities: VelocityHistory, calibration: Calibration, stamp_ns: int) -> FloatArray:
    """Return the mean velocity (6,) around a stamp, as far as its delay may reach.

    The velocity at the very stamp would pass its own noise off as a turn to tell time by. In a
    mean there is less noise. What is yet to come of it, the latest velocity stands in for.
    """
    reach_ns = calibration.delay_error_ns
    if not reach_ns:
        return np.zeros(6)
    centre_ns = stamp_ns - calibration.delay_ns
    return velocities.mean(centre_ns - reach_ns, centre_ns + reach_ns)
