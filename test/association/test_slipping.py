"""Wheels that spin, wholly or in part, for as long as they do."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(
    two_d_mode=True,
    reorder_window=0.0,
    linear_velocity_noise=(0.02, 0.005, 0.0),
    angular_velocity_noise=(0.0, 0.0, 0.02),
    range_noise=0.03,
    bearing_noise=0.02,
)
STEP_S, OBSERVED_EVERY = 0.02, 5
V = np.array([0.0, 0.0, 1.0 / 6.0, 0.5, 0.0, 0.0])
START = se3.pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [3.0, 0.0, 0.0])
ANGLES = np.arange(12) * math.pi / 6.0
TAGS = 5.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(12)])

KNOWN = LandmarkMap(np.arange(12), TAGS, np.tile(1e-4 * np.eye(3), (12, 1, 1)), np.full(12, 10))


def drive(windows_s, made, reported, seed=1, duration_s=30.0):
    """Drive in a circle among tags, three or four in view; return events and true poses.

    In the windows the robot makes ``made`` (turn, way) times its motion, and odometry reports
    ``reported`` rad/s more than it has.
    """
    rng, pose, events, truth = np.random.default_rng(seed), START, [], {}
    for step in range(round(duration_s / STEP_S)):
        time_s, stamp_ns = step * STEP_S, 10**9 + round(step * STEP_S * 1e9)
        slips = any(start <= time_s < end for start, end in windows_s)
        noise = rng.normal(size=6) * [0.0, 0.0, 0.005, 0.01, 0.0, 0.0]
        extra = np.array([0.0, 0.0, reported * slips, 0.0, 0.0, 0.0])
        events.append(VelocityEvent(stamp_ns, V + noise + extra))
        if step % OBSERVED_EVERY == 0:
            points = se3.transform(se3.inverse(pose), TAGS)
            near = np.linalg.norm(points, axis=1) < 6.5
            seen = np.flatnonzero(near & (np.abs(np.arctan2(points[:, 1], points[:, 0])) < 1.4))
            noisy = points[seen] + rng.normal(scale=0.02, size=(len(seen), 3)) * [1.0, 1.0, 0.0]
            events.append(ObservationEvent(stamp_ns, seen, noisy))
            truth[stamp_ns] = pose
        share = np.repeat(made, 3) if slips else 1.0
        pose = pose @ se3.exp(V * share * STEP_S)
    return events, truth


def run(events, truth, in_known_map, settings=SETTINGS):
    """Return the estimator in the end, and how far off its position was after each observation."""
    estimator, off_m = Estimator(settings), []
    if in_known_map:
        estimator.load_map(KNOWN, START, 1e-6 * np.eye(6))
    else:
        estimator.set_pose(START, 1e-8 * np.eye(6))
    for event in events:
        assert estimator.add(event)
        if isinstance(event, ObservationEvent):
            off_m.append(np.linalg.norm(estimator.pose[:3, 3] - truth[event.stamp_ns][:3, 3]))
    return estimator, np.array(off_m)


@pytest.mark.parametrize('in_known_map', [False, True])
@pytest.mark.parametrize(
    ('windows_s', 'made', 'reported'),
    [
        ([(10.0, 15.0)], (0.0, 0.0), 0.0),  # stuck at a sill
        ([(3.0, 6.0)], (0.0, 0.0), 0.0),  # while all in view is new
        ([(10.0, 15.0)], (1.0, 0.0), 0.0),  # slides while it turns
        ([(10.0, 15.0)], (0.0, 1.0), 0.0),
        ([(10.0, 15.0)], (0.1, 0.1), 0.0),
        ([(10.0, 15.0)], (0.5, 0.5), 0.0),
        ([(10.0, 15.0)], (0.7, 0.7), 0.0),
        ([(10.0, 14.0)], (0.0, 0.0), 0.6),  # one wheel spins, and it stands
        ([(10.0, 14.0)], (0.0, 0.0), -0.6),
        ([(10.0, 14.0)], (1.0, 1.0), 0.6),  # one wheel spins, and it drives
    ],
)
def test_wheels_that_spin_lead_neither_robot_nor_landmarks_astray(
    windows_s, made, reported, in_known_map
):
    estimator, off_m = run(*drive(windows_s, made, reported, duration_s=20.0), in_known_map)
    assert 1 <= estimator.counts['slip'] <= 3
    assert estimator.counts['moved_landmark'] == 0
    assert off_m.max() < 0.3
    assert off_m[-1] < 0.06


@pytest.mark.parametrize('in_known_map', [False, True])
def test_each_time_anew(in_known_map):
    windows_s = [(8.0, 10.0), (12.0, 15.0), (18.0, 19.0), (21.0, 26.0)]
    estimator, off_m = run(*drive(windows_s, (0.0, 0.0), 0.0), in_known_map)
    assert estimator.counts['slip'] == len(windows_s)
    assert estimator.counts['moved_landmark'] == 0
    assert off_m.max() < 0.15


@pytest.mark.parametrize('share', [0.95, 1.0])
def test_odometry_that_is_right_or_nearly_is_believed(share):
    estimator, off_m = run(*drive([(0.0, 30.0)], (share, share), 0.0), in_known_map=False)
    assert estimator.counts['slip'] == 0
    assert off_m.max() < 0.1


def test_a_robot_that_was_placed_elsewhere_has_not_slipped():
    events, truth = drive([], (1.0, 1.0), 0.0)
    estimator = Estimator(SETTINGS)
    estimator.load_map(KNOWN, START, 1e-6 * np.eye(6))
    for event in events:
        assert estimator.add(event)
        if isinstance(event, ObservationEvent) and event.stamp_ns in (11 * 10**9, 21 * 10**9):
            off = se3.exp(np.array([0.0, 0.0, 0.2, 0.5, 0.5, 0.0]))
            estimator.set_pose(truth[event.stamp_ns] @ off, np.eye(6))
    assert estimator.counts['slip'] == 0
