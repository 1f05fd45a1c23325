"""Serialised messages out of whole MCAP, rosbag2 and ROS 1 files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import heapq
from itertools import groupby, islice
from pathlib import Path
from typing import NamedTuple, Protocol, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag2
from rosbags.interfaces import Connection

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.recording.ros1 import Ros1Messages

if TYPE_CHECKING:
    from rosbags import rosbag1


MOST_IN_BLOCK = 4096
"""Messages of a block at most."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic, its type as ROS 2 names it (ROS 1 types, too), and its number of messages."""

    name: str
    message_type: str
    count: int

    def __str__(self) -> str:
        return f'{self.name} ({self.message_type}, {self.count} messages)'


def last_part(name: str) -> str:
    """Return what follows the last slash of a topic's name or a message type."""
    return name.rpartition('/')[2]


class RawMessage(NamedTuple):
    """One recorded message: its topic, receive time in nanoseconds, and CDR bytes."""

    topic: Topic
    receive_stamp_ns: int
    data: Buffer

    @property
    def last_ns(self) -> int:
        """When the last of it was received, as a block has it."""
        return self.receive_stamp_ns

    def messages(self) -> Iterator[RawMessage]:
        """Yield this one, as a block yields its own."""
        yield self


class RawBlock(NamedTuple):
    """Messages of one topic and size, received one after the other."""

    topic: Topic
    receive_stamps_ns: IntArray  # (k,)
    data: NDArray[np.uint8]  # (k, size) CDR bytes

    @property
    def last_ns(self) -> int:
        """When the last of them was received."""
        return int(self.receive_stamps_ns[-1])

    def messages(self) -> Iterator[RawMessage]:
        """Yield them one by one."""
        for stamp_ns, data in zip(self.receive_stamps_ns.tolist(), self.data, strict=True):
            yield RawMessage(self.topic, stamp_ns, data.tobytes())


@dataclass(frozen=True, slots=True)
class Loss:
    """What of a recording is damaged, as far as it has been read.

    Attributes
    ----------
    byte_count, seconds : int, float
        Bytes of its files that are not used, and the time from the last whole message before them
        to the first one behind.
    is_cut_off : bool
        Whether a file has no proper end: more is missing than can be said.

    """

    byte_count: int = 0
    seconds: float = 0.0
    is_cut_off: bool = False

    def __bool__(self) -> bool:
        """Return whether anything is lost."""
        return self.byte_count > 0 or self.is_cut_off

    def __str__(self) -> str:
        """Return the amount as text."""
        text = f'{self.byte_count} bytes and {self.seconds:.1f} s in between are lost'
        return f'{text}, and what was cut off' if self.is_cut_off else text

    def __add__(self, other: Loss) -> Loss:
        """Return what is lost of two files."""
        return Loss(
            self.byte_count + other.byte_count,
            self.seconds + other.seconds,
            self.is_cut_off or other.is_cut_off,
        )


NOTHING_LOST = Loss()


class MessageSource(Protocol):
    """An open recording, whatever its format; it was received from ``start_ns`` to ``end_ns``."""

    topics: tuple[Topic, ...]
    start_ns: int
    end_ns: int

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, those of one of the topics in blocks."""

    def close(self) -> None:
        """Close the file."""


class BagSource:
    """A whole MCAP file, rosbag2 (directory or bare .db3) or ROS 1 .bag.

    Raises a RecordingError if rosbags can't read it.
    """

    loss = NOTHING_LOST

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ros1 = Ros1Messages() if path.suffix == '.bag' else None
        with damage_reported(path, mends=False):
            self._reader = _reader_of(path)
            self._reader.open()
        counts: Counter[tuple[str, str]] = Counter()
        for connection in self._reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        self._topics = {key: Topic(*key, count) for key, count in counts.items()}
        self.topics = tuple(self._topics.values())
        self.start_ns = self._reader.start_time
        self.end_ns = self._reader.end_time - 1  # rosbags gives the time just after the end.

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        wanted = [c for c in self._reader.connections if self._topic(c) in topics]
        if not wanted:  # rosbags would take this for all connections.
            return
        with damage_reported(self._path):
            for connection, stamp_ns, data in self._reader.messages(wanted):
                yield RawMessage(self._topic(connection), stamp_ns, self._cdr(connection, data))

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, those of one of the topics in blocks."""
        return in_blocks(self.messages(topics), together)

    @property
    def compresses_messages(self) -> bool:
        """Whether each message is compressed for itself."""
        reader = self._reader
        return isinstance(reader, rosbag2.Reader) and reader.compression_mode == 'message'

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _topic(self, connection: Connection) -> Topic:
        return self._topics[connection.topic, connection.msgtype]

    def _cdr(self, connection: Connection, data: bytes) -> Buffer:
        return data if self._ros1 is None else self._ros1.to_cdr(data, connection.msgtype)


