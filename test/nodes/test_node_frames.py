"""Frames of REP 105 over real DDS: who is whose parent, where sensors sit, and what must wait."""

from __future__ import annotations

import time
from unittest.mock import Mock

import detector_messages as detector
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from node_processes import running
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rclpy.serialization import serialize_message
import ros_messages
from sensor_msgs.msg import PointCloud2

pytest.importorskip('tf2_msgs')

from robots import own_topics, pose_of, Robot, stamp_ns, TransformSender
from tf2_msgs.msg import TFMessage

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.messages.poses import pose_matrices
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES
from slam_observer_ros.nodes.transforms import LiveTransforms
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.recordings.trajectory import PoseTruth
from slam_observer_ros.simulation import Scenario, Simulation

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000
TOLERANCE_NS = 200_000_000
WINDOW_NS = 50_000_000
SENSOR = (0.3, 0.1, 0.5, -1.5, 0.2, -1.6)
SENSOR_POSE = se3.from_rpy(SENSOR)
WHEEL_POSE = se3.from_rpy((-0.4, 0.3, 0.0, 0.0, 0.0, 0.7))
SCENARIO = Scenario(
    velocity_rate=40.0, observation_rate=20.0, duration=2.0, initial_bias=0.0, landmark_count=6
)


def seen_from(sensor_pose, event):
    """Return an event as a sensor at this pose in the base frame measures it."""
    return event.moved(se3.inverse(sensor_pose))


def run(ros, robot, on_pose=None):
    """Publish a simulated run; return its end and the true pose by time, from the start."""
    start_ns = ros.node.get_clock().now().nanoseconds
    simulation = Simulation(SCENARIO, start_ns)
    first = se3.inverse(simulation.pose(start_ns))
    for delivery in simulation.deliveries():
        event = delivery.event
        if isinstance(event, PoseTruth) and on_pose is not None:
            on_pose(event.stamp_ns, first @ event.pose)
        elif isinstance(event, ObservationEvent):
            robot.send(seen_from(SENSOR_POSE, event))
        elif isinstance(event, VelocityEvent):
            robot.send(seen_from(WHEEL_POSE, event))
            ros.spin_for(0.004)
    end_ns = start_ns + round(SCENARIO.duration * SECOND)
    return end_ns, lambda stamp_ns: first @ simulation.pose(stamp_ns)


def landmarks(maps):
    event = decode_point_cloud2(serialize_message(maps[-1]))
    return event.points[np.argsort(event.ids)]


def true_landmarks():
    simulation = Simulation(SCENARIO, 0)
    truth = simulation.landmark_truth(0)
    points = se3.transform(se3.inverse(simulation.pose(0)), truth.world_points)
    return points[np.argsort(truth.ids)]


