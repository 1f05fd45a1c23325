"""What a replay writes: trajectory and map, smoothed or not, and what it replaces."""

from __future__ import annotations

import os
from pathlib import Path
import re
import resource

import numpy as np
import pytest
import recordings
from tum_files import read_tum
import yaml

from slam_observer_ros.runs.metrics import trajectory_errors


class TestOutputs:
    def test_trajectory_and_map(self, slam_observer, simulated, tmp_path):
        tum, landmarks = tmp_path / 'run.tum', tmp_path / 'map.yaml'
        slam_observer.succeed('replay', simulated, '--tum', tum, '--map', landmarks)
        trajectory = read_tum(tum)
        assert len(trajectory) == 84  # 20 Hz at most, of stamps every 20 ms: every 60 ms
        assert np.diff(trajectory.stamps_ns).min() >= 50_000_000
        content = yaml.safe_load(landmarks.read_text())
        assert (content['version'], content['frame']) == (1, 'map')
        assert [landmark['id'] for landmark in content['landmarks']] == [0, 1, 2, 3]
        assert all(len(landmark['position']) == 3 for landmark in content['landmarks'])
        assert content['landmarks'][0]['observations'] == 251

    def test_the_life_of_a_landmark_is_explained(self, slam_observer, simulated):
        """When it was new, and what came of each observation of it."""
        printed = slam_observer.succeed('replay', simulated, '--explain', 2).output
        assert re.search(r'landmark 2 *\n', printed)
        assert re.search(r'0\.000  new in the map', printed)
        (first, *others) = slam_observer.succeed(
            'replay', simulated, '--explain', 2, '--json'
        ).json['landmark']['life']
        assert (first['what'], first['sigmas']) == ('new in the map', None)
        assert len(others) == 250
        assert {other['what'].split(' with')[0] for other in others} == {'used'}
        assert all(other['sigmas'] > 0.0 for other in others)

    def test_a_landmark_that_was_never_seen_is_named_after_all_is_written(
        self, slam_observer, simulated, tmp_path
    ):
        refused = slam_observer(
            'replay', simulated, '--explain', 99, '--tum', tmp_path / 'run.tum'
        )
        assert refused.code == 2
        assert '--explain: no point had the id 99; there are 0, 1, 2, 3' in refused.errors
        assert len(read_tum(tmp_path / 'run.tum')) == 84

    def test_people_read_degrees_and_programs_radians(self, slam_observer, simulated):
        figures = slam_observer.succeed('replay', simulated, '--json').json
        (row,) = (
            line for line in slam_observer.succeed('replay', simulated).output.splitlines()
            if 'heading error' in line
        )  # fmt: skip
        printed = float(re.search(r'([\d.e-]+) °', row).group(1))
        assert printed == pytest.approx(np.degrees(figures['heading_rmse_rad']), rel=1e-2)

    def test_map_states_what_the_gains_know_of_its_accuracy(
        self, slam_observer, simulated, tmp_path
    ):
        for gains in ('constant', 'riccati'):
            path = tmp_path / f'{gains}.yaml'
            slam_observer.succeed('replay', simulated, '--gains', gains, '--map', path)
            landmark = yaml.safe_load(path.read_text())['landmarks'][0]
            if gains == 'constant':
                assert 'covariance' not in landmark
            else:
                assert np.linalg.eigvalsh(landmark['covariance']).min() > 0.0

    def test_nothing_is_overwritten_but_by_force(self, slam_observer, simulated, tmp_path):
        for option, name in (('--tum', 'a.tum'), ('--map', 'a.yaml'), ('--report', 'a.html')):
            path = tmp_path / name
            path.write_text('mine')
            assert '--force' in slam_observer.fail('replay', simulated, option, path)
            assert path.read_text() == 'mine'
            slam_observer.succeed('replay', simulated, option, path, '--force')
            assert b'mine' not in path.read_bytes()[:4]

    def test_what_is_read_is_not_replaced_even_by_force(
        self, slam_observer, simulated, tmp_path, monkeypatch
    ):
        config, landmarks = tmp_path / 'robot.yaml', tmp_path / 'map.yaml'
        config.write_text('/**: {ros__parameters: {gains: constant}}')
        slam_observer.succeed('replay', simulated, '--map', landmarks)
        before = [path.read_bytes() for path in (simulated, config, landmarks)]
        monkeypatch.chdir(tmp_path)
        arguments = ('replay', simulated, '--config', config, '--load-map', landmarks, '--force')
        for option, name, what in (
            ('--tum', simulated.name, str(simulated)),
            ('--map', simulated, str(simulated)),
            ('--tum', config, '--config'),
            ('--map', config, '--config'),
            ('--tum', landmarks, '--load-map'),
        ):
            error = slam_observer.fail(*arguments, option, name)
            assert f'{option} {name} would replace' in error
            assert what in error
        assert [path.read_bytes() for path in (simulated, config, landmarks)] == before
        assert slam_observer(*arguments, '--map', landmarks).code == 0

    def test_files_of_a_recorded_directory_are_not_replaced_but_others_in_it_are(
        self, slam_observer, run_in_every_format
    ):
        directory = run_in_every_format['sqlite3 directory']
        for file in directory.iterdir():
            before = file.read_bytes()
            assert str(directory) in slam_observer.fail(
                'replay', directory, '--force', '--map', file
            )
            assert file.read_bytes() == before
        slam_observer.succeed('replay', directory, '--force', '--tum', directory / 'run.tum')
        slam_observer.succeed('replay', directory, '--force', '--tum', directory / 'run.tum')

    def test_what_can_not_be_written_loses_nothing_else(self, slam_observer, simulated, tmp_path):
        too_long, landmarks = tmp_path / ('x' * 254), tmp_path / 'map.yaml'
        arguments = ('replay', simulated, '--tum', too_long, '--map', landmarks)
        ended = slam_observer(*arguments)
        assert ended.code == 2
        assert ended.errors.startswith('slam-observer: error: ')
        assert 'name too long' in ended.errors.lower()
        assert ended.errors.count('\n') == 1
        assert landmarks.exists()
        assert '(ATE)' in ended.output
        assert 'trajectory' not in ended.output

    def test_links_stay_links_to_what_is_written(self, slam_observer, simulated, tmp_path):
        elsewhere = tmp_path / 'elsewhere'
        elsewhere.mkdir()
        names = 'a.tum', 'map.yaml', 'run.html'
        for name in names:
            (elsewhere / name).write_text('older')
            (tmp_path / name).symlink_to(elsewhere / name)
        slam_observer.succeed(
            'replay', simulated, '--force', '--tum', tmp_path / 'a.tum',
            '--map', tmp_path / 'map.yaml', '--report', tmp_path / 'run.html',
        )  # fmt: skip
        for name in names:
            assert (tmp_path / name).is_symlink()
            assert (elsewhere / name).read_bytes() != b'older'
        assert len(list(elsewhere.iterdir())) == 3

    @pytest.mark.parametrize('option', ['--tum', '--map', '--report'])
    def test_what_is_no_file_is_not_replaced_even_by_force(
        self, slam_observer, simulated, tmp_path, option
    ):
        pipe = tmp_path / 'pipe'
        os.mkfifo(pipe)
        error = slam_observer.fail('replay', simulated, '--force', option, pipe)
        assert f'{pipe} is there, and no regular file' in error
        assert pipe.is_fifo()

    def test_two_names_of_one_file_are_not_two_outputs(self, slam_observer, simulated, tmp_path):
        (tmp_path / 'link').symlink_to(tmp_path / 'map.yaml')
        outputs = ('--tum', tmp_path / 'link', '--map', tmp_path / 'map.yaml')
        assert 'two outputs' in slam_observer.fail('replay', simulated, *outputs)

    @pytest.mark.parametrize('name', ['run.tum', 'run.html', 'run.mcap'])
    def test_on_a_full_disk_the_older_file_stays(self, slam_observer, simulated, tmp_path, name):
        option = {'.html': '--report'}.get(Path(name).suffix, f'--{name[4:]}')
        (tmp_path / name).write_text('older')
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
        try:
            ended = slam_observer('replay', simulated, '--force', option, tmp_path / name)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        said = f"slam-observer: error: can't write {tmp_path / name}: File too large\n"
        assert (ended.code, ended.errors) == (2, said)
        assert [file.read_text() for file in tmp_path.glob('*run*')] == ['older']

    @pytest.mark.parametrize('option', ['--tum', '--map', '--report'])
    def test_where_nothing_may_be_written_is_reported_before_the_work(
        self, slam_observer, simulated, tmp_path, option, monkeypatch
    ):
        monkeypatch.setattr(os, 'access', lambda *_: False)  # root may write anywhere
        ended = slam_observer('replay', simulated, option, tmp_path / 'new')
        assert (ended.code, ended.output) == (2, '')
        assert f'nothing may be written to {tmp_path}' in ended.errors


