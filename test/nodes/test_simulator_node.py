"""``simulator_node`` over real DDS: the paper's section VI as messages."""

from __future__ import annotations

import math

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from node_processes import running
from numpy.testing import assert_allclose
import pytest
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud, PointCloud2

from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import decode_point_cloud, decode_point_cloud2
from slam_observer_ros.messages.poses import decode_pose_stamped
from slam_observer_ros.nodes.ros_node import LATCHED_QOS

pytestmark = pytest.mark.ros

PAPER_LANDMARKS = [[4, 0, 0], [-4, 0, 0], [0, 4, 0], [0, -4, 0]]


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def test_messages_are_those_of_the_paper_and_the_node_ends_by_itself(ros, tmp_path):
    twists = ros.collect(TwistStamped, 'a/twist')
    clouds = ros.collect(PointCloud2, 'a/landmarks')
    truths = ros.collect(PoseStamped, 'a/ground_truth/pose')
    true_landmarks = ros.collect(PointCloud2, 'a/ground_truth/landmarks', LATCHED_QOS)
    clocks = ros.collect(Clock, '/clock')
    parameters = {
        'stamped': True,
        'landmarks_type': 'PointCloud2',
        'laps': 0.1,
        'real_time_factor': 4.0,
        'velocity_rate': 20.0,
        'observation_rate': 20.0,
    }
    arguments = ('-r', '__ns:=/a')
    with running('simulator_node', tmp_path / 'log', *arguments, **parameters) as simulator:
        ros.spin_until(lambda: simulator.process.poll() is not None, 'the end of the run')
        ros.spin_for(0.5)
    expected_count = math.floor(0.1 * 2.0 * math.pi / 0.2 * 20.0) + 1
    assert len(twists) == len(clouds) == len(truths) == expected_count
    assert {twist.twist.linear.x for twist in twists} == {1.0}
    assert {twist.twist.angular.z for twist in twists} == {0.2}
    assert {twist.header.frame_id for twist in twists} == {'base_link'}
    assert {truth.header.frame_id for truth in truths} == {'world'}
    truth = decode_point_cloud2(serialize_message(true_landmarks[-1]))
    assert_allclose(truth.points, PAPER_LANDMARKS)
    for pose_message, cloud in list(zip(truths, clouds, strict=True))[1:]:
        pose = decode_pose_stamped(serialize_message(pose_message)).pose
        seen = decode_point_cloud2(serialize_message(cloud))
        assert seen.stamp_ns == stamp_ns(pose_message)
        assert_allclose(se3.transform(pose, seen.points), PAPER_LANDMARKS, atol=1e-5)
    times_s = [message.clock.sec + message.clock.nanosec * 1e-9 for message in clocks]
    assert times_s == sorted(times_s)
    assert times_s[-1] >= stamp_ns(truths[-1]) * 1e-9


def test_plain_types_in_real_time_need_no_clock(ros, tmp_path):
    twists = ros.collect(Twist, 'b/twist')
    clouds = ros.collect(PointCloud, 'b/landmarks')
    with running('simulator_node', tmp_path / 'log', '-r', '__ns:=/b'):
        ros.spin_until(lambda: len(twists) > 5 and len(clouds) > 5, 'messages')
        clocks = ros.node.get_publishers_info_by_topic('/clock')
        assert '/b' not in {sender.node_namespace for sender in clocks}
    event = decode_point_cloud(serialize_message(clouds[-1]))
    assert event.ids.tolist() == [0, 1, 2, 3]
    now_ns = ros.node.get_clock().now().nanoseconds
    assert 0 <= now_ns - event.stamp_ns < 60e9


def test_robot_waits_for_its_observer(ros, tmp_path):
    clouds = ros.collect(PointCloud, 'c/landmarks')
    with running('simulator_node', tmp_path / 'log', '-r', '__ns:=/c') as simulator:
        simulator.wait_for_output('waiting for 1 subscriber.* on /c/twist')
        ros.spin_for(0.5)
        assert clouds == []
        ros.collect(Twist, 'c/twist')
        ros.spin_until(lambda: clouds, 'the start')
