"""The benchmark's textbook EKF has to be a fair opponent: right in space and in the plane."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import flatten_velocities, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.runs.metrics import (
    average_nees_band,
    normalised_squared_errors,
    pose_errors,
)
from slam_observer_ros.settings.estimator_settings import Settings

BENCHMARK = Path(__file__).resolve().parents[2] / 'benchmark'
LANDMARKS = np.random.default_rng(1).uniform(-6.0, 6.0, (8, 3))
VELOCITY = np.array([0.05, -0.08, 0.3, 1.0, 0.2, -0.1])
RATE_HZ = 10
PRECISE = Settings(
    angular_velocity_noise=(0.003,) * 3,
    linear_velocity_noise=(0.005,) * 3,
    observation_model='cartesian',
    point_noise=0.01,
    huber_threshold=0.0,
)


@pytest.fixture(scope='module')
def ekf_slam() -> Iterator[Any]:
    """Make the class, from a folder that is no package."""
    if not BENCHMARK.is_dir():
        pytest.skip('the benchmark does not come with an installed package')
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARK))
        yield importlib.import_module('ekf_slam').EkfSlam


def drive(ekf: Any, settings: Settings, noise: float, seed: int = 0) -> FloatArray:
    """Feed a run of 6 s to the filter, with ``noise`` times the stated noise; return the pose."""
    rng = np.random.default_rng(seed)
    axes = np.array([1.0, 1.0, 0.0]) if settings.two_d_mode else np.ones(3)
    velocity = flatten_velocities(VELOCITY) if settings.two_d_mode else VELOCITY
    deviation = np.array([*settings.angular_velocity_noise, *settings.linear_velocity_noise])
    deviation = np.where(velocity == 0.0, 0.0, deviation * RATE_HZ**0.5)
    pose = np.eye(4)
    for step in range(60):
        stamp_ns = step * 10**9 // RATE_HZ
        seen = np.arange(3) + step // 10
        points = se3.transform(se3.inverse(pose), LANDMARKS[seen] * axes)
        points = points + noise * settings.point_noise * axes * rng.standard_normal((3, 3))
        measured = velocity + noise * deviation * rng.standard_normal(6)
        ekf.add(VelocityEvent(stamp_ns, measured))
        ekf.add(ObservationEvent(stamp_ns, seen, points))
        last, pose = pose, pose @ se3.exp(velocity / RATE_HZ)
    return last


@pytest.mark.parametrize('planar', [False, True])
def test_exact_data_give_the_exact_pose_and_map(ekf_slam: Any, planar: bool) -> None:
    settings = replace(PRECISE, two_d_mode=planar)
    ekf = ekf_slam(settings)

    pose = drive(ekf, settings, noise=0.0)

    axes = np.array([1.0, 1.0, 0.0]) if planar else np.ones(3)
    np.testing.assert_allclose(ekf.pose, pose, atol=1e-12)
    np.testing.assert_allclose(ekf.world_points, LANDMARKS[ekf.landmark_ids] * axes, atol=1e-12)


@pytest.mark.parametrize('planar', [False, True])
def test_its_covariances_are_honest_where_linearisation_is_good(
    ekf_slam: Any, planar: bool
) -> None:
    settings = replace(PRECISE, two_d_mode=planar)
    axes = np.array([1.0, 1.0, 0.0]) if planar else np.ones(3)
    nees, degrees_of_freedom, point_nees = [], 0, []
    for seed in range(20):
        ekf = ekf_slam(settings)
        pose = drive(ekf, settings, noise=1.0, seed=seed)
        value, degrees_of_freedom = normalised_squared_errors(
            pose_errors(ekf.pose, pose), ekf.pose_covariance
        )
        nees.append(value / degrees_of_freedom)
        point_value, point_freedom = normalised_squared_errors(
            ekf.world_points[-1] - LANDMARKS[ekf.landmark_ids[-1]] * axes,
            ekf.landmark_covariances[-1],
        )
        point_nees.append(point_value / point_freedom)

    lower, upper = average_nees_band(int(degrees_of_freedom), 20, confidence=0.999)
    assert degrees_of_freedom == (3 if planar else 6)
    assert lower < np.mean(nees) < upper
    lower, upper = average_nees_band(int(point_freedom), 20, confidence=0.999)
    assert lower < np.mean(point_nees) < upper


def test_planar_motion_stays_planar(ekf_slam: Any) -> None:
    settings = replace(PRECISE, two_d_mode=True)
    ekf = ekf_slam(settings)

    drive(ekf, settings, noise=1.0)

    np.testing.assert_array_equal(ekf.pose[2], [0.0, 0.0, 1.0, 0.0])
    np.testing.assert_array_equal(ekf.world_points[:, 2], 0.0)