def _reader_of(path: Path) -> rosbag1.Reader | rosbag2.Reader:
    if path.suffix != '.bag':
        return rosbag2.Reader(path)
    from rosbags import rosbag1  # which few recordings need

    return rosbag1.Reader(path)


class SplitSource:
    """The files that one recording was split into, and what is lost with those not open."""

    def __init__(self, parts: Sequence[MessageSource], loss: Loss = NOTHING_LOST) -> None:
        self._loss = loss
        self._parts = sorted(parts, key=lambda part: part.start_ns)
        counts: Counter[tuple[str, str]] = Counter()
        for part in parts:
            for topic in part.topics:
                counts[topic.name, topic.message_type] += topic.count
        self._topics = {key: Topic(*key, count) for key, count in counts.items()}
        self.topics = tuple(self._topics.values())
        self.start_ns = min(part.start_ns for part in parts)
        self.end_ns = max(part.end_ns for part in parts)

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return sum((part.loss for part in self._parts), self._loss)

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        parts = [self._messages_of(part, topics) for part in self._parts]
        return heapq.merge(*parts, key=lambda raw: raw.receive_stamp_ns)

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, those of one of the topics in blocks."""
        return in_blocks(self.messages(topics), together)

    def close(self) -> None:
        """Close the files."""
        for part in self._parts:
            part.close()

    def _messages_of(self, part: MessageSource, topics: Collection[Topic]) -> Iterator[RawMessage]:
        whole = {topic: self._topics[topic.name, topic.message_type] for topic in part.topics}
        wanted = [topic for topic in part.topics if whole[topic] in topics]
        for raw in part.messages(wanted):
            yield raw._replace(topic=whole[raw.topic])


def in_blocks(messages: Iterator[RawMessage], together: Topic) -> Iterator[RawMessage | RawBlock]:
    """Yield messages, those of one topic and size that follow each other in blocks."""

    def key(raw: RawMessage) -> int:
        return len(raw.data) if raw.topic == together else -1

    for size, run in groupby(messages, key):
        if size < 0:
            yield from run
            continue
        while some := list(islice(run, MOST_IN_BLOCK)):
            data = np.frombuffer(b''.join(raw.data for raw in some), dtype=np.uint8)
            stamps_ns = np.array([raw.receive_stamp_ns for raw in some], dtype=np.int64)
            yield RawBlock(together, stamps_ns, data.reshape(len(some), size))


@contextmanager
def damage_reported(path: Path, mends: bool = True) -> Iterator[None]:
    """Turn whatever the reading libraries raise into one line about the file.

    ``mends`` is whether another program may mend a file that was opened.

    Fed with damaged files they pass on AssertionError, OverflowError, MemoryError, and the errors
    of their decompressors and of SQLite: no list of classes is complete.
    """
    try:
        yield
    except Exception as error:
        reason = str(error).strip().split('\n')[0].rstrip('.') or type(error).__name__
        if isinstance(error, UnicodeError):  # bytes where text should be
            reason = f'it is damaged, or no {path.suffix} file'
        remedy = "; 'mcap recover' may save the rest" if mends and path.suffix == '.mcap' else ''
        raise RecordingError(f'{path}: can not be read: {reason}{remedy}') from error
