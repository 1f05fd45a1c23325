"""The demo: both nodes as real processes until the observer has converged."""

from __future__ import annotations

from contextlib import suppress
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
from types import SimpleNamespace

from demo_report import report
from geometry_msgs.msg import Twist
from node_processes import client
import numpy as np
import pytest
from rich.console import Console
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.recordings.trajectory import Trajectory
from slam_observer_ros.simulation import Scenario, Simulation

pytestmark = pytest.mark.ros

DEMO = Path(__file__).resolve().parents[2] / 'demo' / 'demo.py'

FILES = {
    'configuration.png',
    'lyapunov.png',
    'observer_node.log',
    'recording.mcap',
    'simulator_node.log',
}


def run_demo(folder, *options):
    """Return exit code and output of a demo; it and its nodes end, whatever happens."""
    command = [sys.executable, str(DEMO), '--output', str(folder)]
    with subprocess.Popen(
        [*command, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            output, _ = process.communicate(timeout=100)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, output


def _summary(output, name):
    return float(re.search(rf'{name} +│ (\S+)', output)[1])


def test_demo_converges_and_leaves_figures_and_a_recording(tmp_path):
    (tmp_path / 'run_1').mkdir()
    # No faster than people run it: where velocities come long before landmarks, L seems to lag.
    code, output = run_demo(tmp_path, '--duration', '62')
    assert code == 0, output
    assert _summary(output, 'log10 L at 60 s') < -10.0
    assert _summary(output, 'slope of log10 L') == pytest.approx(-0.217, abs=0.005)
    assert list((tmp_path / 'run_1').iterdir()) == [], 'an earlier run was overwritten'
    folder = tmp_path / 'run_2'
    assert {path.name for path in folder.iterdir()} == FILES
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([folder / 'recording.mcap'], default_typestore=typestore) as recording:
        counts = {topic: info.msgcount for topic, info in recording.topics.items()}
    assert counts['/twist'] == counts['/landmarks'] == counts['/ground_truth/pose'] == 1241
    assert min(counts['/observer_node/odometry'], counts['/lyapunov']) > 100
    assert {'/landmark_map', '/markers', '/path', '/diagnostics', '/landmark_estimates'} <= set(
        counts
    )


def test_report_of_a_run_without_convergence_is_negative(tmp_path):
    stamps_ns = np.arange(100, dtype=np.int64) * 1_000_000_000
    poses = Simulation(Scenario()).pose(stamps_ns)
    trajectory = Trajectory(stamps_ns, poses)
    listener = SimpleNamespace(
        times_s=stamps_ns / 1e9,
        lyapunov=np.full(100, 1e-3).tolist(),
        trajectories=lambda: (trajectory, trajectory),
        landmark_tracks=lambda stamps: np.ones((len(stamps), 4, 3)) * np.arange(4)[:, None],
        true_landmarks=lambda: np.ones((4, 3)) * np.arange(4)[:, None],
    )
    console = Console(record=True)
    assert not report(listener, tmp_path, console)
    assert 'did NOT converge' in console.export_text()


def test_report_of_a_run_without_estimates_is_negative(tmp_path):
    listener = SimpleNamespace(times_s=np.zeros(0), lyapunov=[])
    assert not report(listener, tmp_path, Console(record=True))


def test_demo_does_not_mix_with_other_nodes(ros_domain_id, tmp_path):
    with client() as other:
        other.node.create_publisher(Twist, 'twist', 1)
        code, output = run_demo(tmp_path)
    assert code == 1
    assert 'set ROS_DOMAIN_ID' in output
