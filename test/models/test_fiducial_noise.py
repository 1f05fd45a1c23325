"""Noise of tags from their corners' noise: by simulated images, by formulas where frontal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.models.observation_noise import ObservationNoise, orientation_covariances
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(
    observation_model='fiducial', focal_length=600.0, tag_size=0.2, pixel_noise=0.1
)
CORNERS = 0.1 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FRONTAL = so3.exp(np.array([np.pi, 0.0, 0.0]))  # its normal towards a camera that looks along z


def noise(range_m, Z=FRONTAL, settings=SETTINGS):
    """Covariances (3, 3) of position and orientation of a tag straight ahead."""
    event = ObservationEvent(0, np.array([1]), np.array([[0.0, 0.0, range_m]]))
    model = ObservationNoise(settings)
    return model.covariances(event)[0], model.orientation_covariances(event, Z[None])[0]


def fitted_errors(range_m, Z, rng, runs=400):
    """Errors (runs, 6) of poses fitted to noisy corners by least squares: turns, shifts."""

    def image(pose):
        q = CORNERS @ (so3.exp(pose[:3]) @ Z).T + pose[3:] + [0.0, 0.0, range_m]
        return (600.0 * q[:, :2] / q[:, 2:]).ravel()

    def derivatives(pose):
        steps = 1e-6 * np.eye(6)
        return np.array([(image(pose + h) - image(pose - h)) / 2e-6 for h in steps]).T

    errors = []
    for _ in range(runs):
        seen, pose = image(np.zeros(6)) + 0.1 * rng.standard_normal(8), np.zeros(6)
        for _ in range(3):
            pose = pose + np.linalg.lstsq(derivatives(pose), seen - image(pose), rcond=None)[0]
        errors.append(pose)
    return np.array(errors)


def test_it_is_how_far_poses_are_off_that_are_fitted_to_noisy_corners():
    rng = np.random.default_rng(0)
    Z = FRONTAL @ so3.exp(np.array([0.4, 0.5, 0.2]))
    position, orientation = noise(1.5, Z)
    sampled = np.cov(fitted_errors(1.5, Z, rng).T)
    whitening = np.linalg.inv(np.linalg.cholesky(orientation))
    np.testing.assert_allclose(whitening @ sampled[:3, :3] @ whitening.T, np.eye(3), atol=0.25)
    # The position's is that of a frontal tag: less is known of the range of one that is tilted.
    assert 0.5 < sampled[5, 5] / position[2, 2] < 3.0
    np.testing.assert_allclose(sampled[3, 3], position[0, 0], rtol=0.3, atol=1e-8)


@pytest.mark.parametrize('range_m', [1.0, 2.0, 4.0])
def test_frontal_tags_have_the_errors_of_the_formulas(range_m):
    position, orientation = noise(range_m)
    across, along = 0.1 / 1200.0 * range_m, range_m**2 * 0.1 / (np.sqrt(2.0) * 600.0 * 0.2)
    deviations = np.sqrt(np.diag(position))
    np.testing.assert_allclose(deviations[:2], across, rtol=0.05, atol=1e-4)
    np.testing.assert_allclose(deviations[2], along, rtol=0.05)
    tilt, roll = 2.0 * 0.1 * range_m**2 / (600.0 * 0.04), along / range_m
    np.testing.assert_allclose(np.sqrt(np.diag(orientation)), [tilt, tilt, roll], rtol=0.1)


def test_it_does_not_depend_on_the_axes_of_the_message():
    rng = np.random.default_rng(1)
    turn, Z = so3.exp(rng.normal(size=3)), FRONTAL @ so3.exp(np.array([0.4, 0.0, 0.3]))
    _, expected = noise(2.0, Z)
    event = ObservationEvent(0, np.array([1]), np.array([[0.0, 0.0, 2.0]]) @ turn.T)
    model = ObservationNoise(SETTINGS)
    turned = model.orientation_covariances(event, (turn @ Z)[None])[0]
    np.testing.assert_allclose(turned, turn @ expected @ turn.T, atol=1e-9)


def test_what_a_message_states_is_taken_and_else_the_settings_say():
    event = ObservationEvent(0, np.array([1, 2]), np.ones((2, 3)))
    stated = np.array([0.04 * np.eye(3), np.zeros((3, 3))])
    event = replace(event, orientation_covariances=stated)
    model = ObservationNoise(Settings(orientation_noise=0.1))
    found = model.orientation_covariances(event, np.tile(np.eye(3), (2, 1, 1)))
    expected = [0.04 * np.eye(3), 0.01 * np.eye(3)]
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_nothing_is_known_of_a_tag_that_is_seen_as_a_point():
    _, orientation = noise(1e4)
    assert np.all(np.isfinite(orientation))
    assert np.sqrt(orientation[0, 0]) == pytest.approx(np.pi, rel=1e-3)


def test_where_one_has_no_orientation_those_of_others_are_as_they_were():
    settings = Settings(observation_model='fiducial')
    Z, points = np.stack([np.eye(3), np.zeros((3, 3))]), np.array([[2.0, 0, 0], [2.0, 1, 0]])
    both = orientation_covariances(Z, points, settings)
    np.testing.assert_array_equal(both[0], orientation_covariances(Z[:1], points[:1], settings)[0])
    np.testing.assert_allclose(both[1], np.pi**2 * np.eye(3))


@pytest.mark.parametrize('size', [1e-3, 100.0])
@pytest.mark.parametrize('focal_length', [1.0, 1e5])
@pytest.mark.parametrize('pixel_noise', [1e-6, 1e3])
@pytest.mark.parametrize('range_m', [0.0, 1e-6, 1.0, 1e3, 1e6])
def test_whatever_is_set_covariances_are_positive(size, focal_length, pixel_noise, range_m):
    settings = Settings(
        observation_model='fiducial',
        tag_size=size,
        focal_length=focal_length,
        pixel_noise=pixel_noise,
    )
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(50, 3))
    towards *= range_m / np.linalg.norm(towards, axis=1, keepdims=True)
    covariances = orientation_covariances(so3.exp(rng.normal(size=(50, 3))), towards, settings)
    variances = np.linalg.eigvalsh(covariances)
    assert variances.min() > 0.0
    assert variances.max() < 1.001 * np.pi**2
