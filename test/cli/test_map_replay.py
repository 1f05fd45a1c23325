"""``slam-observer replay --map`` and ``--load-map``: one file, from one recording to the next."""

from __future__ import annotations

import re

import numpy as np
from numpy.testing import assert_allclose
import pytest
from tum_files import read_tum

from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.recordings.trajectory import LandmarkTruth, PoseTruth
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.settings.estimator_settings import Settings

BODY_VELOCITY = np.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0])
LANDMARKS = np.random.default_rng(0).uniform([-8, -8, -1], [8, 8, 3], (50, 3))
POINT_NOISE_M = 0.02
SETTINGS = ('--set', 'observation_model=cartesian', '--set', f'point_noise={POINT_NOISE_M}')


def record(
    path,
    start,
    seed,
    first_id=lambda s: 0,
    stamp_ns=lambda s: s * 10**8,
    scale=lambda s: 1.0,
    has_ids=True,
    receive_ns=lambda s: s * 10**8,
    truth=None,
    steps=80,
):
    """Write a noisy drive, of 8 s at 10 Hz, that begins at ``start`` (4, 4), among 50 landmarks.

    At each step ids go up from ``first_id``, and the landmarks' world is ``scale`` times as large.
    Messages are received every 0.1 s, whatever their stamps, unless ``receive_ns`` says when.
    """
    random = np.random.default_rng(seed)
    with RecordingWriter(path) as writer:
        if truth is not None:
            writer.write_landmarks(stamp_ns(0), truth)
        for step in range(steps):
            noise = random.normal(scale=0.01, size=6)
            velocity = VelocityEvent(stamp_ns(step), BODY_VELOCITY + noise)
            writer.write_velocity(velocity, receive_stamp_ns=receive_ns(step))
            pose = start @ se3.exp(BODY_VELOCITY * 0.1 * step)
            writer.write_pose(PoseTruth(stamp_ns(step), pose))
            near = np.linalg.norm(LANDMARKS - pose[:3, 3], axis=1) < 6.0
            seen, points = np.flatnonzero(near), scale(step) * LANDMARKS
            points = se3.transform(se3.inverse(pose), points)
            points = points[seen] + random.normal(scale=POINT_NOISE_M, size=(len(seen), 3))
            ids = first_id(step) + seen if has_ids else np.full(len(seen), UNKNOWN_ID)
            observation = ObservationEvent(stamp_ns(step), ids, points)
            writer.write_observation(observation, receive_stamp_ns=receive_ns(step))
    return path


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
def test_a_run_finds_its_place_in_the_map_of_another_one(slam_observer, tmp_path, mode):
    first = record(tmp_path / 'first.mcap', np.eye(4), seed=1)
    start = se3.exp(np.array([0.0, 0.1, 2.0, 1.0, -2.0, 0.5]))
    second = record(tmp_path / 'second.mcap', start, seed=2)
    saved, again, poses = (tmp_path / name for name in ('map.yaml', 'again.yaml', 'poses.tum'))
    slam_observer.succeed('replay', first, '--map', saved, *SETTINGS)
    slam_observer(
        'replay', second, '--load-map', saved, '--map', again, '--tum', poses, *SETTINGS,
        '--set', f'localization_mode={mode}',
    )  # fmt: skip
    estimate = read_tum(poses)
    true = start @ se3.exp(BODY_VELOCITY * (estimate.stamps_ns * 1e-9)[:, None])
    distance = np.linalg.norm(estimate.poses[:, :3, 3] - true[:, :3, 3], axis=1)
    assert len(distance) > 70
    assert np.median(distance) < 0.1
    report = slam_observer('replay', second, '--load-map', saved, *SETTINGS, '--json').json
    assert report['ate_rmse_m'] < report['unaligned_rmse_m'] < 0.15
    known, after = read_map(saved), read_map(again)
    assert known.joint_covariance is not None
    assert after.joint_covariance is not None
    assert set(known.ids) <= set(after.ids)
    assert (len(after.ids) > len(known.ids)) == (mode == 'off')


