"""A robot that is not where odometry has it: its wheels slipped, or someone carried it.

A slip is weighed as one hypothesis among others (:mod:`.interpretations`), which takes a joint
covariance of pose and landmarks.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.filter.robust import huber_loss
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import (
    solve_symmetric,
    transpose,
)
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.tracking.matching import MatchedObservation
from slam_observer_ros.tracking.state import State

MAX_DURATION_S = 4.0
"""Time, seconds, for which odometry is taken to have been wrong, at most."""

LARGE_TURN_RAD = 0.3
"""Turn, radians, that a correction, which is linear in it, does not find well."""

SHORT_S, TURN_RAD = 1.0, 0.5
"""Time without odometry, seconds, and turns, after which points without ids are looked for: what
is about one of these turns is found by corrections that are linear in it.
"""

ITERATIONS = 10
"""Gauss-Newton steps to the likeliest pose; the last ones hardly move it."""

MIN_VARIANCE = 1e-6
"""Least variance of a motion without odometry, rad² or m²."""


def slip(state: State, matched: MatchedObservation) -> float:
    """Let the robot have slipped to where it sees these landmarks; return the cost of the motion.

    Its pose is then as uncertain as if there had been no odometry for as long as that takes. The
    observation is yet to be used.
    """
    # The noise of a motion without odometry, for as long as it takes, to where landmarks put it.
    observer, start = state.observer, state.observer.A.copy()
    points, r = matched.known.points, matched.residuals.r
    needed_s = min(_needed_s(state, points, r), MAX_DURATION_S)
    noise = unknown_motion(state, needed_s)
    variances = np.maximum(np.diagonal(noise)[state.axes.pose], MIN_VARIANCE)
    state.slip(_pose_after(state, matched, variances), noise)
    state.counts['slip'] += 1
    strayed = se3.log(se3.inverse(start) @ observer.A)[state.axes.pose]
    return float(huber_loss(float(np.sqrt(np.sum(strayed**2 / variances)))))


def astray(state: State) -> Iterator[State]:
    """Yield copies of a state from which points without ids show where a slip may have led it."""
    for turn_rad in (0.0, TURN_RAD, -TURN_RAD):
        other = state.copy()
        turn = se3.exp(np.array([0, 0, turn_rad, 0, 0, 0]))
        other.slip(other.observer.A @ turn, unknown_motion(other, SHORT_S))
        yield other


def unknown_motion(state: State, duration_s: float) -> FloatArray:
    """Return the covariance (6, 6) of a motion without odometry for so long."""
    stray = HeldVelocities.unknown(np.array([duration_s]))
    return np.asarray(state.motion_noise.covariances(stray)[0])


def _needed_s(state: State, points: FloatArray, r: FloatArray) -> float:
    """Return how long a robot without odometry would take to get there, seconds.

    By residuals r (m, k) of ``points`` (m, 3) in the body frame.
    """
    settings, k = state.settings, state.axes.point
    turned_m2 = (k - 1) * settings.unknown_angular_motion**2 * np.sum(points**2, axis=1)
    after_1_s_m2 = turned_m2 + k * settings.unknown_linear_motion**2
    needed_s = np.sum(r**2, axis=1) / np.maximum(after_1_s_m2, MIN_VARIANCE)
    return float(np.mean(needed_s))


def _pose_after(state: State, matched: MatchedObservation, variances: FloatArray) -> FloatArray:
    """Return the likeliest Â (4, 4) after a motion of ``variances`` (p,), if it is far off."""
    # If it is not far, the correction that follows, which is linear, finds it as well.
    A, found = state.observer.A, _likeliest_pose(state, matched, variances)
    turn_rad = np.linalg.norm(so3.log(found[:3, :3] @ A[:3, :3].T))
    shift_m = np.linalg.norm(found[:3, 3] - A[:3, 3])
    reach_m = state.settings.unknown_linear_motion * math.sqrt(MAX_DURATION_S)
    return found if turn_rad > LARGE_TURN_RAD or shift_m > reach_m else A


def _likeliest_pose(
    state: State, matched: MatchedObservation, variances: FloatArray
) -> FloatArray:
    """Return Â (4, 4) by Gauss-Newton steps, as if landmarks and start were known exactly."""
    A, axes = state.observer.A, state.axes
    landmarks = state.observer.points[matched.residuals.rows]
    points = matched.known.points
    # First aligned by the landmarks alone, if they suffice.
    W = np.linalg.inv(matched.covariances[matched.rows >= 0][:, : axes.point, : axes.point])
    found = A
    if len(points) >= axes.point:
        weights = np.trace(W, axis1=1, axis2=2)
        found = rigid_alignment(se3.transform(A, points), landmarks, weights) @ A
    # Then by landmarks and motion together.
    for _ in range(ITERATIONS):
        expected = se3.transform(se3.inverse(found), landmarks)
        C = axes.output_matrix(expected)
        CW, left = transpose(C) @ W, (points - expected)[:, : axes.point, None]
        strayed = se3.log(se3.inverse(A) @ found)[axes.pose]
        H = np.diag(1.0 / variances) + np.sum(CW @ C, axis=0)
        gradient = strayed / variances + np.sum(CW @ left, axis=0)[:, 0]
        found = found @ se3.exp(-axes.full_pose(solve_symmetric(H, gradient)))
    return found
