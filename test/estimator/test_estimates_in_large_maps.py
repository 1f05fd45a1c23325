"""What an estimator does in maps too large for a dense covariance; here they soon are."""

from __future__ import annotations

from dataclasses import replace

from gain_worlds import drive, estimate
import numpy as np
import pytest

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(reorder_window=0.0, max_landmarks=0)


@pytest.fixture(autouse=True)
def _few_landmarks_are_many(monkeypatch):
    monkeypatch.setattr(RiccatiGains, 'block', BlockSize(dense=8, most=8, kept=4))


def dense(world, settings, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(RiccatiGains, 'block', BlockSize(dense=10**9))
        return estimate(world, replace(settings, relinearization_interval=0))


@pytest.mark.parametrize('two_d_mode', [False, True])
@pytest.mark.parametrize('have_ids', [True, False])
def test_estimates_are_those_of_a_dense_covariance(two_d_mode, have_ids, monkeypatch):
    """But for the noise of motions as judged by references: hardly any difference."""
    settings = replace(SETTINGS, two_d_mode=two_d_mode)
    world = drive(settings, 40.0, landmarks=40)
    if not have_ids:
        world = world.with_observations(
            lambda _, event: replace(event, ids=np.full(len(event.ids), UNKNOWN_ID))
        )
    compressed, expected = estimate(world, settings), dense(world, settings, monkeypatch)
    np.testing.assert_array_equal(compressed.landmark_ids, expected.landmark_ids)
    sigma_m = np.sqrt(np.trace(expected.landmark_covariances, axis1=1, axis2=2))
    off_m = np.linalg.norm(compressed.world_points - expected.world_points, axis=1)
    assert np.all(off_m < 0.1 * sigma_m)
    np.testing.assert_allclose(
        compressed.landmark_covariances,
        expected.landmark_covariances,
        atol=0.02 * sigma_m.max() ** 2,
    )


def test_who_looks_at_the_map_does_not_change_it():
    world = drive(SETTINGS, 20.0, landmarks=40)
    unseen, looked_at = Estimator(SETTINGS), Estimator(SETTINGS)
    for event in world.events:
        unseen.add(event)
        looked_at.add(event)
        assert looked_at.world_points.shape == (len(looked_at.landmark_ids), 3)
        assert looked_at.landmark_covariances.shape == (len(looked_at.landmark_ids), 3, 3)
        assert looked_at.landmark_map.covariances.shape == looked_at.landmark_covariances.shape
    np.testing.assert_array_equal(unseen.pose, looked_at.pose)
    np.testing.assert_array_equal(unseen.world_points, looked_at.world_points)
    np.testing.assert_array_equal(unseen.pose_covariance, looked_at.pose_covariance)


def test_a_sensor_is_calibrated_in_a_large_map_that_is_exact():
    settings = replace(SETTINGS, localization_mode='fixed', sensor_rotation_stddev=(0.02,) * 3)
    rng, estimator = np.random.default_rng(0), Estimator(settings)
    points = rng.uniform(-5.0, 5.0, (20, 3))
    known = LandmarkMap(np.arange(20), points, np.zeros((20, 3, 3)), np.ones(20, dtype=np.int64))
    estimator.load_map(known, np.eye(4))
    for k in range(20):
        estimator.add(VelocityEvent(k * 10**8, np.zeros(6)))
        seen = points[:5] + 0.01 * rng.standard_normal((5, 3))
        event = ObservationEvent(k * 10**8, np.arange(5), seen, sensor_frame='camera')
        estimator.add(event)
    assert np.linalg.norm(estimator.pose[:3, 3]) < 0.05
    assert any('camera' in entry.name for entry in estimator.calibration)


def test_all_can_be_smoothed_until_the_history_would_begin_again():
    world = drive(SETTINGS, 20.0, landmarks=40)
    settings = replace(SETTINGS, smoothing_window=0)
    estimator = estimate(world, settings)
    smoothed = estimator.smooth()
    assert len(smoothed.world_points) == len(estimator.world_points) > 8
    sigma_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
    off_m = np.linalg.norm(smoothed.world_points - estimator.world_points, axis=1)
    assert np.all(off_m < 3.0 * sigma_m)
    estimator.set_pose(estimator.pose)
    with pytest.raises(ParameterError, match='so large a map since the pose was set'):
        estimator.smooth()


def test_landmarks_make_room_for_others():
    settings = replace(SETTINGS, max_landmarks=20)
    estimator = estimate(drive(settings, 40.0, landmarks=40), settings)
    assert estimator.counts['forgotten_landmark'] > 0
    assert np.linalg.eigvalsh(estimator.landmark_covariances).min() > 0.0


def test_more_new_tags_at_once_than_are_active_keep_their_orientations(monkeypatch):
    """The orientation of a landmark that is no longer active enters P, not another's columns."""
    rng, tags = np.random.default_rng(3), 30
    points = rng.uniform(-5.0, 5.0, (tags, 3))
    orientations = so3.exp(rng.normal(size=(tags, 3)))

    def seen():
        estimator = Estimator(replace(SETTINGS, use_tag_orientation=True))
        for k in range(4):
            estimator.add(
                ObservationEvent(k * 10**8, np.arange(tags), points, orientations=orientations)
            )
            estimator.add(VelocityEvent(k * 10**8, np.array([0.0, 0.0, 0.1, 0.3, 0.0, 0.0])))
        rows = np.arange(tags)
        return estimator._state.errors.orientation_sigmas(rows), estimator.landmark_covariances

    sigmas, covariances = seen()
    monkeypatch.setattr(RiccatiGains, 'block', BlockSize(dense=10**9))
    expected_sigmas, expected_covariances = seen()
    np.testing.assert_allclose(sigmas, expected_sigmas, rtol=1e-6)
    np.testing.assert_allclose(covariances, expected_covariances, rtol=1e-6, atol=1e-9)
