"""Velocities whose frame /tf does not know yet, and what waits for its transform."""

from __future__ import annotations

from dataclasses import replace
import logging

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import TransformError
from slam_observer_ros.events import BEARING, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.detections import decode_camera_info
from slam_observer_ros.messages.poses import PoseMessage
from slam_observer_ros.recordings.event_builder import drop_reason, EventBuilder, MAX_WAITING
from slam_observer_ros.recordings.frames import BaseFrame, TransformBuffer
from slam_observer_ros.settings.node_settings import InputSettings

MS = 1_000_000
V = np.array([0.0, 0.0, 0.4, 1.0, 0.0, 0.0])
WHEEL = se3.from_rpy((0.3, 0.1, 0.0, 0.0, 0.0, np.pi))
CAMERA = se3.from_rpy((0.2, 0.0, 0.4, -np.pi / 2, 0.0, -np.pi / 2))


class Wheel:
    """Sends a velocity every 20 ms; its transform goes into ``transforms``."""

    def __init__(self, transform_timeout):
        self.transforms = TransformBuffer()
        frame = BaseFrame(InputSettings(), self.transforms)
        self.builder = EventBuilder(frame, transform_timeout, 0.5, on_drop=None)
        self.now_ns = 0

    def send(self, count):
        """Return the events of the next messages."""
        events = []
        for _ in range(count):
            self.now_ns += 20 * MS
            events += self.builder.retry(self.now_ns)
            message = VelocityEvent(self.now_ns, V, sensor_frame='wheel')
            events += self.builder.add(message, self.now_ns)
        return events

    def insert_transform(self, stamp_ns):
        self.transforms.insert('base_link', 'wheel', stamp_ns, WHEEL)


def tags_seen(frame, *ids):
    ids = ids or (3,)
    unknown, families = np.full((len(ids), 3), np.nan), ('tag36h11',) * len(ids)
    return ObservationEvent(0, np.array(ids), unknown, sensor_frame=frame, families=families)


PIXELS_CAMERA = decode_camera_info(ros.serialise(detector.camera_info('camera')))[1]


def pixels_seen(stamp_ns, points, is_tags):
    """Return what an image shows of points (m, 3) before the camera."""
    ids = np.arange(3, 3 + len(points))
    return ObservationEvent(
        stamp_ns,
        ids,
        np.full((len(ids), 3), np.nan),
        sensor_frame='camera',
        families=('tag36h11',) * len(ids) if is_tags else None,
        pixels=detector.pixels_of(points),
    )


def of_base(stamp_ns):
    return VelocityEvent(stamp_ns, V).moved(WHEEL).body_velocity


@pytest.fixture
def log(caplog):
    caplog.set_level(logging.INFO, 'slam_observer_ros')
    return caplog


@pytest.mark.parametrize('timeout_s', [0.0, 0.1])
def test_a_velocitys_frame_that_was_taken_for_the_base_is_used_once_tf_has_it(timeout_s, log):
    wheel = Wheel(timeout_s)
    events = wheel.send(20)
    assert len(events) == 20
    assert_array_equal([event.body_velocity for event in events], [V] * 20)
    wheel.transforms.insert('base_link', 'wheel', 0, WHEEL, is_static=True)
    events = wheel.send(3)
    assert [event.stamp_ns for event in events] == [420 * MS, 440 * MS, 460 * MS]
    assert_array_equal(events[0].body_velocity, of_base(420 * MS))
    assert_array_equal([event.body_velocity for event in events], [of_base(0)] * 3)
    assert [record.levelname for record in log.records] == ['WARNING', 'INFO']
    assert "frame 'wheel' are brought into 'base_link' from now on" in log.text


def test_velocities_wait_again_for_a_late_transform_that_has_begun_to_come(log):
    wheel = Wheel(0.1)
    events = wheel.send(20)
    for _ in range(20):
        wheel.insert_transform(wheel.now_ns - 30 * MS)
        events += wheel.send(1)
    stamps_ns = [event.stamp_ns for event in events]
    assert stamps_ns == list(range(20 * MS, 20 * MS * (len(events) + 1), 20 * MS))
    assert len(events) >= 37
    assert_array_equal(events[20].body_velocity, V)
    assert_array_equal(events[-1].body_velocity, of_base(0))
    assert [record.levelname for record in log.records] == ['WARNING', 'INFO']


def test_a_transform_that_always_comes_too_late_changes_nothing(log):
    wheel = Wheel(0.1)
    events = []
    for _ in range(40):
        wheel.insert_transform(wheel.now_ns - 150 * MS)
        events += wheel.send(1)
    assert_array_equal([event.body_velocity for event in events], [V] * len(events))
    assert [record.levelname for record in log.records] == ['WARNING']


