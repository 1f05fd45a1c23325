"""A recording is one file that other tools read, and that appears only when it is whole."""

from __future__ import annotations

import json
import os
import resource

from mcap.reader import make_reader
import numpy as np
import pytest
import recordings
import ros_messages as ros
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.writer import RecordingWriter


def test_observations_keep_covariances_and_velocities(tmp_path):
    written = ObservationEvent(
        ros.STAMP_NS,
        np.array([4, -1]),
        np.arange(6.0).reshape(2, 3),
        np.tile(np.diag([1.0, 2.0, 3.0]), (2, 1, 1)),
        np.full((2, 3), 0.5),
    )
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path) as writer:
        writer.write_observation(written)
        writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.zeros(6)))
    with Recording(path) as recording:
        read = next(recording.events(recording.find_topics()))
    np.testing.assert_array_equal(read.ids, written.ids)
    np.testing.assert_array_equal(read.points, written.points)
    np.testing.assert_array_equal(read.covariances, written.covariances)
    np.testing.assert_array_equal(read.velocities, written.velocities)


def test_other_tools_find_schemas_counts_and_latching(tmp_path):
    path = recordings.write_mcap(tmp_path / 'run.mcap')
    with path.open('rb') as file:
        reader = make_reader(file)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        types = {
            channel.topic: summary.schemas[channel.schema_id].name
            for channel in summary.channels.values()
        }
        assert types == {
            '/twist': 'geometry_msgs/msg/TwistStamped',
            '/landmarks': 'sensor_msgs/msg/PointCloud2',
            '/ground_truth/pose': 'geometry_msgs/msg/PoseStamped',
            '/ground_truth/landmarks': 'sensor_msgs/msg/PointCloud2',
        }
        assert {schema.encoding for schema in summary.schemas.values()} == {'ros2msg'}
        assert summary.statistics.message_count == 251
        [metadata] = reader.iter_metadata()
    # ros2 bag reads its own metadata from there, which must name this file.
    assert json.dumps(metadata.metadata).count('run.mcap') == 2
    with Reader(path) as bag:
        durabilities = {
            connection.topic: [qos.durability for qos in connection.ext.offered_qos_profiles]
            for connection in bag.connections
        }
    assert durabilities.pop('/ground_truth/landmarks') == [QosDurability.TRANSIENT_LOCAL]
    assert set(map(tuple, durabilities.values())) == {()}


def test_failed_run_leaves_nothing_behind(tmp_path):
    def fail() -> None:
        with RecordingWriter(tmp_path / 'run.mcap') as writer:
            writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.zeros(6)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_file_appears_only_when_it_is_whole(tmp_path):
    path = tmp_path / 'run.mcap'
    with RecordingWriter(path):
        assert not path.exists()
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']


def test_existing_file_is_overwritten_only_when_allowed(tmp_path):
    path = recordings.write_mcap(tmp_path / 'run.mcap')
    before = path.read_bytes()
    with pytest.raises(RecordingError, match='not overwritten'):
        RecordingWriter(path)
    assert path.read_bytes() == before
    with RecordingWriter(path, overwrite=True) as writer:
        writer.write_velocity(VelocityEvent(ros.STAMP_NS, np.zeros(6)))
    with Recording(path) as recording:
        assert recording.message_count == 1


def test_a_link_stays_and_a_pipe_is_not_overwritten(tmp_path):
    (tmp_path / 'elsewhere').mkdir()
    (tmp_path / 'link.mcap').symlink_to(tmp_path / 'elsewhere' / 'run.mcap')
    recordings.write_mcap(tmp_path / 'link.mcap')
    assert (tmp_path / 'link.mcap').is_symlink()
    with Recording(tmp_path / 'elsewhere' / 'run.mcap') as recording:
        assert recording.message_count > 0
    os.mkfifo(tmp_path / 'pipe.mcap')
    with pytest.raises(RecordingError, match='no regular file'):
        RecordingWriter(tmp_path / 'pipe.mcap', overwrite=True)
    assert (tmp_path / 'pipe.mcap').is_fifo()


def test_file_that_appears_while_writing_is_not_overwritten(tmp_path):
    path = tmp_path / 'run.mcap'
    writer = RecordingWriter(path)
    path.write_text('precious')
    with pytest.raises(RecordingError, match='not overwritten'):
        writer.close()
    assert path.read_text() == 'precious'


def test_full_disk_is_reported_with_the_name_of_the_file(tmp_path):
    random = np.random.default_rng(0)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill() -> None:
        with RecordingWriter(tmp_path / 'run.mcap') as writer:
            for index in range(100_000):
                velocity = VelocityEvent(ros.STAMP_NS + index, random.normal(size=6))
                writer.write_velocity(velocity)

    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(RecordingError, match=r'run\.mcap: File too large'):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('name', 'reason'), [('run.bag', '.mcap files'), ('missing/run.mcap', 'No such file')]
)
def test_place_that_can_not_be_written(tmp_path, name, reason):
    with pytest.raises(RecordingError, match=reason):
        RecordingWriter(tmp_path / name)
