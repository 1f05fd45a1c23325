"""The motion between two stamps: velocities as the calibration has them, with their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.held_velocities import HeldVelocities
from slam_observer_ros.sensor_models.motion import Motion, Passage
from slam_observer_ros.sensor_models.motion_noise import MotionNoise
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory


def transition(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> FloatArray:
    """Return exp(V_1 dt_1) … exp(V_k dt_k) (4, 4), how the body moves from stamp to stamp."""
    held = _held(velocities, calibration, start_ns, end_ns)
    end: FloatArray = _path(np.eye(4), held, calibration)[-1]
    return end


def transition_covariance(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    start_ns: int,
    end_ns: int,
) -> FloatArray:
    """Return the covariance (6, 6) of w in exp(w) Φ, Φ the `transition`, axes of the start."""
    held = _held(velocities, calibration, start_ns, end_ns)
    Ad = se3.adjoint(_path(np.eye(4), held, calibration))
    return se3.summed_noise(Ad, noise.covariances(held))


def integrate(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    A: FloatArray,
    start_ns: int,
    end_ns: int,
    at_start: FloatArray | None,
) -> Motion:
    """Return how Â, ``A`` (4, 4) at ``start_ns``, moves on to ``end_ns``.

    ``at_start`` (6,) is the mean velocity with which the motion before ended, or None. As each
    begins like the last one ended, the delay's error shows in their two ends alone.
    """
    held = _held(velocities, calibration, start_ns, end_ns)
    at_ends = None
    if calibration.delay_error_ns:
        at_start = _around(velocities, calibration, start_ns) if at_start is None else at_start
        at_ends = np.array([at_start, _around(velocities, calibration, end_ns)])
    return Motion(
        path=_path(A, held, calibration),
        measured_velocities=held.body_velocities,
        dt_s=held.dt_s,
        covariances=noise.covariances(held),
        duration_s=to_s(end_ns - start_ns),
        at_ends=at_ends,
        calibration=calibration,
    )


def integrate_until(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    A: FloatArray,
    start_ns: int,
    stamps_ns: IntArray,
    at_start: FloatArray | None,
    with_covariances: bool,
) -> Passage:
    """Return how Â, ``A`` (4, 4) at ``start_ns``, moves on to each of s stamps of velocities.

    As :func:`integrate` would have had it at each stamp, maybe without what covariances take.
    """
    held = velocities.held_until(start_ns, stamps_ns, calibration.delay_ns)
    if calibration.delay_ns < 0:
        held = replace(held, usual_s=held.usual_s + to_s(-calibration.delay_ns))
    path, last = _path(A, held.whole, calibration), held.last
    at_ends = None
    if with_covariances and (reach_ns := calibration.delay_error_ns):
        at_ends = np.zeros((2, len(stamps_ns), 6))
        starts_ns = np.full(len(stamps_ns), start_ns)
        for of_each, instants_ns in zip(at_ends, (starts_ns, stamps_ns), strict=True):
            centres_ns = instants_ns - calibration.delay_ns
            of_each[:] = velocities.means_until(centres_ns, reach_ns, stamps_ns)
        if at_start is not None:
            at_ends[0] = at_start
    return Passage(
        path=path,
        poses=path[held.counts]
        @ se3.exp(calibration.apply(last.body_velocities) * last.dt_s[:, None]),
        held=held,
        at_ends=at_ends,
        calibration=calibration,
        motion_noise=noise,
    )


def _held(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> HeldVelocities:
    delay_ns = calibration.delay_ns
    held = velocities.held(start_ns - delay_ns, end_ns - delay_ns)
    if delay_ns >= 0:
        return held
    # The velocities of that time are yet to come: it is no sign that one was lost.
    return replace(held, usual_s=held.usual_s + to_s(-delay_ns))


def _path(start: FloatArray, held: HeldVelocities, calibration: Calibration) -> FloatArray:
    """Return the poses (k + 1, 4, 4) that velocities lead to, from ``start`` (4, 4) on."""
    return se3.path(start, calibration.apply(held.body_velocities) * held.dt_s[:, None])


def _around(velocities: VelocityHistory, calibration: Calibration, stamp_ns: int) -> FloatArray:
    """Return the mean velocity (6,) around a stamp, as far as its delay may reach.

    The velocity at the very stamp would pass its own noise off as a turn to read the time from; a
    mean has less noise. What is yet to come of it, the latest velocity stands in for.
    """
    reach_ns, centre_ns = calibration.delay_error_ns, stamp_ns - calibration.delay_ns
    return velocities.mean(centre_ns - reach_ns, centre_ns + reach_ns)
