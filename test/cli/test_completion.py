"""A shell that asks for completions gets them."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys

import pytest

SEPARATOR = '\013'


def completions(tmp_path: Path, line: str) -> list[str]:
    """Return what a shell is offered after a line, as argcomplete's shell code asks for it."""
    asked = {
        '_ARGCOMPLETE': '1', '_ARGCOMPLETE_IFS': SEPARATOR, 'COMP_LINE': line,
        'COMP_POINT': str(len(line)), '_ARGCOMPLETE_STDOUT_FILENAME': str(tmp_path / 'offered'),
    }  # fmt: skip
    command = [sys.executable, '-m', 'slam_observer_ros.cli.main']
    subprocess.run(
        command, env=os.environ | asked, cwd=tmp_path, check=True, timeout=60, capture_output=True
    )
    offered = (tmp_path / 'offered').read_text().split(SEPARATOR)
    return [name.strip() for name in offered]


@pytest.mark.parametrize(
    ('line', 'expected'),
    [
        ('slam-observer re', 'replay'),
        ('slam-observer replay --ma', '--map'),
        ('slam-observer replay --gains co', 'constant'),
        ('slam-observer replay --set range_n', 'range_noise='),
        ('slam-observer replay --config whe', 'wheeled_bearing_range'),
        ('slam-observer config ste', 'stereo_inertial'),
        ('slam-observer replay my_r', 'my_recording.mcap'),
    ],
)
def test_a_shell_is_offered_what_fits(tmp_path: Path, line: str, expected: str) -> None:
    (tmp_path / 'my_recording.mcap').touch()
    assert expected in completions(tmp_path, line)
