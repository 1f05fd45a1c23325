"""The style checks of a ROS workspace, on what is installed; `make lint` reads the rest, too."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PATHS = [
    str(CHECKOUT / name)
    for name in ('slam_observer_ros', 'demo', 'launch', 'setup.py')
    if (CHECKOUT / name).exists()
]


def check(module, *arguments):
    """Run a check in a process of its own: it forks, which one that had ROS nodes must not."""
    pytest.importorskip(module)
    command = [sys.executable, '-m', f'{module}.main', *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.linter
def test_ament_flake8_is_content():
    check('ament_flake8', '--config', str(CHECKOUT / 'setup.cfg'), *PATHS)


@pytest.mark.linter
def test_ament_pep257_is_content():
    # Summaries stand on the first line (not D213), properties are named by nouns (not D401),
    # and a parameter whose name says it all is not described (not D417).
    check('ament_pep257', '--add-ignore', 'D213', 'D401', 'D417', '--', *PATHS)
