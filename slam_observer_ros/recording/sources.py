"""Serialised messages out of MCAP, rosbag2 and ROS 1 files, also out of truncated MCAP files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.errors import RecordingError
from slam_observer_ros.recording.cdr import Buffer

FILE_SUFFIXES = ('.mcap', '.db3', '.bag')


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes
    ----------
    name : str
    message_type : str
        As ROS 2 writes it, for example ``geometry_msgs/msg/Twist``; ROS 1 types too.
    count : int
        Number of messages.

    """

    name: str
    message_type: str
    count: int

    def __str__(self) -> str:
        return f'{self.name} ({self.message_type}, {self.count} messages)'


class RawMessage(NamedTuple):
    """One recorded message: its topic, receive time in nanoseconds, and CDR bytes."""

    topic: Topic
    receive_stamp_ns: int
    data: Buffer


class MessageSource(Protocol):
    """An open recording, whatever its format.

    Attributes
    ----------
    topics : tuple of Topic
    start_ns, end_ns : int
        Receive times of the first and the last message.

    """

    topics: tuple[Topic, ...]
    start_ns: int
    end_ns: int

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""

    def close(self) -> None:
        """Close the file."""


class BagSource:
    """A whole MCAP file, rosbag2 (directory or bare .db3) or ROS 1 .bag.

    Parameters
    ----------
    path : Path
        The file or directory.

    Raises
    ------
    RecordingError
        If rosbags can't read it.

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
        with _damage_reported(self._path):
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

    Parameters
    ----------
    path : Path
        The .mcap file.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        counts: Counter[tuple[str, str]] = Counter()
        self.start_ns = self.end_ns = 0
        for name, message_type, message in self._records():
            if not counts:
                self.start_ns = self.end_ns = message.log_time
            counts[name, message_type] += 1
            self.start_ns = min(self.start_ns, message.log_time)
            self.end_ns = max(self.end_ns, message.log_time)
        self._topics = {key: Topic(*key, count) for key, count in counts.items()}
        self.topics = tuple(self._topics.values())

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        for name, message_type, message in self._records():
            topic = self._topics[name, message_type]
            if topic in topics:
                yield RawMessage(topic, message.log_time, message.data)

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
                elif isinstance(record, Channel) and record.message_encoding == 'cdr':
                    channels[record.id] = record.topic, message_types.get(record.schema_id, '')
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield *channels[record.channel_id], record


def open_source(path: Path) -> tuple[MessageSource, str | None]:
    """Open a recording of any of the formats, damaged or not.

    Parameters
    ----------
    path : Path
        A .mcap, .db3 or .bag file, or a rosbag2 directory.

    Returns
    -------
    MessageSource
        The open recording.
    str or None
        A warning, if only a part of it could be read.

    Raises
    ------
    RecordingError
        If there is nothing to read; one line that says what to do.

    """
    if not path.exists():
        raise RecordingError(f'{path}: no such file or directory')
    if path.is_dir():
        return _open_directory(path)
    if path.suffix not in FILE_SUFFIXES:
        raise RecordingError(
            f'{path}: not a recording; give a {", ".join(FILE_SUFFIXES)} file '
            'or a rosbag2 directory'
        )
    try:
        return BagSource(path), None
    except RecordingError as error:
        if path.suffix != '.mcap':
            raise
        return _salvage(path, error)


def files_of(path: Path) -> list[Path]:
    """List the files that a recording consists of, compressed ones as well."""
    if not path.is_dir():
        return [path]
    parts = (*FILE_SUFFIXES, 'metadata.yaml')
    return [file for file in sorted(path.iterdir()) if any(part in file.name for part in parts)]


def _open_directory(path: Path) -> tuple[MessageSource, str | None]:
    if (path / 'metadata.yaml').exists():
        try:
            return BagSource(path), None
        except RecordingError:
            # A recorder that was killed leaves a truncated file, which its metadata calls whole.
            if len(_storage_files(path)) != 1:
                raise
    files = _storage_files(path)
    if not files:
        raise RecordingError(f'{path}: no rosbag2 directory (no metadata.yaml, .mcap or .db3)')
    if len(files) > 1:
        raise RecordingError(
            f"{path}: {len(files)} files without metadata.yaml; run 'ros2 bag reindex' on it"
        )
    return open_source(files[0])


def _storage_files(path: Path) -> list[Path]:
    return [file for file in sorted(path.iterdir()) if file.suffix in ('.mcap', '.db3')]


def _salvage(path: Path, error: RecordingError) -> tuple[MessageSource, str]:
    source = SalvagedMcap(path)
    count = sum(topic.count for topic in source.topics)
    if count == 0:
        raise RecordingError(f'{error}; no whole message is left') from error
    return source, f'{path}: cut off or damaged; only the {count} messages before that are used'


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
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
        raise RecordingError(f'{path}: can not be read: {reason}') from error


def _next_whole(records: Iterator[object]) -> object | None:
    """Give the next record, or None at the end or the damage."""
    try:
        return next(records, None)
    except Exception:  # noqa: BLE001 (as above: any error means that the damage begins here)
        return None
