"""A robot has rclpy, numpy, scipy and yaml; what only the command line needs is not there."""

from __future__ import annotations

from absent_packages import node_without
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from node_processes import running
import pytest

from slam_observer_ros.cli.main import OPTIONAL_PACKAGES

pytestmark = pytest.mark.ros


@pytest.fixture
def node(tmp_path):
    """Return a function that runs a node in a minimal installation."""

    def run(name, **parameters):
        absent = (*OPTIONAL_PACKAGES, 'threadpoolctl')
        program = node_without(absent, name, tmp_path)
        return running(name, tmp_path / 'log', program=program, **parameters)

    return run


def test_the_observer_starts(node):
    with node('observer_node') as observer:
        observer.wait_for_output("estimating 'base_link'")


def test_the_managed_observer_is_configured(node, ros):
    with node('lifecycle_observer_node') as observer:
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
        assert ros.call(ChangeState, '/observer_node/change_state', request).success
        observer.wait_for_output("estimating 'base_link'")


def test_the_simulator_starts(node):
    with node('simulator_node', wait_for_subscribers=0) as simulator:
        simulator.wait_for_output('the robot starts')
