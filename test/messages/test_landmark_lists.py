"""Cartographer's lists of named landmarks, and MRPT's ranges and bearings."""

from __future__ import annotations

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.messages import fiducials
from slam_observer_ros.messages.fiducials import FIRST_NAMED_ID, LandmarkNames
from slam_observer_ros.messages.registry import decoders

TURN = np.array([0.0, 0.0, 0.6, 0.8])


def decode(message):
    return decoders('landmarks')[message.__msgtype__](ros.serialise(message))


def entries(*names):
    return [(name, (1.0, 2.0, 3.0 + i), TURN) for i, name in enumerate(names)]


def test_a_number_is_itself_and_a_name_has_the_same_number_in_every_run():
    seen = decode(detector.landmark_list(entries('7', 'dock', '07', '', '-1'), 'imu'))
    assert seen.sensor_frame == 'imu'
    assert_array_equal(seen.ids[[0, 3, 4]], [7, -1, -1])
    assert_array_equal(seen.points[1], [1.0, 2.0, 4.0])
    assert seen.ids[1] == LandmarkNames().number_of('dock') == 2380031649
    assert FIRST_NAMED_ID <= seen.ids[2] <= MAX_ID


def test_the_largest_number_is_an_id_and_a_larger_one_a_name():
    names = LandmarkNames()
    assert names.number_of(str(MAX_ID)) == MAX_ID
    assert names.number_of('9' * 5000) >= FIRST_NAMED_ID
    assert names.number_of('٣') >= FIRST_NAMED_ID


def test_names_that_share_a_number_are_refused_and_the_first_goes_on(monkeypatch):
    monkeypatch.setattr(fiducials, '_hash_of', lambda name: 5)
    names = LandmarkNames()
    first = names.number_of('dock')
    expected = f"the landmarks 'dock' and 'door' both have the number {first}: rename one"
    with pytest.raises(MessageError, match=expected):
        names.number_of('door')
    with pytest.raises(MessageError, match='both have the number'):
        names.number_of(str(first))
    assert names.number_of('dock') == first


def test_names_without_end_are_refused(monkeypatch):
    monkeypatch.setattr(fiducials, 'MAX_NAMES', 2)
    names = LandmarkNames()
    known = [names.number_of(name) for name in ('a', 'b')]
    with pytest.raises(MessageError, match="more than 2 names of landmarks, the last one 'c'"):
        names.number_of('c')
    assert [names.number_of(name) for name in ('a', 'b')] == known


def test_weights_are_inverse_standard_deviations():
    seen = decode(detector.landmark_list(entries('7', '8'), 'imu', weights=(20.0, 50.0)))
    assert_allclose(seen.covariances, [0.05**2 * np.eye(3)] * 2)
    assert_allclose(seen.orientation_covariances, [0.02**2 * np.eye(3)] * 2)
    assert_allclose(seen.orientations[0][0], [0.28, -0.96, 0.0], atol=1e-12)


@pytest.mark.parametrize('weight', [0.0, np.nan, np.inf, 1e-300])
def test_weights_that_say_nothing_leave_the_settings_noise_and_no_rotation(weight):
    seen = decode(detector.landmark_list(entries('7'), 'imu', weights=(weight, weight)))
    assert_array_equal(seen.ids, [7])
    assert seen.covariances is None
    assert seen.orientations is None


def test_ranges_and_bearings_are_points_and_pitch_is_downwards():
    sensed = [(7, 2.0, np.pi / 2, 0.0), (-1, 2.0, 0.0, np.pi / 6), (-8, 1.0, 0.0, 0.0)]
    seen = decode(detector.range_bearing(sensed, 'mast'))
    assert (seen.sensor_frame, seen.stamp_ns) == ('mast', ros.STAMP_NS)
    assert_array_equal(seen.ids, [7, -1, -1])
    assert_allclose(seen.points[:2], [[0, 2, 0], [np.sqrt(3), 0, -1]], atol=1e-12)
    assert seen.covariances is None


def test_stated_deviations_are_along_and_across_the_line_of_sight():
    message = detector.range_bearing([(7, 4.0, np.pi / 2, 0.0)], 'm', deviations=(0.1, 0.02, 0.03))
    expected = np.diag([0.08, 0.1, 0.12]) ** 2
    assert_allclose(decode(message).covariances, [expected], atol=1e-15)
    message.sensor_std_pitch = 0.0
    expected = np.diag([0.08, 0.1, 0.08]) ** 2
    assert_allclose(decode(message).covariances, [expected], atol=1e-15)


def test_what_was_not_measured_is_left_out():
    sensed = [(1, np.nan, 0.0, 0.0), (2, 0.0, 0.0, 0.0), (3, 2.0, np.inf, 0.0), (4, 2.0, 0.0, 0.0)]
    message = detector.range_bearing(sensed, 'mast', deviations=(0.1, 0.01, 0.01))
    assert_array_equal(decode(message).ids, [4])
    assert decode(message).covariances.shape == (1, 3, 3)
    assert decode(detector.range_bearing([], 'mast')).points.shape == (0, 3)
    assert decode(detector.landmark_list([], 'imu')).points.shape == (0, 3)
