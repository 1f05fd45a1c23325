"""Whatever a message states, covariances that go out are some, and no run ends by them."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import are_covariances, lifted, mended
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

PERIOD_NS = 100_000_000
SIZES = (1e-300, 1e-12, 1.0, 1e6, 1e12, 1e300)
WORLD = np.array(
    [[4.0, 1.0, 0.3], [-2.0, 3.0, 0.0], [1.0, -5.0, 0.6], [6.0, 4.0, 0.1], [-4.0, -3.0, 0.4]]
)
IDS = np.arange(len(WORLD))


def shaped(shape: str, size: float, d: int) -> FloatArray:
    """A matrix (d, d) of one kind whose largest entries are of about this size."""
    matrix = np.diag(np.full(d, size))
    if shape == 'singular':
        matrix = np.full((d, d), size)
    elif shape == 'long':
        matrix[0, 0] = 1e-3 * min(size, 1.0)
    elif shape == 'asymmetric':
        matrix[0, 1] = 0.5 * size
    elif shape == 'indefinite':
        matrix[0, 0] *= -1.0
    return matrix


@pytest.mark.parametrize('shape', ['round', 'singular', 'long', 'asymmetric', 'indefinite'])
@pytest.mark.parametrize('stated', ['points', 'velocities', 'map', 'map and points', 'start'])
def test_no_covariance_that_is_stated_ends_a_run(stated: str, shape: str) -> None:
    for size in SIZES:
        for settings in (
            Settings(localization_mode='fixed'),
            Settings(localization_mode='uncertain', two_d_mode=True),
            Settings(localization_mode='off', observation_correlation_time=0.3),
        ):
            run(settings, stated, shape, size)


def run(settings: Settings, stated: str, shape: str, size: float) -> None:
    estimator, pose = Estimator(settings), np.eye(4)
    body_velocity = np.array([0.0, 0.0, 0.3, 0.8, 0.0, 0.0])
    of_points = np.tile(shaped(shape, size, 3), (len(IDS), 1, 1)) if 'points' in stated else None
    of_velocity = shaped(shape, size, 6) if stated == 'velocities' else None
    is_right = shape not in ('asymmetric', 'indefinite')
    if 'map' in stated and is_right and size < 1e12:
        covariances = np.tile(shaped(shape, size, 3), (len(IDS), 1, 1))
        estimator.load_map(LandmarkMap(IDS, WORLD, covariances, np.zeros(len(IDS), dtype=int)))
    if stated == 'start' and is_right:
        estimator.set_pose(pose, shaped(shape, size, 6))
    for step in range(7):
        stamp_ns = (step + 1) * PERIOD_NS
        estimator.add(VelocityEvent(stamp_ns, body_velocity, of_velocity))
        pose = pose @ se3.exp(0.1 * body_velocity)
        points = se3.transform(se3.inverse(pose), WORLD)
        estimator.add(ObservationEvent(stamp_ns, IDS, points, of_points))
        assert np.isfinite(estimator.pose).all()
        for covariances in (estimator.pose_covariance, estimator.landmark_covariances):
            assert covariances is not None
            assert are_covariances(covariances).all(), (settings, stated, shape, size)


def test_of_an_observation_with_one_nan_covariance_the_other_points_are_used() -> None:
    estimator = Estimator(Settings(confirmations=1))
    covariances = np.tile(0.01 * np.eye(3), (len(IDS), 1, 1))
    covariances[2, 0, 0] = np.nan
    assert estimator.add(ObservationEvent(PERIOD_NS, IDS, WORLD, covariances))
    estimator.flush()
    np.testing.assert_array_equal(estimator.landmark_ids, [0, 1, 3, 4])
    assert estimator.counts['bad_point'] == 1
    assert estimator.counts['observed_point'] == len(IDS)
    assert not estimator.dropped


def test_an_observation_with_nan_covariances_alone_is_refused() -> None:
    estimator = Estimator(Settings())
    covariances = np.full((len(IDS), 3, 3), np.nan)
    assert not estimator.add(ObservationEvent(PERIOD_NS, IDS, WORLD, covariances))
    assert estimator.dropped == {'not_finite': 1}


def test_points_that_are_stated_to_be_anywhere_are_counted() -> None:
    estimator = Estimator(Settings())
    covariances = np.tile(1e6 * np.eye(3), (len(IDS), 1, 1))
    estimator.add(ObservationEvent(PERIOD_NS, IDS, WORLD, covariances))
    estimator.flush()
    assert estimator.counts['vague_point'] == len(IDS)


def test_a_covariance_that_rounding_has_spoilt_is_mended() -> None:
    spoilt = np.array([[1.0, 1.0 + 1e-9], [1.0 - 1e-9, 1.0]])
    whole = mended(spoilt - 1e-9 * np.eye(2))
    np.testing.assert_allclose(whole, np.ones((2, 2)), atol=1e-8)
    assert np.linalg.eigvalsh(whole).min() > -1e-15


def test_what_a_correction_leaves_is_lifted_to_the_rounding_of_what_was_there() -> None:
    left = np.array([[-1e-12, 0.0], [0.0, 1.0]])
    whole = lifted(left, np.array([1e4, 1.0]))
    np.linalg.cholesky(whole)
    assert whole[0, 0] <= 1e4 * 1e-14
    np.testing.assert_allclose(whole[1], [0.0, 1.0])
