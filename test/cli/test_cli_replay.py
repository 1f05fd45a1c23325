"""``slam-observer replay`` and ``convert``: recordings of every kind, and what they hold."""

from __future__ import annotations

from dataclasses import replace
import io
import os
from pathlib import Path
import re
import shutil
import sys

import numpy as np
import pytest
import recordings
import ros_messages as ros
from tum_files import read_tum
import yaml

from slam_observer_ros.cli.main import main
from slam_observer_ros.evaluation.trajectory import PoseTruth
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.recording.writer import RecordingWriter
from slam_observer_ros.simulation import Scenario, Simulation

REPORT_KEYS = {
    'lost', 'recording', 'recording_sha256', 'version', 'settings', 'warnings', 'nis',
    'findings',
    'events', 'duration_s', 'seconds', 'landmarks', 'dropped', 'ate_rmse_m', 'rotation_rmse_rad',
    'heading_rmse_rad', 'landmark_rmse_m', 'configuration_rmse_m', 'anees',
    'dead_reckoning_ate_rmse_m', 'smoothed_ate_rmse_m', 'smoothed_landmark_rmse_m', 'calibration',
    'unsmoothed_ate_rmse_m', 'smoothed_slips', 'motion_factors',
    'localised_after_s', 'unaligned_rmse_m', 'used', 'velocity_topic', 'landmarks_topic',
    'imu_topic', 'gains', 'truth_covered', 'configuration_anees', 'map',
}  # fmt: skip


@pytest.fixture(scope='module')
def simulated_once(tmp_path_factory):
    path = tmp_path_factory.mktemp('simulated') / 'simulated.mcap'
    assert main(['simulate', '--duration', '5', '--output', str(path)]) == 0
    return path


@pytest.fixture
def simulated(simulated_once, tmp_path):
    """A simulated run of five seconds, 50 Hz, with truth."""
    return Path(shutil.copy(simulated_once, tmp_path))


@pytest.fixture(scope='module')
def run_in_every_format(tmp_path_factory):
    return recordings.write_all_formats(tmp_path_factory.mktemp('formats'))


def write_events(path, events, true_poses=()):
    """Write a recording without truth, or with some."""
    with RecordingWriter(path) as writer:
        for event in events:
            if isinstance(event, VelocityEvent):
                writer.write_velocity(event)
            else:
                writer.write_observation(event)
        for truth in true_poses:
            writer.write_pose(truth)
    return path


def nameless(events):
    """Take the ids of all points away."""
    return [
        event
        if isinstance(event, VelocityEvent)
        else ObservationEvent(event.stamp_ns, np.full(len(event.ids), UNKNOWN_ID), event.points)
        for event in events
    ]


def blinded(events, which):
    """Take all points out of some of the events."""
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
    blind = {id(event) for event in events[which]}
    return [
        ObservationEvent(event.stamp_ns, *nothing)
        if isinstance(event, ObservationEvent) and id(event) in blind
        else event
        for event in events
    ]


def without(kind):
    """Return events of which those of a kind can't be used."""
    nowhere = {VelocityEvent: 'body_velocity', ObservationEvent: 'points'}
    return [
        replace(
            event,
            **{nowhere[type(event)]: np.full_like(getattr(event, nowhere[type(event)]), np.nan)},
        )
        if isinstance(event, kind)
        else event
        for event in recordings.events()
    ]


@pytest.mark.parametrize(
    ('kind', 'sentence'),
    [
        (ObservationEvent, 'No observation was used (dropped: 50 without a point that is used)'),
        (VelocityEvent, 'No velocity was used (dropped: 100 not_finite)'),
        ((VelocityEvent, ObservationEvent), 'Nothing was used, neither a velocity nor'),
    ],
)
def test_a_replay_of_which_nothing_was_used_says_so_first(
    slam_observer, tmp_path, monkeypatch, kind, sentence
):
    monkeypatch.setenv('COLUMNS', '200')
    recording = write_events(tmp_path / 'blind.mcap', without(kind))
    ended = slam_observer('replay', recording)
    assert ended.code == 0
    lines = ended.output.splitlines()
    top = next(i for i, line in enumerate(lines) if line.startswith('┌'))
    assert sentence in lines[top + 1]
    ended = slam_observer('replay', recording, '--strict')
    assert ended.code == 3
    assert sentence in ended.errors.splitlines()[-1]
    whole = recordings.write_mcap(tmp_path / 'whole.mcap')
    assert 'was used' not in slam_observer.succeed('replay', whole, '--strict').output


