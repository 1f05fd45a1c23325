"""Maps of the real node: save, kill, load, localise; surveyed landmarks; ``/initialpose``."""

from __future__ import annotations

import re
import signal
import time
from unittest.mock import Mock

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from nav_msgs.msg import Odometry
from node_processes import client, NodeProcess, reason_of_refusal, running
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import deserialize_message, serialize_message
from scipy.special import chdtri
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from slam_observer_ros.common.findings import found
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import diagonal_blocks
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.messages.outgoing import StateMessages, uncertain_pose
from slam_observer_ros.messages.poses import pose_matrices
from slam_observer_ros.nodes.initial_pose import filled_in, InitialPoseListener
from slam_observer_ros.nodes.observer_nodes import ObserverNode
from slam_observer_ros.nodes.ros_node import MESSAGES
from slam_observer_ros.nodes.transforms import TransformedOdometry
from slam_observer_ros.recordings.frames import TransformBuffer
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.ros

NOISE_M = 0.02
PARAMETERS = {
    'observation_model': 'cartesian',
    'point_noise': NOISE_M,
    'reorder_window': 0.0,
    'publish_rate': 200.0,
}
SURVEYED = """\
format: slam_observer_ros map
version: 1
frame: map
landmarks:
"""


@pytest.fixture
def ros(ros_domain_id):
    with client() as opened:
        yield opened


class Robot:
    """Stands somewhere among 50 landmarks and reports what it sees."""

    def __init__(self, ros):
        self.ros = ros
        self.random = np.random.default_rng(0)
        self.points = self.random.uniform([-8, -8, 0], [8, 8, 3], (50, 3))
        self.odometry = ros.collect(Odometry, '/observer_node/odometry')
        self.twist = ros.node.create_publisher(TwistStamped, '/twist', 100)
        self.landmarks = ros.node.create_publisher(PointCloud2, '/landmarks', 100)
        self.initialpose = ros.node.create_publisher(PoseWithCovarianceStamped, '/initialpose', 10)

    def connect(self):
        self.odometry.clear()
        self.ros.wait_for_subscriber(self.twist, self.landmarks, self.initialpose)
        return self

    def see(self, pose, ids):
        ids = np.array(list(ids), dtype=np.int64)
        points = se3.transform(se3.inverse(pose), self.points[ids])
        points += self.random.normal(scale=NOISE_M, size=points.shape)
        twist = TwistStamped(header=MESSAGES.header(time.time_ns(), 'base_link'))
        twist.twist = MESSAGES.twist(np.zeros(6))
        self.twist.publish(twist)
        self.ros.spin_for(0.1)
        message = MESSAGES.point_cloud2(time.time_ns(), 'base_link', ids, points)
        self.landmarks.publish(message)
        return message.header.stamp

    def see_until_published(self, pose, ids):
        """Look once, and return the pose published and its covariance, angles first."""
        stamp = self.see(pose, ids)
        self.ros.spin_until(
            lambda: self.odometry and self.odometry[-1].header.stamp == stamp, 'its pose'
        )
        return as_pose(self.odometry[-1].pose)

    def surveyed_file(self, path, ids=range(50)):
        rows = [f'- {{id: {i}, position: {self.points[i].tolist()}, sigma: 0.01}}\n' for i in ids]
        path.write_text(SURVEYED + ''.join(rows))
        return path


@pytest.fixture
def robot(ros):
    return Robot(ros)


def as_pose(message):
    p, q = message.pose.position, message.pose.orientation
    pose = pose_matrices(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
    order = [3, 4, 5, 0, 1, 2]
    return pose, message.covariance.reshape(6, 6)[np.ix_(order, order)]


def nees(pose, covariance, true):
    turn = so3.log(pose[:3, :3] @ true[:3, :3].T)
    error = np.concatenate([turn, pose[:3, 3] - true[:3, 3]])
    return error @ np.linalg.solve(covariance, error)


def call(ros, service):
    return ros.call(Trigger, f'/observer_node/{service}', Trigger.Request())


def name_file(ros, path, must_succeed=True):
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(path))
    request = SetParameters.Request(parameters=[Parameter(name='map_path', value=value)])
    (result,) = ros.call(SetParameters, '/observer_node/set_parameters', request).results
    assert result.successful == must_succeed, result.reason
    return result