def test_sensors_on_tf_and_odometry_of_others_give_map_to_odom(ros, tmp_path):
    transforms = ros.collect(TFMessage, '/wheeled/tf')
    poses = ros.collect(PoseWithCovarianceStamped, '/wheeled/pose')
    maps = ros.collect(PointCloud2, '/wheeled/landmark_map', LATCHED_QOS)
    sender = TransformSender(ros, '/wheeled')
    drift = se3.from_rpy((5.0, -3.0, 0.0, 0.0, 0.0, 1.0))

    def publish_odometry(stamp_ns, pose):
        sender.send(('odom', 'base_footprint', drift @ pose), stamp_ns=stamp_ns)

    parameters = {'transform_tolerance': TOLERANCE_NS * 1e-9, 'velocity_timeout': 1.0}
    arguments = own_topics('/wheeled')
    with (
        running('observer_node', tmp_path / 'log', *arguments, **parameters) as node,
        Robot(ros, namespace='/wheeled', frame_id='wheel', sensor_frame_id='camera') as robot,
    ):
        sender.send(
            ('base_footprint', 'base_link', np.eye(4)),
            ('base_link', 'wheel', WHEEL_POSE),
            ('base_link', 'camera', SENSOR_POSE),
        )
        ros.wait_for_subscriber(sender.dynamic, sender.static)
        end_ns, true_pose = run(ros, robot, on_pose=publish_odometry)
        ros.spin_until(
            lambda: poses and maps and stamp_ns(poses[-1]) >= end_ns - SECOND // 10, 'the end'
        )
        ros.spin_until(lambda: len(known_ids(maps)) == 6, 'all landmarks')
    assert "publishing 'map' to 'odom' on /tf" in node.output
    sent = [t for m in transforms for t in m.transforms if t.header.frame_id == 'map']
    assert len(sent) > 5
    assert {t.child_frame_id for t in sent} == {'odom'}
    stamps = [stamp_ns(t) for t in sent]
    assert stamps == sorted(set(stamps))
    published = {stamp_ns(message): message.pose.pose for message in poses}
    # The publisher of poses keeps ten: on a busy machine some are replaced before they are sent.
    heard = [(t, stamp_ns(t) - TOLERANCE_NS - WINDOW_NS) for t in sent]
    heard = [(transform, at_ns) for transform, at_ns in heard if at_ns in published]
    assert len(heard) > 5
    for transform, at_ns in heard:
        estimate = published[at_ns]
        p, q = estimate.position, estimate.orientation
        pose = pose_matrices(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
        odometry = drift @ true_pose(at_ns)
        # Odometry between two of its stamps is interpolated on a line, so it is a hair off.
        assert_allclose(pose_of(transform.transform) @ odometry, pose, atol=1e-4)
        assert_allclose(pose, true_pose(at_ns), atol=1e-2)
    assert_allclose(landmarks(maps), true_landmarks(), atol=2e-2)


def known_ids(maps):
    return decode_point_cloud2(serialize_message(maps[-1])).ids if maps else []


def test_sensor_pose_by_parameter_and_map_to_base_inverted(ros, tmp_path):
    transforms = ros.collect(TFMessage, '/flown/tf')
    poses = ros.collect(PoseWithCovarianceStamped, '/flown/pose')
    maps = ros.collect(PointCloud2, '/flown/landmark_map', LATCHED_QOS)
    parameters = {'sensor_pose': list(SENSOR), 'odom_frame': "''", 'invert_tf': True}
    arguments = own_topics('/flown')
    with (
        running('observer_node', tmp_path / 'log', *arguments, **parameters),
        Robot(ros, namespace='/flown', sensor_frame_id='nowhere') as robot,
    ):
        end_ns, _ = run(ros, StillBody(robot))
        ros.spin_until(lambda: poses and stamp_ns(poses[-1]) >= end_ns - SECOND // 10, 'the end')
        ros.spin_until(lambda: len(known_ids(maps)) == 6, 'all landmarks')
    published = {stamp_ns(message): message.pose.pose.position.x for message in poses}
    sent = [t for m in transforms for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} == {('base_link', 'map')}
    # Either topic may be heard before the other one, and end later.
    both = [t for t in sent if min(published) <= stamp_ns(t) <= max(published)]
    assert len(both) > 10
    for transform in both:
        x = se3.inverse(pose_of(transform.transform))[0, 3]
        assert x == pytest.approx(published[stamp_ns(transform)], abs=1e-9)
    assert_allclose(landmarks(maps), true_landmarks(), atol=2e-2)


class StillBody:
    """A robot whose wheel is in its base frame."""

    def __init__(self, robot):
        self.robot = robot

    def send(self, event):
        if isinstance(event, VelocityEvent):
            event = event.moved(WHEEL_POSE)
        self.robot.send(event)


def test_observations_wait_for_their_transform_and_are_dropped_without(ros, tmp_path):
    transforms = ros.collect(TFMessage, '/late/tf')
    maps = ros.collect(PointCloud2, '/late/landmark_map', LATCHED_QOS)
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    sender = TransformSender(ros, '/late')
    parameters = {'transform_timeout': 2.0, 'confirmations': 1}
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/late'), **parameters) as node,
        Robot(ros, namespace='/late', sensor_frame_id='turret') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)

        def found():
            return {
                (t.header.frame_id, t.child_frame_id) for m in transforms for t in m.transforms
            }

        now_ns = ros.node.get_clock().now().nanoseconds
        point = np.array([[1.0, 2.0, 3.0]])
        robot.send(VelocityEvent(now_ns, np.zeros(6)))
        robot.send(ObservationEvent(now_ns, np.array([1]), point))  # waits
        robot.send(ObservationEvent(now_ns + 3 * SECOND, np.array([2]), point))  # in vain
        ros.spin_for(0.5)
        turret = se3.from_rpy((1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2))
        sender.send(('base_link', 'turret', turret), stamp_ns=now_ns - 10_000_000)
        sender.send(('base_link', 'turret', turret), stamp_ns=now_ns + 10_000_000)
        ros.spin_for(0.2)
        robot.send(VelocityEvent(now_ns + SECOND, np.zeros(6)))
        ros.spin_until(lambda: len(known_ids(maps)), 'the landmark')
        ros.spin_until(
            lambda: _values(diagnostics).get('dropped: no_transform') == '1', 'the drop'
        )
        node.wait_for_output("no_transform.*'base_link' to 'turret' is known from")
        node.wait_for_output("publishing 'map' to 'base_link'")  # 2 s after the first pose
        ros.spin_until(lambda: ('map', 'base_link') in found(), 'the transform')
    assert known_ids(maps).tolist() == [1]
    assert_allclose(landmarks(maps), [[-1.0, 1.0, 3.0]], atol=1e-6)
    assert "publishing 'map' to 'base_link' on /tf: nobody publishes 'odom'" in node.output
    assert found() == {('base_link', 'turret'), ('map', 'base_link')}


def _values(diagnostics):
    if not diagnostics:
        return {}
    return {value.key: value.value for value in diagnostics[-1].status[0].values}


def test_the_nodes_own_transform_takes_no_other_ones_place():
    node = Mock()
    buffer = TransformBuffer()
    LiveTransforms(node, buffer, ('map', 'base_link'))
    receive = node.create_subscription.call_args_list[0].args[2]
    for parent in ('odom', 'map'):
        header = MESSAGES.header(SECOND, parent)
        transform = TransformStamped(header=header, child_frame_id='base_link')
        receive(serialize_message(TFMessage(transforms=[transform])))
    assert buffer.newest_ns('odom', 'base_link') == SECOND
    assert buffer.newest_ns('map', 'base_link') is None


def test_a_camera_is_heard_and_one_that_is_not_calibrated_is_named():
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    buffer = TransformBuffer()
    LiveTransforms(node, buffer, ('map', 'base_link'))
    (receive,) = (
        call.args[2]
        for call in node.create_subscription.call_args_list
        if call.args[1] == 'camera_info'
    )
    receive(ros_messages.serialise(detector.camera_info('/lens')))
    receive(ros_messages.serialise(detector.camera_info('other', focal_lengths=(0.0, 0.0))))
    assert list(buffer.cameras) == ['lens']
    (logged,) = (call.args[0] for call in node.get_logger().warning.call_args_list)
    assert "'/robot/camera_info': the camera of 'other' is not calibrated" in logged


def test_a_second_localisation_on_tf_is_named(ros, tmp_path):
    sender = TransformSender(ros, '/second')
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/second')) as node,
        Robot(ros, namespace='/second') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)
        for step in range(100):
            stamp = time.time_ns()
            robot.send(VelocityEvent(stamp, np.zeros(6)))
            sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=stamp)
            if step == 50:
                assert 'another node' not in node.output
            if step > 50:
                sender.send(('map', 'odom', np.eye(4)), stamp_ns=stamp)
            ros.spin_for(0.02)
        node.wait_for_output(r"another node publishes 'map' to 'odom' on /tf")


def test_a_static_map_to_odom_is_named_too(ros, tmp_path):
    sender = TransformSender(ros, '/static')
    sender.send(('map', 'odom', np.eye(4)))
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/static')) as node,
        Robot(ros, namespace='/static') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic, sender.static)
        for _ in range(100):
            stamp = time.time_ns()
            robot.send(VelocityEvent(stamp, np.zeros(6)))
            sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=stamp)
            ros.spin_for(0.02)
        node.wait_for_output(r"another node publishes 'map' to 'odom' on /tf_static, too: end it")