class TestTrajectoryOfATopic:
    """What ``convert tum`` writes, for evo to compare with what ``replay --tum`` writes."""

    def test_the_truth_gives_the_error_that_replay_prints(
        self, slam_observer, simulated, tmp_path
    ):
        truth, run = tmp_path / 'truth.tum', tmp_path / 'run.tum'
        found = slam_observer.succeed('replay', simulated, '--tum', run, '--json').json
        written = slam_observer.succeed('convert', 'tum', simulated, truth)
        assert '/ground_truth/pose' in written.output
        errors = trajectory_errors(read_tum(run), read_tum(truth))
        assert errors.ate_rmse_m == pytest.approx(found['ate_rmse_m'], abs=1e-12)
        assert 'exists already' in slam_observer.fail('convert', 'tum', simulated, truth)

    def test_any_topic_of_poses_can_be_named(self, slam_observer, simulated, tmp_path):
        run, estimate = tmp_path / 'run.mcap', tmp_path / 'estimate.tum'
        slam_observer.succeed('replay', simulated, '--mcap', run)
        topic = ('--topic', 'observer_node/odometry')
        slam_observer.succeed('convert', 'tum', run, estimate, *topic)
        assert len(read_tum(estimate)) > 100

    def test_what_has_no_poses_is_refused(self, slam_observer, simulated, tmp_path):
        words = ('convert', 'tum', simulated, tmp_path / 'a.tum')
        refused = slam_observer.fail(*words, '--topic', '/landmarks')
        assert '/landmarks' in refused
        assert 'geometry_msgs/msg/PoseStamped' in refused
        assert '/ground_truth/pose' in slam_observer.fail(*words, '--topic', '/nothing')
        without_truth = recordings.write_events(tmp_path / 'run.mcap', recordings.events())
        refused = slam_observer.fail('convert', 'tum', without_truth, tmp_path / 'a.tum')
        assert 'no true pose topic' in refused
        assert '--topic names another' in refused
        assert not (tmp_path / 'a.tum').exists()