class TestReport:
    def test_what_is_not_finite_is_null_in_json(self, slam_observer, simulated):
        options = ('--set', 'calibration_drift=0.01', '--json')
        report = slam_observer.succeed('replay', simulated, *options, '--gains', 'riccati').json
        assert report['calibration']['angular_bias_z']['stated'] is None

    def test_simulation_against_its_truth(self, slam_observer, simulated):
        report = slam_observer.succeed('replay', simulated, '--json').json
        assert set(report) == REPORT_KEYS
        assert (report['events'], report['landmarks'], report['dropped']) == (502, 4, {})
        assert report['duration_s'] == pytest.approx(5.0)
        assert report['dead_reckoning_ate_rmse_m'] == pytest.approx(0.0, abs=1e-6)
        assert 0.0 < report['landmark_rmse_m'] < 0.5
        assert 0.0 < report['configuration_rmse_m'] < 0.7
        assert report['ate_rmse_m'] < 0.5
        assert report['seconds'] > 0.0

    def test_one_run_one_estimate(self, slam_observer, simulated):
        first, again = (slam_observer('replay', simulated, '--json').json for _ in range(2))
        del first['seconds'], again['seconds']
        assert first == again

    @pytest.mark.parametrize(
        'name', ['mcap file', 'mcap directory', 'sqlite3 file', 'sqlite3 directory', 'ROS 1 bag']
    )
    def test_every_format(self, slam_observer, run_in_every_format, name):
        ended = slam_observer('replay', run_in_every_format[name], '--json')
        assert ended.code == 0
        assert ended.json['events'] == 150
        assert ended.json['landmarks'] == 3

    def test_without_truth_no_accuracy_is_claimed(self, slam_observer, tmp_path):
        path = write_events(tmp_path / 'own.mcap', recordings.events())
        report = slam_observer('replay', path, '--json').json
        unknown = {key for key, value in report.items() if value is None}
        assert unknown == {key for key in REPORT_KEYS if 'rmse' in key} | {
            'anees', 'localised_after_s', 'truth_covered', 'imu_topic', 'map',
            'configuration_anees', 'smoothed_slips',
        }  # fmt: skip
        assert 'no truth to compare with' in slam_observer('replay', path).output

    def test_with_a_truth_all_that_can_be_known_is_reported(self, slam_observer, simulated):
        report = slam_observer.succeed('replay', simulated, '--smooth', '--json').json
        unknown = {key for key, value in report.items() if value is None}
        assert unknown == {'localised_after_s', 'imu_topic', 'unaligned_rmse_m', 'map'}
        assert report['configuration_anees'] > 0.0
        assert report['truth_covered'] == pytest.approx(1.0)

    def test_the_configuration_error_is_that_of_landmarks_where_they_are(
        self, slam_observer, tmp_path
    ):
        path = tmp_path / 'moving.mcap'
        scenario = Scenario(duration=10.0, landmark_speed=0.3, initial_bias=0.0)
        simulation = Simulation(scenario, ros.STAMP_NS)
        with RecordingWriter(path) as writer:
            for delivery in simulation.deliveries():
                event = delivery.event
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(event)
                elif isinstance(event, PoseTruth):
                    writer.write_pose(event)
                    truth = simulation.landmark_truth(event.stamp_ns)
                    writer.write_landmarks(event.stamp_ns, truth)
                else:
                    writer.write_observation(event)
        report = slam_observer('replay', path, '--json').json
        assert report['configuration_rmse_m'] < 0.02

    def test_the_share_of_the_trajectory_that_the_truth_covers_is_reported(
        self, slam_observer, tmp_path
    ):
        half = recordings.true_poses()[:50]
        path = write_events(tmp_path / 'half.mcap', recordings.events(), half)
        output = slam_observer('replay', path).output
        assert re.search(r'truth +│ covers (49|50)\.\d % of the trajectory', output)

    def test_truth_at_another_time_is_no_truth(self, slam_observer, tmp_path):
        early = [
            PoseTruth(1_000_000_000 + index * recordings.STEP_NS, truth.pose)
            for index, truth in enumerate(recordings.true_poses())
        ]
        path = write_events(tmp_path / 'run.mcap', recordings.events(), early)
        ended = slam_observer('replay', path, '--json')
        assert ended.json['ate_rmse_m'] is None
        assert 'slam-observer: warning: The trajectory is not compared' in ended.errors

    def test_what_has_no_stamp_counts_as_of_when_it_was_received(self, slam_observer, tmp_path):
        path = tmp_path / 'zero.mcap'
        with RecordingWriter(path) as writer:
            for event in recordings.events():
                unstamped = replace(event, stamp_ns=0)
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(unstamped, receive_stamp_ns=event.stamp_ns)
                else:
                    writer.write_observation(unstamped, receive_stamp_ns=event.stamp_ns)
            for truth in recordings.true_poses():
                writer.write_pose(truth)
        ended = slam_observer('replay', path, '--json')
        assert ended.errors.count('Stamps are zero on /twist, /landmarks') == 1
        assert ended.json['ate_rmse_m'] < 1e-3

    def test_what_is_not_compared_is_named(self, slam_observer, tmp_path):
        path = tmp_path / 'late.mcap'
        with RecordingWriter(path) as writer:
            for event, truth in zip(
                recordings.events()[1::3], recordings.true_poses()[::2], strict=True
            ):
                writer.write_observation(event)
                writer.write_pose(truth)
            writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.full(6, np.nan)))
        errors = slam_observer('replay', path).errors
        assert 'The dead reckoning is not compared' in errors
        assert 'The trajectory is not compared' not in errors

    def test_summary_names_topics_and_errors(self, slam_observer, simulated):
        output = slam_observer.succeed('replay', simulated).output
        for text in ('/twist', '/landmarks', '502 over 5.0 s', '(ATE)', 'not aligned'):
            assert text in output

    def test_the_velocitys_calibration_is_reported_with_its_uncertainty(
        self, slam_observer, simulated
    ):
        options = (
            '--set',
            'velocity_delay_stddev=0.1',
            '--set',
            'angular_bias_stddev=[0, 0, 0.1]',
        )
        ended = slam_observer.succeed('replay', simulated, *options, '--json')
        calibration = ended.json['calibration']
        assert set(calibration) == {'angular_bias_z', 'velocity_delay'}
        bias, delay = calibration['angular_bias_z'], calibration['velocity_delay']
        assert abs(bias['value']) < 3.0 * bias['deviation'] < 0.3
        assert bias['unit'] == 'rad/s'
        assert delay['deviation'] == pytest.approx(0.1)  # a circle at constant speed does not show
        output = slam_observer.succeed('replay', simulated, *options).output
        assert 'velocity_delay' in output
        assert '±' in output

    def test_what_an_output_has_no_letters_for_is_replaced(
        self, slam_observer, simulated, monkeypatch
    ):
        output = io.TextIOWrapper(io.BytesIO(), encoding='ascii')
        monkeypatch.setattr(sys, 'stdout', output)
        assert main(['replay', str(simulated), '--set', 'velocity_delay_stddev=0.1']) == 0
        assert b'velocity_delay' in output.buffer.getvalue()

    @pytest.mark.parametrize('columns', [24, 60])
    def test_a_narrow_terminal_shortens_nothing(
        self, slam_observer, simulated, monkeypatch, columns
    ):
        monkeypatch.setenv('COLUMNS', str(columns))
        lines = slam_observer('replay', simulated).output.splitlines()
        values = ''.join(line.split('│')[2].strip() for line in lines if line.count('│') == 3)
        assert 'sensor_msgs/msg/PointCloud2' in values
        assert '…' not in values

    def test_without_an_unknown_calibration_none_is_reported(self, slam_observer, simulated):
        unknown = ('angular_bias_stddev=[0, 0, 0]', 'velocity_delay_stddev=0')
        options = ('--set', unknown[0], '--set', unknown[1], '--json')
        assert slam_observer.succeed('replay', simulated, *options).json['calibration'] == {}

    def test_biases_and_the_delay_of_the_velocity_are_reported_unasked(
        self, slam_observer, simulated
    ):
        ended = slam_observer.succeed('replay', simulated, '--json')
        unknown = {*(f'angular_bias_{axis}' for axis in 'xyz'), 'velocity_delay'}
        assert set(ended.json['calibration']) == unknown
        assert unknown <= set(slam_observer.succeed('replay', simulated).output.split())
        constant = slam_observer.succeed('replay', simulated, '--gains', 'constant', '--json')
        assert constant.json['calibration'] == {}
        assert 'No effect' not in constant.errors


