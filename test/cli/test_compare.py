"""Gains, settings and other tools on one recording, side by side."""

from __future__ import annotations

import math
import re

import pytest
from recordings import SAMPLE, write_beginning, write_mcap

from slam_observer_ros.cli.main import main


def test_gains_files_and_trajectories_are_compared(slam_observer, tmp_path):
    recording, tum = write_mcap(tmp_path / 'run.mcap'), tmp_path / 'other.tum'
    settings, picture = tmp_path / 'mine.yaml', tmp_path / 'overlay.svg'
    settings.write_text('/**:\n  ros__parameters:\n    range_noise: 0.3\n')
    alone = slam_observer.succeed('replay', recording, '--tum', tum, '--json').json
    what = ('riccati', 'constant', settings, tum)
    compared = slam_observer.succeed(
        'compare', recording, *what, '--plot', picture, '--json'
    ).json['compared']
    assert list(compared) == [str(one) for one in what]
    assert compared['riccati']['ate_rmse_m'] == alone['ate_rmse_m']
    assert compared[str(tum)]['ate_rmse_m'] == pytest.approx(alone['ate_rmse_m'], abs=1e-9)
    assert compared[str(tum)]['landmark_rmse_m'] is None
    assert compared['constant']['anees'] is None
    assert all(name in picture.read_text() for name in ('riccati', 'mine.yaml'))
    assert 'exists already' in slam_observer.fail('compare', recording, *what, '--plot', picture)
    table = slam_observer.succeed('compare', recording, 'riccati', 'constant').output
    assert 'constant' in table


@pytest.fixture(name='beginning', scope='module')
def fixture_beginning(tmp_path_factory):
    """The sample's first 20 seconds."""
    return write_beginning(tmp_path_factory.mktemp('sample') / 'sample.mcap', SAMPLE, 20.0)


@pytest.fixture(name='trajectories', scope='module')
def fixture_trajectories(tmp_path_factory):
    """A trajectory of the sample, and its first tenth."""
    folder = tmp_path_factory.mktemp('trajectories')
    whole, short = folder / 'whole.tum', folder / 'first_tenth_of_the_trajectory.tum'
    assert main(['replay', str(SAMPLE), '--gains', 'constant', '--tum', str(whole)]) == 0
    lines = whole.read_text().splitlines(keepends=True)
    short.write_text(''.join(lines[: len(lines) // 10]))
    return whole, short


def test_a_part_of_a_trajectory_is_said_to_be_one(slam_observer, trajectories):
    whole, short = trajectories
    ended = slam_observer('compare', SAMPLE, whole, short, '--json')
    assert ended.code == 0
    assert f'{short} covers 9.9 % of the time of the truth' in ended.errors
    figures = ended.json['compared']
    assert figures[str(short)]['ate_rmse_m'] < figures[str(whole)]['ate_rmse_m']
    assert figures[str(short)]['poses_compared'] == 239
    assert figures[str(short)]['time_compared'] == pytest.approx(0.099, abs=1e-3)
    assert figures[str(whole)]['time_compared'] == pytest.approx(1.0, abs=1e-3)


def test_a_gap_counts_as_no_time(slam_observer, trajectories, tmp_path):
    lines = trajectories[0].read_text().splitlines(keepends=True)
    gap = tmp_path / 'gap.tum'
    gap.write_text(''.join(lines[:600] + lines[1800:]))
    figures = slam_observer.succeed('compare', SAMPLE, gap, '--json').json['compared'][str(gap)]
    assert figures['time_compared'] == pytest.approx(0.5, abs=1e-2)


@pytest.mark.parametrize('width', [60, 80, 200])
def test_names_and_numbers_are_whole_in_any_window(
    slam_observer, beginning, trajectories, monkeypatch, width
):
    monkeypatch.setenv('COLUMNS', str(width))
    whole, short = trajectories
    shown = slam_observer('compare', beginning, 'riccati', 'constant', whole, short).output
    assert max(map(len, shown.splitlines())) <= width
    for name in ('riccati', 'constant', 'whole.tum', short.name[:20]):
        assert name in shown
    found = re.findall(r'heading error, RMS \[°\] *│(.*)│', shown)
    degrees = [float(cell) for line in found for cell in line.split('│')]
    figures = slam_observer('compare', beginning, whole, '--json').json['compared'][str(whole)]
    assert degrees[2] == pytest.approx(math.degrees(figures['heading_rmse_rad']), abs=0.01)


@pytest.mark.parametrize(
    ('content', 'reason'),
    [('1 2 3\n', 'line 1 has not 8 numbers'), ('1 0 0 0 0 0 0 0\n', 'a quaternion is zero')],
)
def test_what_is_no_trajectory_is_refused(slam_observer, tmp_path, content, reason):
    recording, tum = write_mcap(tmp_path / 'run.mcap'), tmp_path / 'other.tum'
    tum.write_text(content)
    assert reason in slam_observer.fail('compare', recording, tum)
    assert 'no parameter file' in slam_observer.fail('compare', recording, 'ricati')
