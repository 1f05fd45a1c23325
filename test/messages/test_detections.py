"""Landmarks from poses, boxes and fiducials."""

from __future__ import annotations

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.events import MAX_ID
from slam_observer_ros.messages.detections import (
    decode_apriltags,
    decode_detections,
    decode_pose_array,
    MAX_NAMES,
    no_tags,
    observed_tags,
)
from slam_observer_ros.messages.poses import PoseMessage


def test_poses_are_landmarks_without_ids():
    points = [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    raw = ros.serialise(detector.pose_array(points, 'camera'))
    message = decode_pose_array(raw)
    assert message.sensor_frame == 'camera'
    assert message.stamp_ns == ros.STAMP_NS
    assert_array_equal(message.ids, [-1, -1])
    assert_array_equal(message.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    with pytest.raises(MessageError):
        decode_pose_array(raw[:-20])


def detections(*items):
    message = detector.detections(items, 'camera')
    return decode_detections(ros.serialise(message))


def test_detections_have_the_number_in_their_id_or_class():
    event = detections(
        detector.detection('17'),
        detector.detection('', 'reflector_4', np.eye(3)),
        detector.detection('pole', 'pole'),
    )
    assert_array_equal(event.ids, [17, 4, -1])
    assert_array_equal(event.points, [[7.0, 8.0, 9.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    assert event.covariances is None, 'not all are known'


def test_an_id_and_a_position_are_never_of_different_results():
    message = detector.detection('', 'car')
    message.results += detector.detection('', 'reflector_5').results
    assert_array_equal(detections(message).ids, [-1])


def test_where_a_result_has_no_position_the_centre_of_the_box_is_taken():
    unset = (0.0, 0.0, 0.0)
    event = detections(
        detector.detection('', 'tag_1', np.eye(3), position=unset),
        detector.detection('', 'tag_2', np.eye(3), position=(0.0, 0.0, 1.0)),
    )
    assert_array_equal(event.ids, [1, 2])
    assert_array_equal(event.points, [[7.0, 8.0, 9.0], [0.0, 0.0, 1.0]])
    assert event.covariances is None, 'that of the result is not of the box'


TURN = np.array([0.0, 0.0, 0.6, 0.8])
TURNED = np.array([[0.28, -0.96, 0.0], [0.96, 0.28, 0.0], [0.0, 0.0, 1.0]])


def test_poses_and_detections_have_orientations_unless_nobody_filled_them_in():
    raw = ros.serialise(detector.pose_array([(1.0, 2.0, 3.0)], 'camera', quaternion=TURN))
    assert_allclose(decode_pose_array(raw).orientations, [TURNED], atol=1e-12)
    for unset in (np.zeros(4), detector.NO_TURN, np.full(4, np.nan), np.full(4, 1e200)):
        raw = ros.serialise(detector.pose_array([(1.0, 2.0, 3.0)], 'camera', quaternion=unset))
        assert decode_pose_array(raw).orientations is None
    both = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    event = detections(
        detector.detection('1', 'x', both, quaternion=TURN), detector.detection('2', 'x', both)
    )
    assert_allclose(event.orientations, [TURNED, np.zeros((3, 3))], atol=1e-12)
    assert_array_equal(event.covariances[0], np.diag([1.0, 2.0, 3.0]))
    assert_array_equal(event.orientation_covariances[0], np.diag([0.1, 0.2, 0.3]))


def test_fiducials_on_tf_have_orientations():
    message = PoseMessage(ros.STAMP_NS, 'camera', 'tag36h11:5', np.array([1.0, 2.0, 3.0]), TURN)
    (measurement,) = observed_tags([message], 'tag_')
    assert_allclose(measurement.orientations, [TURNED], atol=1e-12)


def test_what_was_not_measured_is_left_out():
    unmeasured = (np.nan, 0.0, 0.0)
    event = detections(detector.detection('17', centre=unmeasured), detector.detection('18'))
    assert_array_equal(event.ids, [18])
    raw = ros.serialise(detector.pose_array([unmeasured, (1.0, 2.0, 3.0)], 'camera'))
    assert_array_equal(decode_pose_array(raw).points, [[1.0, 2.0, 3.0]])


def test_detections_keep_their_covariances():
    covariance = np.array([[3.0, 0.5, 0.1], [0.5, 2.0, 0.2], [0.1, 0.2, 1.0]])
    event = detections(
        detector.detection('1', 'x', covariance), detector.detection('2', 'x', 2 * covariance)
    )
    assert_array_equal(event.covariances, [covariance, 2 * covariance])


def test_apriltag_detections_give_ids_and_families():
    message = detector.apriltags([('tag36h11', 5), ('tag16h5', 12)], 'camera')
    decoded = decode_apriltags(ros.serialise(message))
    assert_array_equal(decoded.ids, [5, 12])
    assert np.isnan(decoded.points).all(), '/tf has them'
    assert decoded.families == ('tag36h11', 'tag16h5')
    assert (decoded.sensor_frame, decoded.stamp_ns) == ('camera', ros.STAMP_NS)
    negative = detector.apriltags([('tag36h11', 5), ('tag36h11', -3)], 'camera')
    with pytest.raises(MessageError, match='negative tag id -3'):
        decode_apriltags(ros.serialise(negative))


def transform(parent, child, x, stamp_ns=5):
    return PoseMessage(stamp_ns, parent, child, np.array([x, 0.0, 0.0]), detector.NO_TURN)


TOO_LARGE = [str(MAX_ID + 1), '20240501123', '9' * 19, '1' * 5000]


@pytest.mark.parametrize('number', TOO_LARGE)
def test_a_number_that_could_not_be_published_is_no_id_and_loses_no_other(number):
    event = detections(
        detector.detection(number),
        detector.detection('', f'reflector_{number}'),
        detector.detection(number, 'reflector_4'),
        detector.detection('5'),
    )
    assert_array_equal(event.ids, [-1, -1, 4, 5])
    frames = (f'tag_{number}', 'tag_6')
    (seen,) = observed_tags([transform('camera', frame, 1.0) for frame in frames], 'tag_')
    assert_array_equal(seen.ids, [6])


@pytest.mark.parametrize(
    'name',
    [
        '7d444840-9dc0-11d1-b245-5ffdce74fad2',
        'track_7D4448409DC011D1B2455FFDCE74FA42',
        '8f3c-41f9',
    ],
)
def test_a_number_that_ends_a_uuid_or_a_hash_is_no_id(name):
    event = detections(detector.detection(name), detector.detection(name, 'reflector_4'))
    assert_array_equal(event.ids, [-1, 4])


@pytest.mark.parametrize('name', ['00000012', 'facade12', 'b-0000012', 'a1-b12', 'tag36h11:12'])
def test_a_number_in_a_name_that_looks_like_a_hash_is_an_id(name):
    assert_array_equal(detections(detector.detection(name)).ids, [12])


def test_a_frame_with_a_serial_number_is_no_fiducial():
    frames = ('realsense:815412070846', 'tag36h11:3')
    (seen,) = observed_tags([transform('camera', frame, 1.0) for frame in frames], 'tag_')
    assert_array_equal(seen.ids, [3])


def test_the_largest_id_is_taken():
    assert_array_equal(detections(detector.detection(f'000{MAX_ID}')).ids, [MAX_ID])
    (seen,) = observed_tags([transform('camera', f'tag_{MAX_ID}', 1.0)], 'tag_')
    cloud = ros.OUTGOING.point_cloud2(ros.STAMP_NS, 'camera', seen.ids, seen.points)
    assert cloud.width == 1


def test_fiducials_on_tf_are_known_by_their_names():
    seen = observed_tags(
        [
            transform('left', 'tag36h11:7', 1.0),
            transform('odom', 'base_link', 2.0),
            transform('left', 'marker8', 3.0),
            transform('right', 'tag36h11:7', 4.0),
            transform('left', 'tag36h11:9', 5.0, stamp_ns=6),
            transform('base_link', 'marker8_mount', 6.0),
            transform('left', 'marker10', np.nan),
        ],
        'marker',
    )
    assert [(m.sensor_frame, m.stamp_ns) for m in seen] == [
        ('left', 5), ('left', 6), ('right', 5),
    ]  # fmt: skip
    assert_array_equal(seen[0].ids, [7, 8])
    assert_array_equal(seen[0].points, [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


def test_of_the_frames_that_are_no_fiducials_the_first_few_are_named():
    frames = [f'frame_{letter}' for letter in 'abcdefghijklm']
    assert len(frames) == MAX_NAMES + 1
    all_of_them = ', '.join(frames[:MAX_NAMES])
    assert f'(there are {all_of_them}): set' in no_tags('tag_', reversed(frames[:MAX_NAMES]))
    assert f'(there are {all_of_them}, …): set' in no_tags('tag_', frames)