class TestPoints:
    """What became of the points that were observed."""

    def test_all_used(self, slam_observer, simulated):
        report = slam_observer.succeed('replay', simulated, '--json').json
        assert report['used'] == {'velocity': 251, 'observation': 251, 'observed_point': 1004}
        assert '1004 used ' in slam_observer.succeed('replay', simulated).output

    def test_a_landmark_that_jumps_is_rejected_and_then_has_moved(self, slam_observer, tmp_path):
        def jumped(event):
            points = event.points + np.array([[0.0, 5.0, 0.0]]) * (event.ids == 5)[:, None]
            return ObservationEvent(event.stamp_ns, event.ids, points)

        events = [
            jumped(event) if isinstance(event, ObservationEvent) and index > 100 else event
            for index, event in enumerate(recordings.events())
        ]
        path = write_events(tmp_path / 'jump.mcap', events)
        used = slam_observer('replay', path, '--gains', 'riccati', '--json').json['used']
        assert used['moved_landmark'] == 1
        rejected = used['rejected_landmark']
        output = slam_observer('replay', path, '--gains', 'riccati').output
        assert f'{150 - rejected} used, {rejected} rejected ({rejected / 1.5:.1f} %)' in output
        assert '3, 1 moved' in output

    @pytest.mark.parametrize('has_ids', [True, False])
    def test_a_robot_that_was_carried_is_in_the_summary(self, slam_observer, tmp_path, has_ids):
        """It stands among four landmarks, and then somewhere else."""
        square = np.array([[2.0, 2.0, 0.0], [-2.0, 2.0, 0.0], [-2.5, -2.0, 0.0], [2.0, -3.0, 0.0]])
        ids = np.arange(4) if has_ids else np.full(4, UNKNOWN_ID)
        events = []
        for step in range(80):
            shift = np.array([0.9, 0.8, 0.0]) if step >= 40 else np.zeros(3)
            events.append(VelocityEvent(step * 10**8, np.zeros(6)))
            events.append(ObservationEvent(step * 10**8, ids, square + shift))
        path = write_events(tmp_path / 'carried.mcap', events)
        options = ('--landmarks-topic', '/landmarks', '--set', 'two_d_mode=True')
        output = slam_observer('replay', path, *options).output
        row = r'slips +│ \d+ × the robot was not where odometry had it'
        if not has_ids:
            row = r'unexpected places +│ \d+ × nothing seen was where the map has it'
        assert re.search(row, output)

    def test_gains_that_use_no_point_without_id_say_so(self, slam_observer, tmp_path):
        path = write_events(tmp_path / 'nameless.mcap', nameless(recordings.events()))
        arguments = ('replay', path, '--landmarks-topic', '/landmarks', '--gains')
        ended = slam_observer(*arguments, 'constant')
        assert '0 used, 150 without id (100.0 %)' in ended.output
        assert (
            'slam-observer: warning: Points without an id are not used by constant gains '
            '(1 so far): only riccati gains use them.\n'
        ) in ended.errors
        assert '150 used' in slam_observer.succeed(*arguments, 'riccati').output


