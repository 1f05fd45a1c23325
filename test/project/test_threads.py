"""Programs compute in one thread, unless whoever starts them wants more."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import threadpoolctl

from slam_observer_ros.common.process import CHOICES
from slam_observer_ros.estimator import estimator  # noqa: F401  # loads what computes in threads

NODE = """
import sys
sys.argv = ['observer_node', '--help']
from slam_observer_ros.nodes.executables import observer_node
observer_node()
"""
COMMAND = """
from slam_observer_ros.cli.main import main
main(['replay', 'nothing.mcap'])
"""
LIBRARY = """
import slam_observer_ros.estimator.estimator
"""
PROGRAM = """
from slam_observer_ros.common.process import use_one_thread
use_one_thread()
from slam_observer_ros import Estimator
"""
COUNT = """
import json, threadpoolctl
print(json.dumps([pool['num_threads'] for pool in threadpoolctl.threadpool_info()]))
"""


def threads_of(program, **choice):
    environment = {name: value for name, value in os.environ.items() if name not in CHOICES}
    done = subprocess.run(
        [sys.executable, '-c', program + COUNT],
        env={**environment, **choice},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize('program', [COMMAND, PROGRAM, pytest.param(NODE, marks=pytest.mark.ros)])
def test_programs_compute_in_one_thread(program):
    assert set(threads_of(program)) == {1}


@pytest.mark.parametrize('program', [COMMAND, pytest.param(NODE, marks=pytest.mark.ros)])
def test_the_environment_has_the_last_word(program):
    assert threads_of(program, OMP_NUM_THREADS='2') == threads_of(LIBRARY, OMP_NUM_THREADS='2')


def test_the_tests_compute_in_one_thread():
    """As many workers as cores with a thread a core each wait for each other most of the time."""
    if any(os.environ.get(name, '1') != '1' for name in CHOICES):
        pytest.skip('the environment says otherwise')
    assert {pool['num_threads'] for pool in threadpoolctl.threadpool_info()} == {1}
