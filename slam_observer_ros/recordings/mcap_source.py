"""Messages of an MCAP file, whole or damaged, in order of reception, one topic's in blocks.

The library's readers give them one by one, and none of a damaged file's end. Where statistics and
message indexes of a file agree, chunks are decompressed, and their sums compared, when they are
read. If not, or as soon as one turns out to be damaged, the file is read from its beginning to its
end, as which messages it has is seen in these alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
import heapq
from io import BytesIO
from itertools import pairwise
import mmap
from pathlib import Path
import re
import struct
from typing import Final, NamedTuple, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.recordings.sources import (
    by_key,
    damage_reported,
    FEWEST_IN_BLOCK,
    Loss,
    MessageSource,
    MOST_IN_BLOCK,
    RawBlock,
    RawMessage,
    ros2_type,
    Topic,
)

_MAGIC: Final = b'\x89MCAP0\r\n'
_HEADER: Final = struct.Struct('<BQ')  # how a record begins: opcode and length
_PRIVATE: Final = 0x80  # the least opcode of records that programs may add, which others pass over

_INDEX: Final = struct.Struct('<BQHI')
"""How a message index begins: opcode, length, channel, length of its entries."""

_CHUNK_TIMES: Final = struct.Struct('<QQ')
"""How the content of a chunk begins: when its first and its last message were received."""

MESSAGE: Final = np.dtype(
    [
        ('opcode', 'u1'),
        ('length', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('stamp_ns', '<u8'),
        ('publish_ns', '<u8'),
    ]
)
"""What comes before the data of a message."""

_ENTRY: Final = np.dtype([('channel', '<u2'), ('stamp_ns', '<u8'), ('begin', '<u8')])
"""What a message index says of a message: where it begins in the chunk, among others."""

LEAST_LENGTH: Final = MESSAGE.itemsize - _HEADER.size  # length of a message without data

MAX_NS: Final = 2**63 - 1

_BARE_SIZE: Final = 1 << 20
"""Bytes of messages outside chunks that are read at once, about as many as a chunk has."""

_NEXT: Final = re.compile(
    rb'\x06.{6}\x00\x00.{28}(?:\x00\x00\x00\x00|\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd)'
    rb'|\x05.{4}\x00\x00\x00\x00',
    re.DOTALL,
)
"""How a chunk begins: opcode, length, times, size and sum, compression; or how a message does."""

NONE_LEFT: Final = 'can not be read: it is damaged, or no .mcap file; no whole message is left'

_Take: TypeAlias = Callable[[int, bytes], None]
"""Is given the opcode and the content of a record that is no message."""


class Piece(NamedTuple):
    """A chunk, or messages that follow each other outside of chunks: where, and what is in it."""

    begin: int
    end: int
    is_chunk: bool
    start_ns: int = 0
    channels: frozenset[int] = frozenset()


class McapRecords:
    """What a walk through a file finds; of a damaged one, what is before and behind the damage.

    ``pieces`` are in the order of the file, ``channels`` are by their numbers. ``by_indexes`` is
    whether chunks have what their message indexes say, and are not decompressed.
    """

    def __init__(self, by_indexes: bool = False) -> None:
        self.by_indexes = by_indexes
        self.pieces: list[Piece] = []
        self._schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._stated = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._lost_bytes = self._gap_ns = 0
        self._is_cut_off = True
        self.start_ns = self.end_ns = 0
        self._is_behind_damage = False

    def part(self, channel: Channel) -> Topic:
        """Return the topic of a channel, with the messages of this one."""
        count, schema = self._counts[channel.id], self._schemas.get(channel.schema_id)
        if schema is None:
            return Topic(channel.topic, '', count)
        definition = schema.data.decode(errors='replace')
        return Topic(channel.topic, ros2_type(schema.name), count, definition)

    @property
    def agree(self) -> bool:
        """Whether nothing is amiss, and the statistics count the same messages of each channel."""
        stated = self._stated
        counted = Counter(stated.channel_message_counts)  # where none and 0 are the same
        schemas = {channel.schema_id for channel in self.channels.values()}
        is_described = len(self.channels) == stated.channel_count and schemas <= {*self._schemas}
        return is_described and not self.loss and counted == self._counts

    @property
    def loss(self) -> Loss:
        """What is damaged or missing, also of what the statistics in the file count."""
        nameless = sum(self._counts[number] for number in self._counts.keys() - self.channels)
        missing = max(self._stated.message_count - self._counts.total(), 0) + nameless
        return Loss(self._lost_bytes, to_s(self._gap_ns), self._is_cut_off, missing)

    def walk(self, data: mmap.mmap) -> None:
        """Find out what is in the file."""
        size, place = len(data), len(_MAGIC)
        if data[:place] != _MAGIC:
            self._lose(min(size, place))
        while place + _HEADER.size <= size:
            opcode, length = _HEADER.unpack_from(data, place)
            end = place + _HEADER.size + length
            is_known = 1 <= opcode <= max(Opcode) or opcode >= _PRIVATE
            if not is_known or end > size:
                after = _next_whole(data, place + 1, self.channels)
                self._lose(after - place)
                place = after
                continue
            if opcode == Opcode.MESSAGE:
                end = _end_of_messages(data, end)
            try:
                self._take_record(data, opcode, place, end)
            except Exception:  # noqa: BLE001 (decompressors and struct raise whatever they like)
                self._lose(end - place)
            if opcode == Opcode.FOOTER:
                self._is_cut_off = False
                return
            place = end
        self._lose(size - place)

    def _lose(self, byte_count: int) -> None:
        self._lost_bytes += byte_count
        self._is_behind_damage = True

    def _take_record(self, data: mmap.mmap, opcode: int, place: int, end: int) -> None:
        if opcode == Opcode.CHUNK:
            self._take_piece(data, Piece(place + _HEADER.size, end, is_chunk=True))
        elif opcode == Opcode.MESSAGE:
            self._take_piece(data, Piece(place, end, is_chunk=False))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
            self._take_description(opcode, data[place + _HEADER.size : end])

    def _take_description(self, opcode: int, content: bytes) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            self._stated = Statistics.read(stream)

    def _take_piece(self, data: mmap.mmap, piece: Piece) -> None:
        if self.by_indexes and piece.is_chunk:
            heads = _index_entries(data, piece.end)
            times_ns = _CHUNK_TIMES.unpack_from(data, piece.begin)
            stamps_ns = heads['stamp_ns'] if len(heads) else np.zeros(1)
            if times_ns != (stamps_ns.min(), stamps_ns.max()):
                raise ValueError('the index is wrong')
        else:
            _, _, heads = content_of(data, piece, self._take_description)
        if not len(heads):
            return
        first_ns, last_ns = int(heads['stamp_ns'].min()), int(heads['stamp_ns'].max())
        if last_ns >= MAX_NS:
            raise ValueError('no clock has this time')
        if not self.pieces:
            self.start_ns, self.end_ns = first_ns, first_ns
        if self._is_behind_damage:
            self._gap_ns += max(first_ns - self.end_ns, 0)
            self._is_behind_damage = False
        self.start_ns, self.end_ns = min(self.start_ns, first_ns), max(self.end_ns, last_ns)
        counts = np.bincount(heads['channel'])
        channels = np.flatnonzero(counts).tolist()
        self._counts.update(dict(zip(channels, counts[channels].tolist(), strict=True)))
        self.pieces.append(piece._replace(start_ns=first_ns, channels=frozenset(channels)))


def _next_whole(data: mmap.mmap, place: int, channels: Collection[int]) -> int:
    """Return where the next chunk or message begins that is whole; the end if there is none.

    A message, which has no pattern, counts if it is of a known channel, and one follows it.
    """
    while (match := _NEXT.search(data, place)) is not None:
        place = match.start()
        opcode, length = _HEADER.unpack_from(data, place)
        end = place + _HEADER.size + length
        if opcode == Opcode.CHUNK:
            is_whole = end == len(data) or (end < len(data) and 1 <= data[end] <= max(Opcode))
        else:
            is_whole = all(_is_message(data, begin, channels) for begin in (place, end))
        if is_whole:
            return place
        place += 1
    return len(data)


def _is_message(data: mmap.mmap, place: int, channels: Collection[int]) -> bool:
    if place + MESSAGE.itemsize > len(data):
        return False
    opcode, length = _HEADER.unpack_from(data, place)
    channel = int.from_bytes(data[place + _HEADER.size : place + _HEADER.size + 2], 'little')
    fits = LEAST_LENGTH <= length <= len(data) - place - _HEADER.size
    return opcode == Opcode.MESSAGE and channel in channels and fits


def _end_of_messages(data: mmap.mmap, place: int) -> int:
    """Return where messages end that begin at ``place``, or enough of them."""
    most = place + _BARE_SIZE
    while place < most and place + _HEADER.size <= len(data):
        opcode, length = _HEADER.unpack_from(data, place)
        end: int = place + _HEADER.size + length
        if opcode != Opcode.MESSAGE or end > len(data):
            break
        place = end
    return place


def content_of(
    data: mmap.mmap, piece: Piece, take: _Take
) -> tuple[NDArray[np.uint8], IntArray, NDArray[np.void]]:
    """Return the records of a piece, where its messages begin (n,), and what heads their data.

    Raises a ValueError, or whatever decompressors do, if it is damaged.
    """
    content, indexed = data[piece.begin : piece.end], np.empty(0, dtype=np.int64)
    if piece.is_chunk:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        # Each index is in order, and so stable sorting merges them in one pass.
        begins = np.sort(_index_entries(data, piece.end)['begin'].astype(np.int64), kind='stable')
        content, indexed = stream.read(size), begins[np.diff(begins, prepend=-1) != 0]
    try:
        begins = _begins(content, indexed, take)
    except (ValueError, struct.error):  # the index is wrong, or all is
        begins = _begins(content, indexed[:0], take)
    heads = _heads(content, begins)
    if (heads['length'] < LEAST_LENGTH).any():
        raise ValueError('a message is too short')
    return np.frombuffer(content, dtype=np.uint8), begins, heads


def _index_entries(data: mmap.mmap, place: int) -> NDArray[np.void]:
    """Return what message indexes behind a chunk say of its messages, one after the other."""
    found = [np.empty(0, dtype=_ENTRY)]
    while place + _INDEX.size <= len(data):
        opcode, length, channel, _ = _INDEX.unpack_from(data, place)
        begin, place = place + _INDEX.size, place + _HEADER.size + length
        if opcode != Opcode.MESSAGE_INDEX:
            break
        content = data[begin:place]
        pairs = np.frombuffer(content[: len(content) // 16 * 16], '<u8').reshape(-1, 2)
        entries = np.empty(len(pairs), dtype=_ENTRY)
        entries['channel'] = channel
        entries['stamp_ns'], entries['begin'] = pairs[:, 0], pairs[:, 1]
        found.append(entries)
    return np.concatenate(found)


def _begins(content: bytes, indexed: IntArray, take: _Take) -> IntArray:
    """Return where messages begin in records: indexed ones, and all in between."""
    heads = _heads(content, indexed)
    if (heads['opcode'] != Opcode.MESSAGE).any():
        raise ValueError('the index is wrong')
    ends = indexed + _HEADER.size + heads['length'].astype(np.int64)
    starts, stops = np.append(0, ends), np.append(indexed, len(content))
    others = starts != stops
    between = zip(starts[others].tolist(), stops[others].tolist(), strict=True)
    walked = [_walked(content, begin, end, take) for begin, end in between]
    return np.sort(np.concatenate([indexed, *walked]), kind='stable')


def _walked(content: bytes, place: int, end: int, take: _Take) -> IntArray:
    """Return where messages begin in a part of records, one after the other."""
    begins = []
    while place < end:
        opcode, length = _HEADER.unpack_from(content, place)
        after = place + _HEADER.size + length
        if opcode == Opcode.MESSAGE:
            begins.append(place)
        else:
            take(opcode, content[place + _HEADER.size : after])
        place = after
    if place != end:
        raise ValueError('a record goes beyond the end')
    return np.array(begins, dtype=np.int64)


def _heads(content: bytes, begins: IntArray) -> NDArray[np.void]:
    """Return what comes before the data of messages that begin there."""
    if not len(begins):
        return np.empty(0, dtype=MESSAGE)
    if not 0 <= begins[0] <= begins[-1] <= len(content) - MESSAGE.itemsize:
        raise ValueError('a message goes beyond the end')
    bytes_of = sliding_window_view(np.frombuffer(content, dtype=np.uint8), MESSAGE.itemsize)
    heads: NDArray[np.void] = bytes_of[begins].view(MESSAGE)[:, 0]
    return heads


_PLACE: Final = np.dtype([(name, np.int64) for name in ('stamp_ns', 'topic', 'begin', 'size')])
"""When a message was received, the number of its topic, and where its data is."""


class _Messages(NamedTuple):
    """Messages in the order in which they were received, by their places (n,) in some bytes."""

    data: NDArray[np.uint8]
    places: NDArray[np.void]

    def split(self, stamp_ns: int) -> tuple[_Messages, _Messages]:
        """Return those before a stamp, and the others."""
        count = int(self.places['stamp_ns'].searchsorted(stamp_ns))
        return _Messages(self.data, self.places[:count]), _Messages(self.data, self.places[count:])

    def rows(self, run: slice) -> NDArray[np.uint8]:
        """Return the bytes (k, size) of messages that have one size."""
        begins, size = self.places['begin'][run], int(self.places['size'][run.start])
        rows: NDArray[np.uint8] = sliding_window_view(self.data, size)[begins]
        return rows


class McapSource(MessageSource):
    """An MCAP file; of a damaged one, the whole records before and behind the damage.

    ``other_encodings`` are what channels are left out for, as they are not CDR, and how
    many these are.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._records = McapRecords(by_indexes=True)
        with damage_reported(path, mends=False):
            if path.stat().st_size:  # else there is nothing to map
                with self._mapped() as data:
                    self._records.walk(data)
                    if not self._records.agree:
                        self._walk_all(data)
        self.start_ns, self.end_ns = self._records.start_ns, self._records.end_ns
        parts = {
            number: self._records.part(channel)
            for number, channel in self._records.channels.items()
            if channel.message_encoding == 'cdr'
        }
        topics = by_key(parts.values())
        self.topics = tuple(topics.values())
        self._topic_of = {number: topics[part.key] for number, part in parts.items()}
        encodings = (channel.message_encoding for channel in self._records.channels.values())
        self.other_encodings = Counter(name or 'unnamed' for name in encodings if name != 'cdr')

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return self._records.loss

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        ordered = list(topics)
        for messages in self._in_order(ordered):
            yield from _one_by_one(messages, ordered)

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, the messages of one of the topics in blocks."""
        ordered = list(topics)
        for messages in self._in_order(ordered):
            yield from _in_runs(messages, ordered, together)

    def _walk_all(self, data: mmap.mmap) -> None:
        self._records = McapRecords()
        self._records.walk(data)

    @contextmanager
    def _mapped(self) -> Iterator[mmap.mmap]:
        with (
            self._path.open('rb') as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            yield data

    def _in_order(self, topics: list[Topic]) -> Iterator[_Messages]:
        """Yield the messages of topics in the order in which they were received.

        A piece is read when its first message is the next one, and kept while others go on.
        """
        numbers = {
            channel: topics.index(topic)
            for channel, topic in self._topic_of.items()
            if topic in topics
        }
        pieces = self._records.pieces
        waiting: list[tuple[int, int, _Messages | None]] = [
            (piece.start_ns, number, None)
            for number, piece in enumerate(pieces)
            if not numbers.keys().isdisjoint(piece.channels)
        ]
        heapq.heapify(waiting)
        number_of = np.full(1 << 16, -1)
        number_of[list(numbers)] = list(numbers.values())
        with damage_reported(self._path), self._mapped() as data:
            while waiting:
                _, number, messages = heapq.heappop(waiting)
                if messages is None:
                    try:
                        messages = _messages_of(data, pieces[number], number_of)
                    except Exception:
                        if self._records.by_indexes:
                            self._walk_all(data)
                        if pieces[number] in self._records.pieces:  # changed meanwhile
                            raise
                        if not self._records.pieces:
                            raise RecordingError(f'{self._path}: {NONE_LEFT}') from None
                        continue
                else:
                    next_ns, next_number = waiting[0][:2] if waiting else (MAX_NS, number)
                    # Of equal stamps, the file's order holds
                    now, messages = messages.split(next_ns + (number < next_number))
                    yield now
                if len(messages.places):
                    first_ns = int(messages.places['stamp_ns'][0])
                    heapq.heappush(waiting, (first_ns, number, messages))


def _messages_of(data: mmap.mmap, piece: Piece, number_of: IntArray) -> _Messages:
    """Return the messages of channels whose topics have numbers; others have -1."""
    content, begins, heads = content_of(data, piece, lambda _opcode, _content: None)
    topics = number_of[heads['channel']]
    order = np.argsort(heads['stamp_ns'], kind='stable')
    order = order[topics[order] >= 0]
    places = np.empty(len(order), dtype=_PLACE)
    places['stamp_ns'], places['topic'] = heads['stamp_ns'][order], topics[order]
    places['begin'] = begins[order] + MESSAGE.itemsize
    places['size'] = heads['length'][order].astype(np.int64) - LEAST_LENGTH
    return _Messages(content, places)


def _in_runs(
    messages: _Messages, topics: list[Topic], together: Topic
) -> Iterator[RawMessage | RawBlock]:
    """Yield messages one by one; messages that follow each other on a topic come in blocks."""
    places = messages.places
    if len(places) < FEWEST_IN_BLOCK:
        yield from _one_by_one(messages, topics)
        return
    in_block = (places['topic'] == topics.index(together)) & (places['size'] > 0)
    # A block has messages of one size; what is in no block has the size -1 here.
    kinds = np.where(in_block, places['size'], -1)
    edges = [0, *(1 + np.flatnonzero(np.diff(kinds))).tolist(), len(places)]
    for begin, end in pairwise(edges):
        if not in_block[begin]:
            yield from _one_by_one(messages._replace(places=places[begin:end]), topics)
            continue
        for first in range(begin, end, MOST_IN_BLOCK):
            run = slice(first, min(first + MOST_IN_BLOCK, end))
            yield RawBlock(together, places['stamp_ns'][run], messages.rows(run))


def _one_by_one(messages: _Messages, topics: list[Topic]) -> Iterator[RawMessage]:
    for stamp_ns, topic, begin, size in messages.places.tolist():
        yield RawMessage(topics[topic], stamp_ns, messages.data[begin : begin + size].tobytes())