class TestSmoothing:
    def test_outputs_are_of_the_smoothed_trajectory_and_map(
        self, slam_observer, simulated, tmp_path
    ):
        online_tum = tmp_path / 'online.tum'
        online = slam_observer.succeed(
            'replay', simulated, '--gains', 'riccati', '--json', '--tum', online_tum
        ).json
        tum, landmarks = tmp_path / 'a.tum', tmp_path / 'a.yaml'
        report = slam_observer.succeed(
            'replay', simulated, '--gains', 'riccati', '--json', '--smooth',
            '--tum', tum, '--map', landmarks,
        ).json  # fmt: skip
        assert report['ate_rmse_m'] == online['ate_rmse_m']
        assert report['smoothed_ate_rmse_m'] < online['ate_rmse_m']
        assert report['smoothed_landmark_rmse_m'] is not None
        assert report['unsmoothed_ate_rmse_m'] == online['ate_rmse_m']
        # At the same stamps, also where nothing is seen.
        np.testing.assert_array_equal(read_tum(tum).stamps_ns, read_tum(online_tum).stamps_ns)
        assert len(yaml.safe_load(landmarks.read_text())['landmarks']) == 4

    def test_gains_without_a_history_can_not_smooth(self, slam_observer, simulated):
        error = slam_observer.fail('replay', simulated, '--smooth', '--gains', 'constant')
        assert 'riccati' in error

    def test_history_that_is_cut_short_is_reported(self, slam_observer, simulated):
        ended = slam_observer(
            'replay', simulated, '--smooth', '--gains', 'riccati',
            '--set', 'relinearization_angle=0', '--set', 'relinearization_interval=10',
            '--set', 'smoothing_window=20',
        )  # fmt: skip
        assert ended.code == 0
        assert 'of the part that is smoothed, online' in ended.output
        assert 'smoothing_window=0' in ended.errors

    def test_all_of_a_long_recording_is_smoothed(self, slam_observer, simulated):
        """No window cuts it short, as the node's does: 0 stands for all observations."""
        words = ('replay', simulated, '--smooth', '--gains', 'riccati', '--json')
        assert slam_observer.succeed(*words).json['settings']['smoothing_window'] == 0

    def test_messages_without_any_point_cut_no_history_short(self, slam_observer, tmp_path):
        path = recordings.write_events(
            tmp_path / 'blind.mcap', recordings.blinded(recordings.events(), slice(20, 40))
        )
        ended = slam_observer.succeed('replay', path, '--smooth', '--gains', 'riccati')
        assert 'history' not in ended.errors

    def test_where_no_point_is_seen_nothing_is_smoothed(self, slam_observer, tmp_path):
        path = recordings.write_events(
            tmp_path / 'blind.mcap', recordings.blinded(recordings.events(), slice(None))
        )
        tum = tmp_path / 'a.tum'
        error = slam_observer.fail('replay', path, '--smooth', '--gains', 'riccati', '--tum', tum)
        assert 'no observation was used (dropped: 50 without a point that is used)' in error
        assert not tum.exists()
