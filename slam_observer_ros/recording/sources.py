"""Serialised messages out of MCAP, rosbag2 and ROS 1 files, also out of truncated MCAP files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import heapq
from pathlib import Path
from typing import NamedTuple, Protocol

from mcap.records import Channel, Footer, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.messages.cdr import Buffer


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


class MessageSource(Protocol):
    """An open recording, whatever its format; it was received from ``start_ns`` to ``end_ns``."""

    topics: tuple[Topic, ...]
    start_ns: int
    end_ns: int

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""

    def close(self) -> None:
        """Close the file."""


class BagSource:
    """A whole MCAP file, rosbag2 (directory or bare .db3) or ROS 1 .bag.

    Raises a RecordingError if rosbags can't read it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._is_ros1 = path.suffix == '.bag'
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        with _damage_reported(path):
            self._reader = rosbag1.Reader(path) if self._is_ros1 else rosbag2.Reader(path)
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
        remedy = "; 'mcap recover' may save the rest" if self._path.suffix == '.mcap' else ''
        with _damage_reported(self._path, remedy):
            for connection, stamp_ns, data in self._reader.messages(wanted):
                yield RawMessage(self._topic(connection), stamp_ns, self._cdr(connection, data))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _topic(self, connection: Connection) -> Topic:
        return self._topics[connection.topic, connection.msgtype]

    def _cdr(self, connection: Connection, data: bytes) -> Buffer:
        if not self._is_ros1:
            return data
        if connection.msgtype not in self._typestore.types:
            raise RecordingError(f'messages of type {connection.msgtype} are read of ROS 2 only')
        return self._typestore.ros1_to_cdr(data, connection.msgtype)


class SalvagedMcap:
    """What is whole in a truncated MCAP file: all chunks, or bare messages, before the damage.

    Whole files that rosbags refuses, as those that hold other than ROS messages, are read, too:
    ``other_encodings`` are those of the channels that are left out, as they are no CDR.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.is_whole = False
        self.other_encodings: dict[int, str] = {}
        counts: Counter[tuple[str, str]] = Counter()
        self.start_ns = self.end_ns = self._disorder_ns = 0
        for name, message_type, message in self._records():
            if not counts:
                self.start_ns = self.end_ns = message.log_time
            counts[name, message_type] += 1
            self.start_ns = min(self.start_ns, message.log_time)
            self.end_ns = max(self.end_ns, message.log_time)
            self._disorder_ns = max(self._disorder_ns, self.end_ns - message.log_time)
        self._topics = {key: Topic(*key, count) for key, count in counts.items()}
        self.topics = tuple(self._topics.values())

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        held: list[tuple[int, int, RawMessage]] = []
        for number, (name, message_type, message) in enumerate(self._records()):
            topic, stamp_ns = self._topics[name, message_type], message.log_time
            if topic in topics:
                raw = RawMessage(topic, stamp_ns, message.data)
                heapq.heappush(held, (stamp_ns, number, raw))
            while held and held[0][0] <= stamp_ns - self._disorder_ns:
                yield heapq.heappop(held)[-1]
        yield from (raw for *_, raw in sorted(held))

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

    def _records(self) -> Iterator[tuple[str, str, Message]]:
        """Yield topic, type and record of each message up to the damage."""
        message_types: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with self._path.open('rb') as file:
            records = StreamReader(file).records
            while (record := _next_whole(records)) is not None:
                if isinstance(record, Schema):
                    message_types[record.id] = record.name
                elif isinstance(record, Channel) and record.message_encoding != 'cdr':
                    self.other_encodings[record.id] = record.message_encoding
                elif isinstance(record, Channel):
                    channels[record.id] = record.topic, message_types.get(record.schema_id, '')
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield *channels[record.channel_id], record
                elif isinstance(record, Footer):
                    self.is_whole = True


class SplitSource:
    """The open files that one recording was split into."""

    def __init__(self, parts: Sequence[MessageSource]) -> None:
        self._parts = sorted(parts, key=lambda part: part.start_ns)
        counts: Counter[tuple[str, str]] = Counter()
        for part in parts:
            for topic in part.topics:
                counts[topic.name, topic.message_type] += topic.count
        self._topics = {key: Topic(*key, count) for key, count in counts.items()}
        self.topics = tuple(self._topics.values())
        self.start_ns = min(part.start_ns for part in parts)
        self.end_ns = max(part.end_ns for part in parts)

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        parts = [self._messages_of(part, topics) for part in self._parts]
        return heapq.merge(*parts, key=lambda raw: raw.receive_stamp_ns)

    def close(self) -> None:
        """Close the files."""
        for part in self._parts:
            part.close()

    def _messages_of(self, part: MessageSource, topics: Collection[Topic]) -> Iterator[RawMessage]:
        whole = {topic: self._topics[topic.name, topic.message_type] for topic in part.topics}
        wanted = [topic for topic in part.topics if whole[topic] in topics]
        for raw in part.messages(wanted):
            yield raw._replace(topic=whole[raw.topic])


@contextmanager
def _damage_reported(path: Path, remedy: str = '') -> Iterator[None]:
    """Turn whatever the reading libraries raise into one line about the file.

    Fed with damaged files they pass on AssertionError, OverflowError, MemoryError, and the errors
    of their decompressors and of SQLite: no list of classes is complete.
    """
    try:
        yield
    except Exception as error:
        reason = str(error).strip().split('\n')[0].rstrip('.') or type(error).__name__
        if isinstance(error, UnicodeError):  # bytes where text should be
            reason = f'it is damaged, or no {path.suffix} file'
        raise RecordingError(f'{path}: can not be read: {reason}{remedy}') from error


def _next_whole(records: Iterator[object]) -> object | None:
    """Give the next record, or None at the end or the damage."""
    try:
        return next(records, None)
    except Exception:  # noqa: BLE001 (as above: any error means that the damage begins here)
        return None