@pytest.mark.parametrize(
    ('message', 'note'),
    [
        (ros.point_cloud(np.ones((1, 3)), {'id': np.ones(1)}), 'messages) '),
        (ros.point_cloud(np.ones((1, 3)), {'ID': np.ones(1)}), 'without ids; channels ID '),
        (ros.point_cloud(np.ones((1, 3)), {}), 'without ids; channels none '),
        (
            ros.point_cloud2(np.ones((1, 1), [(name, '<f4') for name in ('x', 'y', 'z', 'ID')])),
            'without ids; fields x y z ID ',
        ),
        (
            ros.make(
                'geometry_msgs/msg/PoseArray',
                ros.header('base_link'),
                [ros.pose([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])],
            ),
            'without ids ',
        ),
    ],
)
def test_landmarks_without_ids_are_named(slam_observer, tmp_path, message, note):
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.zeros(6)))
        writer.write('/landmarks', message.__msgtype__, ros.serialise(message), ros.STAMP_NS)
    cells = [line.split('│') for line in slam_observer.succeed('replay', path).output.split('\n')]
    cells_text = ' '.join(' '.join(cell[2] for cell in cells if len(cell) > 2).split())
    assert note in cells_text.partition('events')[0] + ' '
    assert ('without ids' in cells_text) == ('without ids' in note)


def test_in_the_plane_the_height_of_landmarks_is_no_error(slam_observer, tmp_path):
    path = recordings.write_mcap(tmp_path / 'run.mcap')
    errors = slam_observer.succeed('replay', path, '--set', 'two_d_mode=true', '--json').json
    assert errors['landmark_rmse_m'] < 1e-3
    assert errors['configuration_rmse_m'] < 1e-3


