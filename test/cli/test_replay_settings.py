"""Settings of a replay: of the node's own files, and of the command line."""

from __future__ import annotations

from pathlib import Path

import pytest


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
            tmp_path, f'map_file: {landmarks}, autosave_map: true, max_clock_offset: 9'
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
        for name in ('sensor_pose', 'initial_pose'):
            error = slam_observer.fail('replay', simulated, '--set', f'{name}=[0, 0, 0, 0, 0, 90]')
            assert f"'{name}'" in error

    def test_misspelt_name_in_the_file(self, slam_observer, simulated, tmp_path):
        config = self.config(tmp_path, 'gain_q: 4.0')
        error = slam_observer.fail('replay', simulated, '--config', config)
        assert "unknown parameter 'gain_q'; did you mean 'gain_" in error