def test_a_mode_of_localising_without_a_map_is_said_to_have_no_effect(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    ended = slam_observer('replay', path, '--set', 'localization_mode=fixed', *SETTINGS)
    assert ended.code == 0
    assert "No map is loaded, so localization_mode 'fixed' has no effect" in ended.errors
    assert '--load-map' in ended.errors


@pytest.mark.parametrize('gains', ['constant', 'riccati --smooth'])
def test_a_mode_of_localising_has_no_effect_without_a_map(slam_observer, tmp_path, gains):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    options = (path, *SETTINGS, '--json', '--gains', *gains.split())
    plain = slam_observer('replay', *options).json
    fixed = slam_observer('replay', *options, '--set', 'localization_mode=fixed').json
    assert fixed['ate_rmse_m'] == plain['ate_rmse_m']
    assert fixed['landmark_rmse_m'] == plain['landmark_rmse_m']


def test_a_map_keeps_the_name_of_its_frame(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    first, again = tmp_path / 'first.yaml', tmp_path / 'again.yaml'
    slam_observer.succeed('replay', path, '--map', first, '--set', 'map_frame=hall', *SETTINGS)
    ended = slam_observer('replay', path, '--load-map', first, '--map', again, *SETTINGS)
    assert 'the node takes it with map_frame: hall only' in ended.errors
    assert [read_map(file).frame_id for file in (first, again)] == ['hall', 'hall']


def test_no_anees_is_reported_in_a_map_whose_frame_does_not_begin_at_the_first_pose(
    slam_observer, tmp_path
):
    path, saved = record(tmp_path / 'run.mcap', np.eye(4), seed=1), tmp_path / 'map.yaml'
    report = slam_observer.succeed('replay', path, '--map', saved, '--json', *SETTINGS).json
    assert report['unaligned_rmse_m'] is None
    assert 0.2 < report['anees'] < 5.0
    arguments = ('replay', path, '--load-map', saved, *SETTINGS)
    again = slam_observer(*arguments, '--json').json
    assert again['anees'] is None
    assert again['ate_rmse_m'] is not None
    assert 'ANEES' not in slam_observer(*arguments).output


def test_no_anees_of_the_configuration_is_reported_in_a_map_that_is_exact(slam_observer, tmp_path):
    path, saved = tmp_path / 'run.mcap', tmp_path / 'map.yaml'
    record(path, np.eye(4), seed=1, truth=LandmarkTruth(np.arange(50), LANDMARKS))
    slam_observer.succeed('replay', path, '--map', saved, *SETTINGS)
    arguments = ('replay', path, '--load-map', saved, '--json', *SETTINGS)
    uncertain = slam_observer(*arguments, '--set', 'localization_mode=uncertain').json
    assert uncertain['configuration_anees'] is not None
    fixed = slam_observer(*arguments, '--set', 'localization_mode=fixed').json
    assert fixed['configuration_anees'] is None
    assert fixed['configuration_rmse_m'] is not None


def test_covariances_of_a_smoothed_map_are_those_of_relinearising(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    smoothed, relinearised = tmp_path / 'smoothed.yaml', tmp_path / 'relinearised.yaml'
    slam_observer.succeed('replay', path, '--smooth', '--map', smoothed, *SETTINGS)
    at_the_end = ('--set', 'relinearization_interval=80', '--set', 'relinearization_angle=0')
    slam_observer.succeed('replay', path, '--map', relinearised, *SETTINGS, *at_the_end)
    online, exact = read_map(smoothed), read_map(relinearised)
    np.testing.assert_array_equal(online.ids, exact.ids)
    assert_allclose(
        np.trace(online.covariances, axis1=1, axis2=2),
        np.trace(exact.covariances, axis1=1, axis2=2),
        rtol=0.15,
    )


def test_a_map_that_cannot_be_read_is_refused_before_anything_is_done(slam_observer, tmp_path):
    recording = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    missing = tmp_path / 'no.yaml'
    error = slam_observer.fail('replay', recording, '--load-map', missing)
    assert f"can't read map {missing}: No such file or directory" in error


def test_of_a_folder_of_maps_it_is_said_in_which_the_robot_was_found(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1, has_ids=False)
    halls = tmp_path / 'halls'
    halls.mkdir()
    arguments = ('replay', path, '--load-map', halls, *SETTINGS)
    ended = slam_observer(*arguments)
    assert ended.code == 2
    assert 'there is no map, a file *.yaml, in the folder' in ended.errors
    other = np.random.default_rng(7).uniform([-8, -8, -1], [8, 8, 3], (50, 3))
    for name, points in (('east', other), ('west', LANDMARKS)):
        known = LandmarkMap(np.arange(50), points, None, np.zeros(50, dtype=np.int64))
        write_map(halls / f'{name}.yaml', known, None)
    assert slam_observer.succeed(*arguments, '--json').json['map'] == 'west'
    assert ' s in west, where' in slam_observer(*arguments).output
    ended = slam_observer(*arguments, '--tum', halls / 'east.yaml', '--force')
    assert ended.code == 2
    assert 'the file of --load-map' in ended.errors
    for name in ('east', 'west'):  # with ids, and copies of one hall
        known = LandmarkMap(np.arange(50), LANDMARKS, None, known.counts)
        write_map(halls / f'{name}.yaml', known, None)
    with_ids = record(tmp_path / 'ids.mcap', np.eye(4), seed=1)
    ended = slam_observer('replay', with_ids, '--load-map', halls, *SETTINGS)
    assert ended.code == 0
    assert 'The maps east and west say the same, so east is used for both' in ended.errors
    assert ' in east, where' in ended.output


class TestPoseInMapNotKnown:
    """In a map of the landmarks, which have other ids some of the time."""

    @pytest.fixture
    def saved(self, tmp_path):
        covariances = np.tile(1e-4 * np.eye(3), (50, 1, 1))
        surveyed = LandmarkMap(np.arange(50), LANDMARKS, covariances, np.zeros(50, dtype=np.int64))
        write_map(tmp_path / 'map.yaml', surveyed, Settings())
        return tmp_path / 'map.yaml'

    @pytest.mark.parametrize('more', [(), ('--smooth',)])
    def test_a_place_never_found_leaves_nothing_but_the_reason(
        self, slam_observer, tmp_path, saved, more
    ):
        other = record(
            tmp_path / 'other.mcap', np.eye(4), 2, lambda s: 100, scale=lambda s: 1.5, steps=8
        )
        poses, page, before = tmp_path / 'poses.tum', tmp_path / 'run.html', saved.read_bytes()
        error = slam_observer.fail(
            'replay', other, '--load-map', saved, '--map', saved, '--tum', poses, '--force',
            '--report', page, *SETTINGS, *more,
        )  # fmt: skip
        for text in (str(saved), 'not found', 'three of its landmarks', '0 of its 50'):
            assert text in error
        assert saved.read_bytes() == before
        assert not poses.exists()
        assert not page.exists()

    def test_a_start_that_is_given_takes_no_ids(self, slam_observer, tmp_path, saved):
        start = se3.exp(np.array([0.0, 0.0, 1.0, 1.0, -2.0, 0.0]))
        path = record(tmp_path / 'run.mcap', start, seed=2, has_ids=False)
        poses = tmp_path / 'poses.tum'
        arguments = (
            'replay', path, '--load-map', saved, '--tum', poses, '--force', *SETTINGS,
            '--set', 'localization_mode=fixed',
        )  # fmt: skip
        assert slam_observer(*arguments, '--json').json['localised_after_s'] > 0.0
        x, y, z = (start[:3, 3] + [0.2, -0.1, 0.0]).tolist()
        given = ('--set', f'initial_pose=[{x},{y},{z},0,0,0.9]')
        arguments += ('--set', 'set_initial_pose=true', *given)
        assert slam_observer(*arguments, '--json').json['localised_after_s'] == 0.0
        assert 'given at the start' in slam_observer(*arguments).output
        estimate = read_tum(poses)
        true = start @ se3.exp(BODY_VELOCITY * (estimate.stamps_ns * 1e-9)[:, None])
        assert_allclose(estimate.poses[1:], true[1:], atol=0.1)

    def test_a_start_that_is_given_is_of_no_use_without_points(
        self, slam_observer, tmp_path, saved
    ):
        path = record(tmp_path / 'run.mcap', np.eye(4), seed=2, has_ids=False)
        again = tmp_path / 'again.yaml'
        arguments = (
            'replay', path, '--load-map', saved, '--map', again, *SETTINGS, '--gains', 'constant'
        )  # fmt: skip
        ended = slam_observer(*arguments)
        assert ended.code == 2
        assert 'points without id take --gains riccati' in ended.errors
        ended = slam_observer(*arguments, '--set', 'set_initial_pose=true')
        assert ended.code == 2
        assert 'no observation was used' in ended.errors
        assert 'points without id' in ended.errors
        assert not again.exists()

    def test_a_pose_found_late_is_reported_with_its_time(self, slam_observer, tmp_path, saved):
        late = record(tmp_path / 'late.mcap', np.eye(4), seed=2, first_id=lambda s: 100 * (s < 40))
        poses = tmp_path / 'poses.tum'
        arguments = ('replay', late, '--load-map', saved, '--force', '--tum', poses, *SETTINGS)
        report = slam_observer(*arguments, '--json').json
        assert report['localised_after_s'] == pytest.approx(4.0, abs=0.3)
        assert read_tum(poses).stamps_ns[0] * 1e-9 == report['localised_after_s']
        assert (
            f'found after {report["localised_after_s"]:.1f} s' in slam_observer(*arguments).output
        )

    def test_more_rejections_than_a_sensor_has_outliers_are_reported(
        self, slam_observer, tmp_path, saved
    ):
        growing = record(
            tmp_path / 'run.mcap', np.eye(4), 2, scale=lambda s: 3.0 if s % 4 else 1.0, steps=40
        )
        ended = slam_observer('replay', growing, *SETTINGS)
        assert re.search('[0-9]+ % of the points were rejected: look at the signs', ended.errors)

    def test_a_place_lost_at_the_end_gives_poses_but_no_map(self, slam_observer, tmp_path, saved):
        misled = record(
            tmp_path / 'misled.mcap', np.eye(4), seed=2, steps=55,
            scale=lambda s: 10.0 if s >= 40 else 1.0,
        )  # fmt: skip
        poses, again = tmp_path / 'poses.tum', tmp_path / 'again.yaml'
        arguments = (
            'replay', misled, '--load-map', saved, '--tum', poses, *SETTINGS,
            '--set', 'localization_mode=uncertain',
        )  # fmt: skip
        refused = slam_observer(*arguments, '--map', again)
        assert refused.code == 2
        assert ', and not found again' in refused.errors
        assert not again.exists()
        ended = slam_observer(*arguments, '--force')
        assert ended.code == 0
        assert ', and not found again' in ended.errors
        assert 40 <= len(read_tum(poses)) < 50


def test_smoothing_says_what_cut_the_history_short(slam_observer, tmp_path):
    path = record(
        tmp_path / 'run.mcap', np.eye(4), seed=1,
        stamp_ns=lambda s: 10**8 * s + 10**12 * (s >= 40),
    )  # fmt: skip
    saved = tmp_path / 'map.yaml'
    hold = ('--smooth', '--set', 'on_time_jump=hold', *SETTINGS)
    jumped = slam_observer('replay', path, '--map', saved, *hold)
    assert 'those since the clock jumped' in jumped.errors
    loaded = slam_observer('replay', path, '--load-map', saved, '--smooth', *SETTINGS)
    assert 'those since the pose in the loaded map was found' in loaded.errors
    assert 'smoothing_window' not in jumped.errors + loaded.errors


@pytest.mark.parametrize('mode', ['off', 'fixed'])
def test_points_of_no_landmark_of_a_map_that_does_not_grow_are_reported(
    slam_observer, tmp_path, mode
):
    """The map is of some twenty landmarks, whose ids are shared; of others they go up from 100."""
    first = record(tmp_path / 'first.mcap', np.eye(4), seed=1)
    others = record(
        tmp_path / 'second.mcap', np.eye(4), 2, lambda s: 0 if s < 10 else 100, steps=25
    )
    saved = tmp_path / 'map.yaml'
    slam_observer.succeed('replay', first, '--map', saved, *SETTINGS)
    errors = slam_observer(
        'replay', others, '--load-map', saved, *SETTINGS,
        '--set', f'localization_mode={mode}', '--set', 'set_initial_pose=true',
    ).errors  # fmt: skip
    is_reported = (
        'of the points are of no landmark of the map: is it the map of this place' in errors
    )
    assert is_reported == (mode != 'off')
    assert ('did the robot start where it was said to' in errors) == is_reported


def test_smoothing_says_that_landmarks_had_to_make_room(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    limited = ('--smooth', '--set', 'max_landmarks=30', *SETTINGS)
    errors = slam_observer('replay', path, *limited).errors
    assert 'those since landmarks had to make room (max_landmarks)' in errors
    window = ('--set', 'smoothing_window=10', '--set', 'relinearization_interval=1')
    errors = slam_observer('replay', path, *limited, *window).errors
    assert 'those since the history was cut (smoothing_window=0 keeps all of it)' in errors


def test_nothing_to_smooth_is_an_error_and_writes_nothing(slam_observer, tmp_path):
    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1)
    window = ('--set', 'smoothing_window=1', '--set', 'relinearization_interval=1')
    outputs = ('--smooth', '--tum', tmp_path / 'smoothed.tum')
    errors = slam_observer.fail('replay', path, *outputs, *window, *SETTINGS)
    assert 'nothing to smooth: no observation since the history was cut' in errors
    assert not (tmp_path / 'smoothed.tum').exists()


def test_a_silence_of_the_sensors_is_no_jump_of_the_clock(slam_observer, tmp_path):
    def late(step):
        return 10**8 * step + 12 * 10**9 * (step >= 50)

    path = record(tmp_path / 'run.mcap', np.eye(4), seed=1, stamp_ns=late, receive_ns=late)
    ended = slam_observer('replay', path, '--tum', tmp_path / 'poses.tum', *SETTINGS)
    assert ended.code == 0
    assert 'The clock has jumped' not in ended.errors
    assert read_tum(tmp_path / 'poses.tum').stamps_ns[0] < 10**9


@pytest.mark.parametrize('resets', [True, False])
def test_after_a_jump_of_the_clock_only_what_is_of_one_run_is_reported(
    slam_observer, tmp_path, resets
):
    path = record(
        tmp_path / 'run.mcap', np.eye(4), seed=1, stamp_ns=lambda s: 10**8 * s + 10**12 * (s >= 50)
    )
    poses = tmp_path / 'poses.tum'
    jump = 'reset' if resets else 'hold'
    ended = slam_observer(
        'replay', path, '--tum', poses, '--json', '--set', f'on_time_jump={jump}', *SETTINGS
    )
    assert ended.errors.count('The clock has jumped ahead by 1000.') == 1
    assert ('on_time_jump: hold' in ended.errors) == resets
    assert ('after the last jump of the clock (1 in all)' in ended.errors) == resets
    assert (read_tum(poses).stamps_ns[0] > 10**12) == resets
    if resets:
        assert ended.json['ate_rmse_m'] < 0.05
        assert ended.json['dead_reckoning_ate_rmse_m'] < 0.2
        assert ended.json['anees'] < 5.0


def test_a_table_becomes_a_map_file(slam_observer, tmp_path):
    table, made = tmp_path / 'tags.csv', tmp_path / 'tags.yaml'
    table.write_text('id,x,y\n7,1.5,-2\n8,9,1\n')
    output = slam_observer.succeed('map', 'convert', table, made, '--sigma', '0.1').output
    assert 'x 1.50 to 9.00 m' in output
    assert read_map(made).ids.tolist() == [7, 8]
    assert 'exists already' in slam_observer.fail('map', 'convert', table, made)
    table.write_text('7,1\n')
    error = slam_observer.fail('map', 'convert', table, made, '--force')
    assert 'line 1: it needs id, x and y' in error


def test_a_table_becomes_a_map_of_tags(slam_observer, tmp_path):
    table, made = tmp_path / 'tags.csv', tmp_path / 'tags.yaml'
    table.write_text('id,x,y,yaw\n7,1.5,-2,1.57\n8,9,1,\n')
    convert = ('map', 'convert', table, made, '--force')
    output = slam_observer.succeed(*convert, '--orientation-sigma', '0.1').output
    assert '1, x y z of a tag: right up out' in output
    assert read_map(made).orientation_sigmas.tolist() == [0.1, 0.0]
    assert 'orientations' in slam_observer.succeed(*convert, '--tag-axes', 'none').output
    assert read_map(made).orientations is None
    assert 'no standard deviation' in slam_observer.fail(*convert, '--orientation-sigma', 'nan')
