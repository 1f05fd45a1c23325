"""Services, topics and diagnostics by which the observer is steered and watched."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
import os
from pathlib import Path
import re
import time
from types import SimpleNamespace
from unittest.mock import Mock

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from node_processes import running
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from robots import own_topics, pose_of, reliable, Robot, stamp_ns, TransformSender
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Int64
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from slam_observer_ros.common.findings import found
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.nodes import diagnostics as node_diagnostics
from slam_observer_ros.nodes.diagnostics import DiagnosticsPublisher
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES, TFMessage
from slam_observer_ros.runs.health import MANY_UNUSED, of_calibration
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.simulation import Scenario

pytestmark = pytest.mark.ros

RUN = Scenario(velocity_rate=40.0, observation_rate=20.0, duration=0.6)
SECOND = 1_000_000_000


class Diagnostics:
    """The latest status of a node."""

    def __init__(self, ros, namespace):
        self.ros = ros
        self.namespace = namespace
        self.messages = ros.collect(DiagnosticArray, '/diagnostics')

    @property
    def all(self):
        return [m.status[0] for m in self.messages if m.status[0].hardware_id == self.namespace]

    @property
    def status(self):
        return self.all[-1] if self.all else DiagnosticStatus()

    @property
    def values(self):
        return values_of(self.status)

    def wait(self, condition, what):
        self.ros.spin_until(lambda: condition(self), what)


def values_of(status):
    return {value.key: value.value for value in status.values}


def ids(maps):
    return sorted(decode_point_cloud2(serialize_message(maps[-1])).ids) if maps else []


def test_paused_observer_holds_its_pose_and_counts_what_it_drops(ros, tmp_path):
    poses = ros.collect(PoseWithCovarianceStamped, '/paused/pose')
    diagnostics = Diagnostics(ros, '/paused')
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/paused', **reliable('/paused')),
        Robot(ros, namespace='/paused') as robot,
    ):
        last_ns = max(event.stamp_ns for event in robot.run(RUN))
        ros.spin_until(lambda: poses and stamp_ns(poses[-1]) > last_ns - SECOND // 5, 'its end')
        assert ros.call(Trigger, '/paused/observer_node/pause', Trigger.Request()).success
        paused_ns = time.time_ns()
        sent = len(robot.run(RUN))
        diagnostics.wait(lambda d: int(d.values.get('dropped: paused', 0)) >= sent, 'the count')
        assert diagnostics.status.level == DiagnosticStatus.WARN
        assert 'paused' in diagnostics.status.message
        held = poses[-1]
        assert stamp_ns(held) < paused_ns
        ros.call(Trigger, '/paused/observer_node/resume', Trigger.Request())
        robot.send_zeros()
        ros.spin_until(lambda: stamp_ns(poses[-1]) > paused_ns, 'a pose')
    # The velocity from before the pause is held for velocity_timeout at most.
    assert poses[-1].pose.pose.position.x < held.pose.pose.position.x + 1.1


def test_a_pause_longer_than_stamps_may_jump_erases_nothing(ros, tmp_path):
    maps = ros.collect(PointCloud2, '/breaking/landmark_map', LATCHED_QOS)
    with (
        running(
            'observer_node', tmp_path / 'log', '-r', '__ns:=/breaking', max_stamp_jump=0.5
        ) as node,
        Robot(ros, namespace='/breaking') as robot,
    ):
        robot.run(RUN)
        ros.spin_until(lambda: ids(maps) == [0, 1, 2, 3], 'four landmarks')
        ros.call(Trigger, '/breaking/observer_node/pause', Trigger.Request())
        ros.spin_for(1.5)
        ros.call(Trigger, '/breaking/observer_node/resume', Trigger.Request())
        resumed_ns = time.time_ns()
        robot.send_zeros()
        ros.spin_until(lambda: stamp_ns(maps[-1]) > resumed_ns, 'the map after the pause')
        assert ids(maps) == [0, 1, 2, 3]
        assert 'The clock has jumped' not in node.output


def test_correction_of_the_odometry_holds_while_paused(ros, tmp_path):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    transforms = ros.collect(TFMessage, '/parked/tf')
    sender = TransformSender(ros, '/parked')
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/parked')),
        Robot(ros, namespace='/parked') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)

        def corrections():
            sent = [t for m in transforms for t in m.transforms]
            return [t for t in sent if t.header.frame_id == 'map']

        start_ns = time.time_ns()
        for step in range(20):
            stamp = start_ns + step * SECOND // 20
            sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=stamp)
            robot.send(VelocityEvent(stamp, np.array([0.0, 0, 0, 1.0, 0, 0])))
            ros.spin_for(0.05)
        ros.spin_until(corrections, 'a correction')
        ros.call(Trigger, '/parked/observer_node/pause', Trigger.Request())
        # They are post-dated: soon after the pause one from before it may be the last.
        paused_ns = time.time_ns() + SECOND // 2
        ros.spin_until(lambda: stamp_ns(corrections()[-1]) > paused_ns, 'one while paused')
        before = corrections()[-1]
        ros.spin_until(lambda: stamp_ns(corrections()[-1]) > stamp_ns(before), 'another one')
        after = corrections()[-1]
    np.testing.assert_array_equal(pose_of(after.transform), pose_of(before.transform))
    stamps = [stamp_ns(t) for t in corrections()]
    assert len(set(stamps)) == len(stamps)


def test_odometry_that_ends_on_tf_is_reported_by_log_and_diagnostics(ros, tmp_path):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    diagnostics = Diagnostics(ros, '/stranded')
    sender = TransformSender(ros, '/stranded')
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/stranded')) as node,
        Robot(ros, namespace='/stranded') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)
        sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=time.time_ns())
        warning = "'odom' to 'base_link' on /tf is .* s behind the estimate"
        diagnostics.wait(
            lambda d: robot.send_zeros() or re.search(warning, d.status.message), 'the warning'
        )
        assert diagnostics.status.level == DiagnosticStatus.WARN
        node.wait_for_output(warning)


def test_landmarks_are_forgotten_and_seen_again_on_request(ros, tmp_path):
    maps = ros.collect(PointCloud2, '/forgetful/landmark_map', LATCHED_QOS)
    forget = ros.node.create_publisher(Int64, '/forgetful/observer_node/forget_landmark', 10)
    arguments = ('-r', '__ns:=/forgetful')
    with (
        running('observer_node', tmp_path / 'log', *arguments, confirmations=1) as node,
        Robot(ros, namespace='/forgetful') as robot,
    ):
        robot.run(RUN)
        ros.spin_until(lambda: ids(maps) == [0, 1, 2, 3], 'four landmarks')
        ros.wait_for_subscriber(forget)
        forget.publish(Int64(data=2))
        forget.publish(Int64(data=77))
        node.wait_for_output('landmark 2 is forgotten')
        node.wait_for_output('landmark 77 is not known')
        robot.send_zeros()
        ros.spin_until(lambda: ids(maps) == [0, 1, 3], 'three landmarks')
        robot.send(ObservationEvent(time.time_ns(), np.array([2]), np.ones((1, 3))))
        robot.send_zeros()
        ros.spin_until(lambda: ids(maps) == [0, 1, 2, 3], 'it again')


def test_forgotten_landmarks_stay_neither_in_the_latched_map_nor_drawn(ros, tmp_path):
    maps = ros.collect(PointCloud2, '/retracted/landmark_map', LATCHED_QOS)
    markers = ros.collect(MarkerArray, '/retracted/markers')
    forget = ros.node.create_publisher(Int64, '/retracted/observer_node/forget_landmark', 10)

    def call(name):
        assert ros.call(Trigger, f'/retracted/observer_node/{name}', Trigger.Request()).success

    parameters = {'confirmations': 1, 'map_path': tmp_path / 'map.yaml'}
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/retracted', **parameters),
        Robot(ros, namespace='/retracted') as robot,
    ):
        robot.run(RUN)
        ros.spin_until(lambda: ids(maps) == [0, 1, 2, 3] and markers, 'four landmarks')
        call('save_map')
        call('pause')
        ros.wait_for_subscriber(forget)
        forget.publish(Int64(data=2))
        ros.spin_until(lambda: ids(maps) == [0, 1, 3], 'three landmarks')
        for service in ('reset', 'load_map'):
            call(service)
            ros.spin_until(lambda: not ids(maps), 'an empty map')
            ros.spin_until(lambda: len(markers[-1].markers) == 1, 'no markers')
            assert markers[-1].markers[0].action == Marker.DELETEALL
            call('resume')
            robot.send_zeros()
            robot.send(ObservationEvent(time.time_ns(), np.array([7]), np.ones((1, 3))))
            robot.send_zeros()
            if service == 'reset':
                ros.spin_until(lambda: ids(maps) == [7], 'a new landmark')
        assert not ids(maps), 'published before the pose in the loaded map is known'


DELAYED = ('-p', 'velocity_delay_stddev:=0.1')


def test_diagnostics_report_rates_ages_drops_and_times(ros, tmp_path):
    diagnostics = Diagnostics(ros, '/watched')
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/watched', *DELAYED),
        Robot(ros, namespace='/watched') as robot,
    ):
        robot.run(Scenario(velocity_rate=40.0, observation_rate=20.0, duration=3.0))

        def of_a_robot_under_way():
            """Not the latest status: a busy machine may report the run when it is over."""
            reported = [values_of(status) for status in diagnostics.all]
            return [v for v in reported if v['landmarks known'] == '4' and is_moving(v)]

        diagnostics.wait(lambda _: of_a_robot_under_way() or robot.send_zeros(), 'the rates')
        values = of_a_robot_under_way()[-1]
        assert float(values['/watched/twist age [s]']) < 30.0
        assert values['known landmarks seen last'] == '4'
        assert float(values['landmarks seen, age [s]']) < 30.0
        assert float(values['processing time, mean [ms]']) > 0.0
        assert int(values['used: observation']) > 5
        assert values['calibration: velocity_delay'].endswith(' s')
        assert values['calibration: angular_bias_z'].endswith(' °/s')
        now_ns = time.time_ns()
        twins = np.array([7, 7]), np.ones((2, 3))
        diagnostics.wait(
            lambda d: (
                robot.send(ObservationEvent(time.time_ns(), *twins))
                or re.search('of [0-9]+ points seen [0-9]+ of a repeated id', d.status.message)
            ),
            'a warning of points with one id',
        )
        bad = VelocityEvent(now_ns, np.full(6, np.nan))
        diagnostics.wait(
            lambda d: robot.send(bad) or d.status.level == DiagnosticStatus.ERROR,
            'an error while nothing can be used',
        )
        assert int(diagnostics.values['dropped: not_finite']) > 0


def is_moving(values):
    return (
        float(values['/watched/twist rate [Hz]']) > 5.0
        and float(values['/watched/landmarks rate [Hz]']) > 2.0
    )


NO_PLACE = found('no_place', where='the map')


class Publishing:
    """The status that diagnostics publish of an estimator's counts."""

    def __init__(self, *inputs, **estimate):
        self.node = Mock(last_failure='')
        self.node.get_name.return_value = 'observer_node'
        self.node.get_namespace.return_value = '/robot'
        self.node.get_clock.return_value.now.return_value.to_msg.return_value = Time()
        self.dropped = Counter()
        self.estimator = SimpleNamespace(
            counts=Counter(), dropped=self.dropped, last_update=None,
            landmark_ids=np.array([], dtype=np.int64),
            calibration=[], motion_factors=[], undisturbed=([], []), lyapunov=0.0, stamp_ns=None,
            has_rare_velocities=False, velocity_period_s=0.05, distrust_odometry=Mock(),
            anchor_biases={}, open_sides=[],
            velocity_is_stale=False, is_localised=True, ambiguity=None, waiting_landmarks=0,
            settings=Settings(),
            localisation_problem=NO_PLACE, possible_poses=np.empty((0, 4, 4)),
            ids_at_two_places=[],
        )  # fmt: skip
        vars(self.estimator).update(estimate)
        self.feed = SimpleNamespace(
            dropped=Counter(), unstamped=Counter(), is_paused=False, clock_problems=list,
            take_mean_processing_ms=lambda: 0.0,
        )  # fmt: skip
        self.estimate_publisher = SimpleNamespace(
            problem='', rivals=str, early_odometry=str, odometry_age_s=None
        )
        self.localisation = SimpleNamespace(status=lambda *_: DiagnosticStatus(), findings=[])
        self.watch = Mock(findings=[])
        parts = (
            self.estimator, self.feed, inputs, self.estimate_publisher, self.localisation,
            self.watch,
        )  # fmt: skip
        self.diagnostics = DiagnosticsPublisher(self.node, *parts, hardware_id='base_link')

    def publish(self, **new):
        # A new one, as the real one gives.
        self.estimator.counts = self.estimator.counts + Counter(new)
        self.diagnostics.publish()
        return self.node.create_publisher().publish.call_args.args[0].status[0]


