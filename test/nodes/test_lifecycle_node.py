"""The managed node follows the standard transitions; two robots share one machine."""

from __future__ import annotations

import sys
import time
from unittest.mock import MagicMock

from absent_packages import node_without
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from node_processes import NodeProcess, running
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from robots import own_topics, Robot, stamp_ns
from std_srvs.srv import Trigger

from slam_observer_ros.nodes.observer_nodes import LifecycleBond
from slam_observer_ros.nodes.ros_node import TFMessage
from slam_observer_ros.simulation import Scenario

pytestmark = pytest.mark.ros

RUN = Scenario(velocity_rate=40.0, observation_rate=20.0, duration=0.6)


class Manager:
    """What a lifecycle manager does."""

    def __init__(self, ros, name):
        self.ros = ros
        self.name = name

    def change(self, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.ros.call(ChangeState, f'{self.name}/change_state', request).success

    @property
    def state(self):
        request = GetState.Request()
        return self.ros.call(GetState, f'{self.name}/get_state', request).current_state.id


def x_of(odometry):
    return odometry.pose.pose.position.x


def test_managed_node_estimates_only_while_it_is_active(ros, tmp_path):
    odometry = ros.collect(Odometry, '/managed/observer_node/odometry')
    manager = Manager(ros, '/managed/observer_node')
    arguments = ('-r', '__ns:=/managed')
    with running('lifecycle_observer_node', tmp_path / 'log', *arguments) as node:
        assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
        assert 'waiting for its transitions' in node.output
        assert not ros.node.get_publishers_info_by_topic('/managed/observer_node/odometry')
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == State.PRIMARY_STATE_INACTIVE
        with Robot(ros, namespace='/managed', subscribers=False) as robot:
            ros.wait_for_publisher('/managed/observer_node/odometry')
            robot.run(RUN)
            assert not odometry, 'published while inactive'

            assert manager.change(Transition.TRANSITION_ACTIVATE)
            ros.wait_for_subscriber(robot.twist, robot.landmarks)
            robot.run(RUN)
            ros.spin_until(lambda: odometry and x_of(odometry[-1]) > 0.4, 'the estimate')

            assert manager.change(Transition.TRANSITION_DEACTIVATE)
            deactivated_ns = time.time_ns()
            robot.send_zeros()
            assert stamp_ns(odometry[-1]) < deactivated_ns, 'published while inactive again'

            assert manager.change(Transition.TRANSITION_ACTIVATE)
            ros.spin_until(
                lambda: stamp_ns(odometry[-1]) > deactivated_ns or robot.send_zeros(),
                'the estimate',
            )
            # It went on from where it was held, and did not start again.
            again = next(message for message in odometry if stamp_ns(message) > deactivated_ns)
            assert x_of(again) > 0.4

            assert manager.change(Transition.TRANSITION_DEACTIVATE)
            assert manager.change(Transition.TRANSITION_CLEANUP)
            ros.spin_until(
                lambda: (
                    not ros.node.get_publishers_info_by_topic('/managed/observer_node/odometry')
                ),
                'the end of the topics',
            )
            assert manager.change(Transition.TRANSITION_CONFIGURE)
            assert manager.change(Transition.TRANSITION_ACTIVATE)
            started_ns = time.time_ns()
            ros.wait_for_publisher('/managed/observer_node/odometry')
            ros.wait_for_subscriber(robot.twist, robot.landmarks)
            robot.run(RUN)
            ros.spin_until(lambda: stamp_ns(odometry[-1]) > started_ns, 'the estimate')
            first = next(message for message in odometry if stamp_ns(message) > started_ns)
            run_s = (stamp_ns(first) - started_ns) * 1e-9
            assert x_of(first) < min(run_s, RUN.duration) + 0.1, 'it remembers'
        assert manager.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert manager.state == State.PRIMARY_STATE_FINALIZED
        assert 'error' not in node.output.lower()


def test_simulated_time_that_is_set_while_configured_goes_on_after_the_cleanup(ros, tmp_path):
    manager = Manager(ros, '/timed/observer_node')
    value = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    request = SetParameters.Request(parameters=[Parameter(name='use_sim_time', value=value)])

    def listens():
        readers = ros.node.get_subscriptions_info_by_topic('/clock')
        return [reader for reader in readers if reader.node_namespace == '/timed']

    with running('lifecycle_observer_node', tmp_path / 'log', '-r', '__ns:=/timed'):
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        ros.call(SetParameters, '/timed/observer_node/set_parameters', request)
        ros.spin_until(listens, 'its reader of the clock')
        assert manager.change(Transition.TRANSITION_CLEANUP)
        ros.spin_until(
            lambda: not ros.node.get_publishers_info_by_topic('/timed/observer_node/odometry'),
            'the cleanup',
        )
        ros.spin_for(0.5)
        assert listens()
        assert manager.change(Transition.TRANSITION_CONFIGURE)


def test_what_can_not_be_configured_stays_unconfigured_until_it_can(ros, tmp_path):
    manager = Manager(ros, '/mapless/observer_node')
    arguments = ('-r', '__ns:=/mapless')
    log = tmp_path / 'log'
    with running('lifecycle_observer_node', log, *arguments, autosave_map=True) as node:
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
        node.wait_for_output('not configured: .*map_path')
        value = ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value=str(tmp_path / 'map.yaml')
        )
        request = SetParameters.Request(parameters=[Parameter(name='map_path', value=value)])
        ros.call(SetParameters, f'{manager.name}/set_parameters', request)
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == State.PRIMARY_STATE_INACTIVE