class TestOutputs:
    def test_trajectory_and_map_and_figures(self, slam_observer, simulated, tmp_path):
        tum, landmarks, figures = tmp_path / 'run.tum', tmp_path / 'map.yaml', tmp_path / 'figures'
        slam_observer.succeed(
            'replay', simulated, '--tum', tum, '--map', landmarks, '--plot', figures
        )
        trajectory = read_tum(tum)
        assert len(trajectory) == 84  # 20 Hz at most, of stamps every 20 ms: every 60 ms
        assert np.diff(trajectory.stamps_ns).min() >= 50_000_000
        content = yaml.safe_load(landmarks.read_text())
        assert (content['version'], content['frame']) == (1, 'map')
        assert [landmark['id'] for landmark in content['landmarks']] == [0, 1, 2, 3]
        assert all(len(landmark['position']) == 3 for landmark in content['landmarks'])
        assert content['landmarks'][0]['observations'] == 251
        assert {path.name for path in figures.iterdir()} == {
            'map.png', 'errors.png', 'residuals.png'
        }  # fmt: skip

    @pytest.mark.parametrize('kind', ['svg', 'pdf'])
    def test_figures_are_of_the_kind_that_is_asked_for(
        self, slam_observer, simulated, tmp_path, kind
    ):
        slam_observer.succeed('replay', simulated, '--plot', tmp_path / 'a', '--plot-format', kind)
        names = {path.name for path in (tmp_path / 'a').iterdir()}
        assert names == {f'{name}.{kind}' for name in ('map', 'errors', 'residuals')}

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
        figures = tmp_path / 'figures'
        figures.mkdir()
        files = {'--tum': tmp_path / 'a.tum', '--map': tmp_path / 'a.yaml', '--plot': figures}
        for option, path in files.items():
            mine = path / 'map.png' if path == figures else path
            mine.write_text('mine')
            assert '--force' in slam_observer.fail('replay', simulated, option, path)
            assert mine.read_text() == 'mine'
            slam_observer.succeed('replay', simulated, option, path, '--force')
            assert b'mine' not in mine.read_bytes()[:4]

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
        names = 'a.tum', 'map.yaml', 'figures/map.png'
        (tmp_path / 'figures').mkdir()
        for name in names:
            (elsewhere / Path(name).name).write_text('older')
            (tmp_path / name).symlink_to(elsewhere / Path(name).name)
        slam_observer.succeed(
            'replay', simulated, '--force', '--tum', tmp_path / 'a.tum',
            '--map', tmp_path / 'map.yaml', '--plot', tmp_path / 'figures',
        )  # fmt: skip
        for name in names:
            assert (tmp_path / name).is_symlink()
            assert b'older' not in (elsewhere / Path(name).name).read_bytes()
        assert len(list(elsewhere.iterdir())) == 3

    @pytest.mark.parametrize('option', ['--tum', '--map', '--plot'])
    def test_what_is_no_file_is_not_replaced_even_by_force(
        self, slam_observer, simulated, tmp_path, option
    ):
        pipe = tmp_path / 'map.png'
        os.mkfifo(pipe)
        path = tmp_path if option == '--plot' else pipe
        error = slam_observer.fail('replay', simulated, '--force', option, path)
        assert f'{pipe} is there, and no regular file' in error
        assert pipe.is_fifo()

    def test_two_names_of_one_file_are_not_two_outputs(self, slam_observer, simulated, tmp_path):
        (tmp_path / 'link').symlink_to(tmp_path / 'map.yaml')
        outputs = ('--tum', tmp_path / 'link', '--map', tmp_path / 'map.yaml')
        assert 'two outputs' in slam_observer.fail('replay', simulated, *outputs)

    def test_figures_that_can_not_be_written_are_named_as_asked_for(
        self, slam_observer, simulated
    ):
        errors = slam_observer('replay', simulated, '--plot', '/proc/figures').errors
        assert "can't write figures to /proc/figures: " in errors
        assert 'unfinished' not in errors

    def test_figures_of_an_earlier_replay_are_not_left_among_the_new_ones(
        self, slam_observer, simulated, tmp_path
    ):
        slam_observer.succeed('replay', simulated, '--plot', tmp_path)
        assert (tmp_path / 'errors.png').exists()
        without_truth = write_events(tmp_path / 'run.mcap', recordings.events())
        slam_observer.succeed('replay', without_truth, '--plot', tmp_path, '--force')
        assert not (tmp_path / 'errors.png').exists()
        assert (tmp_path / 'map.png').exists()

    @pytest.mark.parametrize('option', ['--tum', '--map', '--plot'])
    def test_where_nothing_may_be_written_is_reported_before_the_work(
        self, slam_observer, simulated, tmp_path, option, monkeypatch
    ):
        monkeypatch.setattr(os, 'access', lambda *_: False)  # root may write anywhere
        ended = slam_observer('replay', simulated, option, tmp_path / 'new')
        assert (ended.code, ended.output) == (2, '')
        assert f'nothing may be written to {tmp_path}' in ended.errors

    def test_figures_leave_other_files_alone(self, slam_observer, simulated, tmp_path):
        (tmp_path / 'notes.txt').write_text('mine')
        slam_observer.succeed('replay', simulated, '--plot', tmp_path)
        assert (tmp_path / 'notes.txt').read_text() == 'mine'
        assert (tmp_path / 'map.png').exists()
        assert not list(tmp_path.glob('.*'))