def test_an_id_that_is_there_twice_is_reported_with_what_to_do():
    figures = dict.fromkeys(('x', 'y', 'z', 'other_x', 'other_y', 'other_z'), 1.0)
    finding = found('id_at_two_places', id=7, **figures)
    status = Publishing(ids_at_two_places=[finding]).publish(velocity=1)
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith('landmark 7 is seen now at')
    assert finding.remedy in values_of(status).values()


def test_two_publishers_are_named_and_nothing_that_they_cause():
    rivals = found('several_publishers', count=2, names='/wheels, /truth', topic='/odom')
    odom = SimpleNamespace(
        topic='/odom', name='twist', received=30, malformed=0, problem='', doubt=rivals, age_s=0.1,
        silent_s=0.0, last_malformed=None, backlog=SimpleNamespace(wait_s=0.0),
        shedding=SimpleNamespace(shed=0),
    )  # fmt: skip
    late = CalibrationEstimate('velocity_delay', 0.5, 0.01, 's', stated=0.2)
    publishing = Publishing(odom, undisturbed=([late], []))
    publishing.localisation.findings = [found('small_noise', factor=3.0)]
    status = publishing.publish(velocity=10, slip=1)
    assert status.message == "2 publishers (/wheels, /truth) publish on '/odom'"
    to_do = [each.value for each in status.values if each.key.startswith('to do')]
    assert to_do == ['remap all but one']
    publishing.estimator.distrust_odometry.assert_called_with()
    # No mistake of the set-up is searched for, and the noise is said to fit neither.
    assert publishing.watch.look.call_args.kwargs == {'has_slipped': False}
    assert publishing.watch.look.call_args.args == ([],)
    odom.doubt = None
    assert 'takes effect 0.50 s late' in publishing.publish(velocity=10, slip=1).message
    assert publishing.watch.look.call_args.kwargs == {'has_slipped': True}


