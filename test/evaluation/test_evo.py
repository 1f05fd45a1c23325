"""evo reads what a replay writes, and finds the same error; it is run as the program it is."""

from __future__ import annotations

import json
from pathlib import Path
import re
import subprocess
import sys
import zipfile

from command_line import CommandLine
import pytest

SAMPLE = Path(__file__).resolve().parents[2] / 'samples' / 'sample.mcap'
SAME_STAMPS = ('--sync_method', 'interpolation', '--t_max_diff', '0.25')
"""As a replay compares: with the truth in between its samples, half a second apart at most."""


@pytest.fixture(name='run_evo')
def fixture_run_evo(tmp_path, monkeypatch):
    """Return what runs a program of evo in an empty folder, and returns what it prints."""
    monkeypatch.setenv('HOME', str(tmp_path / 'home'))  # where evo keeps settings
    (tmp_path / 'home').mkdir()

    def run(program, *arguments):
        command = Path(sys.executable).with_name(program)
        if not command.exists():
            pytest.skip('evo is not installed: it needs Python 3.11')
        words = [str(command), *map(str, arguments)]
        return subprocess.run(
            words, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=100
        ).stdout

    return run


@pytest.fixture(name='figures')
def fixture_figures(capsys, tmp_path):
    arguments = ('--tum', tmp_path / 'run.tum', '--mcap', tmp_path / 'run.mcap', '--json')
    return CommandLine(capsys).succeed('replay', SAMPLE, *arguments).json


def rmse_m(run_evo, tmp_path, *arguments):
    results = tmp_path / 'results.zip'
    results.unlink(missing_ok=True)
    run_evo('evo_ape', *arguments, '--align', *SAME_STAMPS, '--save_results', results)
    with zipfile.ZipFile(results) as opened:
        return json.loads(opened.read('stats.json'))['rmse']


def test_evo_finds_the_same_error_in_a_tum_file(run_evo, figures, tmp_path):
    run_evo('evo_traj', 'mcap', SAMPLE, '/ground_truth/pose', '--save_as_tum')
    found = rmse_m(run_evo, tmp_path, 'tum', 'ground_truth_pose.tum', 'run.tum')
    assert found == pytest.approx(figures['ate_rmse_m'], abs=1e-9)


def test_evo_finds_the_same_error_in_a_recording(run_evo, figures, tmp_path):
    topics = ('/aligned_truth/pose', '/pose')
    found = rmse_m(run_evo, tmp_path, 'mcap', 'run.mcap', *topics)
    assert found == pytest.approx(figures['ate_rmse_m'], abs=1e-9)


def stats(run_evo, tmp_path, program, *arguments):
    """Return what evo finds of the run, beside the truth."""
    results = tmp_path / 'results.zip'
    results.unlink(missing_ok=True)
    files = ('tum', 'ground_truth_pose.tum', 'run.tum')
    run_evo(program, *files, *arguments, *SAME_STAMPS, '--save_results', results)
    with zipfile.ZipFile(results) as opened:
        return json.loads(opened.read('stats.json'))


def test_evo_finds_what_trajectories_are_compared_by(run_evo, figures, capsys, tmp_path):
    run_evo('evo_traj', 'mcap', SAMPLE, '/ground_truth/pose', '--save_as_tum')
    tum = tmp_path / 'run.tum'
    ours = CommandLine(capsys).succeed('compare', SAMPLE, tum, '--json').json['compared'][str(tum)]
    errors = stats(run_evo, tmp_path, 'evo_ape', '--align')
    for name in ('max', 'median', 'std'):
        assert errors[name] == pytest.approx(ours[f'ate_{name}_m'], abs=1e-8), name
    length_m = ours['drift_length_m']
    assert length_m == 10.0
    pieces = ('--delta', length_m, '--delta_unit', 'm', '--all_pairs', '--pairs_from_reference')
    positions = stats(run_evo, tmp_path, 'evo_rpe', *pieces, '-r', 'trans_part')
    assert positions['mean'] / length_m == pytest.approx(ours['drift'], rel=1e-7)
    turns = stats(run_evo, tmp_path, 'evo_rpe', *pieces, '-r', 'angle_rad')
    assert turns['mean'] / length_m == pytest.approx(ours['drift_rad_per_m'], rel=1e-6)
    lengths = run_evo('evo_traj', 'tum', 'run.tum', 'ground_truth_pose.tum', '--full_check')
    found = [float(text) for text in re.findall(r'path length \(m\)\s+([0-9.]+)', lengths)]
    assert ours['path_length_m'] == pytest.approx(found[0], rel=1e-6)


@pytest.mark.parametrize('topic', ['/pose', '/observer_node/odometry', '/aligned_truth/pose'])
def test_evo_reads_the_topics_of_a_recording(run_evo, figures, topic):
    assert 'poses' in run_evo('evo_traj', 'mcap', 'run.mcap', topic)
