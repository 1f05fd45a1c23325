"""Messages of an intact MCAP file, those of one topic in blocks: its index says where they are."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from slam_observer_ros.recording.sources import (
    BagSource,
    damage_reported,
    in_blocks,
    MOST_IN_BLOCK,
    NOTHING_LOST,
    RawBlock,
    RawMessage,
    Topic,
)

_RECORD_HEADER = 1 + 8
"""Bytes before the content of a record: opcode and length."""

_INDEX_HEADER = _RECORD_HEADER + 2 + 4
"""Bytes before the entries of a message index: also the channel, and their length."""

_MESSAGE_HEADER = 2 + 4 + 8 + 8
"""Bytes of a message before its data: channel, number and two times."""

_PLACE = np.dtype([(name, np.int64) for name in ('stamp_ns', 'topic', 'begin', 'size')])
"""When a message was received, the number of its topic, and where its data is."""


@dataclass(frozen=True, slots=True, eq=False)
class _Messages:
    """Messages in the order in which they were received, by their places (n,) in some bytes."""

    data: NDArray[np.uint8]
    places: NDArray[np.void]

    def followed_by(self, later: _Messages) -> _Messages:
        """Return these and later ones in the order in which they were received."""
        if not len(self.places):
            return later
        places = np.concatenate([self.places, later.places])
        places['begin'][len(self.places) :] += len(self.data)
        order = np.argsort(places['stamp_ns'], kind='stable')
        return _Messages(np.concatenate([self.data, later.data]), places[order])

    def split(self, stamp_ns: int) -> tuple[_Messages, _Messages]:
        """Return those before a stamp, and the others, in bytes that hold no more than these."""
        count = int(self.places['stamp_ns'].searchsorted(stamp_ns))
        rest = self.places[count:].copy()
        parts = [self.data[begin : begin + size] for *_, begin, size in rest.tolist()]
        rest['begin'] = np.cumsum(rest['size']) - rest['size']
        data = np.concatenate([np.empty(0, dtype=np.uint8), *parts])
        return _Messages(self.data, self.places[:count]), _Messages(data, rest)

    def rows(self, run: slice) -> NDArray[np.uint8]:
        """Return the bytes (k, size) of messages that have one size."""
        begins, size = self.places['begin'][run], int(self.places['size'][run.start])
        rows: NDArray[np.uint8] = sliding_window_view(self.data, size)[begins]
        return rows


_NONE = _Messages(np.empty(0, dtype=np.uint8), np.empty(0, dtype=_PLACE))


class McapSource:
    """An intact MCAP file that rosbags has opened."""

    loss = NOTHING_LOST

    def __init__(self, path: Path, bag: BagSource) -> None:
        self._path, self._bag = path, bag
        self.topics, self.start_ns, self.end_ns = bag.topics, bag.start_ns, bag.end_ns

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        return self._bag.messages(topics)

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, those of one of the topics in blocks."""
        with damage_reported(self._path), self._path.open('rb') as file:
            summary = SeekingReader(file).get_summary()
        if summary is None or not summary.chunk_indexes:
            yield from in_blocks(self._bag.messages(topics), together)
            return
        ordered = list(topics)
        channels = _numbers_of_channels(summary, ordered)
        with damage_reported(self._path), self._path.open('rb') as file:
            for messages in _in_order(file, summary.chunk_indexes, channels):
                yield from _in_runs(messages, ordered, together)

    def close(self) -> None:
        """Close the file."""
        self._bag.close()


def _numbers_of_channels(summary: Summary, topics: list[Topic]) -> dict[int, int]:
    """Return which of the topics each channel of them is of."""
    keys = [(topic.name, topic.message_type) for topic in topics]
    types = {channel: schema.name for channel, schema in summary.schemas.items()}
    of_channels = {
        channel.id: (channel.topic, types.get(channel.schema_id, ''))
        for channel in summary.channels.values()
    }
    return {channel: keys.index(key) for channel, key in of_channels.items() if key in keys}