def initial_pose(pose, frame_id='map', variances=(0.01,) * 6, stamp_ns=None):
    uncertain = uncertain_pose(pose, np.diag(variances))
    raw = StateMessages(frame_id, '').pose(stamp_ns or time.time_ns(), uncertain)
    return deserialize_message(raw, PoseWithCovarianceStamped)


def test_saved_killed_loaded_and_localised(ros, robot, tmp_path):
    path = tmp_path / 'map.yaml'
    first = NodeProcess(
        'observer_node', tmp_path / 'log', is_forked=True, map_path=path, **PARAMETERS
    )
    try:
        robot.connect()
        for _ in range(5):
            robot.see_until_published(np.eye(4), range(50))
        answer = call(ros, 'save_map')
        assert answer.success
        assert answer.message == f"saved 50 landmarks in frame 'map' to {path}"
    finally:
        first.stop(signal.SIGKILL)
    saved = read_map(path)
    assert_allclose(saved.world_points, robot.points, atol=5 * NOISE_M)
    assert_array_equal(diagonal_blocks(saved.joint_covariance, 3), saved.covariances)
    elsewhere = se3.exp(np.array([0.1, -0.2, 2.0, 3.0, -2.0, 0.5]))
    # For some time a client takes the killed node for alive; a new one never hears of it.
    with (
        client() as ros,
        running('observer_node', tmp_path / 'log', map_file=path, **PARAMETERS) as node,
    ):
        node.wait_for_output('loaded 50 landmarks from .*map.yaml; the pose is unknown until')
        robot = Robot(ros).connect()
        robot.see(elsewhere, [7, 31])
        ros.spin_for(0.5)
        assert not robot.odometry  # two landmarks don't determine where it is
        pose, covariance = robot.see_until_published(elsewhere, [7, 31, 44])
        assert nees(pose, covariance, elsewhere) < chdtri(6, 0.0027)
        node.wait_for_output('Found the pose in the map')


def test_a_fixed_surveyed_map_is_saved_at_the_end_as_it_was(ros, robot, tmp_path):
    surveyed = robot.surveyed_file(tmp_path / 'surveyed.yaml', range(0, 50, 2))
    saved = tmp_path / 'saved.yaml'
    maps = {'map_file': surveyed, 'map_path': saved, 'autosave_map': True}
    pose = se3.exp(np.array([0.0, 0.0, -1.0, 1.0, 2.0, 0.0]))
    with running(
        'observer_node', tmp_path / 'log', localization_mode='fixed', **maps, **PARAMETERS
    ):
        robot.connect()
        for _ in range(3):
            estimate, _ = robot.see_until_published(pose, range(50))
    assert_allclose(estimate, pose, atol=0.1)
    before, after = read_map(surveyed), read_map(saved)
    order = np.argsort(after.ids)
    assert after.ids[order].tolist() == before.ids.tolist()
    assert_allclose(after.world_points[order], before.world_points, atol=1e-9)


def test_a_map_that_is_not_the_nodes_own_is_kept_when_another_one_takes_its_place(
    ros, robot, tmp_path
):
    path = robot.surveyed_file(tmp_path / 'hall.yaml')
    before = path.read_text()
    node = NodeProcess(
        'observer_node', tmp_path / 'log', map_path=path, autosave_map=True, **PARAMETERS
    )
    try:
        node.wait_for_output("'autosave_map' will replace .*hall.yaml, which is not loaded")
        robot.connect()
        for _ in range(3):
            robot.see_until_published(np.eye(4), range(4))
        assert call(ros, 'save_map').message.endswith('; what it held before is in hall.yaml~')
        assert len(read_map(path).ids) == 4
        assert call(ros, 'save_map').message.endswith('hall.yaml')
        name_file(ros, tmp_path / ('x' * 300), must_succeed=False)
        name_file(ros, '~nobody-of-that-name/map.yaml', must_succeed=False)
    finally:
        assert node.stop() == 0
    assert (tmp_path / 'hall.yaml~').read_text() == before