class TestSmoothing:
    def test_outputs_are_of_the_smoothed_trajectory_and_map(
        self, slam_observer, simulated, tmp_path
    ):
        online_tum = tmp_path / 'online.tum'
        online = slam_observer.succeed(
            'replay', simulated, '--gains', 'riccati', '--json', '--tum', online_tum
        ).json
        tum, landmarks, figures = tmp_path / 'a.tum', tmp_path / 'a.yaml', tmp_path / 'figures'
        report = slam_observer.succeed(
            'replay', simulated, '--gains', 'riccati', '--json', '--smooth',
            '--tum', tum, '--map', landmarks, '--plot', figures,
        ).json  # fmt: skip
        assert report['ate_rmse_m'] == online['ate_rmse_m']
        assert report['smoothed_ate_rmse_m'] < online['ate_rmse_m']
        assert report['smoothed_landmark_rmse_m'] is not None
        assert report['unsmoothed_ate_rmse_m'] == online['ate_rmse_m']
        # At the same stamps, also where nothing is seen.
        np.testing.assert_array_equal(read_tum(tum).stamps_ns, read_tum(online_tum).stamps_ns)
        assert len(yaml.safe_load(landmarks.read_text())['landmarks']) == 4
        assert len(list(figures.iterdir())) == 3

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

    def test_all_of_a_long_recording_is_smoothed(self, slam_observer, tmp_path):
        count, points = 3100, np.array([[2.0, 1.0, 0.0], [0.0, 3.0, 1.0], [-1.0, -2.0, 0.0]])
        stamps_ns = range(10**9, 10**9 + count * 10**7, 10**7)
        events = [VelocityEvent(stamp_ns, np.zeros(6)) for stamp_ns in stamps_ns]
        events += [ObservationEvent(stamp_ns, np.arange(3), points) for stamp_ns in stamps_ns]
        path = write_events(tmp_path / 'long.mcap', sorted(events, key=lambda e: e.stamp_ns))
        tum = tmp_path / 'a.tum'
        slam_observer.succeed('replay', path, '--smooth', '--gains', 'riccati', '--tum', tum)
        assert read_tum(tum).stamps_ns[0] == stamps_ns[0]

    def test_messages_without_any_point_cut_no_history_short(self, slam_observer, tmp_path):
        path = write_events(tmp_path / 'blind.mcap', blinded(recordings.events(), slice(20, 40)))
        ended = slam_observer.succeed('replay', path, '--smooth', '--gains', 'riccati')
        assert 'history' not in ended.errors

    def test_where_no_point_is_seen_nothing_is_smoothed(self, slam_observer, tmp_path):
        path = write_events(tmp_path / 'blind.mcap', blinded(recordings.events(), slice(None)))
        tum = tmp_path / 'a.tum'
        error = slam_observer.fail('replay', path, '--smooth', '--gains', 'riccati', '--tum', tum)
        assert 'no observation was used (dropped: 50 without a point that is used)' in error
        assert not tum.exists()


