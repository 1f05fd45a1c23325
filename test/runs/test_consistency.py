"""Consistency: the covariances that are published fit the errors that are made.

The benchmark does the same over longer loops and 50 runs.
"""

from __future__ import annotations

from gain_worlds import drive, START_NS
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.runs.metrics import (
    average_nees_band,
    normalised_squared_errors,
    pose_errors,
)
from slam_observer_ros.settings.estimator_settings import Settings

RUNS = 20
CHECKPOINT_NS = 2_500_000_000

modes = pytest.mark.parametrize(('two_d_mode', 'degrees_of_freedom'), [(False, 6), (True, 3)])


def errors_and_covariances(settings, seed, duration_s, noise=1.0):
    """Errors (c, 6) and covariances (c, 6, 6) of the pose, mean NEES (c,) of the map."""
    world = drive(settings, duration_s, seed, noise, seen=3)
    estimator = Estimator(settings)
    errors, covariances, of_map = [], [], []
    for event in world.events:
        estimator.add(event)
        time_ns = event.stamp_ns - START_NS
        if time_ns and time_ns % CHECKPOINT_NS == 0 and isinstance(event, ObservationEvent):
            errors.append(pose_errors(estimator.pose, world.true_pose(event.stamp_ns)))
            covariances.append(estimator.pose_covariance)
            misses = estimator.world_points - world.world_points[estimator.landmark_ids]
            squares, freedom = normalised_squared_errors(misses, estimator.landmark_covariances)
            of_map.append(squares.sum() / freedom.sum())
    return np.array(errors), np.array(covariances), np.array(of_map)


def pose_anees(errors, covariances):
    """ANEES (c,) per degree of freedom over runs of errors (runs, c, 6)."""
    squares, freedom = normalised_squared_errors(errors, covariances)
    return squares.sum(axis=0) / freedom.sum(axis=0)


@modes
def test_riccati_covariances_are_honest(two_d_mode, degrees_of_freedom):
    settings = Settings(two_d_mode=two_d_mode, reorder_window=0.0)
    runs = [errors_and_covariances(settings, seed, 40.0) for seed in range(RUNS)]
    errors, covariances, of_map = map(np.array, zip(*runs, strict=True))
    anees = pose_anees(errors, covariances)
    lower, upper = average_nees_band(degrees_of_freedom, RUNS)
    assert np.mean((lower < anees) & (anees < upper)) >= 0.9
    assert 0.85 < np.mean(anees) < 1.15
    assert 0.8 < np.mean(of_map) < 1.25


@modes
def test_a_filter_that_is_given_half_of_the_noise_is_found_out(two_d_mode, degrees_of_freedom):
    settings = Settings(two_d_mode=two_d_mode, reorder_window=0.0)
    runs = [errors_and_covariances(settings, seed, 10.0, noise=2.0) for seed in range(15)]
    errors, covariances, _ = map(np.array, zip(*runs, strict=True))
    _, upper = average_nees_band(degrees_of_freedom, len(runs))
    assert np.all(pose_anees(errors, covariances) > upper)


def under_a_ceiling(settings, seed):
    """Error (6,) and covariance (6, 6) after 15 s below 40 tags, and how many were rejected."""
    rng = np.random.default_rng(seed)
    tags = np.column_stack([rng.uniform(-6.0, 6.0, (40, 2)), np.full(40, 3.0)])
    camera = se3.pose(np.eye(3), np.array([0.2, 0.0, 0.4]))
    V, estimator = np.array([0.0, 0.0, 0.25, 0.8, 0.0, 0.0]), Estimator(settings)
    for step in range(301):
        stamp_ns, true_pose = step * 50_000_000, se3.exp(V * 0.05 * step)
        noise = np.array([0.0, 0.0, 0.03, 0.02, 0.02, 0.0]) / np.sqrt(0.05)
        estimator.add(VelocityEvent(stamp_ns, V + noise * rng.normal(size=6)))
        if step % 4 == 0:
            points = se3.transform(se3.inverse(true_pose @ camera), tags)
            seen = np.flatnonzero(np.linalg.norm(points[:, :2], axis=1) < 1.7 * points[:, 2])
            roots = np.linalg.cholesky(ObservationNoise(settings).at(points[seen]))
            noisy = points[seen] + (roots @ rng.normal(size=(len(seen), 3, 1)))[:, :, 0]
            estimator.add(ObservationEvent(stamp_ns, seen, noisy).moved(camera))
    errors = pose_errors(estimator.pose, true_pose)
    return errors, estimator.pose_covariance, estimator.counts['rejected_landmark']


def test_a_planar_robot_below_its_landmarks_stays_honest():
    """A bearing errs in proportion to how far up a landmark is, too."""
    settings = Settings(two_d_mode=True, reorder_window=0.0, range_noise=0.05, bearing_noise=0.02)
    errors, covariances, rejected = map(
        np.array, zip(*(under_a_ceiling(settings, seed) for seed in range(RUNS)), strict=True)
    )
    lower, upper = average_nees_band(3, RUNS)
    assert lower < pose_anees(errors[:, None], covariances[:, None])[0] < upper
    assert rejected.sum() <= 2