@pytest.mark.parametrize(
    ('points', 'rejected', 'warns'), [(20, 3, True), (20, 2, False), (8, 4, False)]
)
def test_more_rejected_points_than_outliers_are_reported_once_there_are_enough(
    points, rejected, warns
):
    publishing = Publishing()
    for _ in range(5):  # MIN_POINTS are 50
        status = publishing.publish(
            observation=1, observed_point=points, rejected_landmark=rejected
        )
    text = f'{100 * rejected / points:.0f} % of the points seen lately were rejected'
    assert (text in status.message) == warns
    assert status.level == (DiagnosticStatus.WARN if warns else DiagnosticStatus.OK)


@pytest.mark.parametrize(('rejected', 'warns'), [(11, True), (10, False)])
def test_more_rejected_orientations_than_flips_are_reported(rejected, warns):
    publishing = Publishing()
    for _ in range(5):
        status = publishing.publish(
            observation=1, observed_point=20, rejected_orientation=rejected
        )
    text = 'the orientations of 55 % of the tags seen lately were rejected'
    assert status.message.startswith(text if warns else 'running')


def test_a_detector_that_finds_nothing_is_reported_and_logged_once():
    publishing = Publishing()
    assert publishing.publish(observation=199).message == 'running'
    for _ in range(3):
        status = publishing.publish(observation=10)
    assert status.message == 'no landmark in 229 messages so far'
    assert values_of(status)['landmarks seen, age [s]'] == 'never'
    publishing.node.get_logger().warning.assert_called_once()
    status = publishing.publish(observation=1, observed_point=1)
    assert status.message == 'running'
    assert values_of(status)['landmarks seen, age [s]'] == '0'


