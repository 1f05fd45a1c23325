"""MCAP files as all kinds of programs write them: nothing in them is lost without a word."""

from __future__ import annotations

import struct
import tracemalloc

from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
import pytest
import ros_messages as ros

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.recordings import mcap_source
from slam_observer_ros.recordings.reader import Recording

STEP_NS = 20_000_000
TWIST, CLOUD = 'geometry_msgs/msg/TwistStamped', 'sensor_msgs/msg/PointCloud'


def run(count=300):
    """Yield topic, type, receive time and bytes of a short drive."""
    for number in range(count):
        stamp_ns = ros.STAMP_NS + number * STEP_NS
        twist = ros.twist_stamped([0.1 * (number % 7), 0, 0, 0, 0, 0.2], 'base_link', stamp_ns)
        yield '/twist', TWIST, stamp_ns, ros.serialise(twist)
        if number % 10 == 0:
            cloud = ros.point_cloud(np.eye(3) + 2.0, {'id': np.arange(3)})
            yield '/landmarks', CLOUD, stamp_ns, ros.serialise(cloud)


def write(path, messages=None, chunk_size=3000, extras=(), **options):
    """Write messages as they come; ``options`` are the writer's."""
    with path.open('wb') as file:
        writer = Writer(file, chunk_size, **options)
        writer.start('ros2', 'test')
        channels = {}
        for topic, message_type, received_ns, data in run() if messages is None else messages:
            if topic not in channels:
                schema = writer.register_schema(message_type, 'ros2msg', b'')
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channels[topic], received_ns, data, received_ns)
        if 'attachment' in extras:
            writer.add_attachment(ros.STAMP_NS, ros.STAMP_NS, 'photo', 'image/png', bytes(9000))
            writer.add_metadata('robot', {'name': 'x'})
        writer.finish()
    return path


def contents(path):
    """Return all messages, and what is said to be lost."""
    with Recording(path) as recording:
        source = recording._source
        found = [
            (raw.topic.name, raw.topic.message_type, raw.receive_stamp_ns, bytes(raw.data))
            for raw in source.messages(source.topics)
        ]
        assert recording.message_count == len(found)
        selected = recording.find_topics()
        assert len(list(recording.events(selected))) == recording.event_count(selected)
        return found, recording.loss, recording.warning


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize(
    'options',
    [
        {},
        {'index_types': IndexType.NONE},
        {'index_types': IndexType.CHUNK},
        {'index_types': IndexType.MESSAGE},
        {'index_types': IndexType.ATTACHMENT | IndexType.METADATA},
        {'repeat_channels': False},
        {'repeat_schemas': False},
        {'repeat_channels': False, 'repeat_schemas': False, 'use_statistics': False},
        {'use_summary_offsets': False, 'enable_crcs': False},
        {'use_chunking': False},
        {'use_chunking': False, 'index_types': IndexType.NONE, 'use_statistics': False},
        {'extras': ('attachment',)},
        {'extras': ('attachment',), 'use_chunking': False},
    ],
    ids=str,
)
def test_whatever_a_file_repeats_or_indexes_all_of_its_messages_are_read(
    tmp_path, compression, options
):
    path = write(tmp_path / 'run.mcap', compression=compression, **options)
    found, loss, warning = contents(path)
    assert (found, bool(loss), warning) == (list(run()), False, None)


def test_a_file_is_opened_without_decompressing_it_and_each_chunk_is_once_when_it_is_read(
    tmp_path, monkeypatch
):
    chunks = []
    decompress = mcap_source.get_chunk_data_stream
    monkeypatch.setattr(
        mcap_source,
        'get_chunk_data_stream',
        lambda chunk, **options: chunks.append(chunk) or decompress(chunk, **options),
    )
    path = write(tmp_path / 'run.mcap')
    data, empty = path.read_bytes(), bytes(40)  # a chunk without messages
    path.write_bytes(data[:8] + struct.pack('<BQ', Opcode.CHUNK, len(empty)) + empty + data[8:])
    source = mcap_source.McapSource(path)
    assert not chunks
    assert sum(topic.count for topic in source.topics) == len(list(source.messages(source.topics)))
    assert len(chunks) == len({chunk.data for chunk in chunks}) > 3