def test_a_file_that_there_can_not_be_is_reported_and_ends_nothing(ros, robot, tmp_path):
    with running('observer_node', tmp_path / 'log', **PARAMETERS):
        robot.connect()
        for _ in range(3):
            robot.see_until_published(np.eye(4), range(4))
        for path in (tmp_path / ('x' * 300), '~nobody-of-that-name/map.yaml', tmp_path):
            name_file(ros, path)
            answer = call(ros, 'save_map')
            assert not answer.success
            assert answer.message.startswith("can't ")


def test_a_map_that_can_not_be_saved_at_the_end_shows_in_the_exit_code(ros, robot, tmp_path):
    folder = tmp_path / 'folder'
    folder.mkdir()
    maps = {'map_path': folder / 'map.yaml', 'autosave_map': True}
    node = NodeProcess('observer_node', tmp_path / 'log', is_forked=True, **maps, **PARAMETERS)
    try:
        robot.connect()
        for _ in range(3):
            robot.see_until_published(np.eye(4), range(4))
        refused = name_file(ros, '/no/such/map.yaml', must_succeed=False)
        assert 'the directory /no/such takes no file' in refused.reason
        folder.rmdir()
    finally:
        exit_code = node.stop()
    assert exit_code == 1
    assert 'the map is not saved: ' in node.output
    assert 'Traceback' not in node.output


def test_in_which_hall_of_a_folder_of_maps_the_robot_is_shows(ros, robot, tmp_path):
    halls = tmp_path / 'halls'
    halls.mkdir()
    robot.surveyed_file(halls / 'here.yaml')
    own, robot.points = robot.points, robot.points[::-1] * [1.0, -1.0, 1.0]
    robot.surveyed_file(halls / 'there.yaml')
    robot.points = own
    pose = se3.exp(np.array([0.0, 0.0, 0.7, 1.0, 2.0, 0.0]))
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    with running('observer_node', tmp_path / 'log', map_file=halls, **PARAMETERS) as node:
        node.wait_for_output(r'loaded 100 landmarks in 2 maps \(here, there\) from .*halls')
        robot.connect()
        estimate, _ = robot.see_until_published(pose, range(8))
        assert_allclose(estimate, pose, atol=0.1)
        node.wait_for_output('Found the pose in the map here by 8 of 8 landmarks')

        def map_name():
            values = diagnostics[-1].status[1].values if diagnostics else ()
            return {entry.key: entry.value for entry in values}.get('map')

        ros.spin_until(lambda: map_name() == 'here', 'the name of the map')


def test_a_map_loaded_while_running_moves_the_estimate_into_its_frame(ros, robot, tmp_path):
    surveyed = robot.surveyed_file(tmp_path / 'surveyed.yaml', range(10))
    pose = se3.exp(np.array([0.0, 0.0, 0.7, 1.0, 2.0, 0.0]))
    with running('observer_node', tmp_path / 'log', **PARAMETERS):
        robot.connect()
        before, _ = robot.see_until_published(pose, range(20))
        assert_allclose(before, np.eye(4), atol=1e-9)
        name_file(ros, surveyed)
        answer = call(ros, 'load_map')
        assert answer.success
        assert answer.message.endswith('the robot has found its pose in it')
        after, covariance = robot.see_until_published(pose, range(20))
        assert nees(after, covariance, pose) < chdtri(6, 0.0027)