def test_a_transition_that_the_state_does_not_allow_is_refused(ros, tmp_path):
    manager = Manager(ros, '/hasty/observer_node')
    with running('lifecycle_observer_node', tmp_path / 'log', '-r', '__ns:=/hasty') as node:
        assert not manager.change(Transition.TRANSITION_ACTIVATE)
        node.wait_for_output('WARN.*transition.*unconfigured')
        assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        assert manager.state == State.PRIMARY_STATE_ACTIVE


def test_two_robots_on_one_machine_do_not_hear_each_other(ros, tmp_path):
    odometry = {
        name: ros.collect(Odometry, f'/{name}/observer_node/odometry')
        for name in ('left', 'right')
    }
    transforms = {
        name: ros.collect(TFMessage, f'/{name}/tf') if TFMessage else [] for name in odometry
    }
    with (
        running('observer_node', tmp_path / 'left', *own_topics('/left'), odom_frame="''"),
        running('observer_node', tmp_path / 'right', *own_topics('/right'), odom_frame="''"),
        Robot(ros, namespace='/left') as left,
        Robot(ros, namespace='/right'),
    ):
        left.run(RUN)
        ros.spin_until(lambda: len(odometry['left']) > 5, 'the estimate')
        ros.call(Trigger, '/right/observer_node/reset', Trigger.Request())
        ros.meet('/left/observer_node')
        last_ns = time.time_ns()
        ros.spin_until(
            lambda: stamp_ns(odometry['left'][-1]) > last_ns or left.send_zeros(), 'a pose since'
        )
        assert x_of(odometry['left'][-1]) > 0.3, "the other robot's reset has reached it"
        assert not odometry['right'] + transforms['right']
        assert len({stamp_ns(message) for message in odometry['left']}) == len(odometry['left'])
        if TFMessage:
            ros.spin_until(lambda: transforms['left'], 'its /tf')


def test_it_activates_itself_if_asked_to(ros, tmp_path):
    odometry = ros.collect(Odometry, '/own_start/observer_node/odometry')
    arguments = ('-r', '__ns:=/own_start')
    with (
        running('lifecycle_observer_node', tmp_path / 'log', *arguments, autostart_node=True),
        Robot(ros, namespace='/own_start') as robot,
    ):
        assert Manager(ros, '/own_start/observer_node').state == State.PRIMARY_STATE_ACTIVE
        robot.run(RUN)
        ros.spin_until(lambda: odometry, 'an estimate')


def test_an_own_start_that_fails_ends_the_process_with_the_reason(tmp_path):
    parameters = {'autostart_node': True, 'map_file': '/no/such/map.yaml'}
    node = NodeProcess('lifecycle_observer_node', tmp_path / 'log', **parameters)
    assert node.wait() == 2
    assert "not configured: can't read map /no/such/map.yaml" in node.output
    assert 'Traceback' not in node.output


def test_a_bond_needs_bondpy(tmp_path):
    parameters = {'autostart_node': True, 'bond_heartbeat_period': 0.25}
    program = node_without(['bondpy'], 'lifecycle_observer_node', tmp_path)
    node = NodeProcess('', tmp_path / 'log', program=program, **parameters)
    assert node.wait() == 2
    assert "'bond_heartbeat_period' needs bondpy: apt install ros-" in node.output


def test_the_bond_lasts_as_long_as_the_node_is_active(monkeypatch):
    bond_class = MagicMock()
    monkeypatch.setitem(sys.modules, 'bondpy', MagicMock())
    monkeypatch.setitem(sys.modules, 'bondpy.bondpy', MagicMock(Bond=bond_class))
    node = MagicMock()
    node.get_name.return_value = 'observer_node'
    bond = LifecycleBond(node, 0.25)
    bond_class.assert_not_called()
    bond.start()
    bond_class.assert_called_once_with(topic='bond', id='observer_node', node=node)
    bond_class.return_value.set_heartbeat_period.assert_called_once_with(0.25)
    bond.end()
    bond_class.return_value.shutdown.assert_called_once_with()


def test_without_a_period_there_is_no_bond():
    node = MagicMock()
    bond = LifecycleBond(node, 0.0)
    bond.start()
    bond.end()
    node.create_publisher.assert_not_called()
