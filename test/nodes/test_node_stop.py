"""Nodes start and stop as a launch system expects: exit code 0, no traceback."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
import re
import signal
import time

from geometry_msgs.msg import TwistStamped
from node_processes import client, NodeProcess
import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2

from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.nodes.ros_node import MESSAGES

pytestmark = pytest.mark.ros

SLOW_NODE = """\
import sys
import time
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.nodes.executables import observer_node

associate, seen = Hypotheses.associate, []

def slow(self, event):
    seen.append(event)
    if len(seen) == 6:
        print('computing', flush=True)
        end_s = time.monotonic() + 60.0
        while time.monotonic() < end_s:
            pass
    return associate(self, event)

Hypotheses.associate = slow
sys.exit(observer_node())
"""

READY = {'observer_node': 'estimating', 'simulator_node': 'waiting|starts'}
CASES = {
    'interrupt observer': ('observer_node', signal.SIGINT),
    'terminate observer': ('observer_node', signal.SIGTERM),
    'interrupt observer twice': ('observer_node', signal.SIGINT, signal.SIGINT),
    'hang up observer': ('observer_node', signal.SIGHUP),
    'interrupt simulator': ('simulator_node', signal.SIGINT),
    'insist on simulator': ('simulator_node', signal.SIGTERM, signal.SIGINT, signal.SIGTERM),
}


@contextmanager
def hang_up(handler):
    """Start processes that do this on SIGHUP, unless they want something else."""
    before = signal.signal(signal.SIGHUP, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.fixture
def ros(ros_domain_id):
    """Give a client that has not heard of nodes which ended without a word."""
    with client() as opened:
        yield opened


@pytest.fixture(scope='module')
def processes(tmp_path_factory):
    """Start all nodes at once: each takes a second to start."""
    folder = tmp_path_factory.mktemp('logs')
    with hang_up(signal.SIG_DFL):  # also where nohup has started the tests
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


def test_a_signal_while_the_interpreter_clears_up_does_not_end_it(tmp_path):
    """Python gives signals back to the system then, which ends the process by the next one."""
    program = tmp_path / 'program.py'
    program.write_text(
        'import signal, sys\n'
        'from slam_observer_ros.nodes.executables import observer_node\n'
        'code = observer_node()\n'
        'print([signal.getsignal(n) == signal.SIG_IGN for n in (signal.SIGINT, signal.SIGTERM)])\n'
        'sys.exit(code)\n'
    )
    node = NodeProcess('observer_node', tmp_path / 'log', program=program)
    node.wait_for_output('estimating')
    assert node.stop() == 0, node.output
    assert '[True, True]' in node.output


@pytest.mark.parametrize('autosave', [False, True])
def test_a_signal_within_a_long_observation_stops_a_node_in_time_with_its_map(
    ros, tmp_path, autosave
):
    """The child's estimator takes a minute for the sixth observation."""
    path = tmp_path / 'map.yaml'
    program = tmp_path / 'program.py'
    program.write_text(SLOW_NODE)
    node = NodeProcess(
        'observer_node', tmp_path / 'log', program=program,
        map_path=path, autosave_map=autosave, reorder_window=0.0, velocity_timeout=100.0,
    )  # fmt: skip
    try:
        twist = ros.node.create_publisher(TwistStamped, '/twist', 10)
        landmarks = ros.node.create_publisher(PointCloud2, '/landmarks', 10)
        ros.wait_for_subscriber(twist, landmarks)
        for _ in range(6):
            stamp_ns = time.time_ns()
            twist.publish(MESSAGES.twist_stamped(stamp_ns, 'base_link', np.zeros(6)))
            points = np.eye(4, 3) + 2.0
            landmarks.publish(MESSAGES.point_cloud2(stamp_ns, 'base_link', np.arange(4), points))
            ros.spin_for(0.3)
        node.wait_for_output('computing')
        asked_s = time.monotonic()
        assert node.stop(signal.SIGINT) == 0
        assert time.monotonic() - asked_s < 20.0  # of sixty, on the busiest machine
    finally:
        node.process.kill()
        node.process.wait()
    assert 'stopped within an observation' in node.output
    assert path.exists() == autosave
    if autosave:
        assert len(read_map(path).ids) == 4


def test_a_node_that_is_to_outlive_its_terminal_does(tmp_path):
    with hang_up(signal.SIG_IGN):
        node = NodeProcess('observer_node', tmp_path / 'log')
    node.wait_for_output('estimating')
    status = Path(f'/proc/{node.process.pid}/status').read_text()
    ignored = int(re.search(r'^SigIgn:\s*(\w+)$', status, re.MULTILINE)[1], 16)
    assert ignored & 1 << signal.SIGHUP - 1
    assert node.stop(signal.SIGHUP, signal.SIGTERM) == 0


def test_a_node_says_how_it_is_used(tmp_path):
    node = NodeProcess('observer_node', tmp_path / 'log', '--', '--help')
    assert node.process.wait(timeout=20.0) == 0
    assert node.output.startswith('usage: ros2 run slam_observer_ros')