def test_the_initial_pose_places_the_robot_in_the_map(ros, robot, tmp_path):
    surveyed = robot.surveyed_file(tmp_path / 'surveyed.yaml')
    pose = se3.exp(np.array([0.0, 0.0, 0.5, -1.0, 2.0, 0.0]))
    with running('observer_node', tmp_path / 'log', map_file=surveyed, **PARAMETERS) as node:
        robot.connect()
        robot.initialpose.publish(initial_pose(pose, frame_id='odom'))
        node.wait_for_output("the pose given is not used: it is in frame 'odom', not 'map'")
        robot.initialpose.publish(initial_pose(pose, variances=[np.nan] * 6))
        node.wait_for_output('the pose given is not used: its covariance is not finite')
        robot.initialpose.publish(initial_pose(pose, variances=(0, 0, 0.07, 0.25, 0.25, 0)))
        node.wait_for_output(r'the robot is set to \(')
        estimate, covariance = robot.see_until_published(pose, [3])
        assert nees(estimate, covariance, pose) < chdtri(6, 0.0027)


class GivenPose:
    """What is given on ``initialpose``, to an observer that sees five landmarks."""

    def __init__(self, reorder_window=0.0):
        self.estimator = Estimator(Settings(reorder_window=reorder_window))
        self.odometry = np.eye(4)
        self.stamp_ns = 0
        self.node, self.on_move = Mock(), Mock()
        self.node.get_clock().now().nanoseconds = 2**62
        self.transforms = TransformBuffer()
        odometry = TransformedOdometry(ObserverNodeSettings(), self.transforms)
        InitialPoseListener(self.node, 'map', self.estimator, odometry, self.on_move)
        self.receive = self.node.create_subscription.call_args.args[2]
        self.see()

    def give(self, *arguments, **options):
        self.receive(serialize_message(initial_pose(*arguments, **options)))

    def drive(self, seconds, V):
        """Drive on, and let the odometry on /tf say so, too."""
        for _ in range(round(10 * seconds)):
            self.estimator.add(VelocityEvent(self.stamp_ns, V))
            self.transforms.insert('odom', 'base_link', self.stamp_ns, self.odometry)
            self.odometry = self.odometry @ se3.exp(0.1 * V)
            self.stamp_ns += 100_000_000
        self.transforms.insert('odom', 'base_link', self.stamp_ns, self.odometry)
        self.estimator.add(VelocityEvent(self.stamp_ns, V))

    def see(self):
        points = np.random.default_rng(1).normal(size=(5, 3))
        for _ in range(5):
            self.stamp_ns += 100_000_000
            self.estimator.add(VelocityEvent(self.stamp_ns, np.zeros(6)))
            self.estimator.add(ObservationEvent(self.stamp_ns, np.arange(5), points))


@pytest.mark.parametrize('x', [1.1e7, -1e200])
def test_an_initial_pose_beyond_what_the_parameter_allows_is_refused(x):
    given = GivenPose()
    given.give(se3.pose(np.eye(3), np.array([0.0, x, 0.0])))
    given.see()
    (reason,) = given.node.get_logger().error.call_args.args
    assert reason == 'the pose given is not used: its position has an entry beyond 1e+07 m'
    assert_allclose(given.estimator.pose, np.eye(4), atol=1e-9)


@pytest.mark.parametrize('frame_id', ['/map', ''])
def test_an_initial_pose_may_have_a_frame_with_a_slash_or_none_which_is_said(frame_id):
    given = GivenPose()
    given.give(se3.pose(np.eye(3), np.array([3.0, 0.0, 0.0])), frame_id=frame_id)
    assert_allclose(given.estimator.pose[0, 3], 3.0)
    given.on_move.assert_called_once_with()
    said = [call.args[0] for call in given.node.get_logger().warning.call_args_list]
    assert len(said) == (not frame_id)
    assert all("names no frame: it is taken as one in 'map'" in text for text in said)


