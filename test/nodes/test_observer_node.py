"""``observer_node`` over real DDS: what comes in and what goes out."""

from __future__ import annotations

from dataclasses import replace
import re
import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
from node_processes import NodeProcess, reason_of_refusal, running
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import serialize_message
from robots import Robot, stamp_ns
from sensor_msgs.msg import PointCloud, PointCloud2
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.nodes.observer_nodes import LifecycleObserverNode, ObserverNode
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES
from slam_observer_ros.nodes.simulator import SimulatorNode
from slam_observer_ros.nodes.transforms import DISCOVERY_S
from slam_observer_ros.simulation import Scenario

pytestmark = pytest.mark.ros

RUN = Scenario(velocity_rate=40.0, observation_rate=20.0, duration=1.0)


@pytest.fixture(scope='module')
def shared_observer(ros, tmp_path_factory):
    log = tmp_path_factory.mktemp('observer') / 'log'
    with running('observer_node', log, max_stamp_jump=1000.0) as node:
        yield node


@pytest.fixture
def observer(ros, shared_observer):
    """Give a node that has forgotten what the test before sent."""
    ros.call(Trigger, '/observer_node/reset', Trigger.Request())
    return shared_observer


@pytest.mark.parametrize(
    ('twist_class', 'cloud_class'),
    [(Twist, PointCloud), (TwistStamped, PointCloud2), (Odometry, PointCloud2)],
)
def test_each_input_type_is_found_on_its_topic(ros, observer, twist_class, cloud_class):
    poses = ros.collect(PoseWithCovarianceStamped, 'pose')
    estimates = ros.collect(PointCloud, 'landmark_estimates')
    with Robot(ros, twist_class, cloud_class) as robot:
        robot.run(RUN)
        ros.spin_until(lambda: estimates and len(estimates[-1].points) == 4, 'four landmarks')
        # An unstamped Twist is only as exact as its time of reception.
        ros.spin_until(
            lambda: poses and abs(poses[-1].pose.pose.position.x - 1.0) < 0.3, 'a run of 1 m'
        )
    received = re.findall(
        r"listening for \w+/msg/(\w+) on '/(?:twist|landmarks)'", observer.output
    )
    assert {twist_class.__name__, cloud_class.__name__} <= set(received)


def test_the_log_of_a_start_has_no_lines_but_the_nodes_own(observer):
    observer.wait_for_output('estimating')
    assert 'number of timers' not in observer.output


def test_incompatible_type_is_reported(ros, observer):
    publisher = ros.node.create_publisher(Float64, 'twist', 1)
    observer.wait_for_output(r"'/twist' carries std_msgs/msg/Float64; .*Twist.* is needed")
    ros.node.destroy_publisher(publisher)


OUTPUTS = {
    '/observer_node/odometry': ('nav_msgs/msg/Odometry', False),
    '/pose': ('geometry_msgs/msg/PoseWithCovarianceStamped', True),
    '/path': ('nav_msgs/msg/Path', False),
    '/landmark_map': ('sensor_msgs/msg/PointCloud2', True),
    '/landmark_estimates': ('sensor_msgs/msg/PointCloud', False),
    '/markers': ('visualization_msgs/msg/MarkerArray', False),
    '/lyapunov': ('std_msgs/msg/Float64', False),
    '/diagnostics': ('diagnostic_msgs/msg/DiagnosticArray', False),
}


def test_each_output_has_its_type_and_quality_of_service(ros, observer):
    ros.wait_for_publisher(*OUTPUTS)
    for topic, (type_name, is_latched) in OUTPUTS.items():
        (info,) = ros.node.get_publishers_info_by_topic(topic)
        assert info.topic_type == type_name
        assert info.qos_profile.reliability is ReliabilityPolicy.RELIABLE
        latched = info.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
        assert latched == is_latched, topic