def test_a_calibration_that_nobody_can_mean_is_reported():
    wrong = CalibrationEstimate('angular_scale_z', -0.5, 0.01, '', nominal=1.0, stated=0.03)
    status = Publishing(undisturbed=([wrong], [])).publish(observation=1)
    assert status.level == DiagnosticStatus.WARN
    (finding,) = of_calibration([wrong])
    assert (status.message, values_of(status)[f'to do: {finding.what}']) == (
        finding.what,
        finding.remedy,
    )


def test_points_rejected_long_ago_are_reported_no_more():
    publishing = Publishing()
    for _ in range(5):
        assert publishing.publish(observation=1, observed_point=20, rejected_landmark=20)
    for _ in range(20):
        status = publishing.publish(observation=1, observed_point=20)
    assert status.message == '20 % of the points seen lately were rejected'
    for _ in range(10):
        status = publishing.publish(observation=1, observed_point=20)
    assert status.message == 'running'


@pytest.mark.parametrize('reason', ['repeated_id', 'reserved_id'])
def test_of_points_left_out_for_their_ids_a_single_one_is_reported(reason):
    status = Publishing().publish(observation=1, observed_point=100, **{reason: 1})
    assert status.message.startswith('of 100 points seen 1 ')
    assert status.level == DiagnosticStatus.WARN