@pytest.mark.parametrize(('is_simulated', 'now_s', 'newest_s', 'stamp_s', 'said'), [
    (True, 100.0, 100.0, None, 'set use_sim_time in RViz'),  # a simulation, RViz on wall time
    (True, None, None, None, ''),  # /clock of a simulator that has the system's time
    (False, None, None, 100.0, 'agree in use_sim_time'),  # the other way round
    (False, None, 100.0, 101.0, ''),  # drivers have the simulation's time, too
    (True, 100.0, 100.0, 109.0, 'synchronise the clocks'),
])  # fmt: skip
def test_an_initial_pose_by_the_wrong_one_of_two_clocks_is_named(
    is_simulated, now_s, newest_s, stamp_s, said
):
    given = GivenPose()
    ns = [time.time_ns() if s is None else round(s * 1e9) for s in (now_s, newest_s, stamp_s)]
    given.stamp_ns = ns[1]
    given.drive(1, CIRCLE)
    given.node.get_clock().now().nanoseconds = ns[0] + 2_000_000_000
    given.node.get_clock().ros_time_is_active = is_simulated
    pose = se3.from_rpy((1.0, -2.0, 0.0, 0.0, 0.0, 1.0))
    given.give(pose, stamp_ns=ns[2])
    texts = [call.args[0] for call in given.node.get_logger().warning.call_args_list]
    assert len(texts) == bool(said)
    assert all(said in text and 'it is taken as of now' in text for text in texts)
    if said:
        assert_allclose(given.estimator.pose, pose, atol=1e-6)


CIRCLE = np.array([0.0, 0.0, 0.2, 0.5, 0.0, 0.0])


@pytest.mark.parametrize(('age_s', 'knows_velocities'), [(2, True), (8, False)])
def test_the_motion_since_the_stamp_of_an_initial_pose_is_added(
    age_s, knows_velocities, monkeypatch
):
    """By the velocities, which are known for seconds, or else by the odometry on /tf."""
    given = GivenPose()
    given.drive(30, CIRCLE)
    pose = se3.from_rpy((1.0, -2.0, 0.0, 0.0, 0.0, 1.0))
    old_ns = given.stamp_ns - age_s * 1_000_000_000
    if not knows_velocities:
        monkeypatch.setattr(given.estimator, 'knows_motion_since', lambda _stamp_ns: False)
    given.give(pose, stamp_ns=old_ns, variances=(1e-8, 1e-8, 1e-4, 1e-8, 1e-8, 1e-8))
    moved = pose @ se3.exp(age_s * CIRCLE)
    assert_allclose(given.estimator.pose, moved, atol=1e-6)
    # The error of the heading turns the way since, of several metres.
    way = np.linalg.norm(moved[:2, 3] - pose[:2, 3])
    sigma = np.sqrt(np.trace(given.estimator.pose_covariance[3:, 3:]))
    assert sigma > 0.99 * way * 0.01
    given.node.get_logger().warning.assert_not_called()


@pytest.mark.parametrize(
    ('age_s', 'said'), [(25.0, 'how the robot moved since is not known'), (-3.0, 'ahead of')]
)
def test_what_is_not_known_of_the_stamp_of_an_initial_pose_is_said(age_s, said):
    given = GivenPose()
    given.drive(30, CIRCLE)
    given.node.get_clock().now().nanoseconds = given.stamp_ns
    pose = se3.from_rpy((1.0, -2.0, 0.0, 0.0, 0.0, 1.0))
    given.give(pose, stamp_ns=given.stamp_ns - round(age_s * 1e9))
    assert_allclose(given.estimator.pose, pose, atol=1e-6)
    (text,) = given.node.get_logger().warning.call_args.args
    assert said in text


def test_an_initial_pose_is_that_of_the_newest_message_even_if_that_waits_for_others():
    given = GivenPose(reorder_window=1.0)
    assert given.estimator.stamp_ns is None
    given.give(se3.pose(np.eye(3), np.array([3.0, 0.0, 0.0])), frame_id='elsewhere')
    given.on_move.assert_not_called()
    given.give(se3.pose(np.eye(3), np.array([3.0, 0.0, 0.0])))
    assert given.estimator.stamp_ns == given.stamp_ns


def test_of_an_initial_pose_what_is_given_counts_and_what_is_not_is_assumed():
    """What only rounding has made negative is not refused."""
    given = np.diag([0.0, 0.0, 0.07, 0.25, 0.25, 0.0])
    given[3, 4] = given[4, 3] = 0.25 + 1e-14
    expected = given + np.diag([0.26, 0.26, 0.0, 0.0, 0.0, 0.5]) ** 2
    assert_allclose(filled_in(given), expected)
    assert_allclose(filled_in(None), np.diag([0.26, 0.26, 0.26, 0.5, 0.5, 0.5]) ** 2)