def test_what_too_many_wait_behind_is_dropped_and_reported():
    drops = []
    transforms = TransformBuffer()
    builder = EventBuilder(BaseFrame(InputSettings(), transforms), 10.0, 0.5, drops.append)
    for k in range(MAX_WAITING + 3):
        frame = 'lidar' if k == MAX_WAITING else 'camera'
        seen = ObservationEvent(k * MS, np.array([1]), np.ones((1, 3)), sensor_frame=frame)
        assert not builder.add(seen, k * MS)
    assert not builder.retry(MAX_WAITING * MS)
    assert len(drops) == 3
    assert f'more than {MAX_WAITING} measurements wait' in str(drops[0])
    assert "'camera' and 'base_link' are not connected" in str(drops[0])
    for frame in ('camera', 'lidar'):
        transforms.insert('base_link', frame, 0, WHEEL, is_static=True)
    events = builder.retry(None)
    assert [event.stamp_ns for event in events] == [k * MS for k in range(3, MAX_WAITING + 3)]
    assert len(drops) == 3


def everything_placed():
    """A map in which odometry, the robot, its camera and a tag are placed."""
    transforms = TransformBuffer()
    for parent, child in (('map', 'odom'), ('odom', 'base_link'), ('base_link', 'camera')):
        transforms.insert(parent, child, 0, WHEEL, is_static=True)
    transforms.insert('map', 'tag_3', 0, WHEEL, is_static=True)
    return transforms


@pytest.mark.parametrize('frame', ['map', '/map'])
def test_landmarks_that_the_estimate_itself_would_place_are_refused(frame):
    event = ObservationEvent(0, np.array([3]), np.ones((1, 3)))
    reason = "given in 'map', which is estimated from these very landmarks: publish them in the"
    base_frame = BaseFrame(InputSettings(), everything_placed())
    with pytest.raises(TransformError, match=reason):
        base_frame.observation(replace(event, sensor_frame=frame))
    with pytest.raises(TransformError, match=reason):
        base_frame.observation(tags_seen(frame))
    with pytest.raises(TransformError, match=reason):
        settings = InputSettings(sensor_frame=frame)
        BaseFrame(settings, everything_placed()).observation(replace(event, sensor_frame='camera'))


POINTS = np.array([[0.5, 0.2, 2.0], [-1.0, 0.1, 4.0]])
"""Before the camera, z forward."""


def assert_directions(event):
    assert event.kinds.tolist() == [BEARING] * 2
    assert event.pixels is event.families is None
    lines = POINTS @ CAMERA[:3, :3].T
    expected = lines / np.linalg.norm(lines, axis=1)[:, None]
    assert_allclose(event.lines_of_sight, expected, atol=1e-12)
    assert_allclose(event.sensor, np.tile(CAMERA[:3, 3], (2, 1)))


def test_pixels_are_directions_from_the_camera_once_it_is_known():
    transforms, dropped = TransformBuffer(), []
    transforms.insert('base_link', 'camera', 0, CAMERA, is_static=True)
    builder = EventBuilder(BaseFrame(InputSettings(), transforms), 0.5, 0.5, dropped.append)
    assert builder.add(pixels_seen(0, POINTS, is_tags=False), 0) == []
    assert builder.retry(500 * MS) == []
    assert "no CameraInfo of 'camera' has come" in str(dropped[0])
    transforms.cameras['camera'] = PIXELS_CAMERA
    (event,) = builder.add(pixels_seen(0, POINTS, is_tags=False), 500 * MS)
    assert_directions(event)


def test_tags_that_tf_never_had_are_directions_after_the_timeout_and_then_at_once():
    transforms = TransformBuffer()
    transforms.insert('base_link', 'camera', 0, CAMERA, is_static=True)
    transforms.cameras['camera'] = PIXELS_CAMERA
    builder = EventBuilder(BaseFrame(InputSettings(), transforms), 0.5, 0.5, on_drop=None)
    assert builder.add(pixels_seen(0, POINTS, is_tags=True), 0) == []
    assert builder.retry(499 * MS) == []
    (event,) = builder.retry(500 * MS)
    assert_directions(event)
    (event,) = builder.add(pixels_seen(0, POINTS, is_tags=True), 600 * MS)
    assert_directions(event)
    # One that /tf has is waited for, as the others of its message
    for number, point in enumerate(POINTS, 3):
        transforms.insert('camera', f'tag36h11:{number}', 0, se3.pose(np.eye(3), point))
    (event,) = builder.add(pixels_seen(0, POINTS, is_tags=True), 700 * MS)
    assert event.kinds is None
    assert_allclose(event.points, se3.transform(CAMERA, POINTS))
    assert builder.add(pixels_seen(MS, POINTS, is_tags=True), 700 * MS) == []


def test_tags_that_tf_has_had_are_dropped_where_it_does_not_have_them_in_time():
    transforms, dropped = TransformBuffer(), []
    transforms.insert('base_link', 'camera', 0, CAMERA, is_static=True)
    transforms.cameras['camera'] = PIXELS_CAMERA
    transforms.insert('camera', 'tag_4', 0, CAMERA)
    builder = EventBuilder(BaseFrame(InputSettings(), transforms), 0.5, 0.5, dropped.append)
    assert builder.add(pixels_seen(0, POINTS, is_tags=True), 0) == []
    assert builder.retry(500 * MS) == []
    assert len(dropped) == 1