class TestSettings:
    def config(self, tmp_path, text):
        path = tmp_path / 'robot.yaml'
        path.write_text(f'/**: {{ros__parameters: {{{text}}}}}')
        return path

    def test_the_nodes_own_file(self, slam_observer, simulated, tmp_path):
        config = self.config(
            tmp_path, 'gains: constant, publish_rate: 20.0, odom_frame: wheels, use_sim_time: true'
        )
        output = slam_observer.succeed('replay', simulated, '--config', config).output
        assert 'constant gains' in output

    def test_what_the_node_does_and_a_replay_only_by_its_options_is_reported(
        self, slam_observer, simulated, tmp_path
    ):
        landmarks = tmp_path / 'map.yaml'
        slam_observer.succeed('replay', simulated, '--map', landmarks)
        config = self.config(
            tmp_path, f'map_file: {landmarks}, autosave_map: true, path_length: 9'
        )
        arguments = ('replay', simulated, '--config', config)
        errors = slam_observer(*arguments).errors
        assert errors == (
            'slam-observer: warning: Not used of --config: map_file (use --load-map), '
            'autosave_map (use --map).\n'
        )
        given = ('--load-map', landmarks, '--map', tmp_path / 'again.yaml')
        slam_observer.succeed(*arguments, *given)

    def test_the_command_line_wins(self, slam_observer, simulated, tmp_path):
        config = self.config(tmp_path, 'gains: constant')
        arguments = ('replay', simulated, '--config', config)
        wins = slam_observer.succeed(*arguments, '--gains', 'riccati').output
        assert 'riccati gains' in wins
        wins = slam_observer.succeed(*arguments, '--set', 'gains=riccati').output
        assert 'riccati gains' in wins

    def test_file_by_the_name_that_it_is_shipped_under(self, slam_observer, simulated):
        shipped = Path(__file__).resolve().parents[2] / 'config' / 'observer.yaml'
        named = slam_observer.succeed('replay', simulated, '--config', 'observer', '--json')
        given = slam_observer.succeed('replay', simulated, '--config', shipped, '--json')
        assert named.json | {'seconds': 0} == given.json | {'seconds': 0}

    def test_values_of_each_type(self, slam_observer, simulated, tmp_path):
        given = (
            '--set', 'gain_k=1e1', '--set', 'gain_l=.5', '--set', 'step_mode=paper',
            '--set', 'angular_velocity_noise=[1e-3, 0.01, 1]', '--gains', 'constant',
        )  # fmt: skip
        config = self.config(
            tmp_path,
            'gains: constant, gain_k: 10.0, gain_l: 0.5, step_mode: paper, '
            'angular_velocity_noise: [0.001, 0.01, 1.0]',
        )
        one = slam_observer.succeed('replay', simulated, *given, '--json').json
        other = slam_observer.succeed('replay', simulated, '--config', config, '--json').json
        assert one | {'seconds': 0} == other | {'seconds': 0}

    def test_a_list_that_the_node_can_not_read_is_reported_once(
        self, slam_observer, simulated, tmp_path
    ):
        config = self.config(tmp_path, 'range_noise: 0.1, linear_velocity_noise: [0.1, 0, 0]')
        errors = slam_observer('replay', simulated, '--config', config).errors
        assert errors.count("he node can't read") == 1
        assert 'linear_velocity_noise of --config: in ROS all numbers of a list are' in errors

    def test_names_of_other_nodes_in_the_file_are_ignored(
        self, slam_observer, simulated, tmp_path
    ):
        config = self.config(tmp_path, 'gain_k: 2.0, world_frame: odom, frequency: 30.0')
        ended = slam_observer('replay', simulated, '--config', config)
        assert ended.code == 0
        assert 'Unknown parameters of --config are ignored: world_frame, frequency' in ended.errors
        others = self.config(tmp_path, 'world_frame: odom')
        assert "none of the parameters of --config is the observer's" in slam_observer.fail(
            'replay', simulated, '--config', others
        )

    @pytest.mark.parametrize(
        ('options', 'names'),
        [
            (('--set', 'odom_frame=base_link'), "'odom_frame' and 'base_frame'"),
            (('--base-frame', '/odom'), "'odom_frame' and 'base_frame'"),
            (('--set', 'map_frame=odom'), "'map_frame' and 'odom_frame'"),
        ],
    )
    def test_frames_that_the_node_refuses(self, slam_observer, simulated, options, names):
        assert f'{names} are both' in slam_observer.fail('replay', simulated, *options)

    def test_angles_in_degrees(self, slam_observer, simulated):
        for name, value in (('sensor_pose', '[0, 0, 0, 0, 0, 90]'), ('initial_yaw', '90')):
            error = slam_observer.fail('replay', simulated, '--set', f'{name}={value}')
            assert f"'{name}'" in error

    def test_misspelt_name_in_the_file(self, slam_observer, simulated, tmp_path):
        config = self.config(tmp_path, 'gain_q: 4.0')
        error = slam_observer.fail('replay', simulated, '--config', config)
        assert "unknown parameter 'gain_q'; did you mean 'gain_" in error