def test_outputs_follow_the_parameters_and_carry_true_stamps(ros, tmp_path):
    odometry = ros.collect(Odometry, '/fresh/observer_node/odometry')
    poses = ros.collect(PoseWithCovarianceStamped, '/fresh/pose')
    lyapunov = ros.collect(Float64, '/fresh/lyapunov')
    paths = ros.collect(Path, '/fresh/path')
    markers = ros.collect(MarkerArray, '/fresh/markers')
    parameters = {
        'map_frame': 'earth',
        'base_frame': 'robot',
        'publish_tf': False,
        'landmarks_type': 'PointCloud',
        'angular_bias_stddev': [0.0, 0.0, 0.0],
    }
    arguments = ('-r', '__ns:=/fresh')
    with (
        running('observer_node', tmp_path / 'log', *arguments, **parameters),
        Robot(ros, cloud_class=PointCloud, namespace='/fresh', frame_id='robot') as robot,
    ):
        topics = ('observer_node/odometry', 'pose', 'lyapunov', 'path', 'markers')
        ros.wait_for_publisher(*(f'/fresh/{topic}' for topic in topics))
        assert not odometry + poses + paths + lyapunov + markers, 'published before any input'
        events = robot.run(RUN)
        ros.spin_for(0.6)
        senders = ros.node.get_publishers_info_by_topic('/tf')
        assert '/fresh' not in {sender.node_namespace for sender in senders}

    assert len(odometry) > 10
    assert {m.header.frame_id for m in odometry + poses + paths} == {'earth'}
    assert {m.child_frame_id for m in odometry} == {'robot'}
    for messages in (odometry, poses, paths):
        stamps = [stamp_ns(message) for message in messages]
        assert stamps == sorted(set(stamps)), 'a stamp came twice or out of order'
        assert set(stamps) <= {event.stamp_ns for event in events}
    assert odometry[-1].twist.twist.linear.x == 1.0
    assert odometry[-1].twist.twist.angular.z == 0.2
    for field in (odometry[-1].pose.covariance, odometry[-1].twist.covariance):
        assert np.diag(field.reshape(6, 6)).min() > 0.0
    assert lyapunov[-1].data > 0.0
    path = paths[-1].poses
    assert 5 < len(path) <= 11
    assert [m.header.stamp for m in path] != [path[0].header.stamp] * len(path)
    by_namespace = {marker.ns: marker for marker in markers[-1].markers}
    assert len(by_namespace['landmarks'].points) == 4
    assert len(by_namespace['residuals'].points) == 8
    sizes = [m.scale.x for m in markers[-1].markers if m.ns == 'uncertainties']
    assert len(sizes) == 4
    assert 0.0 < min(sizes) <= max(sizes) < 5.0
    assert {m.text for m in markers[-1].markers if m.type == Marker.TEXT_VIEW_FACING} == set(
        '0123'
    )


def test_transform_is_the_pose(ros, observer):
    messages = pytest.importorskip('tf2_msgs.msg')
    transforms = ros.collect(messages.TFMessage, '/tf')
    poses = ros.collect(PoseWithCovarianceStamped, 'pose')
    with Robot(ros) as robot:
        ros.wait_for_publisher('/tf', 'pose')
        robot.run(replace(RUN, duration=DISCOVERY_S + 1.0))

        def of_published_poses():
            """Either topic may be heard before the other one, and end later."""
            stamps = [stamp_ns(message) for message in poses] or [0]
            sent = [transform for message in transforms for transform in message.transforms]
            return [t for t in sent if stamps[0] <= stamp_ns(t) <= stamps[-1]]

        ros.spin_until(lambda: len(of_published_poses()) > 10 or robot.send_zeros(), 'transforms')
    published = {stamp_ns(m): m.pose.pose for m in poses}
    for transform in of_published_poses():
        assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'base_link')
        pose = published[stamp_ns(transform)]
        assert transform.transform.rotation == pose.orientation
        assert transform.transform.translation.x == pose.position.x


def test_late_subscriber_gets_the_latched_map(ros, observer):
    with Robot(ros) as robot:
        robot.run(RUN)
        ros.spin_for(0.6)
        maps = ros.collect(PointCloud2, 'landmark_map', LATCHED_QOS)
        ros.spin_until(lambda: maps, 'the latched map')
    assert sorted(decode_point_cloud2(serialize_message(maps[-1])).ids) == [0, 1, 2, 3]


