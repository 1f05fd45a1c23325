"""Who is whose parent on /tf: odometry that begins later, is late, or ends."""

from __future__ import annotations

from dataclasses import replace
import time
from unittest.mock import Mock

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from robots import pose_of, stamp_ns

from slam_observer_ros.lie import se3
from slam_observer_ros.nodes.transforms import (
    DISCOVERY_S,
    MAX_WAITING_NS,
    PoseBroadcaster,
    TFMessage,
)
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not installed')

STEP_NS = 20_000_000
WINDOW_S = 0.05
POSE = se3.exp(np.array([0.0, 0.0, 0.3, 1.0, 2.0, 0.0]))
ODOMETRY = se3.exp(np.array([0.0, 0.0, -0.2, 3.0, 1.0, 0.0]))


class Robot:
    """Poses at 50 Hz, and odometry on /tf while it is alive, ``lag_s`` late."""

    def __init__(self, monkeypatch, rate_factor=1):
        self.buffer = TransformBuffer()
        self.node = Mock()
        self.settings = ObserverNodeSettings()
        self.now_ns = 1_000_000_000_000
        self.step_ns = STEP_NS // rate_factor
        self.ahead_ns = round((WINDOW_S + self.settings.transform_tolerance) * 1e9)
        monkeypatch.setattr(time, 'monotonic', lambda: self.now_ns * 1e-9)
        self.broadcaster = PoseBroadcaster(self.node, self.settings, self.buffer, WINDOW_S)

    def wait(self, duration_s):
        self.now_ns += round(duration_s * 1e9)

    def run(self, duration_s, lag_s=None):
        """Go on for a while; without lag there is no odometry."""
        for _ in range(round(duration_s * 1e9 / self.step_ns)):
            self.now_ns += self.step_ns
            if lag_s is not None:
                stamp = self.now_ns - round(lag_s * 1e9)
                self.buffer.insert('odom', 'base_link', stamp, ODOMETRY)
            self.broadcaster.add(self.now_ns, POSE)

    def take(self):
        """Return the transforms sent since the last time."""
        publish = self.node.create_publisher.return_value.publish
        raw = [call.args[0] for call in publish.call_args_list]
        sent = [deserialize_message(each, TFMessage).transforms[0] for each in raw]
        publish.reset_mock()
        return sent

    @property
    def logged(self):
        logger = self.node.get_logger.return_value
        calls = logger.info.call_args_list + logger.warning.call_args_list
        return ' '.join(call.args[0] for call in calls)


@pytest.fixture
def robot(monkeypatch):
    return Robot(monkeypatch)


def children(sent):
    return {t.child_frame_id for t in sent}


def test_the_search_for_odometry_begins_with_the_first_pose(robot):
    robot.wait(100.0)
    robot.run(DISCOVERY_S - 0.5)
    assert not robot.take()
    robot.run(1.0, lag_s=0.0)
    sent = robot.take()
    assert children(sent) == {'odom'}
    np.testing.assert_allclose(
        pose_of(sent[-1].transform), POSE @ se3.inverse(ODOMETRY), atol=1e-9
    )


def test_a_correction_holds_until_the_next_one_at_25_hz(robot):
    """A pose is known when the second message after it has pushed it out of the window."""
    period_ns, publish_period_ns = 40_000_000, 20_000_000
    for number in range(20):
        stamp = robot.now_ns + number * period_ns
        robot.buffer.insert('odom', 'base_link', stamp, ODOMETRY)
        robot.broadcaster.add(stamp, POSE)
        next_comes_ns = stamp + 3 * period_ns + publish_period_ns
        assert stamp_ns(robot.take()[-1]) >= next_comes_ns


def test_without_odometry_the_base_is_published_until_there_is_some(robot):
    begin_ns = robot.now_ns
    robot.run(DISCOVERY_S + 1.0)
    sent = robot.take()
    assert children(sent) == {'base_link'}
    assert stamp_ns(sent[0]) > begin_ns + round(DISCOVERY_S * 1e9), 'it is the newest pose'
    robot.run(1.0, lag_s=0.0)
    assert children(robot.take()) == {'odom'}
    assert "publishing 'map' to 'odom' on /tf: /tf has 'odom' to 'base_link'" in robot.logged


