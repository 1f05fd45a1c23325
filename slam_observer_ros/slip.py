"""A robot that is not where odometry has it: its wheels slipped, or someone carried it."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.axes import axes_of
from slam_observer_ros.gains.motion import Motion
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.alignment import rigid_alignment
from slam_observer_ros.settings import Settings
from slam_observer_ros.sighting import Sighting
from slam_observer_ros.slam import Slam
from slam_observer_ros.types import FloatArray
from slam_observer_ros.velocity_history import HeldVelocities

LONGEST_S = 4.0
"""Time, seconds, for which odometry is taken to have told nothing, at most."""

LARGE_TURN_RAD = 0.3
"""Turn, radians, that a correction, which is linear in it, does not find well."""


def slip(slam: Slam, sighting: Sighting) -> None:
    """Let the robot have slipped in a way that explains what it sees.

    It is then known as badly as if odometry had told nothing for as long as that takes, and what
    it sees is yet to be used.
    """
    observer, start = slam.observer, slam.observer.A
    observer.propagate(np.array([start, _pose_after(slam, sighting)]))
    stray = HeldVelocities.unknown(np.array([0.0, _duration_s(slam.settings, sighting)]))
    moved = Motion(
        path=np.array([start, observer.A, observer.A]),
        measured_velocities=stray.body_velocities,
        dt_s=stray.dt_s,
        gap_s=np.zeros(2),
        covariances=slam.noise.motion(stray),
        at_ends=np.zeros((2, 6)),
    )
    slam.gains.predict(observer, moved)
    slam.counts['slip'] += 1


def _duration_s(settings: Settings, sighting: Sighting) -> float:
    """Return after how long without odometry a robot might see what it does, seconds."""
    k, residuals = axes_of(settings.two_d_mode).point, sighting.residuals
    points = sighting.event.points[sighting.rows >= 0]
    turned_m2 = (k - 1) * settings.unknown_angular_motion**2 * np.sum(points**2, axis=1)
    after_1_s_m2 = turned_m2 + k * settings.unknown_linear_motion**2
    rounding_m2 = np.finfo(np.float64).tiny
    needed_s = np.sum(residuals.r**2, axis=1) / (after_1_s_m2 + rounding_m2)
    return min(float(np.mean(needed_s)), LONGEST_S)


def _pose_after(slam: Slam, sighting: Sighting) -> FloatArray:
    """Return Â (4, 4) from which landmarks are where they are seen, if the robot has turned.

    If it has not, or that can't be told, the correction that follows finds it better.
    """
    observer, residuals = slam.observer, sighting.residuals
    points, rows = sighting.event.points[sighting.rows >= 0], residuals.rows
    if len(rows) < axes_of(slam.settings.two_d_mode).point:
        return observer.A
    landmarks = observer.y_ref[rows] + observer.a[rows]
    weights = 1.0 / np.trace(residuals.covariances, axis1=1, axis2=2)
    found = rigid_alignment(points, landmarks, weights)
    turn_rad = np.linalg.norm(so3.log(found[:3, :3] @ observer.A[:3, :3].T))
    return found if turn_rad > LARGE_TURN_RAD else observer.A
