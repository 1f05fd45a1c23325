"""Recordings with problems: damaged, without what is needed, ambiguous."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import recordings
import ros_messages as ros

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.recordings.writer import RecordingWriter


def without(kind):
    """Return events of which one kind can't be used."""
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
    recording = recordings.write_events(tmp_path / 'blind.mcap', without(kind))
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
            for event in recordings.blinded(recordings.events(), slice(2)):
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
        tum, landmarks, page = tmp_path / 'a.tum', tmp_path / 'a.yaml', tmp_path / 'a.html'
        ended = slam_observer(
            'replay', unplaced, '--smooth', '--gains', 'riccati',
            '--tum', tum, '--map', landmarks, '--report', page,
        )  # fmt: skip
        assert (ended.code, ended.output) == (2, '')
        last = ended.errors.splitlines()[-1]
        assert 'error: no observation was used (dropped: 50 no_transform)' in last
        assert not any(path.exists() for path in (tum, landmarks, page))

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
