"""Gains, settings and other tools on one recording, side by side."""

from __future__ import annotations

from command_line import CommandLine
import pytest
from recordings import write_mcap


@pytest.fixture(name='slam_observer')
def fixture_slam_observer(capsys):
    return CommandLine(capsys)


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
    table = slam_observer.succeed('compare', recording, 'riccati', 'scheduled').output
    assert 'scheduled' in table


@pytest.mark.parametrize(
    ('content', 'reason'),
    [('1 2 3\n', 'line 1 has not 8 numbers'), ('1 0 0 0 0 0 0 0\n', 'a quaternion is zero')],
)
def test_what_is_no_trajectory_is_refused(slam_observer, tmp_path, content, reason):
    recording, tum = write_mcap(tmp_path / 'run.mcap'), tmp_path / 'other.tum'
    tum.write_text(content)
    assert reason in slam_observer.fail('compare', recording, tum)
    assert 'no parameter file' in slam_observer.fail('compare', recording, 'ricati')