def test_tags_are_those_of_the_sensor_that_a_parameter_names():
    camera, other = map(tags_seen, ('camera', 'lens'))
    expected = BaseFrame(InputSettings(), everything_placed()).observation(camera)
    base_frame = BaseFrame(InputSettings(sensor_frame='camera'), everything_placed())
    assert_allclose(base_frame.observation(other).points, expected.points)


def test_a_tag_on_tf_that_is_exactly_not_turned_has_no_orientation():
    transforms = TransformBuffer()
    transforms.insert('base_link', 'camera', 0, CAMERA, is_static=True)
    unset = se3.pose(np.eye(3), np.array([2.0, 0.0, 0.0]))
    for child, pose in (('tag_3', unset), ('tag_4', WHEEL)):
        transforms.insert('camera', child, 0, pose, is_static=True)
    event = BaseFrame(InputSettings(), transforms).observation(tags_seen('camera', 3, 4))
    assert event.families is None
    assert_array_equal(event.orientations[0], np.zeros((3, 3)))
    assert_allclose(event.orientations[1], (CAMERA @ WHEEL)[:3, :3])
    assert_allclose(event.points, se3.transform(CAMERA, np.stack([unset, WHEEL])[:, :3, 3]))


def test_landmarks_in_the_odometrys_frame_or_of_a_sensor_by_parameter_are_used():
    event = ObservationEvent(0, np.array([3]), np.ones((1, 3)))
    base_frame = BaseFrame(InputSettings(), everything_placed())
    moved = base_frame.observation(replace(event, sensor_frame='odom'))
    assert_allclose(moved.points, se3.transform(se3.inverse(WHEEL), event.points))
    settings = InputSettings(sensor_pose=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    placed = BaseFrame(settings, TransformBuffer()).observation(replace(event, sensor_frame='map'))
    assert_allclose(placed.points, [[1.0, 1.0, 2.0]])


@pytest.mark.parametrize(
    ('frame', 'called', 'axis'),
    [
        ('camera', 'camera', [1.0, 0.0, 0.0]),
        ('/camera_optical', 'camera_optical', [0.0, 0.0, 1.0]),
        ('base_link', '', [1.0, 0.0, 0.0]),
        ('', '', [1.0, 0.0, 0.0]),
    ],
)
def test_landmarks_name_their_sensor_and_the_axis_along_which_it_looks(frame, called, axis):
    transforms = TransformBuffer()
    for sensor in ('camera', 'camera_optical'):
        transforms.insert('base_link', sensor, 0, CAMERA, is_static=True)
    event = ObservationEvent(0, np.array([3]), np.ones((1, 3)))
    seen = BaseFrame(InputSettings(), transforms).observation(replace(event, sensor_frame=frame))
    assert seen.sensor_frame == called
    R = CAMERA[:3, :3] if called else np.eye(3)
    assert_allclose(seen.sensor_axis, R @ np.array(axis))


@pytest.mark.parametrize(
    ('base', 'frame', 'meant'),
    [
        ('base_link', 'robot1/camera', "set that to 'robot1/base_link'"),
        ('base_link', '/a/b/camera', "set that to 'a/b/base_link'"),
        ('robot1/base_link', 'camera', "set that to 'base_link'"),
        ('robot1/base_link', 'robot1/camera', None),
        ('base_link', 'camera', None),
    ],
)
def test_frames_of_another_prefix_point_at_the_base_frame(base, frame, meant):
    frames = BaseFrame(InputSettings(base_frame=base), TransformBuffer())
    event = ObservationEvent(1, np.array([1]), np.ones((1, 3)))
    with pytest.raises(TransformError, match='not connected') as raised:
        frames.observation(replace(event, sensor_frame=frame))
    assert ('base_frame' in str(raised.value)) == (meant is not None)
    assert (meant or '') in str(raised.value)


def test_without_an_odometry_frame_velocities_may_name_none():
    event = VelocityEvent(0, V)
    assert BaseFrame(InputSettings(odom_frame=''), TransformBuffer()).velocity(event)


def test_a_jump_of_the_odometrys_pose_is_dropped_by_a_reason_of_its_own():
    drops = []
    builder = EventBuilder(BaseFrame(InputSettings(), TransformBuffer()), 0.1, 0.5, drops.append)
    no_turn = np.array([0.0, 0.0, 0.0, 1.0])
    events = []
    for step, x in enumerate([5.0, 5.02, 0.0, 0.02]):
        stamp_ns = step * 20 * MS
        pose = PoseMessage(stamp_ns, 'odom', 'base_link', np.array([x, 0.0, 0.0]), no_turn)
        events += builder.add(pose, stamp_ns)
    assert [event.stamp_ns for event in events] == [0, 40 * MS]
    assert_allclose([event.body_velocity[3] for event in events], [1.0, 1.0])
    assert [drop_reason(error) for error in drops] == ['pose_jump']
