"""Errors of observations that last: a landmark seen again soon says little more."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.special import chdtri

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.landmark_table import LandmarkTable
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.point_noise import repetition_factors
from slam_observer_ros.settings.estimator_settings import Settings

ERROR_TIME_S = 0.5
RATE_HZ = 10
POINTS = np.array([[3.0, 0.5, 0.2], [2.0, -2.0, 0.6], [4.0, 1.5, -0.5], [1.5, 2.5, 0.3]])
SETTINGS = Settings(
    reorder_window=0.0,
    observation_model='cartesian',
    point_noise=0.05,
    observation_correlation_time=ERROR_TIME_S,
    relinearization_angle=0.0,
)


@given(st.integers(1, 60), st.floats(0.01, 10.0), st.floats(0.01, 10.0))
def test_observations_say_together_what_their_joint_covariance_says(n, dt_s, error_time_s):
    rho = np.exp(-dt_s / error_time_s)
    joint = rho ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    expected = np.linalg.solve(joint, np.ones(n)).sum()
    since_s = np.array([np.inf, *[dt_s] * (n - 1)])
    np.testing.assert_allclose(
        (1.0 / repetition_factors(since_s, error_time_s)).sum(), expected, rtol=1e-9
    )


def test_errors_that_do_not_last_make_nothing_larger():
    assert (repetition_factors(np.array([0.0, 1.0, np.inf]), 0.0) == 1.0).all()


def standing(settings, seed, duration_s=20.0):
    """An estimator whose robot creeps, and whose observations err alike for half a second.

    With a velocity of exactly zero it would stand, and its errors last longer.
    """
    rng, estimator = np.random.default_rng(seed), Estimator(settings)
    rho = np.exp(-1.0 / (RATE_HZ * ERROR_TIME_S))
    errors = rng.normal(size=POINTS.shape)
    for step in range(round(duration_s * RATE_HZ)):
        stamp_ns = step * 10**9 // RATE_HZ
        estimator.add(VelocityEvent(stamp_ns, np.array([0.0, 0.0, 0.0, 1e-9, 0.0, 0.0])))
        points = POINTS + settings.point_noise * errors
        estimator.add(ObservationEvent(stamp_ns, np.arange(len(POINTS)), points))
        errors = rho * errors + np.sqrt(1.0 - rho**2) * rng.normal(size=POINTS.shape)
    return estimator


def covariance_of(estimator):
    return estimator.configuration_covariance(np.arange(len(POINTS)))


def configuration_nees(estimator):
    seen = (estimator.world_points - estimator.pose[:3, 3]) @ estimator.pose[:3, :3]
    error = (seen - POINTS).ravel()
    return error @ np.linalg.solve(covariance_of(estimator), error)


def test_a_robot_that_all_but_stands_knows_how_well_it_sees():
    still = replace(
        SETTINGS,
        angular_velocity_noise=(1e-4,) * 3,
        linear_velocity_noise=(1e-4,) * 3,
        huber_threshold=0.0,
    )
    unaware = replace(still, observation_correlation_time=0.0)
    band = chdtri(12 * 10, [0.995, 0.005]) / 10
    assert band[0] < mean_nees(still, runs=10) < band[1]
    assert mean_nees(unaware, runs=2) > 5.0 * band[1]


def mean_nees(settings, runs):
    return np.mean([configuration_nees(standing(settings, seed)) for seed in range(runs)])


def test_smoothing_counts_an_observation_as_the_filter_did():
    estimator = standing(SETTINGS, seed=0, duration_s=5.0)
    smoothed = estimator.smooth()
    np.testing.assert_allclose(smoothed.world_points, estimator.world_points, atol=2e-3)
    again = standing(
        replace(SETTINGS, relinearization_angle=1e-9, relinearization_interval=5), 0, 5.0
    )
    variances = np.diag(covariance_of(again))
    np.testing.assert_allclose(variances, np.diag(covariance_of(estimator)), rtol=0.1)


@pytest.mark.parametrize('stamp_ns', [0, 10**8, 10**12])
def test_a_landmark_of_a_loaded_map_counts_fully_when_it_is_first_seen(stamp_ns):
    covariances, counts = np.tile(1e-6 * np.eye(3), (4, 1, 1)), np.ones(4, dtype=np.int64)
    known = LandmarkMap(np.arange(len(POINTS)), POINTS, covariances, counts)
    estimator = Estimator(replace(SETTINGS, localization_mode='fixed'))
    estimator.load_map(known, np.eye(4), np.eye(6))
    estimator.add(ObservationEvent(stamp_ns, np.arange(len(POINTS)), POINTS))
    assert np.sqrt(estimator.pose_covariance[3, 3]) < 0.6 * SETTINGS.point_noise


def test_another_sensor_that_sees_at_the_same_instant_counts_like_the_first():
    one, two = Estimator(SETTINGS), Estimator(SETTINGS)
    for step in range(20):
        first = ObservationEvent(step * 10**8, np.arange(len(POINTS)), POINTS)
        landmarks = two._state.landmarks
        unseen_s = landmarks.unseen_s(np.arange(len(landmarks)), step * 10**8)
        assert np.isin(unseen_s, (np.inf, 0.1)).all()
        for estimator in (one, two):
            estimator.add(first)
        two.add(replace(first, points=POINTS + 1e-3))
    ratio = covariance_of(two).trace() / covariance_of(one).trace()
    assert 0.4 < ratio < 0.8


def test_a_landmark_that_was_relocated_has_not_been_seen_before():
    landmarks, row = LandmarkTable(), np.array([0])
    landmarks.append_zeros(1)
    landmarks.add(np.array([7]), 0)
    landmarks.accept(row, 10**9)
    assert landmarks.unseen_s(row, 2 * 10**9) == 1.0
    assert landmarks.unseen_s(row, 10**9) == 1.0, 'by another sensor'
    landmarks.take_for_new(row, 3 * 10**9)
    assert landmarks.unseen_s(row, 3 * 10**9) == np.inf
    assert landmarks.unseen_s(row, 4 * 10**9) == 1.0


def test_where_a_landmark_was_rejected_is_still_known_when_another_one_was_removed():
    landmarks, last = LandmarkTable(), np.array([2])
    landmarks.append_zeros(3)
    landmarks.add(np.array([7, 8, 9]), 0)
    position, tolerance_m = np.array([[4.0, 5.0, 6.0]]), np.array([0.1])
    landmarks.reject(last, position, tolerance_m)
    landmarks.delete(np.array([0]))
    assert landmarks.are_rejected_again(np.array([1]), position, tolerance_m).all()
    landmarks.reject(np.array([1]), position, tolerance_m)
    assert landmarks.rejections.tolist() == [0, 2]