def test_an_initial_pose_whose_covariance_is_none_is_refused():
    given = GivenPose()
    message = initial_pose(np.eye(4))
    message.pose.covariance[1] = 0.1  # and its mirror image is zero
    given.receive(serialize_message(message))
    (reason,) = given.node.get_logger().error.call_args.args
    assert reason.startswith('the pose given is not used: its covariance is not finite, not sym')
    given.see()
    assert_allclose(given.estimator.pose, np.eye(4), atol=1e-9)


@pytest.mark.parametrize('unknown', [1e9, 1e300, 1.7e308])
def test_huge_variances_of_an_initial_pose_say_unknown(unknown):
    given = GivenPose()
    given.give(np.eye(4), variances=(unknown, unknown, 0.07, 0.25, 0.25, unknown))
    given.node.get_logger().error.assert_not_called()
    given.see()
    deviations = np.sqrt(np.diag(given.estimator.pose_covariance))
    assert (deviations < 0.6).all()
    assert_allclose(given.estimator.pose, np.eye(4), atol=1e-3)


def test_a_robot_that_starts_at_its_dock_is_placed_at_once(ros, robot, tmp_path):
    surveyed = robot.surveyed_file(tmp_path / 'surveyed.yaml')
    pose = se3.exp(np.array([0.0, 0.0, 0.5, -1.0, 2.0, 0.0]))
    x, y, z = (pose[:3, 3] + [0.1, -0.2, 0.0]).tolist()
    dock = {'initial_pose': f'[{x}, {y}, {z}, 0.0, 0.0, 0.4]', 'set_initial_pose': True}
    with running(
        'observer_node', tmp_path / 'log', map_file=surveyed, **dock, **PARAMETERS
    ) as node:
        node.wait_for_output(rf'loaded 50 landmarks .*; the robot starts at \({x:.2f}, {y:.2f}')
        robot.connect()
        estimate, covariance = robot.see_until_published(pose, [3])
        assert nees(estimate, covariance, pose) < chdtri(6, 0.0027)


def test_what_cannot_be_done_is_answered_with_the_reason(ros, robot, tmp_path):
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    broken = tmp_path / 'broken.yaml'
    broken.write_text('landmarks: []')
    elsewhere = tmp_path / 'hall.yaml'
    landmark = '- {id: 1, position: [0, 0, 0]}'
    elsewhere.write_text(SURVEYED.replace('frame: map', 'frame: hall') + landmark)
    with running('observer_node', tmp_path / 'log'):
        assert call(ros, 'save_map').message == "no file is named: set the parameter 'map_path'"
        for path, reason in (
            (tmp_path / 'no.yaml', "can't read map .*no.yaml: No such file"),
            (broken, 'map .*broken.yaml: it has no line'),
            (elsewhere, "is in frame 'hall', and 'map_frame' is 'map'"),
        ):
            name_file(ros, path)
            answer = call(ros, 'load_map')
            assert not answer.success
            assert re.search(reason, answer.message)
        name_file(ros, tmp_path / 'no' / 'map.yaml')
        assert 'the map is empty: nothing is written' in call(ros, 'save_map').message
        name_file(ros, robot.surveyed_file(tmp_path / 'good.yaml'))
        assert call(ros, 'load_map').success
        answer = call(ros, 'save_map')
        assert not answer.success
        assert 'not known yet: nothing is saved' in answer.message
        ros.spin_until(
            lambda: any('pose in the loaded map' in m.status[0].message for m in diagnostics),
            'a diagnostic that says so',
        )