@pytest.mark.parametrize(('parent', 'is_static'), [('odom_combined', False), ('body', True)])
def test_the_base_gets_no_second_parent(robot, parent, is_static):
    robot.buffer.insert(parent, 'base_link', robot.now_ns, ODOMETRY, is_static=is_static)
    robot.run(DISCOVERY_S + 1.0)
    assert not robot.take()
    assert f"'base_link' has the parent '{parent}' on /tf" in robot.broadcaster.problem
    assert 'set odom_frame to the frame of the odometry' in robot.logged
    robot.buffer.insert('odom', parent, robot.now_ns, ODOMETRY, is_static=True)
    robot.buffer.insert(parent, 'base_link', robot.now_ns + STEP_NS, ODOMETRY, is_static=is_static)
    robot.run(0.1)
    assert children(robot.take()) == {'odom'}
    assert not robot.broadcaster.problem


def test_a_parent_that_comes_later_ends_the_bases_own_transform(robot):
    robot.run(DISCOVERY_S + 1.0)
    assert children(robot.take()) == {'base_link'}
    robot.buffer.insert('odom_combined', 'base_link', robot.now_ns, ODOMETRY)
    robot.run(1.0)
    robot.take()
    robot.run(1.0)
    assert not robot.take()
    assert "'base_link' has the parent 'odom_combined'" in robot.broadcaster.problem


@pytest.mark.parametrize('rate_factor', [1, 10])
@pytest.mark.parametrize('lag_s', [0.1, 0.7, 3.0])
def test_odometry_that_is_late_is_waited_for(monkeypatch, rate_factor, lag_s):
    robot = Robot(monkeypatch, rate_factor)
    robot.run(6.0, lag_s)
    sent = robot.take()
    assert children(sent) == {'odom'}
    age_ns = robot.now_ns + robot.ahead_ns - stamp_ns(sent[-1])
    assert age_ns == pytest.approx(lag_s * 1e9, abs=robot.step_ns)
    assert (f'is {lag_s} s behind the estimate' in robot.broadcaster.problem) == (lag_s > 0.5)


def test_odometry_that_is_stamped_far_ahead_is_reported(robot):
    robot.run(15.0, lag_s=-20.0)
    assert not robot.take()
    text = 'odometry on /tf is stamped far ahead of the estimate'
    assert text in robot.broadcaster.problem
    assert text in robot.logged