class TestRecordingsWithProblems:
    def test_malformed_and_impossible_messages_are_dropped_by_reason(
        self, slam_observer, tmp_path
    ):
        path = tmp_path / 'problems.mcap'
        good = ros.serialise(ros.twist_stamped([0.1] * 6))
        with RecordingWriter(path) as writer:
            for data in (good, good[:20], ros.serialise(ros.twist_stamped([np.nan] * 6))):
                writer.write('/twist', 'geometry_msgs/msg/TwistStamped', data, ros.STAMP_NS)
            for ids in ([1, 2], [3, 3]):
                writer.write_observation(
                    ObservationEvent(ros.STAMP_NS, np.array(ids), np.ones((2, 3)))
                )
        ended = slam_observer('replay', path, '--json')
        assert ended.code == 0
        assert ended.json['dropped'] == {'not_finite': 1, 'malformed': 1}
        assert ended.json['used']['repeated_id'] == 2
        assert ended.json['events'] == 5
        assert ended.errors.count('slam-observer: warning: ') == 3

    def test_truncated_recording_is_used_up_to_the_damage(self, slam_observer, tmp_path):
        path = tmp_path / 'long.mcap'
        slam_observer.succeed('simulate', '--duration', 300, '--step', 0.1, '--output', path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
        ended = slam_observer('replay', path, '--json')
        assert ended.code == 0
        assert 0 < ended.json['events'] < 6002
        assert ended.errors.startswith('slam-observer: warning: ')
        assert ended.errors.count('\n') == 1

    def test_frames_that_differ_are_reported(self, slam_observer, tmp_path):
        path = tmp_path / 'frames.mcap'
        with RecordingWriter(path) as writer:
            for event in recordings.events():
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(event)
                else:
                    writer.write_observation(event, frame_id='camera')
        errors = slam_observer('replay', path).errors
        assert 'base_link' in errors
        assert 'camera' in errors

    @pytest.fixture
    def unplaced(self, tmp_path):
        """A recording with truth, whose camera is nowhere on /tf."""
        with RecordingWriter(tmp_path / 'unplaced.mcap') as writer:
            for event in recordings.events():
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(event)
                else:
                    writer.write_observation(event, frame_id='camera')
            for truth in recordings.true_poses():
                writer.write_pose(truth)
        return tmp_path / 'unplaced.mcap'

    def test_that_no_observation_was_used_is_reported(self, slam_observer, unplaced):
        errors = slam_observer('replay', unplaced).errors
        assert 'warning: No observation was used (dropped: 50 no_transform)' in errors
        assert '--set sensor_pose=[X,Y,Z,ROLL,PITCH,YAW]' in errors
        assert '--base-frame' in errors

    def test_a_message_without_points_is_no_observation_and_its_map_replaces_none(
        self, slam_observer, tmp_path
    ):
        path, landmarks = tmp_path / 'unplaced.mcap', tmp_path / 'map.yaml'
        with RecordingWriter(path) as writer:
            for event in blinded(recordings.events(), slice(2)):
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(event)
                else:
                    frame = 'camera' if len(event.ids) else 'base_link'
                    writer.write_observation(event, frame_id=frame)
        landmarks.write_text('a good map')
        ended = slam_observer('replay', path, '--map', landmarks, '--force')
        assert 'dropped: 1 without a point that is used, 49 no_transform' in ended.errors
        assert 'no observation was used' in ended.errors
        assert landmarks.read_text() == 'a good map'

    def test_a_map_without_landmarks_replaces_none(self, slam_observer, simulated, tmp_path):
        landmarks = tmp_path / 'map.yaml'
        landmarks.write_text('a good map')
        unconfirmed = ('--set', 'confirmations=1000', '--map', landmarks, '--force')
        ended = slam_observer('replay', simulated, *unconfirmed)
        assert f'the map is empty: nothing is written to {landmarks}' in ended.errors
        assert ended.code == 2
        assert landmarks.read_text() == 'a good map'

    def test_that_no_velocity_was_used_is_reported(self, slam_observer, tmp_path):
        with RecordingWriter(tmp_path / 'run.mcap') as writer:
            for event in recordings.events():
                if isinstance(event, VelocityEvent):
                    message = ros.odometry(
                        event.body_velocity, -2.0 * np.eye(6), stamp_ns=event.stamp_ns
                    )
                    data = ros.serialise(message)
                    writer.write('/odom', message.__msgtype__, data, event.stamp_ns)
                else:
                    writer.write_observation(event)
        errors = slam_observer('replay', tmp_path / 'run.mcap').errors
        assert 'warning: No velocity was used (dropped: 100 bad_covariance)' in errors

    def test_without_any_observation_nothing_is_smoothed_or_written(
        self, slam_observer, unplaced, tmp_path
    ):
        tum, landmarks, figures = tmp_path / 'a.tum', tmp_path / 'a.yaml', tmp_path / 'figures'
        ended = slam_observer(
            'replay', unplaced, '--smooth', '--gains', 'riccati',
            '--tum', tum, '--map', landmarks, '--plot', figures,
        )  # fmt: skip
        assert (ended.code, ended.output) == (2, '')
        last = ended.errors.splitlines()[-1]
        assert 'error: no observation was used (dropped: 50 no_transform)' in last
        assert not any(path.exists() for path in (tum, landmarks, figures))

    def test_two_topics_that_fit_are_listed_with_the_option_that_decides(
        self, slam_observer, tmp_path
    ):
        path = tmp_path / 'two.mcap'
        with RecordingWriter(path) as writer:
            for event in recordings.events():
                if isinstance(event, VelocityEvent):
                    writer.write_velocity(event, topic='/wheels')
                    writer.write_velocity(event, topic='/imu')
                else:
                    writer.write_observation(event)
        error = slam_observer.fail('replay', path)
        for text in ('/wheels', '/imu', '--velocity-topic'):
            assert text in error
        ended = slam_observer('replay', path, '--velocity-topic', 'wheels', '--json')
        assert ended.json['events'] == 150