@pytest.mark.parametrize(
    ('parameters', 'reason'),
    [
        ({'gains': 'ricati'}, "'gains' takes one of constant, riccati, not 'ricati'"),
        ({'use_sim_time': 'ja'}, "Trying to set parameter 'use_sim_time' to 'ja'"),
    ],
)
def test_with_a_wrong_parameter_the_node_says_why_in_a_line(tmp_path, parameters, reason):
    node = NodeProcess('observer_node', tmp_path / 'log', is_forked=True, **parameters)
    assert node.wait() == 2
    last = node.output.splitlines()[-1]
    assert reason in last
    assert 'Reason:' not in last


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        (None, r"Couldn't parse params file: '--params-file .*'. Error: Error opening YAML file"),
        ('map_frame: hall', 'Cannot have a value before ros__parameters at line 1'),
    ],
)
def test_with_a_wrong_parameter_file_the_node_says_why_in_a_line(tmp_path, text, reason):
    file = tmp_path / 'file.yaml'
    if text is not None:
        file.write_text(text)
    node = NodeProcess(
        'observer_node', tmp_path / 'log', '--params-file', str(file), is_forked=True
    )
    assert node.wait() == 2
    assert re.search(reason, node.output.splitlines()[-1])
    assert 'Traceback' not in node.output


def test_off_is_a_mode_that_yaml_takes_for_false(ros, tmp_path):
    file = tmp_path / 'file.yaml'
    file.write_text('/**: {ros__parameters: {localization_mode: off}}')
    with running('observer_node', tmp_path / 'log', '--params-file', str(file)) as node:
        node.wait_for_output("estimating 'base_link' in 'map'")


@pytest.mark.parametrize(
    ('parameters', 'reason'),
    [
        ({'sensor_pose': [0, 0, 0, 0, 0, 90]}, "'sensor_pose': roll, pitch and yaw are radians"),
        ({'map_file': '/no/such/map.yaml'}, "can't read map /no/such/map.yaml"),
        ({'autosave_map': True}, "'autosave_map' needs a file in 'map_path'"),
        (
            {'autosave_map': True, 'map_path': '/no/such/map.yaml'},
            "can't write map /no/such/map.yaml: the directory /no/such takes no file: No such",
        ),
        ({'autosave_map': True, 'map_path': '/'}, "can't write map /: it is a directory"),
        (
            {'map_frame': 'odom'},
            "'map_frame' and 'odom_frame' are both 'odom': give each a name of its own, or set "
            "'odom_frame' to '' to have 'odom' to the base published",
        ),
        ({'map_frame': "''"}, "'map_frame' is empty: give it the name of a frame"),
        ({'base_frame': '/'}, "'base_frame' is empty: give it the name of a frame"),
        ({'base_frame': '/map'}, "'map_frame' and 'base_frame' are both 'map': give each a name"),
    ],
)
def test_with_wrong_parameters_the_node_says_why_and_does_not_start(
    ros_domain_id, parameters, reason
):
    assert reason in reason_of_refusal(ObserverNode, **parameters)


def test_points_without_ids_that_fit_nowhere_in_a_map_are_reported(ros, robot, tmp_path):
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics')
    surveyed = robot.surveyed_file(tmp_path / 'surveyed.yaml', range(5))
    message = found('no_place', where='the map').what

    def is_reported():
        return diagnostics and message in diagnostics[-1].status[0].message

    def see_without_ids():
        ids, points = np.full(3, UNKNOWN_ID), 1.5 * robot.points[2:5]  # not in the map
        robot.landmarks.publish(MESSAGES.point_cloud2(time.time_ns(), 'base_link', ids, points))
        ros.spin_for(0.1)

    with running('observer_node', tmp_path / 'log', map_file=surveyed, **PARAMETERS) as node:
        node.wait_for_output('until three of them are recognised by their ids, more without ids')
        robot.connect()
        robot.see(np.eye(4), [0, 1])
        diagnostics.clear()
        ros.spin_until(lambda: len(diagnostics) > 1, 'diagnostics')
        assert 'pose in the loaded map' in diagnostics[-1].status[0].message
        assert not is_reported()
        ros.spin_until(lambda: see_without_ids() or is_reported(), 'the request')