def test_late_subscriber_of_the_pose_gets_it_as_from_amcl(ros, observer):
    with Robot(ros) as robot:
        events = robot.run(RUN)
        ros.spin_for(0.6)
        newest_ns = max(event.stamp_ns for event in events)
        poses = ros.collect(PoseWithCovarianceStamped, 'pose', LATCHED_QOS)
        ros.spin_until(
            lambda: poses and newest_ns - stamp_ns(poses[-1]) < 300_000_000, 'the latched pose'
        )


def test_malformed_and_impossible_messages_are_counted_and_do_no_harm(ros, observer):
    poses = ros.collect(PoseWithCovarianceStamped, 'pose')
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    ros.spin_until(lambda: diagnostics, 'diagnostics')
    malformed, dropped = _malformed(diagnostics[-1]), _dropped(diagnostics[-1])
    with Robot(ros) as robot:
        robot.run(RUN)
        no_fields = PointCloud2(header=MESSAGES.header(time.time_ns(), 'base_link'), width=1)
        no_fields.height = 1
        robot.landmarks.publish(no_fields)
        robot.send(VelocityEvent(time.time_ns(), np.full(6, np.nan)))
        robot.run(RUN)
        ros.spin_until(lambda: _malformed(diagnostics[-1]) == malformed + 1, 'the count')
    said = ' '.join(message.status[0].message for message in diagnostics)
    assert "malformed message on '/landmarks': " in said
    assert _dropped(diagnostics[-1]) == dropped + 1
    assert all(np.isfinite(m.pose.pose.position.x) for m in poses)


def test_a_lidars_scan_is_dropped_and_counted(ros, observer):
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    scan = ObservationEvent(time.time_ns(), np.full(501, UNKNOWN_ID), np.ones((501, 3)))
    with Robot(ros) as robot:
        robot.run(RUN)
        robot.send(scan)
        ros.spin_until(
            lambda: diagnostics and _sum(diagnostics[-1], 'dropped: scan') == 1, 'the count'
        )


def _malformed(diagnostics):
    return _sum(diagnostics, ' malformed')


def _dropped(diagnostics):
    """Return how many were dropped for their content; a busy machine may deliver some too late."""
    return _sum(diagnostics, 'dropped: not_finite')


def _sum(diagnostics, key):
    values = [v for v in diagnostics.status[0].values if not v.key.startswith('to do')]
    return sum(int(v.value) for v in values if key in v.key)


def test_diagnostics_warn_when_nothing_comes_in(ros, observer):
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    ros.spin_until(
        lambda: (
            diagnostics and "nothing publishes on '/twist'" in diagnostics[-1].status[0].message
        ),
        'the warning',
    )
    assert diagnostics[-1].status[0].level == DiagnosticStatus.WARN


def _set(ros, name, **value):
    kind = {'double_value': ParameterType.PARAMETER_DOUBLE}.get(
        next(iter(value)), ParameterType.PARAMETER_STRING
    )
    parameter = Parameter(name=name, value=ParameterValue(type=kind, **value))
    request = SetParameters.Request(parameters=[parameter])
    (result,) = ros.call(SetParameters, '/observer_node/set_parameters', request).results
    return result


def test_parameters_can_be_set_within_their_range_only(ros, observer):
    assert _set(ros, 'gain_k', double_value=2.5).successful
    refused = _set(ros, 'gain_k', double_value=-1.0)
    assert not refused.successful
    assert 'gain_k' in refused.reason
    wrong_type = _set(ros, 'gain_k', string_value='high')
    assert wrong_type.reason == "parameter 'gain_k' takes a number, not 'high'"
    read_only = _set(ros, 'map_frame', string_value='moon')
    assert 'read-only' in read_only.reason


