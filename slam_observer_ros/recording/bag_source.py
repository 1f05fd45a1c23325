"""Messages out of .db3 and .bag files: of whole ones, and what is whole in damaged ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import cached_property
import heapq
import mmap
from pathlib import Path
import re
from typing import Any, NamedTuple, TYPE_CHECKING, TypeAlias

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.recording.sources import (
    by_key,
    damage_reported,
    Loss,
    MessageSource,
    RawMessage,
    ros2_type,
    Topic,
)

if TYPE_CHECKING:
    from rosbags import rosbag1, rosbag2
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


class BagSource(MessageSource):
    """A whole .db3 file of rosbag2, or a ROS 1 .bag.

    Raises a RecordingError if rosbags can't read it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ros1 = Ros1Messages() if path.suffix == '.bag' else None
        with damage_reported(path, mends=False):
            self._reader = _reader_of(path)
            self._reader.open()
        self._topics = by_key(_part(connection) for connection in self._reader.connections)
        self.topics = tuple(self._topics.values())
        self.start_ns = self._reader.start_time
        self.end_ns = self._reader.end_time - 1  # rosbags gives the time just after the end.

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        wanted = [c for c in self._reader.connections if self._topic(c) in topics]
        if not wanted:  # rosbags would take this for all connections.
            return
        with damage_reported(self._path):
            of_connection = {c.id: self._topic(c) for c in wanted}
            for connection, stamp_ns, data in self._reader.messages(wanted):
                topic = of_connection[connection.id]
                yield RawMessage(topic, stamp_ns, self._cdr(topic, data))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _topic(self, connection: Connection) -> Topic:
        return self._topics[_part(connection).key]

    def _cdr(self, topic: Topic, data: bytes) -> Buffer:
        return (
            data
            if self._ros1 is None
            else self._ros1.to_cdr(data, topic.message_type, topic.definition)
        )


def _part(connection: Connection) -> Topic:
    name = ros2_type(connection.msgtype)
    return Topic(connection.topic, name, connection.msgcount, connection.msgdef.data)


def _reader_of(path: Path) -> rosbag1.Reader | rosbag2.Reader:
    from rosbags import rosbag1, rosbag2  # which few recordings need

    if path.suffix != '.bag':
        return rosbag2.Reader(path)

    return rosbag1.Reader(path)


_IDL = re.compile(r'\s*(=+\s*IDL:|#include|module\b)')


def types_in(definition: str, message_type: str) -> dict[str, Any]:
    """Return what a definition defines, as rosbags has it; nothing if it can't be read."""
    if not definition:
        return {}
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, TypesysError

    try:
        if _IDL.match(definition):
            return dict(get_types_from_idl(definition))
        return dict(get_types_from_msg(definition, message_type))
    except (TypesysError, LookupError, ValueError):
        return {}


class Ros1Messages:
    """Turns serialised messages of ROS 1 into CDR."""

    @cached_property
    def _typestore(self) -> Typestore:
        from rosbags.typesys import get_typestore, Stores  # which takes a while to import

        return get_typestore(Stores.ROS2_JAZZY)

    def to_cdr(self, data: bytes, message_type: str, definition: str) -> memoryview:
        """Return a message as CDR; raise RecordingError if nothing defines its type."""
        types = self._typestore.types
        if message_type not in types:
            defined = types_in(definition, message_type)
            self._typestore.register({k: v for k, v in defined.items() if k not in types})
        if message_type not in types:
            raise RecordingError(f'messages of type {message_type} are read of ROS 2 only')
        return self._typestore.ros1_to_cdr(data, message_type)


class FoundChannel(NamedTuple):
    """Under which number a file has a topic, not counted yet."""

    number: int
    topic: Topic


class FoundMessage(NamedTuple):
    """A whole message, and the number of its topic."""

    channel: int
    stamp_ns: int
    data: Buffer


class Damaged(NamedTuple):
    """Bytes that are not used; and whether the file ends there though it should go on."""

    byte_count: int
    is_cut_off: bool = False


Found: TypeAlias = FoundChannel | FoundMessage | Damaged
Scan: TypeAlias = Callable[[mmap.mmap], Iterator[Found]]
"""Reads a file from its beginning to its end, whatever is in it, and raises nothing."""