def _in_order(
    file: BinaryIO, chunks: list[ChunkIndex], channels: dict[int, int]
) -> Iterator[_Messages]:
    """Yield the messages of channels, whose topics have these numbers, chunk by chunk.

    What was received when a later chunk had already begun comes with that one.
    """
    chunks = [
        chunk for chunk in chunks if not channels.keys().isdisjoint(chunk.message_index_offsets)
    ]
    starts_ns = [chunk.message_start_time for chunk in chunks]
    later_ns = np.minimum.accumulate(np.array([*starts_ns, 2**63 - 1])[::-1])[::-1]
    left = _NONE
    for chunk, next_ns in zip(chunks, later_ns[1:].tolist(), strict=True):
        now, left = left.followed_by(_of_chunk(file, chunk, channels)).split(next_ns)
        yield now
    yield left


def _of_chunk(file: BinaryIO, chunk: ChunkIndex, channels: dict[int, int]) -> _Messages:
    file.seek(chunk.chunk_start_offset + _RECORD_HEADER)
    record = Chunk.read(ReadDataStream(BytesIO(file.read(chunk.chunk_length - _RECORD_HEADER))))
    stream, size = get_chunk_data_stream(record, validate_crc=True)
    data = np.frombuffer(stream.read(size), dtype=np.uint8)
    places = [
        _indexed(file, offset, data, channels[channel])
        for channel, offset in chunk.message_index_offsets.items()
        if channel in channels
    ]
    together = np.concatenate(places)
    return _Messages(data, together[np.lexsort((together['begin'], together['stamp_ns']))])


def _indexed(file: BinaryIO, offset: int, data: NDArray[np.uint8], topic: int) -> NDArray[np.void]:
    """Return the places (n,) in a chunk of a channel's messages, whose index is at ``offset``."""
    file.seek(offset)
    header = file.read(_INDEX_HEADER)
    entries = np.frombuffer(file.read(int.from_bytes(header[-4:], 'little')), '<u8').reshape(-1, 2)
    begins = entries[:, 1].astype(np.int64)
    headers = sliding_window_view(data, _RECORD_HEADER + 2)[begins]
    is_right = headers[:, 0] == Opcode.MESSAGE
    is_right &= (headers[:, _RECORD_HEADER:] == np.frombuffer(header[-6:-4], np.uint8)).all(axis=1)
    if not is_right.all():
        raise ValueError('the index of its messages is damaged')
    places = np.empty(len(entries), dtype=_PLACE)
    places['stamp_ns'], places['topic'] = entries[:, 0], topic
    places['begin'] = begins + _RECORD_HEADER + _MESSAGE_HEADER
    places['size'] = np.ascontiguousarray(headers[:, 1:_RECORD_HEADER]).view('<u8')[:, 0]
    places['size'] -= _MESSAGE_HEADER
    return places


def _in_runs(
    messages: _Messages, topics: list[Topic], together: Topic
) -> Iterator[RawMessage | RawBlock]:
    """Yield messages one by one, but in blocks those that follow each other on one topic."""
    places = messages.places
    in_block = (places['topic'] == topics.index(together)) & (places['size'] > 0)
    # A block has messages of one size; what is in no block has the size -1 here.
    kinds = np.where(in_block, places['size'], -1)
    edges = [0, *(1 + np.flatnonzero(np.diff(kinds))).tolist(), len(places)]
    for begin, end in pairwise(edges):
        if begin < end and in_block[begin]:
            for first in range(begin, end, MOST_IN_BLOCK):
                run = slice(first, min(first + MOST_IN_BLOCK, end))
                yield RawBlock(together, places['stamp_ns'][run], messages.rows(run))
            continue
        for stamp_ns, topic, place, size in places[begin:end].tolist():
            yield RawMessage(
                topics[topic], stamp_ns, messages.data[place : place + size].tobytes()
            )
