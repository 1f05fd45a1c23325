"""Fiducials with their poses in one message."""

from __future__ import annotations

from functools import partial

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.messages.registry import decoders

TURN, TURNED = np.array([0.0, 0.0, 0.6, 0.8]), [[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1.0]]
MARKERS = [(7, (1.0, 2.0, 3.0), TURN), (513, (4.0, 5.0, 6.0), detector.NO_TURN)]
ARRAYS = {
    'aruco_opencv': partial(detector.aruco_detection, boards=('dock', 'a wall')),
    'ros2_aruco': detector.aruco_markers,
    'aruco_interfaces': partial(detector.aruco_markers, package='aruco_interfaces'),
    'isaac': detector.isaac_apriltags,
}
WITH_SIGNED_IDS = sorted(ARRAYS.keys() - {'aruco_opencv'})


def decode(message):
    return decoders('landmarks')[message.__msgtype__](ros.serialise(message))


@pytest.mark.parametrize('name', ARRAYS)
@pytest.mark.parametrize('frame_id', ['', 'cam', 'camera'])
def test_ids_and_poses_are_taken_in_the_frame_of_the_array(name, frame_id):
    seen = decode(ARRAYS[name](MARKERS, frame_id))
    assert (seen.sensor_frame, seen.stamp_ns) == (frame_id, ros.STAMP_NS)
    assert_array_equal(seen.ids, [7, 513])
    assert_array_equal(seen.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert_allclose(seen.orientations, [TURNED, np.zeros((3, 3))], atol=1e-12)
    assert seen.covariances is None


@pytest.mark.parametrize('name', ARRAYS)
def test_an_array_without_any_says_that_nothing_is_in_view(name):
    seen = decode(ARRAYS[name]([], 'camera'))
    assert seen.ids.shape == (0,)
    assert seen.points.shape == (0, 3)


@pytest.mark.parametrize('name', WITH_SIGNED_IDS)
def test_an_id_that_could_not_be_published_is_unknown_and_loses_no_other(name):
    seen = decode(ARRAYS[name]([(-3, (9.0, 0.0, 0.0), TURN), *MARKERS], 'camera'))
    assert_array_equal(seen.ids, [-1, 7, 513])


def test_an_array_with_more_poses_than_ids_is_malformed():
    message = detector.aruco_markers(MARKERS, 'camera')
    message.marker_ids = message.marker_ids[:1]
    with pytest.raises(MessageError, match='1 marker ids for 2 poses'):
        decode(message)


def test_what_was_not_measured_is_left_out():
    seen = decode(detector.aruco_markers([(3, (np.nan, 0.0, 0.0), TURN), *MARKERS], 'camera'))
    assert_array_equal(seen.ids, [7, 513])


def test_stated_covariances_are_kept():
    covariance = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    event = decode(detector.isaac_apriltags(MARKERS, 'camera', covariance=covariance))
    assert_array_equal(event.covariances, [covariance[:3, :3]] * 2)
    assert_array_equal(event.orientation_covariances, [covariance[3:, 3:]] * 2)
