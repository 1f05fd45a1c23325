"""Recordings of every format give the same events; unreadable ones a line that says what to do."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import shutil

from mcap.writer import Writer
import numpy as np
from numpy.testing import assert_allclose
import pytest
import recordings
import ros_messages as ros
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.messages.poses import PoseBlock, PoseMessage
from slam_observer_ros.recordings.mcap_source import McapSource
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.sources import SplitSource
from slam_observer_ros.recordings.topics import TopicNames
from slam_observer_ros.recordings.trajectory import LandmarkTracks, LandmarkTruth, other_frames
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.settings.node_settings import InputSettings

FORMATS = [
    'mcap file',
    'mcap directory',
    'sqlite3 file',
    'sqlite3 directory',
    'ROS 1 bag',
    'own mcap',
]


@pytest.fixture(scope='module')
def paths(tmp_path_factory) -> dict[str, Path]:
    """Path of the run in each format."""
    return recordings.write_all_formats(tmp_path_factory.mktemp('formats'))


def assert_same_events(actual: list[Event], expected: list[Event]) -> None:
    assert [type(event) for event in actual] == [type(event) for event in expected]
    for one, other in zip(actual, expected, strict=True):
        assert one.receive_ns is not None
        other = dataclasses.replace(other, receive_ns=one.receive_ns)
        if isinstance(other, ObservationEvent):
            other = dataclasses.replace(other, sensor_axis=np.array([1.0, 0.0, 0.0]))
        else:
            assert one.sensor_frame in ('', 'base_link')
            other = dataclasses.replace(other, sensor_frame=one.sensor_frame)
        for name, value in dataclasses.asdict(other).items():
            np.testing.assert_array_equal(getattr(one, name), value)


def write_big_mcap(path: Path) -> Path:
    """Write so many velocities, which don't compress, that they fill several chunks."""
    random = np.random.default_rng(0)
    with RecordingWriter(path) as writer:
        writer.write_observation(ObservationEvent(ros.STAMP_NS, np.array([1]), np.zeros((1, 3))))
        for index in range(30_000):
            writer.write_velocity(VelocityEvent(ros.STAMP_NS + index, random.normal(size=6)))
    return path


@pytest.fixture(scope='module')
def big(tmp_path_factory):
    """A recording of several chunks, which nobody changes."""
    return write_big_mcap(tmp_path_factory.mktemp('big') / 'big.mcap')


def open_files(directory: Path) -> list[Path]:
    """List what this process holds open in a directory."""
    held = (descriptor.resolve() for descriptor in Path('/proc/self/fd').iterdir())
    return [file for file in held if directory.resolve() in file.parents]


class TestFormats:
    @pytest.mark.parametrize('name', FORMATS)
    def test_every_format_gives_the_same_events(self, paths, name):
        with Recording(paths[name]) as recording:
            selected = recording.find_topics()
            assert recording.warning is None
            assert recording.event_count(selected) == 150
            assert recording.duration_s == pytest.approx(1.98)
            assert_same_events(list(recording.events(selected)), recordings.events())
            assert not recording.malformed

    @pytest.mark.parametrize('name', FORMATS)
    def test_every_format_gives_the_landmark_truth(self, paths, name):
        with Recording(paths[name]) as recording:
            landmarks = recording.truth(recording.find_topics()).landmarks
        np.testing.assert_array_equal(landmarks.ids, recordings.LANDMARKS.ids)
        np.testing.assert_array_equal(landmarks.world_points, recordings.LANDMARKS.world_points)

    def test_pose_truth(self, paths):
        with Recording(paths['own mcap']) as recording:
            truth = recording.truth(recording.find_topics())
        np.testing.assert_array_equal(truth.stamps_ns, list(recordings.stamps_ns()))
        expected = [true_pose.pose for true_pose in recordings.true_poses()]
        np.testing.assert_allclose(truth.poses, expected, atol=1e-12)

    def test_without_pose_truth_there_are_no_poses(self, paths):
        with Recording(paths['mcap file']) as recording:
            truth = recording.truth(recording.find_topics())
        assert truth.stamps_ns.shape == (0,)
        assert truth.poses.shape == (0, 4, 4)

    def test_frames_are_those_of_the_messages(self, paths):
        with Recording(paths['own mcap']) as recording:
            assert recording.contents.frames(recording.find_topics()) == ('base_link', 'base_link')
        with Recording(paths['mcap file']) as recording:  # Its Twists have no frame.
            assert recording.contents.frames(recording.find_topics()) == ('', 'base_link')

    def test_events_come_as_received_with_the_stamps_of_their_headers(self, tmp_path):
        late = ObservationEvent(ros.STAMP_NS, np.array([1]), np.zeros((1, 3)))
        with RecordingWriter(tmp_path / 'late.mcap') as writer:
            writer.write_observation(late, receive_stamp_ns=ros.STAMP_NS + 50)
            writer.write_velocity(VelocityEvent(ros.STAMP_NS + 20, np.zeros(6)))
        with Recording(tmp_path / 'late.mcap') as recording:
            events = list(recording.events(recording.find_topics()))
        assert [event.stamp_ns for event in events] == [ros.STAMP_NS + 20, ros.STAMP_NS]


