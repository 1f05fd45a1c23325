"""Of a damaged MCAP file the whole messages are read; others are refused with what mends them."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import ros_messages as ros
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.sources import MENDED_BY
from slam_observer_ros.recordings.writer import RecordingWriter

COUNT = 30_000  # of MCAP, whose chunks are large
FEWER = 9_000
COUNTS = {'mcap': COUNT, 'db3': FEWER, 'bag': FEWER}
STEP_NS = 1_000_000
METADATA = """\
rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths: [run_0.mcap, run_1.mcap]
  duration: {nanoseconds: 1}
  starting_time: {nanoseconds_since_epoch: 0}
  message_count: 1
  compression_format: ''
  compression_mode: ''
  topics_with_message_count:
"""

TOPIC = """\
  - message_count: 1
    topic_metadata:
      {{name: {}, type: {}, serialization_format: cdr, offered_qos_profiles: ''}}
"""

FORMATS = ['mcap', 'db3', 'bag']


def write_mcap(path, start_ns=ros.STAMP_NS):
    random = np.random.default_rng(0)  # which does not compress
    with RecordingWriter(path) as writer:
        writer.write_observation(ObservationEvent(start_ns, np.array([1]), np.zeros((1, 3))))
        for index in range(COUNT):
            event = VelocityEvent(start_ns + index * STEP_NS, random.normal(size=6))
            writer.write_velocity(event)
    return path


def write_db3(path):
    bag = rosbag2.Writer(path.with_suffix(''), version=9, storage_plugin=StoragePlugin.SQLITE3)
    with bag:
        write_all(bag, ros.TYPESTORE, lambda message: bytes(ros.serialise(message)))
    next(path.with_suffix('').glob('*.db3')).rename(path)
    return path


def write_bag(path):
    typestore = get_typestore(Stores.ROS1_NOETIC)
    bag = rosbag1.Writer(path)
    bag.set_compression(bag.CompressionFormat.LZ4)
    bag.chunk_threshold //= COUNT // FEWER
    with bag:
        write_all(
            bag, typestore, lambda message: typestore.serialize_ros1(message, message.__msgtype__)
        )
    return path


def write_all(bag, typestore, serialise):
    points = np.full((2000, 3), np.nan)  # on several pages, and all but one not measured
    points[0] = 1.0
    big = ros.point_cloud(points, {'id': np.arange(2000)})
    if isinstance(bag, rosbag1.Writer):
        big.header = typestore.types['std_msgs/msg/Header'](0, big.header.stamp, 'base_link')
    twists = bag.add_connection('/twist', 'geometry_msgs/msg/Twist', typestore=typestore)
    clouds = bag.add_connection('/landmarks', big.__msgtype__, typestore=typestore)
    cloud = serialise(big)
    random = np.random.default_rng(0)
    for index in range(FEWER):
        stamp_ns = ros.STAMP_NS + index * STEP_NS
        if index % 3000 == 0:
            bag.write(clouds, stamp_ns, cloud)
        bag.write(twists, stamp_ns, serialise(ros.twist(random.normal(size=6).tolist())))


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Recordings of some seconds by format."""
    folder = tmp_path_factory.mktemp('whole')
    writers = {'mcap': write_mcap, 'db3': write_db3, 'bag': write_bag}
    return {name: write(folder / f'run.{name}') for name, write in writers.items()}


def read(path: Path):
    with Recording(path) as recording:
        velocities = [
            event.receive_ns - ros.STAMP_NS
            for event in recording.events(recording.find_topics())
            if isinstance(event, VelocityEvent)
        ]
        return velocities, recording.loss, recording.warning


@pytest.mark.parametrize('name', FORMATS)
def test_of_a_whole_recording_nothing_is_lost(whole, name):
    velocities, loss, warning = read(whole[name])
    assert (len(velocities), bool(loss), warning) == (COUNTS[name], False, None)


def test_of_a_split_recording_what_is_whole_before_and_behind_a_damaged_chunk_is_read(
    whole, tmp_path
):
    (tmp_path / 'run_0.mcap').write_bytes(whole['mcap'].read_bytes())
    second = write_mcap(tmp_path / 'run_1.mcap', ros.STAMP_NS + COUNT * STEP_NS)
    data = bytearray(second.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20_000] = bytes(20_000)
    second.write_bytes(data)
    with Recording(whole['mcap']) as recording:
        topics = [(topic.name, topic.message_type) for topic in recording.topics]
    (tmp_path / 'metadata.yaml').write_text(METADATA + ''.join(TOPIC.format(*t) for t in topics))
    velocities, loss, _ = read(tmp_path)
    assert velocities == sorted(set(velocities))
    assert 1.5 * COUNT < len(velocities) < 2 * COUNT
    assert velocities[-1] == (2 * COUNT - 1) * STEP_NS
    assert loss.byte_count > 0