NO_POSE = 'the pose in the loaded map is not known yet: no pose is published'


@pytest.mark.parametrize(
    ('estimate', 'message'),
    [
        ({'velocity_is_stale': True}, 'running'),  # there was no event yet
        ({'velocity_is_stale': True, 'stamp_ns': 1}, 'no velocity in force: the pose is held'),
        ({'is_localised': False}, NO_POSE),
        ({'is_localised': False, 'landmark_ids': [7]}, NO_POSE),
        (
            {'is_localised': False, 'landmark_ids': [FIRST_AUTOMATIC_ID]},
            f'{NO_POSE}; {NO_PLACE.what}',
        ),
    ],
)
def test_what_is_amiss_with_the_estimate_is_reported_and_nothing_else(estimate, message):
    landmark_ids = np.array(estimate.get('landmark_ids', []), dtype=np.int64)
    publishing = Publishing(**{**estimate, 'landmark_ids': landmark_ids})
    assert publishing.publish().message == message


def test_what_is_dropped_in_a_pause_is_no_error():
    publishing = Publishing()
    publishing.feed.is_paused = True
    publishing.feed.dropped['paused'] += 3
    status = publishing.publish()
    assert (status.level, status.message) == (DiagnosticStatus.WARN, 'paused')


def test_the_worst_is_named_first_three_at_most_and_all_are_in_the_values():
    inputs = [
        Mock(
            topic=f'/{name}', received=count, malformed=0, age_s=3.0, problem='', doubt=None,
            silent_s=silent_s, shedding=Mock(shed=0), backlog=Mock(wait_s=0.0),
        )
        for name, count, silent_s in (('landmarks', 30, 3.0), ('imu', 0, 3.0), ('twist', 99, 0.0))
    ]  # fmt: skip
    for each in inputs:
        each.name = each.topic.removeprefix('/')
    publishing = Publishing(*inputs, velocity_is_stale=True, stamp_ns=1)
    publishing.feed.dropped['no_transform'] += 5
    publishing.estimate_publisher.problem = 'no odometry'
    status = publishing.publish(velocity=1)
    problems = [value for key, value in values_of(status).items() if key.startswith('problem ')]
    assert status.level == DiagnosticStatus.ERROR
    assert problems[:2] == ["none of 30 messages on '/landmarks' was used", 'no odometry']
    assert len(problems) == 6
    assert status.message == '; '.join([*problems[:3], 'and 3 more'])


def test_what_cannot_be_published_is_reported():
    publishing = Publishing()
    publishing.estimate_publisher.problem = 'no odometry'
    assert publishing.publish().message == 'no odometry'


