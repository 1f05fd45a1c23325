"""Orientations of tags in the estimator: one tag is enough for the heading, flips do no harm."""

from __future__ import annotations

from dataclasses import replace
import logging

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import flipped

TAG = np.array([3.0, 0.0, 0.0])
FACING = so3.exp(np.array([0.0, -np.pi / 2 + 0.4, 0.0]))  # a tag's z axis is its normal
SETTINGS = Settings(
    use_tag_orientation=True,
    orientation_noise=0.02,
    observation_model='cartesian',
    point_noise=0.02,
    reorder_window=0.0,
    angular_bias_stddev=(0.0, 0.0, 0.0),
)


def drive(settings, turn_rad=0.15, with_orientation=True, flips=(), seconds=20):
    """An estimator that has stood before one tag, then turned unnoticed, and stood again."""
    estimator, rng = Estimator(settings), np.random.default_rng(0)
    for k in range(10 * seconds):
        A = se3.exp(np.array([0.0, 0.0, turn_rad if k >= 20 else 0.0, 0.0, 0.0, 0.0]))
        # With a velocity of exactly zero it would stand, and know it.
        estimator.add(VelocityEvent(k * 10**8, np.array([0.0, 0.0, 0.0, 1e-9, 0.0, 0.0])))
        if 20 <= k < 60:  # it turns now, and says nothing of it
            continue
        back = se3.inverse(A)
        y = se3.transform(back, TAG[None]) + 0.02 * rng.normal(size=(1, 3))
        Z = back[:3, :3] @ FACING[None] @ so3.exp(0.02 * rng.normal(size=(1, 3)))
        Z = flipped(Z, y) if k in flips else Z
        event = ObservationEvent(k * 10**8, np.array([7]), y)
        estimator.add(replace(event, orientations=Z) if with_orientation else event)
    return estimator


UNSURE = replace(SETTINGS, angular_velocity_noise=(0.05,) * 3, linear_velocity_noise=(0.2,) * 3)


def heading_error(estimator, turn_rad=0.15):
    return so3.log(estimator.pose[:3, :3] @ so3.exp(np.array([0.0, 0.0, -turn_rad])))[2]


def test_one_tag_in_view_is_enough_for_the_heading():
    points = drive(UNSURE, with_orientation=False)
    tags = drive(UNSURE)
    assert abs(heading_error(tags)) < 0.06
    assert np.sqrt(tags.pose_covariance[2, 2]) < 0.03
    assert np.sqrt(points.pose_covariance[2, 2]) > 0.05


def test_without_the_parameter_orientations_change_nothing():
    off = replace(UNSURE, use_tag_orientation=False)
    with_them, without = drive(off), drive(off, with_orientation=False)
    np.testing.assert_array_equal(with_them.pose, without.pose)
    np.testing.assert_array_equal(with_them.pose_covariance, without.pose_covariance)


def test_other_gains_use_the_position_and_say_so(caplog):
    settings = replace(UNSURE, gains='constant')
    with caplog.at_level(logging.WARNING):
        with_them = drive(settings)
    assert 'use_tag_orientation' in caplog.text
    without = drive(replace(settings, use_tag_orientation=False), with_orientation=False)
    np.testing.assert_array_equal(with_them.pose, without.pose)


def test_landmarks_that_may_move_are_points_and_it_is_said(caplog):
    estimator = Estimator(replace(SETTINGS, landmark_velocity_stddev=0.1))
    assert estimator._state.gains.tags is None
    (message,) = caplog.messages
    assert message.startswith('No effect of use_tag_orientation')
    assert 'set landmark_velocity_stddev: 0.0' in message


def test_one_in_ten_that_is_flipped_does_no_harm():
    flips = np.flatnonzero(np.random.default_rng(1).random(200) < 0.1)
    estimator = drive(UNSURE, flips=flips)
    assert abs(heading_error(estimator)) < 0.06
    assert estimator.counts['rejected_orientation'] > 0
    assert estimator.counts['rejected_landmark'] == 0  # as a point it was right


def test_an_orientation_that_was_flipped_when_it_was_new_is_replaced():
    estimator = drive(replace(UNSURE, angular_velocity_noise=(0.01,) * 3), 0.0, flips=[0])
    orientations = estimator._state.observer.orientations
    turn = so3.log(estimator.pose[:3, :3].T @ orientations.B[0] @ FACING.T)
    np.testing.assert_allclose(turn, 0.0, atol=0.03)
    assert estimator.counts['rejected_orientation'] < 5


def test_points_and_tags_may_be_in_one_observation():
    estimator = Estimator(SETTINGS)
    points = np.array([[3.0, 0.0, 0.0], [3.0, 1.0, 0.0]])
    orientations = np.stack([FACING, np.zeros((3, 3))])  # the second one is a point
    for k in range(5):
        event = ObservationEvent(k * 10**8, np.array([1, 2]), points)
        assert estimator.add(replace(event, orientations=orientations))
    are_known = estimator._state.observer.orientations.are_known
    np.testing.assert_array_equal(are_known, [True, False])


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
@pytest.mark.parametrize('model', ['range_bearing', 'cartesian', 'stereo', 'fiducial'])
def test_by_every_noise_model_a_tag_may_come_without_its_orientation(model, gains):
    settings = replace(UNSURE, observation_model=model, gains=gains)
    estimator, ids = Estimator(settings), np.array([1, 2])
    points = np.array([TAG, TAG + [0.0, 1.0, 0.0]])
    for k in range(6):
        Z = np.stack([FACING, FACING])
        Z[: 1 + k % 2] *= k > 3  # none, one or both
        assert estimator.add(ObservationEvent(k * 10**8, ids, points, orientations=Z))
    np.testing.assert_allclose(estimator.pose, np.eye(4), atol=1e-6)
    if gains == 'riccati':
        np.testing.assert_allclose(estimator.landmark_map.orientations[1], FACING, atol=1e-6)


def test_a_late_tag_is_used_as_it_would_be_seen_now():
    settings = replace(UNSURE, angular_velocity_noise=(0.01,) * 3)
    estimator = drive(settings, 0.0)
    before = heading_error(estimator, 0.0)
    event = ObservationEvent(19 * 10**9, np.array([7]), TAG[None], orientations=FACING[None])
    assert estimator.add(event)
    assert estimator.counts['late_observation'] == 1
    assert abs(heading_error(estimator, 0.0)) <= abs(before) + 0.005


@pytest.mark.parametrize(
    ('orientations', 'reason'),
    [
        (np.zeros((2, 3, 3)), 'wrong_shape'),
        (2.0 * np.eye(3)[None], 'bad_orientation'),
        (-np.eye(3)[None], 'bad_orientation'),
        (np.full((1, 3, 3), np.nan), 'not_finite'),
    ],
)
def test_what_is_no_rotation_is_refused(orientations, reason):
    estimator = Estimator(SETTINGS)
    event = ObservationEvent(0, np.array([1]), TAG[None], orientations=orientations)
    assert not estimator.add(event)
    assert estimator.dropped[reason] == 1