def cut_off(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def blanked(data: bytes) -> bytes:
    """Return it with zeros in the middle."""
    middle = len(data) // 2
    return data[:middle] + bytes(20_000) + data[middle + 20_000 :]


def test_a_recording_that_is_cut_off_is_read_up_to_there(whole, tmp_path):
    path = tmp_path / 'run.mcap'
    path.write_bytes(cut_off(whole['mcap'].read_bytes()))
    velocities, loss, warning = read(path)
    assert COUNT // 3 < len(velocities) < COUNT
    assert velocities == sorted(velocities)
    assert loss.is_cut_off
    assert 'cut off or damaged' in warning
    assert f'{loss.byte_count} bytes' in warning


def test_behind_damage_in_the_middle_it_goes_on_with_what_is_whole(whole, tmp_path):
    data = blanked(whole['mcap'].read_bytes())
    path = tmp_path / 'run.mcap'
    path.write_bytes(data)
    velocities, loss, _ = read(path)
    assert COUNT // 2 < len(velocities) < COUNT
    assert velocities[-1] == (COUNT - 1) * STEP_NS
    assert 10_000 < loss.byte_count < len(data) // 2
    assert loss.seconds == pytest.approx(np.diff(velocities).max() * 1e-9, abs=0.01)
    assert not loss.is_cut_off


@pytest.mark.parametrize('name', FORMATS)
def test_scripts_see_that_nothing_is_lost(slam_observer, whole, name):
    ended = slam_observer('replay', whole[name], '--strict', '--json', '--gains', 'constant')
    assert ended.code == 0
    assert not any(ended.json['lost'].values())


def test_scripts_see_what_is_lost(slam_observer, whole, tmp_path):
    path = tmp_path / 'run.mcap'
    path.write_bytes(blanked(whole['mcap'].read_bytes()))
    ended = slam_observer('replay', path, '--strict', '--json', '--gains', 'constant')
    assert ended.code == 3
    assert ended.json['lost']['bytes'] > 0
    assert 'a part of it was lost, which --strict does not allow' in ended.errors
    assert 'bytes and' in ended.errors


@pytest.mark.parametrize('damaged', [cut_off, blanked])
@pytest.mark.parametrize('name', ['db3', 'bag'])
def test_a_damaged_file_of_another_format_is_refused_with_what_mends_it(
    slam_observer, whole, tmp_path, name, damaged
):
    path, tum = tmp_path / f'run.{name}', tmp_path / 'run.tum'
    path.write_bytes(damaged(whole[name].read_bytes()))
    ended = slam_observer('replay', path, '--gains', 'constant', '--tum', tum)
    assert (ended.code, ended.output) == (2, '')
    error = ended.errors.splitlines()[-1]
    assert f'{path}: can not be read: ' in error
    assert f'; mend it by {MENDED_BY[path.suffix]}' in error
    assert not tum.exists()


@pytest.mark.parametrize('name', ['db3', 'bag'])
@pytest.mark.parametrize(
    ('content', 'why'), [(b'', 'it is empty'), (bytes(range(200)), 'it is damaged, or no .')]
)
def test_nothing_mends_a_file_that_is_of_no_format(tmp_path, name, content, why):
    path = tmp_path / f'run.{name}'
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=why) as caught:
        Recording(path)
    assert 'mend it' not in str(caught.value)


def test_of_a_split_recording_the_whole_databases_are_read_and_the_damaged_one_is_named(
    whole, tmp_path
):
    (tmp_path / 'run_0.db3').write_bytes(whole['db3'].read_bytes())
    (tmp_path / 'run_1.db3').write_bytes(cut_off(whole['db3'].read_bytes()))
    metadata = METADATA.replace('mcap', 'sqlite3', 1).replace('.mcap', '.db3')
    with Recording(whole['db3']) as recording:
        topics = [(topic.name, topic.message_type) for topic in recording.topics]
    (tmp_path / 'metadata.yaml').write_text(metadata + ''.join(TOPIC.format(*t) for t in topics))
    velocities, loss, warning = read(tmp_path)
    assert len(velocities) == FEWER
    assert loss.byte_count == (tmp_path / 'run_1.db3').stat().st_size
    assert f'{tmp_path / "run_1.db3"}: can not be read' in warning
    assert f'mend it by {MENDED_BY[".db3"]}' in warning


@pytest.mark.parametrize('name', FORMATS)
@settings(max_examples=15)
@given(data=st.data())
def test_whatever_the_damage_a_scan_ends_and_raises_nothing(whole, tmp_path_factory, name, data):
    damaged = bytearray(whole[name].read_bytes()[:300_000])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        size = data.draw(st.sampled_from([1, 1, 8, 5000]))
        value = data.draw(st.sampled_from([b'\0', b'\xff', b'\x7f', b'\x06', b'\x05']))
        damaged[at : at + size] = value * size
    path = tmp_path_factory.mktemp('damaged') / f'run.{name}'
    path.write_bytes(damaged)
    try:
        read(path)
    except RecordingError as error:
        assert '\n' not in str(error)
