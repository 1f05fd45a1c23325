"""A robot that is not where odometry has it: its wheels slipped, or someone carried it."""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.geometry.alignment import rigid_alignment
from slam_observer_ros.motion.motion import Motion
from slam_observer_ros.motion.velocity_history import HeldVelocities
from slam_observer_ros.slam.sighting import Sighting
from slam_observer_ros.slam.slam import Slam
from slam_observer_ros.types import FloatArray

MAX_DURATION_S = 4.0
"""Time, seconds, for which odometry is taken to have told nothing, at most."""

LARGE_TURN_RAD = 0.3
"""Turn, radians, that a correction, which is linear in it, does not find well."""

MIN_SPREAD = 10.0
"""Least extent of landmarks, in standard deviations, that tells how the robot has turned."""

MIN_VARIANCE_M2 = 1e-6
"""Variance, m², at least, of where a robot without odometry sees what it does after a second."""


def slip(slam: Slam, sighting: Sighting) -> None:
    """Let the robot have slipped in a way that explains what it sees.

    It is then known as badly as if odometry had told nothing for as long as that takes, and what
    it sees is yet to be used.
    """
    observer, start = slam.observer, slam.observer.A
    needed_s = _duration_s(slam, sighting)
    observer.propagate(np.array([start, _pose_after(slam, sighting)]))
    stray = HeldVelocities.unknown(np.array([0.0, min(needed_s, MAX_DURATION_S)]))
    moved = Motion(
        path=np.array([start, observer.A, observer.A]),
        measured_velocities=stray.body_velocities,
        dt_s=stray.dt_s,
        gap_s=np.zeros(2),
        covariances=slam.motion_noise.covariances(stray),
        at_ends=None,
    )
    slam.gains.predict(observer, moved)
    slam.counts['slip'] += 1


def _duration_s(slam: Slam, sighting: Sighting) -> float:
    """Return after how long without odometry a robot might see what it does, seconds."""
    settings, k, residuals = slam.settings, slam.axes.point, sighting.residuals
    points = sighting.event.points[sighting.known]
    turned_m2 = (k - 1) * settings.unknown_angular_motion**2 * np.sum(points**2, axis=1)
    after_1_s_m2 = turned_m2 + k * settings.unknown_linear_motion**2
    needed_s = np.sum(residuals.r**2, axis=1) / np.maximum(after_1_s_m2, MIN_VARIANCE_M2)
    return float(np.mean(needed_s))


def _pose_after(slam: Slam, sighting: Sighting) -> FloatArray:
    """Return Â (4, 4) from which landmarks are where they are seen, if that is far from here.

    If it is not, or can't be told, the correction that follows finds it better.
    """
    A, residuals = slam.observer.A, sighting.residuals
    k, rows = slam.axes.point, residuals.rows
    landmarks = slam.observer.points[rows]
    weights = 1.0 / np.trace(residuals.covariances, axis1=1, axis2=2)
    offsets = landmarks - np.average(landmarks, axis=0, weights=weights)
    spreads = np.linalg.svd(np.sqrt(weights)[:, None] * offsets, compute_uv=False)
    if len(rows) < k or spreads[k - 2] < MIN_SPREAD:
        return A
    seen = se3.transform(A, sighting.event.points[sighting.known])
    found = rigid_alignment(seen, landmarks, weights) @ A
    turn_rad = np.linalg.norm(so3.log(found[:3, :3] @ A[:3, :3].T))
    shift_m = np.linalg.norm(found[:3, 3] - A[:3, 3])
    reach_m = slam.settings.unknown_linear_motion * math.sqrt(MAX_DURATION_S)
    return found if turn_rad > LARGE_TURN_RAD or shift_m > reach_m else A
