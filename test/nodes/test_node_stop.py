"""Nodes start and stop as a launch system expects: exit code 0, no traceback."""

from __future__ import annotations

from pathlib import Path
import re
import signal

from node_processes import NodeProcess
import pytest

pytestmark = pytest.mark.ros

READY = {'observer_node': 'estimating', 'simulator_node': 'waiting|starts'}
CASES = {
    'interrupt observer': ('observer_node', signal.SIGINT),
    'terminate observer': ('observer_node', signal.SIGTERM),
    'interrupt observer twice': ('observer_node', signal.SIGINT, signal.SIGINT),
    'hang up observer': ('observer_node', signal.SIGHUP),
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


@pytest.mark.parametrize('name', ['observer_node', 'lifecycle_observer_node', 'simulator_node'])
@pytest.mark.parametrize('loaded', ['_multiarray_umath', '_rclpy_pybind11', 'librmw_fastrtps'])
def test_a_signal_while_it_starts_stops_a_node_cleanly(tmp_path, name, loaded):
    node = NodeProcess(name, tmp_path / 'log')
    node.wait_for_library(loaded)
    assert node.stop() == 0, node.output
    assert 'Traceback' not in node.output


def test_a_node_that_is_to_outlive_its_terminal_does(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        node = NodeProcess('observer_node', tmp_path / 'log')
    finally:
        signal.signal(signal.SIGHUP, before)
    node.wait_for_output('estimating')
    status = Path(f'/proc/{node.process.pid}/status').read_text()
    ignored = int(re.search(r'^SigIgn:\s*(\w+)$', status, re.MULTILINE)[1], 16)
    assert ignored & 1 << signal.SIGHUP - 1
    assert node.stop(signal.SIGHUP, signal.SIGTERM) == 0


def test_a_node_says_how_it_is_used(tmp_path):
    node = NodeProcess('observer_node', tmp_path / 'log', '--', '--help')
    assert node.process.wait(timeout=20.0) == 0
    assert node.output.startswith('usage: ros2 run slam_observer_ros')
