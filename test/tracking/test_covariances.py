"""The map as the robot sees it: its errors where the robot may be turned by much."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.covariances import SMALL_RAD, turned_moment


@pytest.mark.parametrize(('q', 'k'), [(1, 2), (3, 3)])
def test_errors_are_as_large_as_those_that_are_drawn(q, k):
    rng = np.random.default_rng(0)
    scales = np.append(np.full(q, 0.3), np.linspace(0.01, 0.5, 2 * k))
    root = scales[:, None] * rng.standard_normal((len(scales), len(scales))) / 2.0
    P = root @ root.T
    x = rng.standard_normal((100_000, len(scales))) @ root.T
    w = np.zeros((len(x), 3))
    w[:, 3 - q :] = x[:, :q]
    d = x[:, q:].reshape(-1, 2, k, 1)
    drawn = (so3.left_jacobian(w)[:, None, :k, :k] @ d).reshape(len(x), -1)
    moment = turned_moment(P[q:, q:], P[q:, :q], P[:q, :q])
    expected = drawn.T @ drawn / len(x)
    assert np.mean(drawn @ np.linalg.inv(moment) * drawn) == pytest.approx(1.0, abs=0.05)
    assert_allclose(moment, expected, atol=0.05 * np.abs(expected).max())


def test_where_the_attitude_is_known_nothing_changes():
    P = np.diag([0.9 * SMALL_RAD**2, 1.0, 4.0])
    assert_array_equal(turned_moment(P[1:, 1:], P[1:, :1], P[:1, :1]), P[1:, 1:])


@pytest.mark.parametrize('two_d_mode', [True, False])
def test_of_no_landmarks_there_is_an_empty_covariance_however_unknown_the_heading(two_d_mode):
    settings = Settings(reorder_window=0.0, two_d_mode=two_d_mode)
    estimator = Estimator(settings)
    estimator.add(ObservationEvent(0, np.arange(3), np.diag([3.0, 2.0, 0.0])))
    estimator.set_pose(np.eye(4), np.eye(6))
    assert estimator.configuration_covariance(np.empty(0, dtype=np.int64)).shape == (0, 0)