def test_odometry_that_begins_after_the_pose_is_no_problem(robot):
    robot.run(0.1)
    robot.buffer.insert('odom', 'base_link', robot.now_ns + STEP_NS // 2, ODOMETRY)
    robot.broadcaster.retry()
    assert not robot.take()
    assert not robot.broadcaster.problem


def test_odometry_that_ends_is_reported_until_it_is_back(robot):
    robot.run(1.0, lag_s=0.0)
    assert not robot.broadcaster.problem
    robot.take()
    robot.run(3.0)
    assert not robot.take()
    assert "'odom' to 'base_link' on /tf is 3.0 s behind" in robot.broadcaster.problem
    assert "'map' to 'odom' waits for it" in robot.logged
    robot.run(0.1, lag_s=0.0)
    assert not robot.broadcaster.problem
    assert children(robot.take()) == {'odom'}


def test_odometry_that_does_not_come_back_after_a_jump_of_the_clock_is_reported(robot):
    robot.run(1.0, lag_s=0.0)
    robot.buffer.clear()
    robot.broadcaster.clear()
    robot.run(0.4)
    assert not robot.broadcaster.problem
    robot.run(1.0)
    assert 's behind' in robot.broadcaster.problem


def test_while_poses_are_held_the_last_correction_holds_on(robot):
    robot.broadcaster.repeat(robot.now_ns)
    assert not robot.take(), 'there is none yet'
    robot.run(1.0, lag_s=0.0)
    last = robot.take()[-1]
    robot.wait(5.0)
    for _ in range(2):
        robot.broadcaster.repeat(robot.now_ns)
    (repeated,) = robot.take()  # no stamp goes out twice
    assert repeated.transform == last.transform
    tolerance_ns = round(robot.settings.transform_tolerance * 1e9)
    assert stamp_ns(repeated) == robot.now_ns + tolerance_ns


def test_after_a_reset_nothing_of_before_goes_out(robot):
    robot.run(1.0, lag_s=0.0)
    robot.run(0.4)  # poses that wait for their odometry
    robot.take()
    robot.broadcaster.clear()
    robot.buffer.insert('odom', 'base_link', robot.now_ns, ODOMETRY)
    robot.broadcaster.retry()
    robot.broadcaster.repeat(robot.now_ns)
    assert not robot.take()


def test_poses_wait_no_longer_for_odometry_than_tf_keeps_it(robot):
    robot.run(1.0, lag_s=0.0)
    robot.run(30.0)
    assert len(robot.broadcaster._waiting) <= MAX_WAITING_NS // STEP_NS + 1


def test_where_the_map_is_published_below_the_base_that_may_have_another_parent(robot):
    settings = replace(robot.settings, invert_tf=True)
    robot.broadcaster = PoseBroadcaster(robot.node, settings, robot.buffer, WINDOW_S)
    robot.buffer.insert('body', 'base_link', robot.now_ns, ODOMETRY)
    robot.run(DISCOVERY_S + 1.0)
    sent = robot.take()[-1]
    assert (sent.header.frame_id, sent.child_frame_id) == ('base_link', 'map')
    np.testing.assert_allclose(pose_of(sent.transform), se3.inverse(POSE), atol=1e-9)


def test_frames_have_no_leading_slash():
    settings = ObserverNodeSettings(base_frame='/base', sensor_frame='//eye', odom_frame='/')
    plain = settings.with_plain_frames()
    plain.check_frames()
    assert (plain.base_frame, plain.sensor_frame, plain.odom_frame) == ('base', 'eye', '')


def test_no_odometry_is_looked_for_unless_its_frame_is_named(robot):
    settings = ObserverNodeSettings(odom_frame='')
    robot.broadcaster = PoseBroadcaster(robot.node, settings, robot.buffer, WINDOW_S)
    robot.run(0.1, lag_s=0.0)
    assert children(robot.take()) == {'base_link'}


def test_another_publisher_of_the_same_transform_is_named_until_it_ends(robot):
    robot.run(1.0, lag_s=0.0)
    for transform in robot.take():
        robot.broadcaster.hear('map', 'odom', stamp_ns(transform))
    robot.broadcaster.hear('odom', 'base_link', robot.now_ns)
    assert not robot.broadcaster.rival, 'its own, heard back'
    robot.broadcaster.hear('map', 'odom', robot.now_ns + 7)
    assert robot.broadcaster.rival.startswith("another node publishes 'map' to 'odom' on /tf")
    assert robot.logged.count('another node publishes') == 1
    robot.run(10.0, lag_s=0.0)
    assert not robot.broadcaster.rival


@pytest.mark.parametrize('first', [True, False])
@pytest.mark.parametrize('parent', ['/map', 'world'])
def test_a_static_transform_of_the_same_frame_is_named_whenever_it_was_heard(robot, first, parent):
    if first:  # before it is known what is published from here
        robot.broadcaster.hear(parent, 'odom', None)
        assert not robot.broadcaster.rival
    robot.run(1.0, lag_s=0.0)
    if not first:
        assert not robot.broadcaster.rival
        robot.broadcaster.hear(parent, 'odom', None)
    robot.run(20.0, lag_s=0.0)
    name = parent.lstrip('/')
    expected = f"another node publishes '{name}' to 'odom' on /tf_static, too: end it (it may be "
    assert robot.broadcaster.rival.startswith(expected)
    assert robot.logged.count('another node publishes') == 1


def test_static_transforms_of_other_frames_are_no_rivals(robot):
    for ends in (('world', 'map'), ('base_link', 'camera'), ('map', 'dock')):
        robot.broadcaster.hear(*ends, None)
    robot.run(1.0, lag_s=0.0)
    assert not robot.broadcaster.rival
    assert 'another node publishes' not in robot.logged