class SalvagedSource(MessageSource):
    """The whole messages of a damaged .db3 or .bag file."""

    def __init__(self, path: Path, scan: Scan) -> None:
        self._path, self._scan = path, scan
        self._ros1 = Ros1Messages() if path.suffix == '.bag' else None
        channels: dict[int, Topic] = {}
        self._disorder_ns = 0
        self.start_ns = self.end_ns = 0
        counts: Counter[int] = Counter()
        byte_count, gap_ns, is_cut_off, is_behind_damage = 0, 0, False, False
        for found in self._found():
            if isinstance(found, FoundChannel):
                channels[found.number] = found.topic
            elif isinstance(found, Damaged):
                byte_count += found.byte_count
                is_cut_off |= found.is_cut_off
                is_behind_damage = True
            else:
                if not counts:
                    self.start_ns = self.end_ns = found.stamp_ns
                if is_behind_damage:
                    gap_ns += max(found.stamp_ns - self.end_ns, 0)
                    is_behind_damage = False
                counts[found.channel] += 1
                self.start_ns = min(self.start_ns, found.stamp_ns)
                self.end_ns = max(self.end_ns, found.stamp_ns)
                self._disorder_ns = max(self._disorder_ns, self.end_ns - found.stamp_ns)
        self._loss = Loss(byte_count, to_s(gap_ns), is_cut_off)
        # Several channels may be of one topic.
        parts = {number: replace(channels[number], count=counts[number]) for number in channels}
        topics = by_key(part for part in parts.values() if part.count)
        self.topics = tuple(topics.values())
        self._topic_of = {number: topics[part.key] for number, part in parts.items() if part.count}

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return self._loss

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        held: list[tuple[int, int, RawMessage]] = []
        for number, found in enumerate(self._found()):
            if not isinstance(found, FoundMessage) or found.channel not in self._topic_of:
                continue
            topic, stamp_ns = self._topic_of[found.channel], found.stamp_ns
            if topic in topics:
                raw = RawMessage(topic, stamp_ns, self._cdr(topic, found.data))
                heapq.heappush(held, (stamp_ns, number, raw))
            while held and held[0][0] <= stamp_ns - self._disorder_ns:
                yield heapq.heappop(held)[-1]
        yield from (raw for *_, raw in sorted(held))

    def _found(self) -> Iterator[Found]:
        with self._path.open('rb') as file:
            if file.seek(0, 2) == 0:
                yield Damaged(0, is_cut_off=True)
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                yield from self._scan(data)

    def _cdr(self, topic: Topic, data: Buffer) -> Buffer:
        if self._ros1 is None:
            return data
        try:
            return self._ros1.to_cdr(bytes(data), topic.message_type, topic.definition)
        except RecordingError:
            raise
        except Exception:  # noqa: BLE001 (no list of what rosbags raises is complete)
            return b''  # which is counted as malformed


class MendedSource(MessageSource):
    """What rosbags opens; should it turn out to be damaged, what is whole of the rest."""

    def __init__(self, whole: MessageSource, salvage: Callable[[], MessageSource]) -> None:
        self._whole, self._salvage = whole, salvage
        self._salvaged: MessageSource | None = None
        self.topics = whole.topics
        self.start_ns, self.end_ns = whole.start_ns, whole.end_ns

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return self._whole.loss if self._salvaged is None else self._salvaged.loss

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        last_ns: int | None = None
        try:
            for raw in self._whole.messages(topics):
                last_ns = raw.receive_stamp_ns
                yield raw
        except RecordingError as error:
            yield from self._rest(error, topics, last_ns)

    def close(self) -> None:
        """Close the file."""
        self._whole.close()
        if self._salvaged is not None:
            self._salvaged.close()

    def _rest(
        self, error: RecordingError, topics: Collection[Topic], last_ns: int | None
    ) -> Iterator[RawMessage]:
        """Yield what was received after ``last_ns`` of what is whole."""
        if self._salvaged is None:
            self._salvaged = self._salvage()
        salvaged = self._salvaged
        if not salvaged.topics:
            raise RecordingError(f'{error}; no whole message is left') from error
        known = {topic.key: topic for topic in topics}
        wanted = [topic for topic in salvaged.topics if topic.key in known]
        for raw in salvaged.messages(wanted):
            if last_ns is None or raw.receive_stamp_ns > last_ns:
                yield raw._replace(topic=known[raw.topic.key])
