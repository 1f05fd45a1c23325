"""Whatever fails inside a node is said and counted, and the node goes on."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from node_processes import NodeProcess, PATIENCE_S
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from robots import Robot
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from slam_observer_ros.nodes.observer_nodes import LifecycleObserverNode
from slam_observer_ros.nodes.ros_node import _refusal, Entities, GuardedNode
from slam_observer_ros.nodes.runner import _executor, turn
from slam_observer_ros.simulation import Scenario

pytestmark = pytest.mark.ros

FAILING_NODE = """\
import sys
import numpy as np
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.nodes.observer_nodes import ObserverCore
from slam_observer_ros.nodes.executables import observer_node
from slam_observer_ros.nodes.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.services import ControlServices

def fail(*_):
    raise np.linalg.LinAlgError('singular matrix')

def break_filter(self, message):
    broken = self._estimator._hypotheses.best.errors
    if message.data == 1:
        broken.observer.A[...] = np.nan
    else:
        broken.joint.P = np.full_like(broken.joint.P, np.nan)

reset = Estimator.reset

def told_reset(self, *pose):
    print('was reset', flush=True)
    reset(self, *pose)

Estimator.reset = told_reset
Hypotheses.associate = fail
Estimator.load_map = fail
Estimator.change_settings = fail
Estimator.set_pose = fail
ControlServices._forget = break_filter
EstimatePublisher.publish_overview = fail
sys.exit(observer_node())
"""

HUBER = Parameter(
    name='huber_threshold',
    value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=2.0),
)
MAP = """\
format: slam_observer_ros map
version: 1
frame: map
landmarks:
- {id: 7, position: [1.5, -2.0, 0.3], sigma: 0.01}
"""


@pytest.fixture(scope='module')
def node(tmp_path_factory):
    """A node of which an observation, a load, a setting, a pose and a timer fail."""
    folder = tmp_path_factory.mktemp('failing')
    (folder / 'program.py').write_text(FAILING_NODE)
    (folder / 'map.yaml').write_text(MAP)
    node = NodeProcess(
        'observer_node', folder / 'log', program=folder / 'program.py',
        map_path=folder / 'map.yaml',
    )  # fmt: skip
    yield node
    node.process.kill()
    node.process.wait()


def test_a_service_that_fails_is_answered_with_the_reason(ros, node):
    answer = ros.call(Trigger, '/observer_node/load_map', Trigger.Request())
    assert not answer.success
    assert 'LinAlgError: singular matrix' in answer.message
    assert "a call of '~/load_map' failed" in node.output


def test_a_setting_that_fails_is_refused_with_the_reason(ros, node):
    request = SetParameters.Request(parameters=[HUBER])
    (result,) = ros.call(SetParameters, '/observer_node/set_parameters', request).results
    assert not result.successful
    assert 'LinAlgError' in result.reason
    request = SetParametersAtomically.Request(parameters=[HUBER])
    name = '/observer_node/set_parameters_atomically'
    assert not ros.call(SetParametersAtomically, name, request).result.successful
    assert node.process.poll() is None


def test_messages_and_timers_that_fail_are_said_and_the_node_goes_on(ros, node):
    said = ros.collect(DiagnosticArray, '/diagnostics')
    given = ros.node.create_publisher(PoseWithCovarianceStamped, '/initialpose', 10)
    ros.wait_for_subscriber(given)
    given.publish(PoseWithCovarianceStamped())
    with Robot(ros) as robot:
        odometry = ros.collect(Odometry, '/observer_node/odometry')
        ros.wait_for_publisher('/observer_node/odometry')
        robot.run(Scenario(velocity_rate=40.0, observation_rate=20.0, duration=0.6))
        ros.spin_until(lambda: odometry, 'velocities are still used')
        ros.spin_until(
            lambda: any(
                status.level != b'\0'
                and 'LinAlgError' in status.message
                and any('internal_error' in value.key for value in status.values)
                for message in said
                for status in message.status
            ),
            'the failure on /diagnostics',
        )
    assert "a message on 'initialpose' failed" in node.output
    assert 'Dropped a message, internal_error: LinAlgError' in node.output
    assert 'the timer of ObserverCore._publish_overview failed' in node.output


def test_an_estimate_that_is_not_finite_any_more_is_started_again(ros, node):
    broken = ros.node.create_publisher(Int64, '/observer_node/forget_landmark', 10)
    ros.wait_for_subscriber(broken)
    for number in (1, 2):  # the pose, or its covariance
        before = node.output.count('was reset')
        broken.publish(Int64(data=number))
        ros.spin_until(lambda count=before: node.output.count('was reset') > count, 'a new start')
    assert node.output.count('not finite any more') == 1  # in ten seconds
    assert ros.call(Trigger, '/observer_node/pause', Trigger.Request()).success
    assert node.stop() == 0


def test_a_response_of_nav2_says_that_it_failed():
    class Response:
        RESULT_INDEFINITE_FAILURE = 255
        result = 0

    assert _refusal(object(), Response(), 'reason').result == 255


def test_a_managed_node_that_can_not_be_configured_keeps_nothing_of_it(ros_domain_id, tmp_path):
    rclpy.init(args=['--ros-args', '-p', f'map_file:={tmp_path}/none.yaml'])
    try:
        node = LifecycleObserverNode()
        before = [len(held) for held in held_by(node)]
        for _ in range(3):
            assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
        assert [len(held) for held in held_by(node)] == before
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_what_is_removed_while_it_is_due_is_not_called_any_more(ros_domain_id):
    rclpy.init()
    try:
        node, other, called = GuardedNode('closing'), rclpy.create_node('other'), []
        executor, entities = _executor(), Entities(node)
        executor.add_node(node)
        node.create_steady_timer(0.01, lambda: called.append('timer'))
        node.create_subscription(Int64, 'number', lambda _: called.append('message'), 10)
        node.create_service(Trigger, 'act', lambda *_: called.append('service'))
        publisher = other.create_publisher(Int64, 'number', 10)
        client = other.create_client(Trigger, 'act')

        def close():
            if publisher.get_subscription_count() and client.service_is_ready():
                publisher.publish(Int64())
                client.call_async(Trigger.Request())
                time.sleep(0.3)  # all of them are due when it ends
                entities.remove_new()
                called.append('closed')

        node.create_steady_timer(0.05, close)
        deadline = time.monotonic() + PATIENCE_S
        while 'closed' not in called:
            assert time.monotonic() < deadline
            turn(executor)
        for _ in range(5):
            turn(executor)
        assert called[-1] == 'closed'
        executor.shutdown()
    finally:
        rclpy.shutdown()


def held_by(node):
    """Return all that a node keeps until it is told to let go of it."""
    callbacks = node._on_set_parameters_callbacks, node._post_set_parameters_callbacks
    entities = node.publishers, node.subscriptions, node.timers, node.services
    return [[*each] for each in (*callbacks, *entities)]
