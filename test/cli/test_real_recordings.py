"""Real robots: replays are as accurate as README and docs/benchmark.md say, within 15 %."""

from __future__ import annotations

from contextlib import redirect_stdout
import io

import numpy as np
import pytest

from slam_observer_ros.cli.main import main
from slam_observer_ros.recordings.data_sets import load_plaza


@pytest.fixture(scope='module')
def recordings(data_dir, tmp_path_factory):
    """Starry Night and MRCLAM 6's robot 4, as ``convert`` writes them."""
    folder = tmp_path_factory.mktemp('real')
    starry_night, robot = folder / 'starry_night.mcap', folder / 'robot4.mcap'
    with redirect_stdout(io.StringIO()) as output:
        source = data_dir / 'starry_night' / 'dataset3.mat'
        assert main(['convert', 'starry-night', str(source), str(starry_night)]) == 0
        assert '1900' in output.getvalue()
        source = data_dir / 'mrclam' / 'MRCLAM_Dataset6'
        assert main(['convert', 'mrclam', str(source), '--robot', '4', str(robot)]) == 0
        assert 'left out: misread' in output.getvalue()
    return {'stereo_inertial': starry_night, 'mrclam': robot}


def replayed(slam_observer, recordings, config, gains):
    """Replay the recording that a configuration is for; return the report."""
    options = ['--config', config, '--gains', gains, '--json']
    options += ['--smooth'] if gains == 'riccati' else []
    ended = slam_observer('replay', recordings[config], *options)
    assert ended.code == 0
    return ended.json


@pytest.mark.parametrize(
    ('gains', 'ate_m', 'configuration_m'),
    [
        ('constant', 0.081, 0.053),
        ('riccati', 0.041, 0.034),
    ],
)
def test_starry_night(slam_observer, recordings, gains, ate_m, configuration_m):
    report = replayed(slam_observer, recordings, 'stereo_inertial', gains)
    assert report['dead_reckoning_ate_rmse_m'] == pytest.approx(0.83, abs=0.01)
    assert report['landmarks'] == 20
    assert report['ate_rmse_m'] < 1.15 * ate_m
    assert report['configuration_rmse_m'] < 1.15 * configuration_m
    if gains == 'riccati':
        assert report['smoothed_ate_rmse_m'] < 0.6 * report['ate_rmse_m']


@pytest.mark.parametrize(
    ('gains', 'ate_m', 'configuration_m'),
    [
        ('constant', 0.660, 1.027),
        # Of this robot it hangs on how it comes out of 78 s without a landmark.
        ('riccati', 0.267, 0.332),
    ],
)
def test_mrclam(slam_observer, recordings, gains, ate_m, configuration_m):
    """The tables have ATE of all of the path for the mean of five robots only."""
    report = replayed(slam_observer, recordings, 'mrclam', gains)
    assert report['landmarks'] == 15
    assert report['ate_rmse_m'] < 1.15 * ate_m
    assert report['configuration_rmse_m'] < 1.15 * configuration_m
    if gains == 'riccati':
        # Over all poses, also those of 78 s without a landmark, where odometry alone leads.
        assert report['smoothed_ate_rmse_m'] < 0.85 * report['ate_rmse_m']


def test_plaza_by_surveyed_radios_whose_ranges_are_long(slam_observer, data_dir, tmp_path):
    source, out = data_dir / 'plaza', tmp_path / 'plaza.mcap'
    if not source.is_dir():
        pytest.skip('no recordings of Plaza')
    slam_observer.succeed('convert', 'plaza', source, out, '--run', 2)
    start = load_plaza(source, 2).true_poses[0]
    x, y, yaw = start[0, 3], start[1, 3], np.arctan2(start[1, 0], start[0, 0])
    placed = 'set_initial_pose=true', f'initial_pose=[{x},{y},0,0,0,{yaw}]'
    settings = [word for setting in placed for word in ('--set', setting)]
    survey = out.with_suffix('.yaml')
    options = ('--config', 'uwb', '--load-map', survey, '--json', *settings)
    report = slam_observer('replay', out, *options).json
    assert report['ate_rmse_m'] < 0.42
    assert 'range_scale' in [finding['kind'] for finding in report['findings']]
