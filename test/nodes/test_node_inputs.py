"""Every kind of input over real DDS; missing packages and deaf subscriptions are reported."""

from __future__ import annotations

from contextlib import ExitStack
import importlib.util
import inspect
import math
import sys
import time
from types import SimpleNamespace
from unittest.mock import MagicMock, Mock

import detector_messages as detector
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose, PoseArray, Twist, TwistStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_processes import NodeProcess, running
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from robots import own_topics, reliable, Robot, stamp_ns, TransformSender
import ros_messages
from sensor_msgs.msg import Imu, PointCloud2

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.messages.poses import decode_twist, ODOMETRY
from slam_observer_ros.nodes import chosen_inputs
from slam_observer_ros.nodes.chosen_inputs import open_inputs
from slam_observer_ros.nodes.input_topic import InputTopic
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES, TFMessage, with_info
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

IMU = 'sensor_msgs/msg/Imu'
pytestmark = pytest.mark.ros

SECOND = 1_000_000_000
STEP_NS = SECOND // 20
STEPS = 30
V = np.array([0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
MARKER = (7, (1.0, 2.0, 3.0), detector.NO_TURN)
WRONG_TURN = np.array([0.0, 0.0, -0.8, 1.0, 0.0, 0.0])


def true_pose(stamp_ns, start_ns):
    return se3.exp(V * (stamp_ns - start_ns) * 1e-9)


def odometry(stamp, start_ns, velocity=V):
    message = Odometry(header=MESSAGES.header(stamp, 'odom'), child_frame_id='base_link')
    message.pose.pose = MESSAGES.pose(true_pose(stamp, start_ns))
    message.twist.twist = MESSAGES.twist(velocity)
    return message


def twist_with_covariance(stamp, _start_ns):
    message = TwistWithCovarianceStamped(header=MESSAGES.header(stamp, 'base_link'))
    message.twist.twist = MESSAGES.twist(V)
    message.twist.covariance = (np.eye(6) * 1e-4).ravel()
    return message


def imu(stamp, _start_ns):
    message = Imu(header=MESSAGES.header(stamp, 'base_link'))
    message.angular_velocity = MESSAGES.vector(V[:3])
    return message


# For each way of knowing the velocity: parameters, and what is published where.
VELOCITY_INPUTS = {
    '/twist_with_covariance': ({}, {'twist': (TwistWithCovarianceStamped, twist_with_covariance)}),
    '/odometry_twist': ({}, {'twist': (Odometry, odometry)}),
    '/pose_differences': (
        {'velocity_source': 'pose_differences', 'reorder_window': 0.1},
        {'twist': (Odometry, lambda stamp, start: odometry(stamp, start, np.zeros(6)))},
    ),
    '/wheels_and_imu': (
        {'use_imu': True},
        {
            'imu': (Imu, imu),
            'twist': (Odometry, lambda stamp, start: odometry(stamp, start, WRONG_TURN)),
        },
    ),
}


class FakeClock:
    """The system clock 10 s ahead, which is then the ROS clock's; or a simulated one."""

    def __init__(self, is_simulated=False):
        self.ros_time_is_active = is_simulated

    def now(self):
        return SimpleNamespace(nanoseconds=time.time_ns() + 10 * SECOND)


def unstamped_input(node, received, is_simulated=False):
    """Return an input of Twist, and what its subscription calls with bytes and their info."""
    node.get_clock.return_value = FakeClock(is_simulated)
    node.resolve_topic_name.side_effect = lambda name: f'/{name}'
    decoders = {'geometry_msgs/msg/Twist': decode_twist}
    source = InputTopic(node, 'twist', decoders, lambda *taken: received.append(taken), QOS)
    return source, node.create_subscription.call_args.args[2]


QOS = QoSProfile(depth=1)
QOS_DEEP = QoSProfile(depth=100)
TWIST = serialize_message(Twist())
NOW_NS = 1_700_000_000 * SECOND


@pytest.mark.parametrize('is_simulated', [False, True])
def test_a_message_that_had_to_wait_was_received_when_the_middleware_had_it(
    monkeypatch, is_simulated
):
    monkeypatch.setattr(time, 'time_ns', lambda: NOW_NS)
    received = []
    _, receive = unstamped_input(Mock(), received, is_simulated)
    waited_since_ns = NOW_NS - 3 * SECOND
    receive(TWIST, {'received_timestamp': waited_since_ns})
    receive(TWIST, {'received_timestamp': 0})  # as where the middleware does not say
    (first, first_ns), (last, last_ns) = received
    assert (first.stamp_ns, last.stamp_ns) == (first_ns, last_ns)
    assert last_ns == NOW_NS + 10 * SECOND
    assert first_ns == (last_ns if is_simulated else waited_since_ns)


def test_a_first_message_ends_the_report_that_there_is_none():
    node = Mock()
    source, receive = unstamped_input(node, [])
    publisher = Mock(topic_type='geometry_msgs/msg/Twist', qos_profile=QOS)
    node.get_publishers_info_by_topic.return_value = [publisher]
    source.check_publishers()
    assert source.problem == "no message yet on '/twist' (geometry_msgs/msg/Twist)"
    receive(TWIST, {'received_timestamp': time.time_ns()})
    assert not source.problem


@pytest.mark.parametrize(
    ('is_held', 'is_simulated', 'said'),
    [
        (True, False, "the node was busy for 6.2 s, in which it read nothing on '/twist'"),
        (False, False, "no message on '/twist' for 6 s, though it has a publisher"),
        (False, True, '/clock stands still for 6 s, and nothing comes on'),
    ],
    ids=['busy node', 'silent driver', 'stopped clock'],
)
def test_a_busy_node_a_silent_driver_and_a_stopped_clock_are_distinguished(
    monkeypatch, is_held, is_simulated, said
):
    node, now_s = Mock(), [1000.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now_s[0])
    monkeypatch.setattr(time, 'time_ns', lambda: NOW_NS)
    source, receive = unstamped_input(node, [], is_simulated)
    publisher = Mock(topic_type='geometry_msgs/msg/Twist', qos_profile=QOS)
    node.get_publishers_info_by_topic.return_value = [publisher]
    receive(TWIST, {'received_timestamp': 0})
    source.check_publishers()
    assert not source.problem
    for _ in range(1 if is_held else 25):
        now_s[0] += 6.2 if is_held else 0.25
        source.check_publishers()
    assert source.problem.startswith(said)
    receive(TWIST, {'received_timestamp': 0})
    for _ in range(12):  # what was wrong is said for a while if it was the node
        assert source.problem.startswith(said) == is_held
        now_s[0] += 0.4
        source.check_publishers()
        receive(TWIST, {'received_timestamp': 0})
    now_s[0] += 0.4
    assert not source.problem


def test_of_two_types_on_a_topic_the_one_that_comes_is_heard(monkeypatch):
    node, now_s = Mock(), [1000.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now_s[0])
    node.get_clock.return_value = FakeClock()
    node.resolve_topic_name.return_value = '/cmd_vel'
    teleop, nav = (
        Mock(topic_type=f'geometry_msgs/msg/{name}', qos_profile=QOS, node_namespace='/')
        for name in ('Twist', 'TwistStamped')
    )
    decoders = {each.topic_type: decode_twist for each in (teleop, nav)}
    source = InputTopic(node, 'twist', decoders, Mock(), QOS)

    def heard_after(seconds, publishers):
        node.get_publishers_info_by_topic.return_value = publishers
        for _ in range(4 * seconds):
            now_s[0] += 0.25
            source.check_publishers()
        return node.create_subscription.call_args.args[0].__name__

    assert heard_after(3, [teleop]) == 'Twist'
    assert heard_after(1, [teleop, nav]) == 'TwistStamped'
    assert source.doubt == found(
        'several_types', topic='/cmd_vel', heard=nav.topic_type, others=teleop.topic_type
    )
    node.create_subscription.call_args.args[2](TWIST, {'received_timestamp': 0})
    assert heard_after(4, [teleop, nav]) == 'TwistStamped', 'a pause of what has come is usual'
    assert heard_after(2, [teleop, nav]) == 'Twist'
    assert heard_after(3, [teleop, nav]) == 'TwistStamped'
    listened = [call.args[0] for call in node.get_logger().info.call_args_list]
    assert len(listened) == 2, 'each type is said once'
    heard_after(1, [nav])
    assert source.doubt is None


def test_a_node_that_is_always_busy_leaves_a_silent_type_too_but_reads_what_waits_first(
    monkeypatch,
):
    node, now_s = Mock(), [1000.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now_s[0])
    node.get_clock.return_value = FakeClock()
    node.resolve_topic_name.return_value = '/cmd_vel'
    node.get_publishers_info_by_topic.return_value = [
        Mock(topic_type=f'geometry_msgs/msg/{name}', qos_profile=QOS, node_namespace='/')
        for name in ('Twist', 'TwistStamped')
    ]
    decoders = dict.fromkeys(('geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped'), Mock())
    source = InputTopic(node, 'twist', decoders, Mock(), QOS)
    heard = []
    for wait_s in (0.25, 9.0, 1.5, 1.5, 9.0, 0.25):  # a message may wait where a look is late
        now_s[0] += wait_s
        source.check_publishers()
        heard.append(node.create_subscription.call_args.args[0].__name__)
    assert heard == ['Twist', 'Twist', 'Twist', 'TwistStamped', 'TwistStamped', 'TwistStamped']


def test_a_node_that_was_not_to_look_was_not_busy(monkeypatch):
    node, now_s = Mock(), [1000.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now_s[0])
    source, receive = unstamped_input(node, [])
    publisher = Mock(topic_type='geometry_msgs/msg/Twist', qos_profile=QOS)
    node.get_publishers_info_by_topic.return_value = [publisher]
    receive(TWIST, {'received_timestamp': 0})
    now_s[0] += 600.0
    source.begin_looking()
    source.check_publishers()
    assert 'busy' not in source.problem


def test_a_node_that_does_not_keep_up_says_so(monkeypatch):
    node = Mock()
    source, receive = unstamped_input(node, [])
    steady_s = time.monotonic()
    monkeypatch.setattr(time, 'time_ns', lambda: NOW_NS)
    publisher = Mock(topic_type='geometry_msgs/msg/Twist', qos_profile=QOS)
    node.get_publishers_info_by_topic.return_value = [publisher]
    problems = []

    def at(step):
        monkeypatch.setattr(time, 'monotonic', lambda: steady_s + 0.1 * step)
        source.check_publishers()
        return source.problem

    for step, wait_s in enumerate([0.0, *[1.5] * 30, 0.0, *[1.5] * 30]):
        at(step)
        receive(TWIST, {'received_timestamp': NOW_NS - round(wait_s * SECOND)})
        problems.append(at(step))
    assert problems[:20] == [''] * 20, 'it may only have been busy for a moment'
    assert problems[30].startswith("the node does not keep up: messages on '/twist' wait 1.5 s")
    assert problems[31] == ''
    assert problems[-1]
    assert [at(later) for later in range(step, step + 31)][-1] == '', 'no message comes any more'
    for step in (2000, 4000):
        monkeypatch.setattr(time, 'monotonic', lambda step=step: steady_s + 0.1 * step)
        source.begin_looking()
        receive(TWIST, {'received_timestamp': NOW_NS - SECOND})
        assert at(step) == '', 'single messages say nothing of the time between'


@pytest.mark.parametrize(
    ('message_type', 'name', 'found'),
    [
        ('sensor_msgs/msg/PointCloud2', 'ID', 'fields x y z ID'),
        ('sensor_msgs/msg/PointCloud', 'landmark_id', 'channels landmark_id'),
        ('sensor_msgs/msg/PointCloud2', 'id', None),
        ('sensor_msgs/msg/PointCloud', 'id', None),
    ],
)
def test_points_whose_ids_are_named_otherwise_are_reported_once(message_type, name, found):
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    if message_type.endswith('2'):
        dtype = [('x', '<f4'), ('y', '<f4'), ('z', '<f4'), (name, '<u4')]
        clouds = [ros_messages.point_cloud2(np.ones((1, count), dtype)) for count in (0, 2, 2)]
    else:
        clouds = [
            ros_messages.point_cloud(np.ones((count, 3)), {name: np.ones(count)})
            for count in (0, 2, 2)
        ]
    decode = chosen_inputs.CloudDecoder(node, message_type)
    decoded = [decode(ros_messages.serialise(cloud), 0) for cloud in clouds]
    assert [len(message.ids) for message in decoded] == [0, 2, 2]
    logged = [call.args[0] for call in node.get_logger().warning.call_args_list]
    start = f"points on '/robot/landmarks' come without ids; {found}: they are distinguished"
    assert [text.startswith(start) for text in logged] == ([] if found is None else [True])
    assert all(text.endswith("name these 'id'") for text in logged)


@pytest.mark.parametrize(
    ('velocity', 'speed', 'is_logged'),
    [(np.zeros(6), 0.5, True), (V, 0.5, False), (np.zeros(6), 0.001, False)],
    ids=['poses alone', 'both', 'at rest'],
)
def test_an_odometry_with_poses_alone_is_reported_once(velocity, speed, is_logged):
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    decode = chosen_inputs.OdometryDecoder(node)
    for step in range(20):
        message = odometry(round(speed * step * SECOND), 0, velocity)
        assert_allclose(decode(serialize_message(message), 0).body_velocity, velocity)
    logged = [call.args[0] for call in node.get_logger().warning.call_args_list]
    assert len(logged) == is_logged
    finding = found('zero_twist', topic="'/robot/twist'")
    assert decode.doubt == (finding if is_logged else None)
    assert all(text == finding.text() for text in logged)


def test_that_the_velocities_of_an_odometry_are_missing_is_said_until_they_come():
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    node.get_clock.return_value = FakeClock()
    decode = chosen_inputs.OdometryDecoder(node)
    source = InputTopic(node, 'twist', {ODOMETRY: decode}, Mock(), QOS)
    receive = node.create_subscription.call_args.args[2]
    for step in range(5):
        message = odometry(step * SECOND, 0, np.zeros(6))
        receive(serialize_message(message), {'received_timestamp': 0})
    assert source.doubt.what == "all velocities on '/robot/twist' are zero, but its poses move"
    receive(serialize_message(odometry(5 * SECOND, 0)), {'received_timestamp': 0})
    assert source.doubt is None


def test_a_message_that_cannot_be_read_is_said_as_a_recordings_is():
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    node.get_clock.return_value = FakeClock()
    source = InputTopic(
        node, 'twist', {ODOMETRY: chosen_inputs.OdometryDecoder(node)}, Mock(), QOS
    )
    receive = node.create_subscription.call_args.args[2]
    assert source.last_malformed is None
    receive(serialize_message(odometry(0, 0))[:40], {'received_timestamp': 0})
    assert source.last_malformed.kind == 'malformed_message'
    assert source.last_malformed.what.startswith("malformed message on '/robot/twist': ")
    (source._log._next_s, source._log._quiet_until_s) = {}, 0.0
    receive(serialize_message(odometry(0, 0))[:40], {'received_timestamp': 0})
    (logged,) = (call.args[0] for call in node.get_logger().warning.call_args_list)
    assert logged == source.last_malformed.text(' (2 so far)')


def landmarks_input(type_name, feed=None, **settings):
    """Return the input of landmarks, and a node on whose topic somebody publishes a type."""
    node = MagicMock()
    node.create_subscription.return_value.handle.take_message.return_value = None
    node.resolve_topic_name.side_effect = lambda topic: f'/{topic}'
    node.get_clock.return_value.now.return_value.nanoseconds = 0
    publisher = Mock(topic_type=type_name, qos_profile=QOS)
    node.get_publishers_info_by_topic.return_value = [publisher]
    _, landmarks = open_inputs(node, ObserverNodeSettings(**settings), feed or Mock())
    return landmarks, node


DETECTIONS = {
    message.__msgtype__: message
    for message in (
        detector.detections([detector.detection('7')], 'camera'),
        detector.apriltags([('tag36h11', 7)], 'camera'),
        detector.boxes([('lamp_7', (400.0, 200.0))], 'camera'),
        detector.isaac_apriltags([MARKER], 'camera'),
        detector.aruco_detection([MARKER], 'camera'),
        detector.aruco_markers([MARKER], 'camera'),
        detector.aruco_markers([MARKER], 'camera', package='aruco_interfaces'),
        detector.landmark_list([('7', *MARKER[1:])], 'camera'),
        detector.range_bearing([(7, 2.0, 0.1, 0.2)], 'camera'),
        *detector.ranges_of_packages(),
    )
}


@pytest.mark.parametrize('type_name', DETECTIONS)
def test_a_detection_type_that_is_found_names_its_package_if_that_is_missing(
    type_name, monkeypatch
):
    package, _, name = type_name.split('/')
    monkeypatch.setitem(sys.modules, f'{package}.msg', None)
    landmarks, node = landmarks_input(type_name)
    landmarks.check_publishers()
    node.create_subscription.assert_not_called()
    assert f'{type_name} needs the package {package}: apt install ros-' in landmarks.problem
    assert package.replace('_', '-') in landmarks.problem
    monkeypatch.setitem(sys.modules, f'{package}.msg', SimpleNamespace(**{name: object}))
    landmarks.check_publishers()
    node.create_subscription.assert_called_once()
    assert landmarks.problem.startswith("no message yet on '/landmarks'")


@pytest.mark.parametrize('type_name', DETECTIONS)
def test_detections_are_found_on_the_topic_and_read(type_name, monkeypatch):
    package, _, name = type_name.split('/')
    monkeypatch.setitem(sys.modules, f'{package}.msg', SimpleNamespace(**{name: object}))
    feed = Mock()
    landmarks, node = landmarks_input(type_name, feed)
    landmarks.check_publishers()
    receive = node.create_subscription.call_args.args[2]
    receive(ros_messages.serialise(DETECTIONS[type_name]), {'received_timestamp': 0})
    (measured, _), _ = feed.add_observation.call_args
    assert_array_equal(measured.ids, [7])


def test_no_package_of_a_detector_is_imported_unasked(monkeypatch):
    for package in {name.partition('/')[0] for name in DETECTIONS}:
        monkeypatch.setitem(sys.modules, package, None)
    landmarks, node = landmarks_input('sensor_msgs/msg/PointCloud2')
    landmarks.check_publishers()
    node.create_subscription.assert_called_once()


def test_what_else_a_topic_carries_is_answered_with_the_types_that_are_read():
    landmarks, _ = landmarks_input('sensor_msgs/msg/LaserScan')
    landmarks.check_publishers()
    assert landmarks.problem == (
        "'/landmarks' carries sensor_msgs/msg/LaserScan; PointCloud2, PointCloud, "
        'AprilTagDetectionArray, PoseArray, Detection3DArray, Detection2DArray, ArucoDetection, '
        'ArucoMarkers, LandmarkList, ObservationRangeBearing, ObservationRangeBeacon, '
        'LinktrackNodeframe2, LinktrackNodeframe3, LinktrackAoaNodeframe0, BeaconDistance, '
        'beacon_distance, Ranging, GenericRanging, DWRanging, UWBRanging or Range is needed'
    )


def test_an_odometry_without_an_attitude_has_a_velocity():
    message = odometry(0, 0, np.zeros(6))
    message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
    decode = chosen_inputs.OdometryDecoder(Mock())
    assert_allclose(decode(serialize_message(message), 0).body_velocity, 0.0)


def test_a_velocity_without_poses_has_no_pose_differences():
    settings = ObserverNodeSettings(velocity_source='pose_differences', velocity_type='Twist')
    with pytest.raises(ParameterError, match="'Twist' has no poses"):
        open_inputs(Mock(), settings, Mock())


@pytest.mark.parametrize('is_seen', [False, True])
def test_fiducials_on_tf_by_another_name_are_reported_once(monkeypatch, is_seen):
    node, now = Mock(), [0.0]
    monkeypatch.setattr(chosen_inputs, 'time', Mock(monotonic=lambda: now[0]))
    decode = chosen_inputs.TagDecoder(node, 'dock')
    for name in ('dock7' if is_seen else 'fiducial_7', 'wheel', 'wheel'):
        names, position, quaternion = ('camera', name), (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)
        sent = [ros_messages.transform_stamped(names, position, quaternion)]
        decode(ros_messages.serialise(ros_messages.make('tf2_msgs/msg/TFMessage', sent)), 0)
        now[0] += chosen_inputs.WITHOUT_TAG_S
    logged = [call.args[0] for call in node.get_logger().warning.call_args_list]
    assert len(logged) == (not is_seen)
    assert all("named 'dock<id>'" in text for text in logged)
    assert all('(there are fiducial_7, wheel)' in text for text in logged)


def test_each_source_of_velocity_leads_to_the_same_place(ros, tmp_path):
    with ExitStack() as stack:
        received, publishers = {}, []
        for namespace, (parameters, topics) in VELOCITY_INPUTS.items():
            log = tmp_path / namespace.strip('/')
            arguments = own_topics(namespace)
            stack.enter_context(running('observer_node', log, *arguments, **parameters))
            received[namespace] = ros.collect(Odometry, f'{namespace}/observer_node/odometry')
            publishers += [
                (ros.node.create_publisher(message_class, f'{namespace}/{topic}', 100), make)
                for topic, (message_class, make) in topics.items()
            ]
        ros.wait_for_subscriber(*(publisher for publisher, _ in publishers))
        start_ns = time.time_ns()
        for step in range(STEPS):
            stamp = start_ns + step * STEP_NS
            for publisher, make in publishers:
                publisher.publish(make(stamp, start_ns))
                ros.spin_for(0.005)
        last_ns = start_ns + (STEPS - 5) * STEP_NS
        ros.spin_until(
            lambda: all(m and stamp_ns(m[-1]) >= last_ns for m in received.values()), 'the end'
        )
    for namespace, messages in received.items():
        pose = messages[-1].pose.pose.position
        truth = true_pose(stamp_ns(messages[-1]), start_ns)
        assert_allclose([pose.x, pose.y, pose.z], truth[:3, 3], atol=1e-6, err_msg=namespace)
        assert_allclose(messages[-1].twist.twist.angular.z, V[2], atol=1e-6, err_msg=namespace)


def test_poses_without_ids_and_fiducials_on_tf_are_landmarks(ros, tmp_path):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    maps = ros.collect(PointCloud2, '/tags/landmark_map', LATCHED_QOS)
    nameless_maps = ros.collect(PointCloud2, '/nameless/landmark_map', LATCHED_QOS)
    poses = ros.node.create_publisher(PoseArray, '/nameless/landmarks', 10)
    sender = TransformSender(ros, '/tags')
    tagged = {'landmarks_type': 'tf', 'tag_frame_prefix': 'dock', 'odom_frame': "''"}
    with (
        running('observer_node', tmp_path / 'tags', *own_topics('/tags'), **tagged),
        running('observer_node', tmp_path / 'nameless', *own_topics('/nameless')),
        Robot(ros, namespace='/tags', subscribers=False) as robot,
    ):
        sender.send(('base_link', 'camera', se3.pose(np.eye(3), np.array([0.0, 0.0, 1.0]))))
        ros.wait_for_subscriber(sender.dynamic, robot.twist, poses)

        def send():
            stamp = time.time_ns()
            robot.send(VelocityEvent(stamp, np.zeros(6)))
            sender.send(
                ('camera', 'tag36h11:3', se3.pose(np.eye(3), np.array([2.0, 0.0, 0.0]))),
                ('camera', 'dock11', se3.pose(np.eye(3), np.array([0.0, 3.0, 0.0]))),
                ('odom', 'base_link', np.eye(4)),
                stamp_ns=stamp,
            )
            point = Pose(position=MESSAGES.point(np.ones(3)))
            header = MESSAGES.header(stamp, 'base_link')
            poses.publish(PoseArray(header=header, poses=[point]))

        ros.spin_until(lambda: len(seen(maps)) == 2 or send(), 'two fiducials')
        ros.spin_until(lambda: len(seen(nameless_maps)) == 1 or send(), 'a landmark without id')
    assert set(seen(maps)) == {3, 11}
    assert_allclose(seen(maps)[3], [2.0, 0.0, 1.0], atol=1e-6)
    assert_allclose(seen(maps)[11], [0.0, 3.0, 1.0], atol=1e-6)
    assert_allclose(seen(nameless_maps)[FIRST_AUTOMATIC_ID], [1.0, 1.0, 1.0], atol=1e-6)


def test_the_map_has_the_velocities_that_landmarks_came_with(ros, tmp_path):
    maps = ros.collect(PointCloud2, '/moving/landmark_map', LATCHED_QOS)
    points, speed = np.array([[2.0, 0, 0], [0, 3.0, 1.0]]), np.array([[0, 0.5, 0], [0, 0, 0]])
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/moving'), odom_frame="''"),
        Robot(ros, namespace='/moving') as robot,
    ):
        start_ns = time.time_ns()
        for step in range(20):
            stamp = start_ns + step * STEP_NS
            robot.send(VelocityEvent(stamp, np.zeros(6)))
            moved = points + speed * step * STEP_NS * 1e-9
            robot.send(ObservationEvent(stamp, np.array([3, 4]), moved, None, speed))
            ros.spin_for(0.05)
        ros.spin_until(lambda: len(seen(maps)) == 2, 'two landmarks')
        ros.spin_until(
            lambda: stamp_ns(maps[-1]) >= start_ns + 15 * STEP_NS, 'a map of the last stamps'
        )
    event = decode_point_cloud2(serialize_message(maps[-1]))
    assert_allclose(event.velocities, speed, atol=1e-6)
    elapsed_s = (stamp_ns(maps[-1]) - start_ns) * 1e-9
    assert_allclose(event.points, points + speed * elapsed_s, atol=1e-3)


def seen(maps):
    if not maps:
        return {}
    event = decode_point_cloud2(serialize_message(maps[-1]))
    return dict(zip(event.ids.tolist(), event.points, strict=True))


def test_optional_packages_are_named_when_they_are_missing(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_DISTRO', 'kilted')
    packages = {
        'Detection3DArray': 'vision_msgs',
        'AprilTagDetectionArray': 'apriltag_msgs',
        'ArucoDetection': 'aruco_opencv_msgs',
    }
    nodes = {
        package: NodeProcess(
            'observer_node', tmp_path / package, is_forked=True, landmarks_type=landmarks_type
        )
        for landmarks_type, package in packages.items()
        if importlib.util.find_spec(package) is None
    }
    for package, node in nodes.items():
        assert node.wait() == 2
        assert f'apt install ros-kilted-{package.replace("_", "-")}' in node.output
        assert 'Traceback' not in node.output


def test_a_driver_that_falls_silent_is_logged_once_each_time(monkeypatch):
    """A robot may be parked for days."""
    clock = SimpleNamespace(now_s=1000.0)
    monkeypatch.setattr(time, 'monotonic', lambda: clock.now_s)
    node, qos = Mock(), QoSProfile(depth=1)
    node.resolve_topic_name.return_value = '/twist'
    node.get_clock.return_value = FakeClock()
    publisher = SimpleNamespace(topic_type=IMU, qos_profile=qos, node_name='driver')
    node.get_publishers_info_by_topic.return_value = [publisher]
    source = InputTopic(node, 'twist', {IMU: lambda raw, receive_ns: raw}, Mock(), qos)
    receive = node.create_subscription.call_args.args[2]
    warning = node.get_logger.return_value.warning

    def check_for(duration_s):
        for _ in range(duration_s):
            clock.now_s += 1.0
            source.check_publishers()
        return [call.args[0] for call in warning.call_args_list]

    for _ in range(20):
        receive(b'', {'received_timestamp': 0})
        assert not check_for(1)
    logged = check_for(100)
    assert logged == ["no message on '/twist' for 6 s, though it has a publisher"]
    assert 'for 101 s' in source.problem
    receive(b'', {'received_timestamp': 0})
    assert len(check_for(4)) == 1
    assert not source.problem
    assert check_for(100) == 2 * logged
    receive(b'', {'received_timestamp': 0})
    assert len(check_for(7)) == 3
    receive(b'', {'received_timestamp': 0})
    assert len(check_for(7)) == 3, 'one line in 10 s'
    assert len(check_for(20)) == 4, 'but not forgotten'


def test_a_busy_node_reads_in_the_order_in_which_messages_came(ros):
    """Its executor reads one of each topic in turn: landmarks would run ahead of velocities."""
    qos, order = QoSProfile(depth=100), []
    node = rclpy.create_node('busy', context=ros.node.context)

    def take(kind, _receive_ns):
        order.append(kind)

    decoders = {'geometry_msgs/msg/Twist': lambda *_: 'velocity'}
    velocities = InputTopic(node, 'busy/twist', decoders, take, qos)
    decoders = {'geometry_msgs/msg/PoseArray': lambda *_: 'landmarks'}
    InputTopic(node, 'busy/landmarks', decoders, take, qos).read_first = [velocities]
    twists = ros.node.create_publisher(Twist, 'busy/twist', qos)
    landmarks = ros.node.create_publisher(PoseArray, 'busy/landmarks', qos)
    executor = SingleThreadedExecutor(context=ros.node.context)
    executor.add_node(node)
    try:
        for publisher in (twists, landmarks):
            ros.spin_until(publisher.get_subscription_count, publisher.topic_name)
        for _ in range(12):
            for _ in range(5):
                twists.publish(Twist())
            landmarks.publish(PoseArray())
        for publisher in (twists, landmarks):
            assert publisher.wait_for_all_acked(Duration(seconds=10))
        deadline_s = time.monotonic() + 10.0
        while len(order) < 72 and time.monotonic() < deadline_s:
            executor.spin_once(timeout_sec=0.1)
        assert len(order) == 72
        velocities_before = np.flatnonzero(np.array(order) == 'landmarks') - np.arange(12)
        published_before = 5 * np.arange(1, 13)
        # One more shows that there is none before, and one comes in turn.
        assert set(velocities_before - published_before) <= {0, 1, 2}
    finally:
        executor.shutdown()
        node.destroy_node()
        for publisher in (twists, landmarks):
            ros.node.destroy_publisher(publisher)


def test_after_a_stall_all_that_waits_is_used_in_order_before_anything_is_published():
    node, order = Mock(), []
    node.get_clock.return_value = FakeClock()

    def waiting_input(name, type_name, *received_s, max_wait_s=math.inf):
        def take(_message, receive_ns):
            is_due = not any(source.has_more for source in sources)
            order.append((name, receive_ns // SECOND, is_due))

        source = InputTopic(node, name, {type_name: lambda *_: name}, take, QOS_DEEP, max_wait_s)
        queue = [(b'', {'received_timestamp': NOW_NS + at_s * SECOND}) for at_s in received_s]
        source._take = lambda: queue.pop(0) if queue else None
        return source

    velocities = waiting_input('twist', 'geometry_msgs/msg/Twist', 0, 1, 3, 5)
    landmarks = waiting_input('landmarks', 'geometry_msgs/msg/PoseArray', 2, 4, max_wait_s=1e10)
    landmarks.read_first = [velocities]
    sources = landmarks, velocities
    for source in sources:
        source.read_waiting()
    assert [(name, at_s - NOW_NS // SECOND) for name, at_s, _ in order] == [
        ('twist', 0), ('twist', 1), ('twist', 3), ('landmarks', 2), ('twist', 5), ('landmarks', 4)
    ]  # fmt: skip
    assert [is_due for *_, is_due in order] == [False] * 5 + [True]


def test_publisher_of_another_quality_of_service_is_reported_or_heard(ros, tmp_path):
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    maps = ros.collect(PointCloud2, '/picky/landmark_map', LATCHED_QOS)
    with (
        running(
            'observer_node', tmp_path / 'log', *own_topics('/picky'), **reliable('/picky')
        ) as node,
        Robot(ros, namespace='/picky', subscribers=False) as robot,
    ):
        ros.node.destroy_publisher(robot.landmarks)
        robot.landmarks = ros.node.create_publisher(PointCloud2, '/picky/landmarks', best_effort)
        node.wait_for_output(r"'test_client' can't be heard on '/picky/landmarks'.*[Rr]eliab")
        ros.node.destroy_publisher(robot.landmarks)
        robot.landmarks = ros.node.create_publisher(PointCloud2, '/picky/landmarks', 10)
        ros.wait_for_subscriber(robot.twist, robot.landmarks)
        ros.spin_until(lambda: send_landmark(robot) or set(seen(maps)) == {5}, 'the landmark')


def send_landmark(robot):
    robot.send(ObservationEvent(time.time_ns(), np.array([5]), np.ones((1, 3))))
    robot.send_zeros()


def test_a_second_publisher_of_velocities_or_of_the_odometry_is_named(ros, tmp_path):
    statuses = ros.collect(DiagnosticArray, '/diagnostics')
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/rivals') as node,
        Robot(ros, namespace='/rivals') as robot,
    ):
        velocities = ros.node.create_publisher(TwistStamped, '/rivals/twist', 10)
        node.wait_for_output(r"2 publishers \(/test_client, /test_client\) publish on '/rivals/tw")
        ros.node.destroy_publisher(velocities)
        estimates = ros.node.create_publisher(Odometry, '/rivals/observer_node/odometry', 10)
        node.wait_for_output(
            r"/rivals/observer_node, /test_client\) publish on '/rivals/observer_node/odom"
        )
        ros.spin_until(
            lambda: any(
                "publish on '/rivals/observer_node/odom" in m.status[0].message for m in statuses
            ),
            'its diagnostics',
        )
        ros.node.destroy_publisher(estimates)
        assert "publish on '/rivals/landmarks'" not in node.output
        robot.send_zeros()


def test_another_type_of_cloud_than_is_asked_for_is_said_by_its_own_name():
    landmarks, _ = landmarks_input('sensor_msgs/msg/PointCloud2', landmarks_type='PoseArray')
    landmarks.check_publishers()
    assert landmarks.problem.endswith('PoseArray is needed; set landmarks_type: PointCloud2')


def test_a_callback_gets_what_dds_knows_of_a_message_from_every_executor():
    received = []
    callback = with_info(lambda raw, info: received.append((raw, info)))
    callback(b'1', {'received_timestamp': 1})
    callback((b'2', {'received_timestamp': 2}))  # as EventsExecutor does
    assert received == [(b'1', {'received_timestamp': 1}), (b'2', {'received_timestamp': 2})]
    with pytest.raises(TypeError):  # rclpy would take it for one that wants the message alone
        inspect.signature(callback).bind(b'')


def test_a_twist_along_the_axes_of_the_odometrys_frame_is_reported_once():
    node = Mock()
    node.resolve_topic_name.side_effect = lambda topic: f'/robot/{topic}'
    decode = chosen_inputs.OdometryDecoder(node)
    for step in range(500):  # ahead, but along y of its frame
        angle, stamp_ns = np.pi / 2, step * SECOND // 50
        message = Odometry(header=MESSAGES.header(stamp_ns, 'odom'), child_frame_id='base_link')
        message.pose.pose.position.y = 0.01 * step
        message.pose.pose.orientation.z = float(np.sin(angle / 2))
        message.pose.pose.orientation.w = float(np.cos(angle / 2))
        message.twist.twist.linear.y = 0.5
        decode(serialize_message(message), 0)
    (text,) = (call.args[0] for call in node.get_logger().warning.call_args_list)
    assert text == decode.doubt.text()
    assert decode.doubt.kind == 'wrong_twist'
    assert text.startswith("The twist on '/robot/twist' is along the axes of 'odom'")
