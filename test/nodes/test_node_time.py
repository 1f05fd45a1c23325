"""Clocks: simulated, beginning at zero, looped, of another machine; and messages out of order."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
import itertools
import time
from unittest.mock import Mock

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Path
from node_processes import running
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rclpy.serialization import serialize_message
from robots import own_topics, reliable, Robot, stamp_ns, TransformSender
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.nodes.estimator_feed import ClockChange, EstimatorFeed, MAX_LOOKS
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES, TFMessage
from slam_observer_ros.recordings.frames import BaseFrame, TransformBuffer
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.simulation import Scenario, Simulation

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000
RUN = Scenario(velocity_rate=40.0, observation_rate=20.0, duration=1.5, initial_bias=0.0)


@pytest.fixture(scope='module')
def clock(ros):
    publisher = ros.node.create_publisher(Clock, '/clock', 100)
    yield lambda now_ns: publisher.publish(Clock(clock=MESSAGES.time(now_ns)))
    ros.node.destroy_publisher(publisher)


def play(ros, robots, clock, deliveries):
    """Play a recording as `ros2 bag play --clock` does."""
    for delivery in deliveries:
        clock(delivery.arrival_ns)
        for robot in robots:
            robot.send(delivery.event)
        ros.spin_for(0.005)


def landmark_count(maps):
    return len(decode_point_cloud2(serialize_message(maps[-1])).ids) if maps else 0


def test_looped_recording_under_simulated_time(ros, clock, tmp_path):
    choices = ('reset', 'hold')
    poses = {c: ros.collect(PoseWithCovarianceStamped, f'/{c}/pose') for c in choices}
    maps = {c: ros.collect(PointCloud2, f'/{c}/landmark_map', LATCHED_QOS) for c in choices}
    with ExitStack() as stack:
        nodes = {}
        for choice in choices:
            parameters = {'use_sim_time': True, 'on_time_jump': choice}
            arguments = ('-r', f'__ns:=/{choice}')
            node = running('observer_node', tmp_path / choice, *arguments, **parameters)
            nodes[choice] = stack.enter_context(node)
        robots = [stack.enter_context(Robot(ros, namespace=f'/{choice}')) for choice in choices]
        assert not any(poses.values()), 'published before the clock began'
        deliveries = list(Simulation(RUN, SECOND).deliveries())
        play(ros, robots, clock, deliveries)
        ros.spin_until(lambda: all(landmark_count(m) == 4 for m in maps.values()), 'the maps')
        # To its very end: what is read after the clock has jumped comes twice.
        end_ns = max(delivery.arrival_ns for delivery in deliveries) - SECOND // 20
        ros.spin_until(
            lambda: all(m and stamp_ns(m[-1]) >= end_ns for m in poses.values()), 'the first run'
        )
        for choice in choices:
            ros.meet(f'/{choice}/observer_node')
        for messages in poses.values():
            messages.clear()
        clock(SECOND)
        for node in nodes.values():
            node.wait_for_output('The clock has jumped')
        beginning = [d for d in deliveries if d.arrival_ns < int(1.3 * SECOND)]
        play(ros, robots, clock, beginning)
        ros.spin_until(
            lambda: all(any(stamp_ns(p) < 1.3 * SECOND for p in m) for m in poses.values()),
            'the second run',
        )
        play(ros, robots, clock, deliveries[len(beginning) :])
        ros.spin_until(
            lambda: all(m and m[-1].pose.pose.position.x > 1.0 for m in poses.values()), 'its end'
        )
    for choice in choices:
        first = min(poses[choice], key=stamp_ns)
        output = nodes[choice].output
        assert output.count('The clock has jumped') == 1, 'seen in the clock and in the stamps'
        assert 'Dropped' not in output
        if choice == 'reset':
            assert first.pose.pose.position.x < 0.3
        else:
            assert landmark_count(maps[choice]) == 4
            assert 'pose and map are held' in output


@pytest.mark.parametrize('clock_late_s', [-0.03, 0.03])
def test_a_recording_that_is_looped_without_a_pause_is_reset_once_and_loses_nothing(
    ros, tmp_path, clock_late_s
):
    namespace = f'/seamless_{"late" if clock_late_s > 0.0 else "early"}'
    statuses = ros.collect(DiagnosticArray, '/diagnostics')
    own_clock = ros.node.create_publisher(Clock, f'{namespace}/clock', 100)
    arguments = ('-r', f'__ns:={namespace}', '-r', f'/clock:={namespace}/clock')
    parameters = {'use_sim_time': True, **reliable(namespace)}
    deliveries = list(Simulation(replace(RUN, duration=3.0), SECOND).deliveries())
    length_s, loops, sent = 3.0, 2, 0
    clocks = [(k * 0.025 + max(clock_late_s, 0.0), k * SECOND // 40) for k in range(120)]

    def values():
        found = [m.status[0] for m in statuses if m.status[0].hardware_id == namespace]
        return {v.key: v.value for status in found[-1:] for v in status.values}

    with (
        running('observer_node', tmp_path / 'log', *arguments, **parameters) as node,
        Robot(ros, namespace=namespace) as robot,
    ):
        ros.wait_for_subscriber(own_clock)
        own_clock.publish(Clock(clock=MESSAGES.time(SECOND)))
        ros.spin_for(0.2)
        early_s = max(-clock_late_s, 0.0)  # of the clock, before the last messages of a loop
        due = [
            (loop * length_s + at_s, sent_ns, None)
            for loop in range(loops)
            for at_s, sent_ns in clocks
        ] + [
            (loop * length_s + to_s(d.arrival_ns - SECOND) + early_s, 0, d.event)
            for loop in range(loops)
            for d in deliveries
        ]
        begin_s = time.monotonic()
        for due_s, sent_ns, event in sorted(due, key=lambda each: each[0]):
            ros.spin_for(begin_s + due_s - time.monotonic())
            if event is None:
                own_clock.publish(Clock(clock=MESSAGES.time(SECOND + sent_ns)))
            else:
                robot.send(event)
                sent += isinstance(event, VelocityEvent)
        ros.spin_until(lambda: int(values().get('used: velocity', 0)) >= sent - 10, 'velocities')
    assert node.output.count('The clock has jumped') == loops - 1
    assert 'ropped' not in node.output
    # What comes after /clock has jumped and is of the time before is of no use any more.
    dropped = {key for key in values() if key.startswith('dropped')}
    assert dropped <= ({'dropped: last_run'} if clock_late_s < 0.0 else set())


def test_what_seems_to_be_of_the_next_run_is_used_if_the_clock_has_just_been_late():
    change, use = ClockChange(), Mock()
    assert change.hold(use, SECOND, 5 * SECOND, usable_from_ns=4 * SECOND)
    for _ in range(MAX_LOOKS):
        assert change.take_overdue() == []
    assert change.take_overdue() == [use]
    assert not change.is_holding


def test_unstamped_velocity_waits_for_the_clock_to_begin(ros, clock, tmp_path):
    poses = ros.collect(PoseWithCovarianceStamped, '/early/pose')
    arguments = ('-r', '__ns:=/early', '-r', '/clock:=/early/clock')
    own_clock = ros.node.create_publisher(Clock, '/early/clock', 10)
    with (
        running('observer_node', tmp_path / 'log', *arguments, use_sim_time=True) as node,
        Robot(ros, twist_class=Twist, namespace='/early') as robot,
    ):
        for _ in range(3):
            robot.send(VelocityEvent(0, np.zeros(6)))
            ros.spin_for(0.05)
        node.wait_for_output(r'no_clock.*/clock has not begun')
        assert not poses
        for step in range(1, 6):
            own_clock.publish(Clock(clock=MESSAGES.time(step * SECOND // 10)))
            ros.spin_for(0.05)
            robot.send(VelocityEvent(0, np.zeros(6)))
            ros.spin_for(0.05)
        ros.spin_until(lambda: poses, 'a pose')
    assert 0 < stamp_ns(poses[0]) < SECOND


def test_a_clock_that_steps_back_a_little_has_not_jumped(ros, tmp_path):
    maps = ros.collect(PointCloud2, '/jittery/landmark_map', LATCHED_QOS)
    own_clock = ros.node.create_publisher(Clock, '/jittery/clock', 100)
    arguments = ('-r', '__ns:=/jittery', '-r', '/clock:=/jittery/clock')
    parameters = {'use_sim_time': True, 'confirmations': 1}
    with (
        running('observer_node', tmp_path / 'log', *arguments, **parameters) as node,
        Robot(ros, namespace='/jittery') as robot,
    ):
        ros.wait_for_subscriber(own_clock)

        def play_a_second(start_ns):
            for stamp in range(start_ns, start_ns + SECOND, SECOND // 20):
                own_clock.publish(Clock(clock=MESSAGES.time(stamp)))
                own_clock.publish(Clock(clock=MESSAGES.time(stamp - 1_000_000)))
                robot.send(VelocityEvent(stamp, np.zeros(6)))
                robot.send(ObservationEvent(stamp, np.array([1]), np.ones((1, 3))))
                ros.spin_for(0.01)

        play_a_second(100 * SECOND)
        play_a_second(101 * SECOND)
        ros.spin_until(lambda: landmark_count(maps), 'the map')
        ros.meet('/jittery/observer_node')  # where the clock was shows in which way it has jumped
        assert 'The clock has jumped' not in node.output
        own_clock.publish(Clock(clock=MESSAGES.time(101 * SECOND + SECOND // 2)))
        node.wait_for_output('The clock has jumped')


def test_stamps_from_another_clock_are_reported_and_corrected_if_asked(ros, tmp_path):
    poses = {
        name: ros.collect(PoseWithCovarianceStamped, f'/{name}/pose')
        for name in ('reported', 'corrected')
    }
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    offset_ns = 100 * SECOND
    with (
        running('observer_node', tmp_path / '1', '-r', '__ns:=/reported') as reported,
        running('observer_node', tmp_path / '2', '-r', '__ns:=/corrected',
                correct_clock_offset=True) as corrected,
        Robot(ros, namespace='/reported') as left,
        Robot(ros, namespace='/corrected') as right,
    ):  # fmt: skip
        for _ in range(40):
            for robot in (left, right):
                robot.send(VelocityEvent(time.time_ns() - offset_ns, np.zeros(6)))
            ros.spin_for(0.03)
        for name, node in (('reported', reported), ('corrected', corrected)):
            said = f"stamps on '/{name}/twist' are"
            node.wait_for_output(rf"{said} 100\.\d+ s behind this machine's clock")
            assert node.output.count(said) == 1, 'not throttled'
        ros.spin_until(
            lambda: any("stamps on '/reported/twist'" in m.status[0].message for m in diagnostics),
            'the warning',
        )
        lag_ns = {name: time.time_ns() - stamp_ns(poses[name][-1]) for name in poses}
    assert abs(lag_ns['reported'] - offset_ns) < 30 * SECOND
    assert abs(lag_ns['corrected']) < 30 * SECOND


class AnotherClock:
    """A robot whose clock, and /tf's, is behind; it stands and sees one landmark."""

    def __init__(self, behind_ns, **parameters):
        self.behind_ns = behind_ns
        self.transforms = TransformBuffer()
        settings = ObserverNodeSettings(**parameters)
        self.node = Mock()
        self.node.resolve_topic_name = lambda name: f'/{name.lstrip("/")}'
        self.estimator = Estimator(Settings(reorder_window=0.0))
        base_frame = BaseFrame(settings, self.transforms)
        self.feed = EstimatorFeed(
            self.node, settings, self.estimator, base_frame, Mock(), Mock(), Mock()
        )
        self.feed.is_active = True

    def send(self, received_ns):
        stamp_ns = received_ns - self.behind_ns
        angle = to_s(received_ns)
        for child, pose in (('turret', se3.exp(angle * TURN)), ('tag_9', np.eye(4))):
            parent = 'base_link' if child == 'turret' else 'turret'
            self.transforms.insert(parent, child, stamp_ns, pose)
        self.feed.add('twist', VelocityEvent(stamp_ns, STILL), received_ns)
        seen = se3.transform(se3.exp(-angle * TURN), np.array([[3.0, 1.0, 0.0]]))
        event = ObservationEvent(stamp_ns, np.array([4]), seen, sensor_frame='turret')
        self.feed.add_observation(event, received_ns)
        tags = replace(
            event, ids=np.array([9]), points=np.full((1, 3), np.nan), families=('none',)
        )
        self.feed.add('landmarks', tags, received_ns + 1)

    def send_all(self):
        for step in range(40):
            self.send(1000 * SECOND + step * SECOND // 20)
        return 1000 * SECOND + step * SECOND // 20


STILL = np.zeros(6)
TURN = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize('behind_ns', [0, 100 * SECOND, -100 * SECOND])
def test_what_places_a_sensor_has_the_stamps_of_the_same_clock(behind_ns):
    robot = AnotherClock(behind_ns, correct_clock_offset=True)
    last_ns = robot.send_all()
    assert robot.feed.dropped['no_transform'] == 0
    assert robot.estimator.dropped.total() == 0
    assert robot.estimator.stamp_ns == last_ns
    seen = dict(zip(robot.estimator.landmark_ids, robot.estimator.world_points, strict=True))
    assert_allclose(seen[4], [3.0, 1.0, 0.0], atol=1e-6)
    assert_allclose(seen[9], [0.0, 0.0, 0.0], atol=1e-6)


def test_nothing_is_recommended_that_is_done_already():
    robot = AnotherClock(100 * SECOND, correct_clock_offset=True)
    robot.send_all()
    logged = [call.args[0] for call in robot.node.get_logger().info.call_args_list]
    assert logged == [
        f"stamps on '/{name}' are 100.000 s behind this machine's clock, and corrected from now on"
        for name in ('landmarks', 'twist')
    ]
    warned = [call.args[0] for call in robot.node.get_logger().warning.call_args_list]
    assert not any('correct_clock_offset' in text for text in warned)
    assert robot.feed.clock_problems() == []
    uncorrected = AnotherClock(100 * SECOND)
    uncorrected.send_all()
    assert len(uncorrected.feed.clock_problems()) == 2


def test_fiducials_have_the_clock_of_tf():
    robot = AnotherClock(100 * SECOND, landmarks_type='tf')
    robot.send_all()
    assert [text.partition(' are ')[0] for text in robot.feed.clock_problems()] == [
        "stamps on '/twist'",
        "stamps on '/tf'",
    ]


def test_of_several_cameras_the_one_whose_clock_is_ahead_is_named():
    robot = AnotherClock(0)
    robot.node.get_clock.return_value.ros_time_is_active = False
    for step in range(40):
        received_ns = 1000 * SECOND + step * SECOND // 20
        robot.send(received_ns)
        stamp_ns, points = received_ns + 2 * SECOND // 5, np.ones((1, 3))
        event = ObservationEvent(stamp_ns, np.array([5]), points, sensor_frame='base_link')
        robot.feed.add_observation(event, received_ns)
    said = "stamps on '/landmarks' in frame 'base_link' are 0.400 s ahead of this machine's clock"
    (problem,) = robot.feed.clock_problems()
    assert problem.startswith(said)
    warned = [call.args[0] for call in robot.node.get_logger().warning.call_args_list]
    assert sum("frame 'base_link' was 0.400 s ahead of" in text for text in warned) == 1


def test_one_stamp_of_the_future_is_named_while_it_is_recent():
    robot = AnotherClock(0)
    robot.node.get_clock.return_value.ros_time_is_active = False
    last_ns = robot.send_all()
    assert robot.feed.clock_problems() == []
    event = VelocityEvent(last_ns + SECOND, STILL)
    robot.feed.add('twist', event, last_ns + SECOND // 10)
    (problem,) = robot.feed.clock_problems()
    assert problem.startswith("a stamp on '/twist' was 0.900 s ahead of this machine's clock")
    for step in range(20):
        robot.send(last_ns + 2 * SECOND + step * SECOND // 20)
    assert robot.feed.clock_problems() == []


def test_until_the_offset_of_its_clock_is_known_what_an_input_says_is_dropped_and_counted():
    robot = AnotherClock(100 * SECOND, correct_clock_offset=True)
    robot.send_all()
    # Ten of the twist, and ten of the landmarks, to which the fiducials belong.
    assert robot.feed.dropped == {'clock_unknown': 20}
    plain = AnotherClock(0)
    plain.send_all()
    assert not plain.feed.dropped


def test_that_a_clock_was_put_right_is_reported_and_its_stamps_are_then_taken_as_they_are():
    robot = AnotherClock(100 * SECOND, correct_clock_offset=True)
    last_ns = robot.send_all()
    robot.node.get_logger().info.reset_mock()
    robot.behind_ns = 0
    for step in range(1, 21):
        robot.send(last_ns + step * SECOND // 20)
    logged = [call.args[0] for call in robot.node.get_logger().info.call_args_list]
    assert len(logged) == 2
    assert all(text.endswith('and not corrected any more') for text in logged)
    assert all(robot.feed.clocks[name].correction_ns == 0 for name in ('twist', 'landmarks'))


def test_a_stamp_that_was_left_out_is_the_time_of_reception(ros, tmp_path):
    poses = ros.collect(PoseWithCovarianceStamped, '/bare/pose')
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/bare'),
        Robot(ros, namespace='/bare') as robot,
    ):
        for _ in range(5):
            message = TwistStamped()
            assert message.header.stamp == Time()
            robot.twist.publish(message)
            ros.spin_for(0.06)
        ros.spin_until(lambda: poses, 'a pose')
    assert abs(time.time_ns() - stamp_ns(poses[-1])) < 60 * SECOND


def test_late_and_shuffled_messages_lead_to_the_same_state(ros, tmp_path):
    scenario = Scenario(velocity_rate=40.0, observation_rate=20.0, duration=1.0, point_noise=0.05)
    start_ns = time.time_ns()
    events = [
        delivery.event
        for delivery in Simulation(scenario, start_ns).deliveries()
        if isinstance(delivery.event, VelocityEvent | ObservationEvent)
    ]
    lateness = np.random.default_rng(1).integers(0, SECOND // 5, len(events))
    arrivals_ns = np.array([event.stamp_ns for event in events]) + lateness
    shuffled = [events[index] for index in np.argsort(arrivals_ns, kind='stable')]
    orders = {'/ordered': events, '/shuffled': shuffled}
    end_ns = max(event.stamp_ns for event in events)
    # A wide window, since a busy machine may deliver one topic well before the other.
    parameters = {'reorder_window': 1.0}
    with ExitStack() as stack:
        maps, robots = {}, {}
        for name in orders:
            maps[name] = ros.collect(PointCloud2, f'{name}/landmark_map', LATCHED_QOS)
            arguments = ('-r', f'__ns:={name}')
            log = tmp_path / name.strip('/')
            stack.enter_context(
                running('observer_node', log, *arguments, **parameters, **reliable(name))
            )
        for name in orders:
            robots[name] = stack.enter_context(Robot(ros, namespace=name))
        for pair in zip(*orders.values(), strict=True):
            for robot, event in zip(robots.values(), pair, strict=True):
                robot.send(event)
            ros.spin_for(0.004)
        for name, robot in robots.items():
            ros.meet(f'{name}/observer_node')  # which has all that was sent before the last
            robot.send(VelocityEvent(start_ns + 3 * SECOND, np.zeros(6)))
        ros.spin_until(
            lambda: all(m and stamp_ns(m[-1]) == end_ns for m in maps.values()), 'the end'
        )
    outcome = {
        name.strip('/'): decode_point_cloud2(serialize_message(messages[-1]))
        for name, messages in maps.items()
    }
    assert_array_equal(outcome['ordered'].ids, outcome['shuffled'].ids)
    assert_array_equal(outcome['ordered'].points, outcome['shuffled'].points)
    assert_array_equal(outcome['ordered'].covariances, outcome['shuffled'].covariances)


@pytest.mark.parametrize('choice', ['reset', 'hold'])
def test_looped_recording_without_simulated_time_begins_path_and_tf_again(ros, tmp_path, choice):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    namespace = f'/looped_{choice}'
    paths = ros.collect(Path, f'{namespace}/path')
    transforms = ros.collect(TFMessage, f'{namespace}/tf')
    sender = TransformSender(ros, namespace)
    arguments = own_topics(namespace)
    with (
        running('observer_node', tmp_path / 'log', *arguments, on_time_jump=choice) as node,
        Robot(ros, namespace=namespace) as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)

        def send(stamp):
            sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=stamp)
            robot.send(VelocityEvent(stamp, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])))
            ros.spin_for(0.01)

        for stamp in range(100 * SECOND, 102 * SECOND, SECOND // 20):
            send(stamp)
        # Held up on its way, the beginning may seem to be of the first run, late.
        again = itertools.count(50 * SECOND, SECOND // 20)
        ros.spin_until(
            lambda: (paths and stamp_ns(paths[-1]) < 100 * SECOND) or send(next(again)),
            'the second run',
        )
        ros.spin_until(
            lambda: (
                any(stamp_ns(t) < 100 * SECOND for t in corrections(transforms))
                or send(next(again))
            ),
            'its /tf',
        )
    stamps = [stamp_ns(pose) for pose in paths[-1].poses]
    assert max(stamps) < 100 * SECOND, 'the path still has poses of the first run'
    assert node.output.count('The clock has jumped') == 1


def corrections(transforms):
    return [t for m in transforms for t in m.transforms if t.header.frame_id == 'map']


@pytest.mark.parametrize(
    ('behind_ns', 'is_said'), [(3 * SECOND // 2, True), (-100 * SECOND, False)]
)
def test_stamps_that_are_behind_may_be_late_those_ahead_not(behind_ns, is_said):
    robot = AnotherClock(behind_ns)
    robot.send_all()
    problems = robot.feed.clock_problems()
    assert len(problems) == 2
    assert all(('or what publishes them is that late' in text) == is_said for text in problems)
