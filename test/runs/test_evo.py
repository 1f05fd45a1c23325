"""evo reads what a replay writes, and finds the same error; it is run as the program it is."""

from __future__ import annotations

from contextlib import redirect_stdout
import json
from pathlib import Path
import re
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from recordings import SAMPLE

from slam_observer_ros.cli.main import main

SAME_STAMPS = ('--sync_method', 'interpolation', '--t_max_diff', '0.25')
"""As a replay compares: with the truth in between its samples, half a second apart at most."""


@pytest.fixture(name='folder', scope='module')
def fixture_folder(tmp_path_factory):
    """Return a folder with a replay of the sample as a TUM file and as a recording."""
    folder = tmp_path_factory.mktemp('evo')
    outputs = ['--tum', folder / 'run.tum', '--mcap', folder / 'run.mcap', '--json']
    with (folder / 'run.json').open('w') as figures, redirect_stdout(figures):
        assert main(['replay', *map(str, (SAMPLE, *outputs))]) == 0
    return folder


@pytest.fixture(name='run_evo')
def fixture_run_evo(folder, tmp_path, monkeypatch):
    """Return what runs a program of evo in that folder, and returns what it prints."""
    monkeypatch.setenv('HOME', str(tmp_path))  # where evo keeps settings

    def run(program, *arguments):
        command = Path(sys.executable).with_name(program)
        if not command.exists():
            pytest.skip('evo is not installed: it needs Python 3.11')
        words = [str(command), *map(str, arguments)]
        return subprocess.run(
            words, cwd=folder, capture_output=True, text=True, check=True, timeout=100
        ).stdout

    return run


@pytest.fixture(name='ours', scope='module')
def fixture_ours(folder):
    """Return what a replay finds, and write the true trajectory for evo."""
    assert main(['convert', 'tum', str(SAMPLE), str(folder / 'truth.tum')]) == 0
    return json.loads((folder / 'run.json').read_text())


def stats(run_evo, folder, program, *arguments):
    """Return what evo finds of a trajectory beside the truth."""
    results = folder / 'results.zip'
    results.unlink(missing_ok=True)
    run_evo(program, *arguments, *SAME_STAMPS, '--save_results', results)
    with zipfile.ZipFile(results) as opened:
        return json.loads(opened.read('stats.json'))


def test_evo_finds_the_same_error_in_a_recording(run_evo, ours, folder):
    topics = ('mcap', 'run.mcap', '/aligned_truth/pose', '/pose')
    found = stats(run_evo, folder, 'evo_ape', *topics, '--align')
    assert found['rmse'] == pytest.approx(ours['ate_rmse_m'], abs=1e-9)


def test_evo_finds_the_same_error_in_the_files_of_replay_and_convert(run_evo, ours, folder):
    found = stats(run_evo, folder, 'evo_ape', 'tum', 'truth.tum', 'run.tum', '--align')
    assert found['rmse'] == pytest.approx(ours['ate_rmse_m'], abs=1e-9)


@pytest.mark.usefixtures('ours')
def test_evo_reads_the_truth_as_the_recording_has_it(run_evo, folder):
    run_evo('evo_traj', 'mcap', SAMPLE, '/ground_truth/pose', '--save_as_tum')
    read, written = (np.loadtxt(folder / f'{name}.tum') for name in ('ground_truth_pose', 'truth'))
    np.testing.assert_allclose(read, written, atol=1e-9)


def test_evo_reads_the_topics_of_a_recording(run_evo):
    topics = ('/pose', '/observer_node/odometry', '/aligned_truth/pose')
    read = run_evo('evo_traj', 'mcap', 'run.mcap', *topics)
    assert all(re.search(f'{topic}\\b[^/]*?[0-9]+ poses', read) for topic in topics), read
