"""Events in another frame: what a message says is unknown stays a number there."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, ObservationEvent, VelocityEvent
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

UNKNOWN = float(np.finfo(np.float64).max)
"""The largest number there is: what drivers write where a variance is unknown."""

MOUNTS = se3.exp(np.random.default_rng(0).normal(size=(200, 6)))


def unknown(size):
    return np.diag(np.full(size, UNKNOWN))


@pytest.mark.parametrize('rows', [[2, 1], [2, 1, 1], [0], [2, 1, 0]])
def test_points_are_picked_by_rows_or_by_a_mask(rows):
    ids, points, noise = (
        5 + np.arange(3),
        np.arange(9.0).reshape(3, 3),
        np.tile(np.eye(3), (3, 1, 1)),
    )
    event = ObservationEvent(0, ids, points)
    residuals = Residuals(ids, points, points, points, noise, np.zeros(3), np.ones(3))
    assert event.select(np.array(rows)).ids.tolist() == ids[rows].tolist()
    assert residuals.select(np.array(rows)).rows.tolist() == ids[rows].tolist()
    mask = np.isin(np.arange(3), rows)
    assert event.select(mask).ids.tolist() == residuals.select(mask).rows.tolist() == [*ids[mask]]


@pytest.mark.parametrize('known_m2', [None, 1e-4])
def test_unknown_covariances_are_numbers_however_the_sensor_is_mounted(known_m2):
    points = unknown(3)[None].copy()
    if known_m2 is not None:
        points[0, 0, 0] = known_m2  # one axis is known, the others are not
    zero = np.zeros(6)
    for mount in MOUNTS:
        seen = ObservationEvent(0, np.array([1]), np.ones((1, 3)), points).moved(mount)
        velocity = VelocityEvent(0, zero, unknown(6)).moved(mount)
        angular = AngularVelocityEvent(0, zero[:3], unknown(3)).moved(mount)
        for covariance in (seen.covariances, velocity.covariance, angular.covariance):
            assert np.isfinite(covariance).all()
            assert np.diagonal(covariance, axis1=-2, axis2=-1).max() > 1e5


def test_a_late_observation_of_unknown_covariance_leaves_the_state_a_state():
    rng = np.random.default_rng(1)
    for _ in range(15):
        estimator = Estimator(Settings(reorder_window=0.0, confirmations=1))
        turning = np.concatenate([rng.normal(size=3), [1.0, 0.0, 0.0]])
        points, ids = rng.normal(scale=4.0, size=(3, 3)), np.arange(3)
        for step in range(12):
            assert estimator.add(VelocityEvent(step * 10**8, turning))
            assert estimator.add(ObservationEvent(step * 10**8, ids, points))
        late = ObservationEvent(65 * 10**7, ids, points, np.tile(unknown(3), (3, 1, 1)))
        assert estimator.add(late)
        assert estimator.add(ObservationEvent(12 * 10**8, ids, points))
        assert np.isfinite(estimator.pose).all()
        assert np.isfinite(estimator.world_points).all()