def test_a_dumped_parameter_file_is_loaded_again_without_a_failure(ros, observer):
    names = ros.call(
        ListParameters, '/observer_node/list_parameters', ListParameters.Request()
    ).result.names
    values = ros.call(
        GetParameters, '/observer_node/get_parameters', GetParameters.Request(names=names)
    ).values
    assert len(names) > 60
    dumped = [Parameter(name=name, value=value) for name, value in zip(names, values, strict=True)]
    request = SetParameters.Request(parameters=dumped)
    results = ros.call(SetParameters, '/observer_node/set_parameters', request).results
    assert [result.reason for result in results if not result.successful] == []
    request = SetParametersAtomically.Request(parameters=dumped)
    answer = ros.call(SetParametersAtomically, '/observer_node/set_parameters_atomically', request)
    assert answer.result.successful, answer.result.reason


def test_noise_may_be_tuned_while_the_node_runs(ros, observer):
    assert _set(ros, 'range_noise', double_value=0.3).successful
    assert not _set(ros, 'range_noise', double_value=-0.3).successful
    assert _set(ros, 'range_noise', double_value=0.1).successful


def test_parameters_describe_themselves(ros, observer):
    request = DescribeParameters.Request(names=['publish_rate', 'gain_k'])
    rate, gain = ros.call(
        DescribeParameters, '/observer_node/describe_parameters', request
    ).descriptors
    assert rate.read_only
    assert rate.description.endswith('[Hz]')
    assert rate.floating_point_range[0].to_value == 1000.0
    assert not gain.read_only


def test_a_quality_of_service_that_there_is_none_of_is_refused_with_its_name(ros):
    name = 'qos_overrides./twist.subscription.reliability'
    reason = reason_of_refusal(ObserverNode, velocity_type='Twist', **{name: 'relaible'})
    assert "'qos_overrides./twist.subscription'" in reason
    assert 'relaible' in reason


def test_bad_parameter_at_the_start_is_refused_with_the_reason(ros):
    reason = reason_of_refusal(ObserverNode, publish_rate=0)
    assert 'publish_rate' in reason
    assert '≥ 0.1' in reason


@pytest.mark.parametrize('node_class', [ObserverNode, LifecycleObserverNode, SimulatorNode])
@pytest.mark.parametrize('value', ['1', '"yes"'])
def test_a_parameter_of_ros_itself_that_has_a_wrong_type_is_refused(
    ros, tmp_path, node_class, value
):
    file = tmp_path / 'robot.yaml'
    file.write_text(f'/**: {{ros__parameters: {{use_sim_time: {value}}}}}')
    reason = reason_of_refusal(node_class, '--params-file', str(file))
    assert "'use_sim_time'" in reason
    assert "expecting type 'BOOL'" in reason


@pytest.mark.parametrize(
    ('node_class', 'written', 'meant'),
    [
        (ObserverNode, 'gans', 'gains'),
        (ObserverNode, 'point_niose', 'point_noise'),
        (LifecycleObserverNode, 'velocity_timeot', 'velocity_timeout'),
    ],
)
def test_parameter_misspelt_by_a_letter_is_refused_with_the_one_that_may_be_meant(
    ros, tmp_path, node_class, written, meant
):
    file = tmp_path / 'robot.yaml'
    file.write_text(f'/**: {{ros__parameters: {{{written}: 1.0}}}}')
    reason = reason_of_refusal(node_class, '--params-file', str(file))
    assert f"'{written}'; did you mean '{meant}'?" in reason


def test_parameters_under_the_name_of_another_node_are_reported_at_the_start(ros, tmp_path):
    file = tmp_path / 'robot.yaml'
    file.write_text(
        'slam_node: {ros__parameters: {gains: constant, two_d_mode: true}}\n'
        'amcl: {ros__parameters: {base_frame: base, min_particles: 500, max_particles: 900}}\n'
    )
    with running('observer_node', tmp_path / 'log', '--params-file', str(file)) as node:
        node.wait_for_output(
            f"parameter file {file} has nothing for '/observer_node'; are the values under "
            "'/slam_node' meant for it"
        )


