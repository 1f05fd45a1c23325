"""What radios and acoustic beacons measure becomes distances of numbered landmarks."""

from __future__ import annotations

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.events import AZIMUTH_RANGE, MAX_ID, RANGE, UNKNOWN_ID
from slam_observer_ros.messages.registry import decoders

RECEIVED_NS = 42
NODEFRAMES = 'LinktrackNodeframe2', 'LinktrackNodeframe3'
AOA = 'LinktrackAoaNodeframe0'
RELEASES = (None, 'uwb_link')


def decode(message):
    return decoders('landmarks')[message.__msgtype__](ros.serialise(message), RECEIVED_NS)


def distances(event):
    return np.linalg.norm(event.lines_of_sight, axis=1)


@pytest.mark.parametrize(
    'message', detector.ranges_of_packages(), ids=lambda message: message.__msgtype__
)
def test_each_type_gives_metres_and_the_landmarks_number(message):
    event = decode(message)
    assert_array_equal(event.ids, [7])
    assert_allclose(distances(event), [2.0])
    assert event.kinds.tolist() == [AZIMUTH_RANGE if AOA in message.__msgtype__ else RANGE]
    assert event.covariances is None
    is_stamped = hasattr(message, 'header')
    assert event.stamp_ns == (ros.STAMP_NS if is_stamped else RECEIVED_NS)
    assert event.sensor_frame == ('camera' if is_stamped else '')


@pytest.mark.parametrize('bad', [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize('frame_id', RELEASES)
@pytest.mark.parametrize('frame', NODEFRAMES)
def test_nodes_that_linktrack_does_not_hear_are_left_out(frame, frame_id, bad):
    event = decode(detector.linktrack(frame, [(3, bad), (255, 4.0)], frame_id))
    assert_array_equal(event.ids, [255])
    assert_array_equal(distances(event), [4.0])
    assert len(decode(detector.linktrack(frame, [], frame_id)).ids) == 0


@pytest.mark.parametrize('frame_id', RELEASES)
def test_angles_of_arrival_are_degrees_from_x_to_y(frame_id):
    nodes = [(1, 2.0, 90.0), (2, -1.0, 5.0), (3, 4.0, -60.0), (4, 3.0, np.nan)]
    event = decode(detector.linktrack(AOA, nodes, frame_id))
    assert_array_equal(event.ids, [1, 3])
    expected = [[0.0, 2.0, 0.0], [2.0, -np.sqrt(12.0), 0.0]]
    assert_allclose(event.points, expected, atol=1e-6)
    assert event.kinds.tolist() == [AZIMUTH_RANGE] * 2
    assert len(decode(detector.linktrack(AOA, [], frame_id)).ids) == 0


def test_mrpts_beacons_state_one_deviation_and_may_have_no_id():
    sensed = [(7, 2.0), (-1, 3.0), (8, np.nan), (-5, 1.0)]
    event = decode(detector.range_beacon(sensed, 'mast', deviation=0.1))
    assert_array_equal(event.ids, [7, UNKNOWN_ID, UNKNOWN_ID])
    assert_allclose(event.covariances[:, 0, 0], [0.01] * 3)
    for unknown in (0.0, np.nan, np.inf, -1.0):
        assert decode(detector.range_beacon(sensed, 'mast', deviation=unknown)).covariances is None
    assert len(decode(detector.range_beacon([], 'mast', deviation=0.1)).ids) == 0


def test_a_radio_of_16_bits_is_the_same_with_a_sign():
    assert_array_equal(decode(detector.gtec('Ranging', -0x7FFF, 2500)).ids, [0x8001])


@pytest.mark.parametrize('bad', [0, -1])
def test_an_anchor_that_was_not_reached_is_no_landmark(bad):
    assert len(decode(detector.gtec('UWBRanging', 3, bad)).ids) == 0
    assert len(decode(detector.beacon_distance(3, float(bad))).ids) == 0


@pytest.mark.parametrize(
    ('frame', 'number'),
    [('anchor_12', 12), ('uwb/3', 3), ('sonar_front', UNKNOWN_ID), ('', UNKNOWN_ID)],
)
def test_a_range_is_of_the_landmark_whose_number_ends_its_frame(frame, number):
    event = decode(detector.one_range(frame, 2.5, variance=0.04))
    assert event.sensor_frame == frame
    assert_array_equal(event.ids, [number])
    assert_allclose(distances(event), [2.5])
    assert_allclose(event.covariances[:, 0, 0], [0.04])
    assert event.ids[0] <= MAX_ID


def test_a_range_of_older_releases_has_no_variance():
    raw = ros.serialise(detector.one_range('anchor_12', 2.5))
    event = decoders('landmarks')['sensor_msgs/msg/Range'](raw[:-4])
    assert_array_equal(event.ids, [12])
    assert event.covariances is None


@pytest.mark.parametrize('beyond', [0.1, 51.0, np.inf, -np.inf, np.nan])
def test_a_range_beyond_what_the_sensor_measures_is_none(beyond):
    assert len(decode(detector.one_range('anchor_12', beyond)).ids) == 0


def test_a_range_is_only_taken_where_somebody_names_it():
    from slam_observer_ros.settings.node_settings import message_types

    assert message_types('landmarks')['sensor_msgs/msg/Range'].is_ambiguous