class TestDamage:
    def test_truncated_mcap_is_read_up_to_the_damage(self, tmp_path, big):
        with Recording(big) as recording:
            whole = list(recording.events(recording.find_topics()))
        path = tmp_path / 'cut.mcap'
        path.write_bytes(big.read_bytes()[: big.stat().st_size * 2 // 3])
        with Recording(path) as recording:
            selected = recording.find_topics()
            events = list(recording.events(selected))
            assert f'only the {len(events)} messages before that' in recording.warning
            assert 'can not be read' not in recording.warning
            assert recording.event_count(selected) == len(events)
            assert recording.duration_s == pytest.approx(1e-9 * (len(events) - 2))
        assert len(whole) // 3 < len(events) < len(whole)
        assert [event.stamp_ns for event in events] == [
            event.stamp_ns for event in whole[: len(events)]
        ]
        assert_same_events(events[::50], whole[: len(events) : 50])

    def test_what_is_left_of_a_truncated_mcap_comes_as_received_though_written_otherwise(
        self, tmp_path
    ):
        order = np.random.default_rng(1).permutation(200)
        path = tmp_path / 'untidy.mcap'
        with RecordingWriter(path) as writer:
            for index in order.tolist():
                writer.write_velocity(VelocityEvent(ros.STAMP_NS + index, np.zeros(6)))
            writer.write_observation(
                ObservationEvent(ros.STAMP_NS + 200, np.array([1]), np.zeros((1, 3)))
            )
        path.write_bytes(path.read_bytes()[:-100])
        with Recording(path) as recording:
            assert 'cut off or damaged' in recording.warning
            events = list(recording.events(recording.find_topics()))
        assert [event.stamp_ns - ros.STAMP_NS for event in events] == list(range(201))

    def test_killed_recorder_leaves_a_directory_without_metadata(self, tmp_path, paths, big):
        directory = tmp_path / 'killed'
        directory.mkdir()
        data = big.read_bytes()
        (directory / 'killed_0.mcap').write_bytes(data[: len(data) // 2])
        with Recording(directory) as recording:
            assert 'cut off or damaged' in recording.warning
        shutil.copy(paths['sqlite3 file'], tmp_path / 'whole.db3')
        (directory / 'killed_0.mcap').unlink()
        (tmp_path / 'whole.db3').rename(directory / 'killed_0.db3')
        with Recording(directory) as recording:
            assert recording.warning is None

    def test_the_only_file_of_a_directory_is_read_though_its_metadata_is_damaged(
        self, tmp_path, paths
    ):
        shutil.copy(paths['mcap file'], tmp_path / 'run_0.mcap')
        (tmp_path / 'metadata.yaml').touch()
        with Recording(tmp_path) as recording, Recording(paths['mcap file']) as whole:
            assert recording.message_count == whole.message_count

    def test_several_files_without_metadata_can_not_be_put_together(self, tmp_path, paths):
        for index in range(2):
            shutil.copy(paths['mcap file'], tmp_path / f'run_{index}.mcap')
        with pytest.raises(RecordingError, match='ros2 bag reindex'):
            Recording(tmp_path)

    @pytest.fixture
    def split(self, tmp_path, big):
        """A directory of two files, of which the second is cut off, and the message count."""
        directory = tmp_path / 'split'
        directory.mkdir()
        for index in range(2):
            shutil.copy(big, directory / f'{index}.mcap')
        cut_off = directory / '1.mcap'
        cut_off.write_bytes(cut_off.read_bytes()[: cut_off.stat().st_size * 2 // 3])
        (directory / 'metadata.yaml').write_text(
            'rosbag2_bagfile_information: {relative_file_paths: [0.mcap, 1.mcap]}'
        )
        with Recording(directory / '0.mcap') as recording:
            return directory, recording.message_count

    def test_of_a_split_recording_the_whole_files_are_read_and_the_truncated_one_up_to_the_damage(
        self, split
    ):
        directory, count = split
        with Recording(directory) as recording:
            assert f'{directory / "1.mcap"}: cut off or damaged' in recording.warning
            assert '0.mcap' not in recording.warning
            events = list(recording.events(recording.find_topics()))
            assert len(events) == recording.message_count
        assert count < len(events) < 2 * count

    @pytest.mark.parametrize('size', [0, 8, 300])
    def test_of_a_split_recording_a_file_without_any_whole_message_is_left_out(self, split, size):
        directory, count = split
        os.truncate(directory / '1.mcap', size)
        with Recording(directory) as recording:
            assert f'{directory / "1.mcap"}: can not be read' in recording.warning
            assert recording.message_count == count
            assert len(list(recording.events(recording.find_topics()))) == count
        os.truncate(directory / '0.mcap', size)
        with pytest.raises(RecordingError, match=f'{directory / "0.mcap"}: .* no whole message'):
            Recording(directory)

    def test_of_a_split_recording_whose_files_overlap_events_come_as_received(self, tmp_path):
        for part in range(2):
            with RecordingWriter(tmp_path / f'{part}.mcap') as writer:
                writer.write_observation(
                    ObservationEvent(ros.STAMP_NS, np.array([part]), np.zeros((1, 3)))
                )
                for index in range(part * 50, 100 + part * 50, 2):
                    writer.write_velocity(VelocityEvent(ros.STAMP_NS + index + part, np.zeros(6)))
        (tmp_path / 'metadata.yaml').write_text(
            'rosbag2_bagfile_information: {relative_file_paths: [0.mcap, 1.mcap]}'
        )
        with Recording(tmp_path) as recording:
            events = list(recording.events(recording.find_topics()))
        stamps_ns = [event.stamp_ns for event in events]
        assert len(stamps_ns) == 102
        assert stamps_ns == sorted(stamps_ns)

    def test_a_file_that_metadata_does_not_list_is_named(self, split):
        directory, count = split
        (directory / 'metadata.yaml').write_text(
            'rosbag2_bagfile_information: {relative_file_paths: [0.mcap]}'
        )
        with Recording(directory) as recording:
            expected = f'{directory}: metadata.yaml does not list 1.mcap, left out'
            assert (recording.warning, recording.message_count) == (expected, count)

    def test_of_a_split_recording_a_file_that_is_missing_is_named(self, split):
        directory, count = split
        (directory / '1.mcap').unlink()
        with (directory / 'metadata.yaml').open('w') as file:
            file.write(
                'rosbag2_bagfile_information:\n  relative_file_paths: [0.mcap, 1.mcap]\n'
                f'  message_count: {2 * count}\n'
            )
        with Recording(directory) as recording:
            assert recording.warning == f'{directory}: 1.mcap is missing: {count} messages'
            assert recording.loss.message_count == count
            assert len(list(recording.events(recording.find_topics()))) == count
        (directory / '0.mcap').unlink()
        with pytest.raises(RecordingError, match='no rosbag2 directory'):
            Recording(directory)

    @pytest.mark.parametrize('name', ['mcap file', 'sqlite3 file', 'ROS 1 bag', 'own mcap'])
    def test_damaged_file_is_read_or_refused_in_one_line(self, tmp_path, paths, name):
        whole = paths[name].read_bytes()
        random = np.random.default_rng(3)
        for trial in range(40):
            damaged = bytearray(whole)
            if trial % 2:
                del damaged[random.integers(len(whole)) :]
            else:
                for place in random.integers(len(whole), size=10):
                    damaged[place] = random.integers(256)
            path = tmp_path / f'{trial}{paths[name].suffix}'
            path.write_bytes(damaged)
            try:
                with Recording(path) as recording:
                    list(recording.events(recording.find_topics()))
            except RecordingError as error:
                assert '\n' not in str(error)

    def test_a_file_whose_first_message_is_damaged_is_closed_again(self, tmp_path):
        path = recordings.write_mcap(tmp_path / 'run.mcap')
        whole = path.read_bytes()
        path.write_bytes(whole[:2000] + bytes(50) + whole[2050:])
        with pytest.raises(RecordingError, match='can not be read') as caught:
            Recording(path)
        assert str(path) in str(caught.value)
        assert open_files(tmp_path) == []

    def test_malformed_message_is_left_out_and_counted(self, tmp_path, caplog):
        path = tmp_path / 'malformed.mcap'
        with RecordingWriter(path) as writer:
            twist = ros.serialise(ros.twist_stamped([1.0] * 6))
            message_type = 'geometry_msgs/msg/TwistStamped'
            for index, data in enumerate([twist[:20], twist, twist[:30]]):
                writer.write('/twist', message_type, data, ros.STAMP_NS + index)
            writer.write_observation(
                ObservationEvent(ros.STAMP_NS, np.array([1]), np.zeros((1, 3)))
            )
        with Recording(path) as recording:
            assert len(list(recording.events(recording.find_topics()))) == 2
            assert recording.malformed == {'/twist': 2}
        assert 'too short' in caplog.text


def test_a_split_recording_lasts_from_the_start_of_the_first_file_to_the_end_of_the_last(tmp_path):
    for index in range(2):
        with RecordingWriter(tmp_path / f'{index}.mcap') as writer:
            for count in range(3):
                writer.write_velocity(VelocityEvent(10 * index + count, np.zeros(6)))
    source = SplitSource([McapSource(tmp_path / f'{index}.mcap') for index in (1, 0)])
    assert (source.start_ns, source.end_ns) == (0, 12)
    received = [raw.receive_stamp_ns for raw in source.messages(source.topics)]
    assert received == [0, 1, 2, 10, 11, 12]
    source.close()


@pytest.mark.parametrize(('base_frame', 'expected'), [('', set()), ('base_link', {'wheels'})])
def test_true_poses_are_of_another_frame_only_where_the_robots_has_a_name(base_frame, expected):
    frames = ('', 'wheels', '/base_link')
    messages = [PoseMessage(0, 'map', frame, np.zeros(3), np.eye(4)[3]) for frame in frames]
    poses = [PoseBlock.of(message) for message in messages]
    assert other_frames(base_frame, poses) == expected


@pytest.mark.parametrize('count', [500, 501])
def test_a_lidars_scan_is_not_taken_for_landmarks(tmp_path, count):
    path = tmp_path / 'lidar.mcap'
    cloud = ros.point_cloud(np.ones((count, 3)), {'intensity': np.zeros(count)})
    with RecordingWriter(path) as writer:
        for topic, message in (('/twist', ros.twist([1.0] * 6)), ('/landmarks', cloud)):
            writer.write(topic, message.__msgtype__, ros.serialise(message), ros.STAMP_NS)
    with Recording(path) as recording:
        events = recording.events(recording.find_topics())
        if count == 500:
            assert len(list(events)) == 2
        else:
            with pytest.raises(RecordingError, match=r'501 points without id .* not scans'):
                list(events)


ENCODINGS = {1: 'ros1', 2: 'cdr'}


def write_foreign(path: Path, *others: str, profile: str = 'ros2', version: int = 2) -> Path:
    """Write two messages as others' recorders may, and one of each of the other encodings."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile)
        for message in (
            ros.twist([1.0] * 6),
            ros.point_cloud(np.ones((1, 3)), {'id': np.ones(1)}),
        ):
            schema = writer.register_schema(message.__msgtype__, f'ros{version}msg', b'')
            channel = writer.register_channel(f'/{schema}', ENCODINGS[version], schema)
            writer.add_message(channel, ros.STAMP_NS, ros.serialise(message), ros.STAMP_NS)
        for other in others:
            schema = writer.register_schema(other, f'{other}schema', b'{}')
            channel = writer.register_channel(f'/{other}', other, schema)
            writer.add_message(channel, ros.STAMP_NS, b'{}', ros.STAMP_NS)
        writer.finish()
    return path


@pytest.mark.parametrize('profile', ['', 'ros2'])
@pytest.mark.parametrize(
    ('others', 'warning'),
    [
        ((), None),
        (('json', ''), 'foreign.mcap: 2 channels of other encodings are left out: json, unnamed'),
    ],
)
def test_a_whole_mcap_file_that_is_not_only_of_ros_is_not_called_damaged(
    tmp_path, profile, others, warning
):
    path = write_foreign(tmp_path / 'foreign.mcap', *others, profile=profile)
    with Recording(path) as recording:
        assert recording.warning == (warning and f'{tmp_path}/{warning}')
        assert len(list(recording.events(recording.find_topics()))) == 2
    path.write_bytes(path.read_bytes()[:-40])
    with Recording(path) as recording:
        assert 'cut off or damaged; only the 2 messages before' in recording.warning


@pytest.mark.parametrize('profile', ['ros1', 'ros2'])
def test_messages_of_ros_1_in_an_mcap_file_are_refused_with_what_to_do(tmp_path, profile):
    path = write_foreign(tmp_path / 'old.mcap', profile=profile, version=1)
    with pytest.raises(RecordingError, match=r'of ROS 1, .* give the \.bag that it was made of$'):
        Recording(path)


class TestNothingToRead:
    def test_missing_file(self, tmp_path):
        with pytest.raises(RecordingError, match='no such file'):
            Recording(tmp_path / 'nothing.mcap')

    def test_wrong_extension(self, tmp_path):
        (tmp_path / 'run.csv').touch()
        with pytest.raises(RecordingError, match=r'not a recording; give a \.mcap, \.db3, \.bag'):
            Recording(tmp_path / 'run.csv')

    def test_bytes_that_are_no_bag(self, tmp_path):
        path = tmp_path / 'x.bag'
        path.write_bytes(bytes([250] * 200))
        with pytest.raises(RecordingError, match=r'it is damaged, or no \.bag file'):
            Recording(path)

    @pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.bag'])
    def test_empty_file(self, tmp_path, suffix):
        path = tmp_path / f'empty{suffix}'
        path.touch()
        with pytest.raises(RecordingError, match=r'can not be read|empty'):
            Recording(path)

    def test_directory_that_is_no_recording(self, tmp_path):
        with pytest.raises(RecordingError, match='no rosbag2 directory'):
            Recording(tmp_path)

    def test_recording_without_messages(self, tmp_path):
        with RecordingWriter(tmp_path / 'empty.mcap'):
            pass
        with pytest.raises(RecordingError, match='the recording is empty'):
            Recording(tmp_path / 'empty.mcap')


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
class TestCompression:
    @pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
    def test_with_metadata_it_is_read(self, tmp_path, storage, mode):
        with Recording(recordings.write_rosbag2(tmp_path / 'run', storage, mode)) as run:
            assert len(list(run.events(run.find_topics()))) == 150

    @pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
    def test_without_metadata_it_is_read_too(self, tmp_path, storage, mode):
        directory = recordings.write_rosbag2(tmp_path / 'run', storage, mode)
        (directory / 'metadata.yaml').unlink()
        (file,) = directory.iterdir()
        for path in (directory, file):
            with Recording(path) as run:
                assert_same_events(list(run.events(run.find_topics())), recordings.events())
                assert not run.loss

    @pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
    def test_of_one_that_is_cut_off_what_is_there_is_read_or_the_remedy_named(
        self, tmp_path, storage, mode
    ):
        repeats = 200 if storage == StoragePlugin.MCAP else 50  # chunks are large
        directory = recordings.write_rosbag2(tmp_path / 'run', storage, mode, repeats=repeats)
        (file,) = (path for path in directory.iterdir() if path.suffix != '.yaml')
        os.truncate(file, file.stat().st_size * 2 // 3)
        if storage == StoragePlugin.SQLITE3:
            with pytest.raises(RecordingError, match='mend it by') as caught:
                Recording(directory)
            assert str(file) in str(caught.value)
            assert 'slam_observer_' not in str(caught.value)
            return
        with Recording(directory) as run:
            assert 0 < len(list(run.events(run.find_topics()))) < repeats * 150
            assert run.loss
            assert run.loss.message_count > 0
            assert str(file) in run.warning
            assert 'slam_observer_' not in run.warning

    def test_a_message_that_is_damaged_is_malformed(self, tmp_path, storage):
        directory = recordings.write_rosbag2(tmp_path / 'run', storage, CompressionMode.MESSAGE)
        (file,) = (path for path in directory.iterdir() if path.suffix != '.yaml')
        data = file.read_bytes()
        middle = data.index(bytes.fromhex('28b52ffd'), len(data) // 2)  # how zstd begins
        file.write_bytes(data[: middle + 5] + bytes(8) + data[middle + 13 :])
        with Recording(directory) as run:
            events = list(run.events(run.find_topics()))
            lost = run.malformed.total() + bool(run.loss)
        assert len(events) < 150
        assert lost


def cloud2_with(count: int, *fields: str) -> object:
    """sensor_msgs/PointCloud2 of so many points."""
    return ros.point_cloud2(np.zeros((1, count), [(name, '<f4') for name in fields]))


class TestTopics:
    """What is found without asking, and what is asked."""

    TWIST = ros.twist([1.0] * 6)
    ODOMETRY = ros.odometry([1.0] * 6, np.eye(6))
    CLOUD = ros.point_cloud(np.zeros((1, 3)), {'id': np.array([1])})
    LIDAR = ros.point_cloud(np.zeros((2, 3)), {'intensity': np.zeros(2)})
    POSE = ros.make(
        'geometry_msgs/msg/PoseStamped', ros.header('map'), ros.pose([0.0] * 3, [0, 0, 0, 1.0])
    )

    def find(
        self,
        path: Path,
        messages: dict[str, object],
        inputs: InputSettings = InputSettings(),  # it is immutable
        **names: str,
    ):
        with RecordingWriter(path / 'topics.mcap') as writer:
            for topic, message in messages.items():
                writer.write(topic, message.__msgtype__, ros.serialise(message), ros.STAMP_NS)
        with Recording(path / 'topics.mcap') as recording:
            selected = recording.find_topics(TopicNames(**names), inputs)
        return {
            role: topic.name if topic else None
            for role, topic in (
                ('velocity', selected.velocity),
                ('landmarks', selected.landmarks),
                ('pose_truth', selected.pose_truth),
                ('landmark_truth', selected.landmark_truth),
            )
        }

    def test_the_only_topics_of_their_types(self, tmp_path):
        assert self.find(tmp_path, {'/wheels': self.TWIST, '/beacons': self.CLOUD}) == {
            'velocity': '/wheels',
            'landmarks': '/beacons',
            'pose_truth': None,
            'landmark_truth': None,
        }

    def test_recording_of_the_demo_with_the_observers_own_output(self, tmp_path):
        found = self.find(
            tmp_path,
            {
                '/observer_node/odometry': self.ODOMETRY,
                '/landmark_map': self.CLOUD,
                '/landmark_estimates': self.CLOUD,
                '/twist': self.TWIST,
                '/landmarks': self.CLOUD,
                '/pose': self.POSE,
                '/ground_truth/pose': self.POSE,
                '/ground_truth/odometry': self.ODOMETRY,
                '/ground_truth/landmarks': self.CLOUD,
            },
        )
        assert found == {
            'velocity': '/twist',
            'landmarks': '/landmarks',
            'pose_truth': '/ground_truth/pose',
            'landmark_truth': '/ground_truth/landmarks',
        }

    def test_measured_velocity_comes_before_commands(self, tmp_path):
        messages = {'/cmd_vel': self.TWIST, '/odom': self.ODOMETRY, '/beacons': self.CLOUD}
        assert self.find(tmp_path, messages)['velocity'] == '/odom'

    @pytest.mark.parametrize(
        ('empty', 'full'),
        [
            (ros.point_cloud(np.zeros((0, 3)), {}), CLOUD),
            (cloud2_with(0), cloud2_with(2, 'x', 'y', 'z', 'id')),
            (cloud2_with(0, 'x', 'y', 'z'), cloud2_with(2, 'x', 'y', 'z', 'id')),
        ],
    )
    def test_empty_clouds_do_not_hide_the_ids_of_those_that_follow(self, tmp_path, empty, full):
        with RecordingWriter(tmp_path / 'run.mcap') as writer:
            messages = ('/twist', self.TWIST), ('/beacons', empty), ('/beacons', full)
            for index, (topic, message) in enumerate(messages):
                data = ros.serialise(message)
                writer.write(topic, message.__msgtype__, data, ros.STAMP_NS + index)
        with Recording(tmp_path / 'run.mcap') as recording:
            assert recording.contents.missing_ids(recording.find_topics().landmarks) == ''

    def test_a_topic_of_empty_clouds_only_is_taken_if_they_have_a_field_for_ids(self, tmp_path):
        messages = {'/twist': self.TWIST, '/beacons': cloud2_with(0, 'x', 'y', 'z', 'id')}
        assert self.find(tmp_path, messages)['landmarks'] == '/beacons'

    @pytest.mark.parametrize('command', [TWIST, None])
    def test_an_odometry_that_is_stated_in_the_map_is_taken_only_where_nothing_else_is(
        self, tmp_path, command
    ):
        estimate = ros.odometry([1.0] * 6, np.eye(6), frames=('map', 'base_link'))
        messages = {'/odometry': estimate, '/beacons': self.CLOUD}
        if command is not None:
            messages['/cmd_vel'] = command
        expected = '/odometry' if command is None else '/cmd_vel'
        assert self.find(tmp_path, messages)['velocity'] == expected

    def test_clouds_without_ids_are_taken_only_by_name(self, tmp_path):
        messages = {'/twist': self.TWIST, '/lidar': self.LIDAR, '/beacons': self.CLOUD}
        assert self.find(tmp_path, messages)['landmarks'] == '/beacons'
        (tmp_path / 'topics.mcap').unlink()
        assert self.find(tmp_path, messages, landmarks='lidar')['landmarks'] == '/lidar'

    def test_clouds_without_ids_are_taken_by_their_type(self, tmp_path):
        inputs = InputSettings(landmarks_type=self.LIDAR.__msgtype__.rsplit('/', 1)[-1])
        messages = {'/twist': self.TWIST, '/lidar': self.LIDAR}
        assert self.find(tmp_path, messages, inputs)['landmarks'] == '/lidar'
        (tmp_path / 'topics.mcap').unlink()
        found = self.find(tmp_path, {**messages, '/beacons': self.CLOUD}, inputs)
        assert found['landmarks'] == '/beacons', 'points with ids come first'

    def test_a_cloud_called_landmarks_needs_no_ids(self, tmp_path):
        messages = {'/twist': self.TWIST, '/landmarks': self.LIDAR, '/beacons': self.CLOUD}
        assert self.find(tmp_path, messages)['landmarks'] == '/landmarks'

    @pytest.mark.parametrize(
        ('others', 'reason'),
        [
            (
                {'/a/twist': TWIST, '/b/twist': TWIST, '/landmarks': CLOUD},
                r'2 topics could be the velocity topic: /a/twist \(geometry_msgs/msg/Twist, '
                r'1 messages\), /b/twist .*choose one with --velocity-topic',
            ),
            (
                {'/twist': TWIST, '/a': CLOUD, '/b': CLOUD},
                '2 topics could be the landmark topic: .*choose one with --landmarks-topic',
            ),
            ({'/landmarks': CLOUD}, 'no velocity topic: .*the recording holds /landmarks'),
            ({'/twist': TWIST, '/lidar': LIDAR}, 'no landmark topic: .*with ids'),
            (
                {'/twist': TWIST, '/ground_truth/landmarks': CLOUD},
                'no landmark topic: .*the recording holds',
            ),
        ],
    )
    def test_missing_or_ambiguous_topics_are_listed(self, tmp_path, others, reason):
        with pytest.raises(RecordingError, match=reason):
            self.find(tmp_path, others)

    def test_choice_settles_what_is_ambiguous(self, tmp_path):
        messages = {'/a/twist': self.TWIST, '/b/twist': self.TWIST, '/landmarks': self.CLOUD}
        assert self.find(tmp_path, messages, velocity='b/twist')['velocity'] == '/b/twist'

    def test_choice_that_is_not_there_or_of_another_type(self, tmp_path):
        messages = {'/twist': self.TWIST, '/landmarks': self.CLOUD}
        with pytest.raises(RecordingError, match='no topic /wheels; the recording holds /twist'):
            self.find(tmp_path, messages, velocity='/wheels')
        (tmp_path / 'topics.mcap').unlink()
        with pytest.raises(RecordingError, match='can not be the velocity topic, which is one of'):
            self.find(tmp_path, messages, velocity='/landmarks')


def test_last_position_of_a_true_landmark_counts(tmp_path):
    path = tmp_path / 'moved.mcap'
    with RecordingWriter(path) as writer:
        writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.zeros(6)))
        writer.write_observation(ObservationEvent(ros.STAMP_NS, np.array([1]), np.zeros((1, 3))))
        for ids, x in (([7, 8], 1.0), ([8, -1], 2.0)):
            truth = LandmarkTruth(np.array(ids), np.full((2, 3), x))
            writer.write_landmarks(ros.STAMP_NS, truth)
    with Recording(path) as recording:
        landmarks = recording.truth(recording.find_topics()).landmarks
    assert landmarks.ids.tolist() == [7, 8]
    assert landmarks.world_points[:, 0].tolist() == [1.0, 2.0]


def landmark_messages(*stated):
    """Messages of (second, ids, x of all of them)."""
    return [
        ObservationEvent(s * 1_000_000_000, np.array(ids), np.full((len(ids), 3), float(x)))
        for s, ids, x in stated
    ]


@pytest.mark.parametrize(
    ('stated', 'expected'),
    [
        ([(0, [7], 0), (1, [7], 0), (2, [7, 8], 1), (3, [7, 8], 2)],
         {0.0: (0, 1), 1.5: (0.5, 1), 2.5: (1.5, 1.5), 3.0: (2, 2), 9.0: (2, 2)}),
        ([(s, [7], 0) for s in range(100)] + [(100, [7], 10), (101, [7], 10)],
         {50.0: (0,), 99.0: (0,), 99.5: (5,), 100.0: (10,)}),
        ([(s, [i], s) for s in range(3) for i in (7, 8)], {0.5: (0.5, 0.5), 1.5: (1.5, 1.5)}),
        ([(1, [7], 1), (0, [7], 0)], {-1.0: (0,), 0.5: (0.5,), 1.0: (1,)}),
        ([(0, [7], 0), (0, [7], 3)], {-1.0: (3,), 0.0: (3,), 1.0: (3,)}),
        ([(0, [-1], 0), (5, [7], 3)], {0.0: (3,)}),
    ],
    ids=['moves', 'at rest, then put', 'one each message', 'unsorted', 'stated again', 'unknown'],
)  # fmt: skip
def test_true_landmarks_are_where_they_are_at_the_time(stated, expected):
    tracks = LandmarkTracks.from_messages(landmark_messages(*stated))
    for time_s, x in expected.items():
        landmarks = tracks.at(int(time_s * 1e9))
        assert_allclose(landmarks.world_points[:, 0], x)


def test_nothing_known_of_true_landmarks_is_no_truth():
    for stated in ((), ((0, [-1], 0),)):
        assert LandmarkTracks.from_messages(landmark_messages(*stated)) is None


def test_bag_of_several_files_is_read_whole(tmp_path):
    directory = recordings.write_rosbag2(tmp_path / 'split', StoragePlugin.MCAP)
    metadata = directory / 'metadata.yaml'
    shutil.copy(directory / 'split.mcap', directory / 'split_1.mcap')
    metadata.write_text(
        metadata.read_text().replace('  - split.mcap', '  - split.mcap\n  - split_1.mcap', 1)
    )
    with Recording(directory) as recording:
        assert len(list(recording.events(recording.find_topics()))) == 300