def test_parameters_that_are_not_given_to_ros_are_not_passed_over(ros, tmp_path):
    arguments = ('--', '--params-file', 'robot.yaml')
    node = NodeProcess('simulator_node', tmp_path / 'log', *arguments)
    assert node.wait() == 2
    assert 'unknown arguments --params-file robot.yaml: ' in node.output
    assert 'come after --ros-args' in node.output
    assert 'Traceback' not in node.output


@pytest.mark.parametrize(
    ('source', 'output', 'topic', 'remaps'),
    [
        ('twist', '~/odometry', '/observer_node/odometry', ['twist:=~/odometry']),
        ('twist', '~/odometry', '/wheels', ['~/odometry:=/wheels', 'twist:=/wheels']),
        (
            'landmarks',
            'landmark_map',
            '/robot/landmark_map',
            ['__ns:=/robot', 'landmarks:=landmark_map'],
        ),
    ],
)
def test_a_node_does_not_take_in_its_own_estimate(ros, source, output, topic, remaps):
    arguments = [argument for remap in remaps for argument in ('-r', remap)]
    reason = reason_of_refusal(ObserverNode, *arguments)
    assert f"input '{source}' and the output '{output}' are both '{topic}'" in reason
    assert f'-r {output}:=filter/{output.removeprefix("~/")}' in reason


def test_parameters_of_other_nodes_in_the_same_file_are_left_alone(ros, tmp_path):
    file = tmp_path / 'robot.yaml'
    file.write_text('/**: {ros__parameters: {base_frame_id: body, wheel: {radius: 0.1}}}')
    arguments = ('--params-file', str(file), '-r', '__ns:=/shared')
    with running('observer_node', tmp_path / 'log', *arguments, use_sim_time=False) as node:
        node.wait_for_output('estimating')
        assert node.output.count('WARN') == 1
        assert 'ignored: base_frame_id, wheel.radius\n' in node.output


def test_all_that_a_node_prints_is_its_log(ros, tmp_path):
    with running('observer_node', tmp_path / 'log', use_imu=True) as node:
        node.wait_for_output('estimating')
    assert all(line.startswith('[') for line in node.output.splitlines()), node.output


def test_large_ids_are_warned_about(ros, observer):
    maps = ros.collect(PointCloud2, 'landmark_map', LATCHED_QOS)
    ros.collect(PointCloud, 'landmark_estimates')  # for nobody they are not made
    large_id = 2**32 - 2
    with Robot(ros) as robot:

        def is_warned():
            robot.send(ObservationEvent(time.time_ns(), np.array([large_id]), np.ones((1, 3))))
            return "landmark_estimates can't carry ids" in observer.output

        ros.spin_until(is_warned, 'the warning')
        ros.spin_until(
            lambda: maps and large_id in decode_point_cloud2(serialize_message(maps[-1])).ids,
            'the landmark',
        )


def test_reset_forgets_pose_and_map(ros, observer):
    estimates = ros.collect(PointCloud, 'landmark_estimates')
    poses = ros.collect(PoseWithCovarianceStamped, 'pose')
    with Robot(ros) as robot:
        robot.run(RUN)
        ros.spin_until(lambda: estimates and len(estimates[-1].points) == 4, 'four landmarks')
        robot.send_zeros()  # else a velocity still on its way would move it after the reset
        response = ros.call(Trigger, '/observer_node/reset', Trigger.Request())
        assert response.success
        ros.spin_for(0.2)
        poses.clear()
        robot.send(VelocityEvent(time.time_ns(), np.zeros(6)))
        for _ in range(5):  # a landmark is published once it is confirmed
            point = np.array([[1.0, 0.0, 0.0]])
            robot.send(ObservationEvent(time.time_ns(), np.array([7]), point))
            ros.spin_for(0.1)
        robot.send(VelocityEvent(time.time_ns(), np.zeros(6)))
        ros.spin_until(lambda: poses and len(estimates[-1].points) == 1, 'the only landmark')
    assert_allclose(poses[-1].pose.pose.position.x, 0.0, atol=1e-9)
    assert list(estimates[-1].channels[0].values) == [7.0]