def test_an_input_is_judged_by_what_came_since_the_last_time(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr(node_diagnostics.time, 'monotonic', lambda: now_s[0])
    source = SimpleNamespace(
        name='twist', topic='/twist', received=0, age_s=None, silent_s=0.0, malformed=0,
        problem='', doubt=None,
        backlog=SimpleNamespace(wait_s=0.0), shedding=SimpleNamespace(shed=0),
        last_malformed=found('malformed_message', topic="'/twist'", error='too short'),
    )  # fmt: skip
    publishing, messages, rates = Publishing(source), [], []
    for received, malformed, age_s in [(0, 0, None), (40, 2, 0.1), (60, 2, 0.1), (60, 2, 3.0)]:
        source.received, source.malformed, source.age_s = received, malformed, age_s
        source.silent_s = age_s or 0.0
        now_s[0] += 2.0
        status = publishing.publish(velocity=1)
        assert status.level != DiagnosticStatus.ERROR
        messages.append(status.message)
        rates.append(values_of(status)['/twist rate [Hz]'])
    dropped = "2 messages dropped (malformed); malformed message on '/twist': too short"
    assert messages == ['running', dropped, 'running', "no message on '/twist'"]
    assert rates == ['0.0', '20.0', '10.0', '0.0']
    now_s[0] += 2.0
    source.problem = 'another type'
    assert publishing.publish(velocity=1).message == 'another type'


def test_an_input_of_which_nothing_was_ever_used_is_an_error():
    """As landmarks in a frame that /tf does not have, beside good odometry."""
    source = SimpleNamespace(
        name='landmarks', topic='/tags', received=MANY_UNUSED, age_s=0.1, malformed=0, problem='',
        doubt=None, silent_s=0.1,
        backlog=SimpleNamespace(wait_s=0.0), shedding=SimpleNamespace(shed=0),
        last_malformed=found('malformed_message', topic="'/twist'", error='too short'),
    )  # fmt: skip
    publishing = Publishing(source)
    assert publishing.publish(velocity=5).message == 'running', 'they may have come during a pause'
    publishing.dropped['no_transform'] += 1
    status = publishing.publish(velocity=5)
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == (
        f"none of {MANY_UNUSED} messages on '/tags' was used; 1 message dropped (no_transform)"
    )
    status = publishing.publish(velocity=5, observation=1)
    assert (status.level, status.message) == (DiagnosticStatus.OK, 'running')


def test_messages_that_are_all_dropped_are_an_error_and_some_a_warning():
    publishing = Publishing()
    publishing.publish()
    publishing.dropped['not_finite'] += 3
    assert publishing.publish().level == DiagnosticStatus.ERROR
    publishing.dropped['not_finite'] += 1
    status = publishing.publish(velocity=5)
    assert (status.level, status.message) == (
        DiagnosticStatus.WARN,
        '1 message dropped (not_finite)',
    )
    publishing.dropped.update({'not_finite': 2, 'too_late': 1})
    assert publishing.publish(velocity=5).message == '3 messages dropped (mostly not_finite)'
    assert publishing.publish(velocity=5).level == DiagnosticStatus.OK


SENT = {
    '/idle': (),
    '/blind': ('twist',),
    '/numb': ('landmarks',),
}


def test_what_is_missing_is_said_once_with_topic_and_type(ros, tmp_path):
    with ExitStack() as stack:
        nodes, robots = {}, {}
        for namespace in SENT:
            log = tmp_path / namespace.strip('/')
            node = running('observer_node', log, '-r', f'__ns:={namespace}')
            nodes[namespace] = stack.enter_context(node)
            robots[namespace] = OneSidedRobot(ros, namespace, SENT[namespace])
        ros.spin_until(
            lambda: all(
                robots[namespace].send() or is_reported(node, namespace)
                for namespace, node in nodes.items()
            ),
            'all to be reported',
        )
        start_s = time.monotonic()
        busy_s = {namespace: cpu_seconds(node) for namespace, node in nodes.items()}
        ros.spin_for(2.0)
        for namespace, node in nodes.items():
            share = (cpu_seconds(node) - busy_s[namespace]) / (time.monotonic() - start_s)
            assert share < 0.5, 'it burns CPU'
            said = re.findall('nothing publishes on', node.output)
            assert len(said) == 2 - len(SENT[namespace])


WANTED = {'twist': 'TwistStamped', 'landmarks': 'PointCloud2'}


def is_reported(node, namespace):
    return all(
        re.search(
            rf"nothing publishes on '{namespace}/{topic}' \({wanted}, .*is needed\)", node.output
        )
        for topic, wanted in WANTED.items()
        if topic not in SENT[namespace]
    )


class OneSidedRobot:
    """A robot of whose topics some have no publisher."""

    def __init__(self, ros, namespace, topics):
        self.ros = ros
        self.publishers = [
            ros.node.create_publisher(
                TwistStamped if topic == 'twist' else PointCloud2, f'{namespace}/{topic}', 10
            )
            for topic in topics
        ]

    def send(self):
        header = MESSAGES.header(time.time_ns(), 'base_link')
        for publisher in self.publishers:
            publisher.publish(publisher.msg_type(header=header))
        self.ros.spin_for(0.02)


def cpu_seconds(node):
    stat = Path(f'/proc/{node.process.pid}/stat').read_text()
    fields = stat.rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def test_diagnostics_report_why_messages_were_dropped(ros, tmp_path):
    diagnostics = Diagnostics(ros, '/unclocked')
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/unclocked', use_sim_time=True),
        Robot(ros, namespace='/unclocked') as robot,
    ):
        diagnostics.wait(
            lambda d: (
                robot.send_zeros()
                or re.search(r'[0-9]+ messages? dropped \(no_clock\)', d.status.message)
            ),
            'the reason',
        )
        assert diagnostics.status.level == DiagnosticStatus.ERROR