def test_a_file_whose_only_chunk_is_damaged_is_refused(tmp_path):
    path = write(tmp_path / 'run.mcap', chunk_size=10**6, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 255
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r'it is damaged, .* no whole message is left$'):
        Recording(path)


def test_what_programs_add_to_a_file_is_passed_over(tmp_path):
    data = write(tmp_path / 'run.mcap').read_bytes()
    private = struct.pack('<BQ', 0x80, 5) + b'12345'
    path = tmp_path / 'private.mcap'
    path.write_bytes(data[:8] + private + data[8:])
    found, loss, warning = contents(path)
    assert (found, bool(loss), warning) == (list(run()), False, None)


def test_messages_outside_chunks_are_read_beside_those_in_chunks(tmp_path):
    """As a writer leaves them that is given chunks of another: in order, and none lost."""
    parts = [[row for n, row in enumerate(run()) if n // 11 % 2 == part] for part in (0, 1)]
    chunked = write(tmp_path / 'chunks.mcap', parts[0]).read_bytes()
    bare = write(tmp_path / 'bare.mcap', parts[1], use_chunking=False).read_bytes()
    records = [bare[begin:end] for opcode, begin, end in records_of(bare) if opcode in (3, 4, 5)]
    end_of_data = next(begin for opcode, begin, _ in records_of(chunked) if opcode == 15)
    path = tmp_path / 'both.mcap'
    path.write_bytes(chunked[:end_of_data] + b''.join(records) + chunked[end_of_data:])
    found, loss, _ = contents(path)
    assert sorted(found) == sorted(run())
    assert [row[2] for row in found] == [row[2] for row in run()]
    assert not loss


def records_of(data):
    """Yield opcode, begin and end of each record of a file."""
    place = 8
    while place < len(data) - 8:
        opcode, length = struct.unpack_from('<BQ', data, place)
        yield opcode, place, place + 9 + length
        place += 9 + length


@pytest.mark.parametrize('shift', [1, 31, 2**40])
def test_an_index_that_is_wrong_is_not_believed(tmp_path, shift):
    path = write(tmp_path / 'run.mcap')
    data = bytearray(path.read_bytes())
    for opcode, begin, end in records_of(data):
        if opcode == Opcode.MESSAGE_INDEX and end - begin > 15:
            place = begin + 15 + 8
            struct.pack_into('<Q', data, place, struct.unpack_from('<Q', data, place)[0] + shift)
    path.write_bytes(data)
    found, loss, warning = contents(path)
    assert (found, bool(loss), warning) == (list(run()), False, None)


def with_statistics(path, count):
    data = bytearray(path.read_bytes())
    for opcode, begin, _ in records_of(data):
        if opcode == Opcode.STATISTICS:
            struct.pack_into('<Q', data, begin + 9, count)
    path.write_bytes(data)
    return path


def test_messages_that_the_statistics_count_and_the_file_has_not_are_lost(tmp_path, slam_observer):
    total = len(list(run()))
    path = with_statistics(write(tmp_path / 'run.mcap', enable_crcs=False), total + 70)
    found, loss, warning = contents(path)
    assert (found, loss.message_count) == (list(run()), 70)
    assert '70 messages are lost' in warning
    ended = slam_observer('replay', path, '--strict', '--json')
    assert ended.code == 3
    assert ended.json['lost'] == {
        'bytes': 0,
        'seconds': 0.0,
        'cut_off': False,
        'messages': 70,
        'malformed': 0,
    }


def test_statistics_of_zero_say_nothing(tmp_path):
    path = with_statistics(write(tmp_path / 'run.mcap', enable_crcs=False), 0)
    found, loss, warning = contents(path)
    assert (found, bool(loss), warning) == (list(run()), False, None)


def test_messages_of_a_channel_that_the_file_does_not_describe_are_lost(tmp_path):
    path = write(tmp_path / 'run.mcap', use_chunking=False, repeat_channels=False)
    data = path.read_bytes()
    channels = [(b, e) for opcode, b, e in records_of(data) if opcode == Opcode.CHANNEL]
    begin, end = channels[1]  # of the landmarks
    path.write_bytes(data[:begin] + data[end:])
    with Recording(path) as recording:
        assert [topic.name for topic in recording.topics] == ['/twist']
        assert recording.loss.message_count == 30
        assert '30 messages are lost' in recording.warning


@pytest.mark.parametrize('has_summary', [True, False])
@pytest.mark.parametrize('compression', list(CompressionType))
def test_a_file_that_is_cut_off_is_read_up_to_there(tmp_path, compression, has_summary):
    options = {} if has_summary else {'index_types': IndexType.NONE, 'use_statistics': False}
    path = write(tmp_path / 'run.mcap', compression=compression, **options)
    whole = path.read_bytes()
    for share in (0.3, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        found, loss, warning = contents(path)
        assert found == list(run())[: len(found)]
        assert len(found) > 0
        assert loss.is_cut_off
        assert 'cut off or damaged' in warning


def test_behind_damage_among_messages_outside_chunks_it_goes_on_with_the_next_one(tmp_path):
    path = write(tmp_path / 'run.mcap', use_chunking=False)
    data = bytearray(path.read_bytes())
    messages = [begin for opcode, begin, _ in records_of(data) if opcode == Opcode.MESSAGE]
    data[messages[100] : messages[100] + 40] = bytes(40)
    path.write_bytes(data)
    found, loss, warning = contents(path)
    rows = list(run())
    assert found == rows[:100] + rows[101:]
    assert loss.message_count == 1
    assert loss.byte_count == messages[101] - messages[100]
    assert not loss.is_cut_off
    assert str(loss) in warning


def test_a_message_of_the_beginning_in_the_last_chunk_does_not_keep_all_others_waiting(tmp_path):
    """They would all be held in memory until the end, and be copied with each chunk."""
    random = np.random.default_rng(0)  # which does not compress

    def rows():
        for number in range(20_000):
            yield '/twist', TWIST, ros.STAMP_NS + number, random.bytes(200)
        yield '/twist', TWIST, ros.STAMP_NS - 1, random.bytes(200)

    path = write(tmp_path / 'late.mcap', rows(), chunk_size=20_000)
    with Recording(path) as recording:
        topics, next_ns = recording.topics, ros.STAMP_NS - 1
        tracemalloc.start()
        for block in recording._source.blocks(topics, topics[0]):
            for raw in block.messages():
                assert raw.receive_stamp_ns == next_ns
                next_ns += 1
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert next_ns == ros.STAMP_NS + 20_000
    assert peak < 20_000 * 200 / 4  # a quarter of what there is


def test_messages_of_equal_times_keep_the_order_of_the_file(tmp_path):
    rows = [('/twist', TWIST, ros.STAMP_NS + n // 50, bytes([n])) for n in range(250)]
    shuffled = [row for part in (3, 1, 4, 0, 2) for row in rows[50 * part : 50 * part + 50]]
    path = write(tmp_path / 'equal.mcap', shuffled, chunk_size=700)
    with Recording(path) as recording:
        found = [bytes(raw.data) for raw in recording._source.messages(recording.topics)]
    assert found == [row[3] for row in rows]


def test_a_file_of_other_programs_is_refused_by_what_it_is(tmp_path):
    with (tmp_path / 'json.mcap').open('wb') as file:
        writer = Writer(file)
        writer.start('', 'test')
        channel = writer.register_channel('/x', 'json', 0)
        writer.add_message(channel, 1, b'{}', 1)
        writer.finish()
    with pytest.raises(RecordingError, match='its messages are not of ROS, but json'):
        Recording(tmp_path / 'json.mcap')


NAMES = {
    TWIST: ('geometry_msgs/TwistStamped', 'geometry_msgs::msg::dds_::TwistStamped_'),
    CLOUD: ('sensor_msgs/PointCloud', 'sensor_msgs::msg::PointCloud'),
}


@pytest.mark.parametrize('form', [0, 1])
def test_types_are_known_by_other_names(tmp_path, form):
    rows = [(topic, NAMES[kind][form], *rest) for topic, kind, *rest in run()]
    found, _, _ = contents(write(tmp_path / 'names.mcap', rows))
    assert found == list(run())
