"""One small run, written in every format that recordings come in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import math
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
import numpy as np
import ros_messages as ros
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.events import Event, ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import LandmarkTruth, PoseTruth
from slam_observer_ros.recordings.writer import RecordingWriter

SAMPLE = Path(__file__).resolve().parents[2] / 'samples' / 'sample.mcap'
"""The recording that comes with the package."""

STEP_NS = 20_000_000
LANDMARKS = LandmarkTruth(np.array([3, 5, 9]), np.arange(9.0).reshape(3, 3))
MESSAGE_COUNT = 100


def stamps_ns() -> range:
    """Stamps of the run's velocities, every other one with an observation."""
    return range(ros.STAMP_NS, ros.STAMP_NS + MESSAGE_COUNT * STEP_NS, STEP_NS)


def events() -> list[Event]:
    """Drive straight on at 1/8 m a step, past the landmarks: numbers that float32 holds."""
    made: list[Event] = []
    for index, stamp_ns in enumerate(stamps_ns()):
        made.append(VelocityEvent(stamp_ns, np.array([0.0, 0.0, 0.0, 6.25, 0.0, 0.0])))
        if index % 2 == 0:
            points = LANDMARKS.world_points - np.array([index / 8, 0.0, 0.0])
            made.append(ObservationEvent(stamp_ns, LANDMARKS.ids, points))
    return made


def true_poses() -> list[PoseTruth]:
    """The run's true poses."""
    return [
        PoseTruth(stamp_ns, se3.exp(np.array([0.0, 0.0, 0.0, 0.125, 0.0, 0.0]) * index))
        for index, stamp_ns in enumerate(stamps_ns())
    ]


def write_mcap(path: Path) -> Path:
    """Write the run as the package does."""
    with RecordingWriter(path) as writer:
        writer.write_landmarks(ros.STAMP_NS, LANDMARKS)
        for item in (*events(), *true_poses()):
            writer.write_event(item)
    return path


def write_events(path: Path, written: Iterable[Event | PoseTruth]) -> Path:
    """Write a recording of what is given."""
    with RecordingWriter(path) as writer:
        for item in written:
            writer.write_event(item)
    return path


def blinded(of: list[Event], which: slice) -> list[Event]:
    """Take all points out of some of the events."""
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
    blind = range(len(of))[which]
    return [
        ObservationEvent(event.stamp_ns, *nothing)
        if isinstance(event, ObservationEvent) and index in blind
        else event
        for index, event in enumerate(of)
    ]


def write_beginning(path: Path, of: Path, seconds: float) -> Path:
    """Write the first seconds of an MCAP file as another one."""
    with of.open('rb') as opened, path.open('wb') as file:
        reader, writer, channels = make_reader(opened), McapWriter(file), dict[int, int]()
        writer.start(profile='ros2')
        until_ns = math.inf
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            until_ns = min(until_ns, message.log_time + seconds * 1e9)
            if message.log_time > until_ns:
                break
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return path


def messages() -> Iterator[tuple[str, int, object]]:
    """Topic, receive time and message of the run, with a PointCloud and unstamped Twists."""
    cloud = ros.point_cloud(LANDMARKS.world_points, {'id': LANDMARKS.ids})
    yield '/ground_truth/landmarks', ros.STAMP_NS, cloud
    for event in events():
        if isinstance(event, VelocityEvent):
            yield '/twist', event.stamp_ns, ros.twist(event.body_velocity.tolist())
        else:
            cloud = ros.point_cloud(event.points, {'id': event.ids})
            cloud.header.stamp.sec, cloud.header.stamp.nanosec = divmod(
                event.stamp_ns, 1_000_000_000
            )
            yield '/landmarks', event.stamp_ns, cloud


def write_rosbag2(
    directory: Path,
    storage: StoragePlugin,
    compression: CompressionMode = CompressionMode.NONE,
    repeats: int = 1,
) -> Path:
    """Write the run as a rosbag2 directory, again and again."""
    serialised = [
        (topic, stamp_ns, message.__msgtype__, ros.serialise(message))
        for topic, stamp_ns, message in messages()
    ]
    bag = rosbag2.Writer(directory, version=9, storage_plugin=storage)
    bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag:
        connections = {}
        for number in range(repeats):
            for topic, stamp_ns, message_type, data in serialised:
                if topic not in connections:
                    connections[topic] = bag.add_connection(
                        topic, message_type, typestore=ros.TYPESTORE
                    )
                bag.write(connections[topic], stamp_ns + number * 3 * 10**9, data)
    return directory


def write_rosbag1(path: Path) -> Path:
    """Write the run as a ROS 1 .bag, which begins with a message of a type that ROS 2 has not."""
    typestore = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as bag:
        log_type = 'rosgraph_msgs/msg/Log'
        rosout = bag.add_connection('/rosout', log_type, typestore=typestore)
        bag.write(rosout, ros.STAMP_NS, b'')
        connections = {}
        for topic, stamp_ns, message in messages():
            if topic not in connections:
                connections[topic] = bag.add_connection(
                    topic, message.__msgtype__, typestore=typestore
                )
            if hasattr(message, 'header'):
                stamped = typestore.types['std_msgs/msg/Header']
                message.header = stamped(
                    seq=0, stamp=message.header.stamp, frame_id=message.header.frame_id
                )
            bag.write(
                connections[topic],
                stamp_ns,
                typestore.serialize_ros1(message, message.__msgtype__),
            )
    return path


def write_all_formats(directory: Path) -> dict[str, Path]:
    """Write the run in each format; return the paths by format."""
    sqlite = write_rosbag2(directory / 'sqlite', StoragePlugin.SQLITE3)
    mcap = write_rosbag2(directory / 'mcap', StoragePlugin.MCAP)
    return {
        'mcap file': mcap / 'mcap.mcap',
        'mcap directory': mcap,
        'sqlite3 file': next(sqlite.glob('*.db3')),
        'sqlite3 directory': sqlite,
        'ROS 1 bag': write_rosbag1(directory / 'run.bag'),
        'own mcap': write_mcap(directory / 'own.mcap'),
    }
