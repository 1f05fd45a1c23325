"""Velocities that are read in blocks are those read one by one, whatever is in between."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
import numpy as np
from numpy.testing import assert_array_equal
import pytest
import ros_messages as ros
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_typestore, Stores
from strategies import generators

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityBlock
from slam_observer_ros.recordings import reader
from slam_observer_ros.recordings.mcap_source import McapSource
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.sources import in_blocks, RawBlock
from slam_observer_ros.recordings.topics import TopicNames
from slam_observer_ros.settings.estimator_settings import Settings

STEP_NS = 20_000_000
TYPES = ('Twist', 'TwistStamped', 'TwistWithCovarianceStamped', 'Odometry')


def write_mcap(path, messages, chunk_size):
    """Write topics, types, receive times and bytes as they come."""
    with path.open('wb') as file:
        writer = Writer(file, chunk_size, CompressionType.LZ4)
        writer.start('ros2', 'test')
        channels = {}
        for topic, message_type, received_ns, data in messages:
            if topic not in channels:
                schema = writer.register_schema(message_type, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], received_ns, data, received_ns)
        writer.finish()


def write_sqlite(directory, messages):
    with rosbag2.Writer(directory, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        write_bag(bag, messages, ros.TYPESTORE, lambda data, _: data)
    return directory


def write_ros1(path, messages):
    with rosbag1.Writer(path) as bag:
        write_bag(bag, messages, get_typestore(Stores.ROS1_NOETIC), ros.TYPESTORE.cdr_to_ros1)
    return path


def write_bag(bag, messages, typestore, converted):
    connections = {}
    for topic, message_type, received_ns, data in messages:
        if topic not in connections:
            connections[topic] = bag.add_connection(topic, message_type, typestore=typestore)
        bag.write(connections[topic], received_ns, bytes(converted(data, message_type)))


def one_by_one(items):
    for item in items:
        if isinstance(item, RawBlock):
            yield from item.messages()
        else:
            yield item


@given(rng=generators(), jitter_ns=st.sampled_from([0, 0, 300, 10**4]), few=st.booleans())
@hypothesis_settings(max_examples=15)
def test_blocks_of_an_mcap_file_are_its_messages(rng, jitter_ns, few):
    """Received in any order, at equal times, of different sizes, over chunks that overlap."""
    messages = []
    for number in range(400):
        topic = rng.choice(['/a', '/b', '/c'], p=[0.9, 0.05, 0.05])
        late_ns = int(rng.integers(-jitter_ns, jitter_ns + 1)) // 50 * 50
        received_ns = 10**9 + 100 * number + late_ns
        size = int(rng.choice([0, 4, 40, 41], p=[0.01, 0.09, 0.8, 0.1]))
        messages.append((topic, 'geometry_msgs/msg/Twist', received_ns, rng.bytes(size)))
    with TemporaryDirectory() as directory:
        path = Path(directory) / 'some.mcap'
        write_mcap(path, messages, chunk_size=int(rng.choice([300, 3000, 10**6])))
        source = McapSource(path)
        try:
            topics = [topic for topic in source.topics if not (few and topic.name == '/b')]
            together = next(topic for topic in topics if topic.name == '/a')
            expected = list(source.messages(topics))
            blocks = list(source.blocks(topics, together))
            of_messages = list(in_blocks(iter(expected), together))
        finally:
            source.close()
    assert list(one_by_one(blocks)) == expected
    assert list(one_by_one(of_messages)) == expected
    assert jitter_ns > 300 or len(blocks) < len(expected)


def velocity(rng, message_type, stamp_ns, frame, covariance):
    twist = rng.normal(size=6)
    if rng.random() < 0.02:
        twist[rng.integers(6)] = np.nan
    if message_type == 'Twist':
        return ros.twist(twist)
    if message_type == 'TwistStamped':
        return ros.twist_stamped(twist, frame, stamp_ns)
    if message_type == 'Odometry':
        return ros.odometry(twist, covariance, frames=('odom', frame), stamp_ns=stamp_ns)
    stated = 'geometry_msgs/msg/TwistWithCovariance'
    of_twist = ros.make(stated, ros.twist(twist), covariance.ravel())
    header = ros.header(frame, stamp_ns)
    return ros.make('geometry_msgs/msg/TwistWithCovarianceStamped', header, of_twist)


def recorded(rng, message_type, oddities):
    """A run with landmarks now and then, and with a few velocities that differ from the others."""
    covariance = rng.choice([0.0, 1.0]) * np.arange(36.0).reshape(6, 6)
    for number in range(200):
        odd = oddities * rng.random(5) < 0.02 * oddities
        received_ns = ros.STAMP_NS + number * STEP_NS
        stamp_ns = 0 if odd[0] else received_ns - int(rng.integers(10**7))
        unknown = np.diag([-1.0, 0, 0, 0, 0, 0])
        frame = str(rng.choice(['imu_link', 'nowhere', 'odom'])) if odd[1] else 'base_link'
        message = velocity(rng, message_type, stamp_ns, frame, unknown if odd[2] else covariance)
        data = ros.serialise(message, little_endian=not odd[3])
        data = data[:-7] if odd[4] else data
        yield '/odom', message.__msgtype__, received_ns, data
        if number % 37 == 5:
            cloud = ros.point_cloud(rng.normal(size=(3, 3)), {'id': np.arange(3)})
            yield '/landmarks', cloud.__msgtype__, received_ns, ros.serialise(cloud)
        if number == 60:
            tf = ros.make(
                'tf2_msgs/msg/TFMessage',
                [
                    ros.transform_stamped(
                        ('base_link', 'imu_link'), [1, 0, 0], [0, 0, 0, 1.0], received_ns
                    )
                ],
            )
            yield '/tf', tf.__msgtype__, received_ns, ros.serialise(tf)


def read(path, fewest_in_block):
    """Events one by one, whether they came in blocks, and what was counted."""
    before = reader.FEWEST_IN_BLOCK
    reader.FEWEST_IN_BLOCK = fewest_in_block
    try:
        with Recording(path) as recording:
            selected = recording.find_topics(TopicNames(velocity='/odom'))
            items = list(recording.blocks(selected))
            events = list(recording.events(selected))
    finally:
        reader.FEWEST_IN_BLOCK = before
    arrivals = recording.arrivals['/odom']
    counts = (recording.malformed, recording.unstamped, recording.dropped, len(arrivals))
    times = arrivals.first_s, arrivals.last_s, arrivals._received_s, arrivals._delays_s
    return events, sum(isinstance(item, VelocityBlock) for item in items), counts, times


@given(
    rng=generators(),
    message_type=st.sampled_from(TYPES),
    oddities=st.sampled_from([0, 1, 3]),
)
@hypothesis_settings(max_examples=10)
def test_velocities_in_blocks_are_those_one_by_one(rng, message_type, oddities):
    with TemporaryDirectory() as directory:
        path = Path(directory) / 'run.mcap'
        write_mcap(path, recorded(rng, message_type, oddities), chunk_size=5000)
        expected, none, *expected_counts = read(path, 10**9)
        events, blocks, *counts = read(path, reader.FEWEST_IN_BLOCK)
    assert none == 0
    assert blocks > 0
    assert counts == expected_counts
    assert [type(event) for event in events] == [type(event) for event in expected]
    for event, same in zip(events, expected, strict=True):
        for field in dataclasses.fields(event):
            value = getattr(event, field.name)
            assert_array_equal(value, getattr(same, field.name), err_msg=field.name)
            assert type(value) is type(getattr(same, field.name))


def estimated(path):
    """All bits that are estimated of a recording, and how many velocities came in blocks."""
    estimator, in_blocks_count = Estimator(Settings(confirmations=1)), 0
    with Recording(path) as recording:
        for item in recording.blocks(recording.find_topics(TopicNames(velocity='/odom'))):
            if isinstance(item, VelocityBlock):
                in_blocks_count += len(item)
                estimator.add_velocities(item)
            else:
                estimator.add(item)
    estimator.flush()
    arrays = estimator.pose, estimator.pose_covariance, estimator.world_points
    return [array.tobytes() for array in arrays], in_blocks_count


@pytest.mark.parametrize('message_type', TYPES)
def test_every_format_of_a_drive_comes_in_blocks_and_gives_the_same_estimates(
    tmp_path, message_type
):
    messages = [
        each
        for each in recorded(np.random.default_rng(5), message_type, 0)
        if each[1] != 'tf2_msgs/msg/TFMessage'
    ]
    write_mcap(tmp_path / 'run.mcap', messages, chunk_size=10**6)
    estimates, in_blocks_count = estimated(tmp_path / 'run.mcap')
    assert in_blocks_count > 150
    sqlite = write_sqlite(tmp_path / 'sqlite', messages)
    assert estimated(sqlite) == (estimates, in_blocks_count)
    assert estimated(write_ros1(tmp_path / 'run.bag', messages)) == (estimates, in_blocks_count)


def true_pose(rng, message_type, stamp_ns, frame):
    position, quaternion = rng.normal(size=3), rng.normal(size=4)
    quaternion *= rng.choice([1.0, 1.05]) / np.linalg.norm(quaternion)
    if message_type == 'TransformStamped':
        return ros.transform_stamped(('map', frame), position, quaternion, stamp_ns)
    if message_type == 'Odometry':
        return ros.odometry(np.zeros(6), np.eye(6), position, quaternion, ('map', frame), stamp_ns)
    header, pose = ros.header('map', stamp_ns), ros.pose(position, quaternion)
    if message_type == 'PoseStamped':
        return ros.make('geometry_msgs/msg/PoseStamped', header, pose)
    uncertain = ros.make('geometry_msgs/msg/PoseWithCovariance', pose, np.zeros(36))
    return ros.make('geometry_msgs/msg/PoseWithCovarianceStamped', header, uncertain)


def recorded_truth(rng, message_type, oddities):
    yield from recorded(rng, 'Twist', 0)
    for number in range(100):
        odd = rng.random(4) < 0.03 * oddities
        received_ns = ros.STAMP_NS + number * STEP_NS
        stamp_ns = 0 if odd[0] else received_ns + int(rng.integers(-3, 3)) * STEP_NS
        message = true_pose(rng, message_type, stamp_ns, 'imu_link' if odd[1] else 'base_link')
        data = ros.serialise(message, little_endian=not odd[2])
        data = data[:-9] if odd[3] else data
        yield '/ground_truth/pose', message.__msgtype__, received_ns, data


def read_truth(path):
    with Recording(path) as recording:
        selected = recording.find_topics(TopicNames(velocity='/odom'))
        truth = recording.truth(selected, 'base_link')
    return truth, recording.malformed


@given(
    rng=generators(),
    message_type=st.sampled_from(
        ('PoseStamped', 'PoseWithCovarianceStamped', 'TransformStamped', 'Odometry')
    ),
    oddities=st.sampled_from([0, 1]),
)
@hypothesis_settings(max_examples=10)
def test_true_poses_in_blocks_are_those_one_by_one(rng, message_type, oddities):
    with TemporaryDirectory() as directory:
        path = Path(directory) / 'run.mcap'
        write_mcap(path, recorded_truth(rng, message_type, oddities), chunk_size=5000)
        truth, malformed = read_truth(path)
        with patch.object(reader, 'decode_pose_block', side_effect=MessageError):
            expected, expected_malformed = read_truth(path)
    assert malformed == expected_malformed
    assert len(truth.poses) > 0
    assert_array_equal(truth.stamps_ns, expected.stamps_ns)
    assert_array_equal(truth.poses, expected.poses)
