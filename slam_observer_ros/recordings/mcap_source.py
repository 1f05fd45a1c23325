"""Messages of an MCAP file in the order in which they were received, one topic's in blocks.

The library's readers give them one by one, and none of a damaged file's end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
import heapq
from itertools import pairwise
import mmap
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from slam_observer_ros.common.types import IntArray
from slam_observer_ros.recordings.mcap_records import (
    content_of,
    LEAST_LENGTH,
    MAX_NS,
    McapRecords,
    MESSAGE,
    Piece,
)
from slam_observer_ros.recordings.sources import (
    by_key,
    damage_reported,
    FEWEST_IN_BLOCK,
    Loss,
    MessageSource,
    MOST_IN_BLOCK,
    RawBlock,
    RawMessage,
    Topic,
)

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
        self._records = McapRecords()
        with damage_reported(path, mends=False):
            if path.stat().st_size:  # else there is nothing to map
                with self._mapped() as data:
                    self._records.walk(data)
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
        waiting: list[tuple[int, int, _Messages | None]] = [
            (piece.start_ns, number, None)
            for number, piece in enumerate(self._records.pieces)
            if not numbers.keys().isdisjoint(piece.channels)
        ]
        heapq.heapify(waiting)
        number_of = np.full(1 << 16, -1)
        number_of[list(numbers)] = list(numbers.values())
        with damage_reported(self._path), self._mapped() as data:
            while waiting:
                _, number, messages = heapq.heappop(waiting)
                if messages is None:
                    messages = _messages_of(data, self._records.pieces[number], number_of)
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
