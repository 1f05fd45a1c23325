"""Nodes start and stop as a launch system expects: exit code 0, no traceback."""

from __future__ import annotations

import signal

from node_processes import NodeProcess
import pytest

pytestmark = pytest.mark.ros

READY = {'observer_node': 'estimating', 'simulator_node': 'waiting|starts'}
CASES = {
    'interrupt observer': ('observer_node', signal.SIGINT),
    'terminate observer': ('observer_node', signal.SIGTERM),
    'interrupt observer twice': ('observer_node', signal.SIGINT, signal.SIGINT),
    'interrupt simulator': ('simulator_node', signal.SIGINT),
    'insist on simulator': ('simulator_node', signal.SIGTERM, signal.SIGINT, signal.SIGTERM),
}


@pytest.fixture(scope='module')
def processes(tmp_path_factory):
    """Start all nodes at once: each takes a second to start."""
    folder = tmp_path_factory.mktemp('logs')
    started = {case: NodeProcess(CASES[case][0], folder / case) for case in CASES}
    yield started
    for node in started.values():
        node.process.kill()
        node.process.wait()


@pytest.mark.parametrize('case', CASES)
def test_signals_stop_a_node_cleanly(processes, case):
    name, *signals = CASES[case]
    node = processes[case]
    node.wait_for_output(READY[name])

    code = node.stop(*signals)

    assert code == 0, node.output
    assert 'Traceback' not in node.output


def test_a_node_says_how_it_is_used(tmp_path):
    node = NodeProcess('observer_node', tmp_path / 'log', '--', '--help')
    assert node.process.wait(timeout=20.0) == 0
    assert node.output.startswith('usage: ros2 run slam_observer_ros')
