"""What ``slam-observer replay`` reports of a run, and which points it used."""

from __future__ import annotations

from dataclasses import replace
import io
import re
import sys

import numpy as np
import pytest
import recordings
import ros_messages as ros

from slam_observer_ros.cli.main import main
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.recordings.trajectory import PoseTruth
from slam_observer_ros.recordings.writer import RecordingWriter
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


def nameless(events):
    """Take the ids of all points away."""
    return [
        event
        if isinstance(event, VelocityEvent)
        else ObservationEvent(event.stamp_ns, np.full(len(event.ids), UNKNOWN_ID), event.points)
        for event in events
    ]


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
        path = recordings.write_events(tmp_path / 'own.mcap', recordings.events())
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
        path = recordings.write_events(tmp_path / 'half.mcap', [*recordings.events(), *half])
        output = slam_observer('replay', path).output
        assert re.search(r'truth +│ covers (49|50)\.\d % of the trajectory', output)

    def test_truth_at_another_time_is_no_truth(self, slam_observer, tmp_path):
        early = [
            PoseTruth(1_000_000_000 + index * recordings.STEP_NS, truth.pose)
            for index, truth in enumerate(recordings.true_poses())
        ]
        path = recordings.write_events(tmp_path / 'run.mcap', [*recordings.events(), *early])
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
        used = {'velocity': 251, 'observation': 251, 'observed_point': 1004, 'new_landmark': 4}
        assert report['used'] == used
        assert '1004 used ' in slam_observer.succeed('replay', simulated).output

    def test_a_landmark_that_jumps_is_rejected_and_then_has_moved(self, slam_observer, tmp_path):
        def jumped(event):
            points = event.points + np.array([[0.0, 5.0, 0.0]]) * (event.ids == 5)[:, None]
            return ObservationEvent(event.stamp_ns, event.ids, points)

        events = [
            jumped(event) if isinstance(event, ObservationEvent) and index > 100 else event
            for index, event in enumerate(recordings.events())
        ]
        path = recordings.write_events(tmp_path / 'jump.mcap', events)
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
        path = recordings.write_events(tmp_path / 'carried.mcap', events)
        options = ('--landmarks-topic', '/landmarks', '--set', 'two_d_mode=True')
        output = slam_observer('replay', path, *options).output
        row = r'slips +│ \d+ × the robot was not where odometry had it'
        assert re.search(row, output)

    def test_gains_that_use_no_point_without_id_say_so(self, slam_observer, tmp_path):
        path = recordings.write_events(tmp_path / 'nameless.mcap', nameless(recordings.events()))
        arguments = ('replay', path, '--landmarks-topic', '/landmarks', '--gains')
        ended = slam_observer(*arguments, 'constant')
        assert '0 used, 150 without id (100.0 %)' in ended.output
        assert (
            'slam-observer: warning: Points without an id are not used by constant gains '
            '(1 so far): only riccati gains use them.\n'
        ) in ended.errors
        assert '150 used' in slam_observer.succeed(*arguments, 'riccati').output


def test_in_the_plane_the_height_of_landmarks_is_no_error(slam_observer, tmp_path):
    path = recordings.write_mcap(tmp_path / 'run.mcap')
    errors = slam_observer.succeed('replay', path, '--set', 'two_d_mode=true', '--json').json
    assert errors['landmark_rmse_m'] < 1e-3
    assert errors['configuration_rmse_m'] < 1e-3
