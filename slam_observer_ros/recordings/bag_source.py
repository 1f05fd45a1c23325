"""Messages out of .db3 and .bag files."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cached_property
from pathlib import Path
import re
from typing import Any, Final, TYPE_CHECKING

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.recordings.sources import (
    by_key,
    damage_reported,
    MessageSource,
    RawMessage,
    ros2_type,
    Topic,
)

if TYPE_CHECKING:
    from rosbags import rosbag1, rosbag2
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


_BEGINS: Final = {'.db3': b'SQLite format 3\0', '.bag': b'#ROSBAG V'}
"""First bytes of a file by its suffix; no program mends one that begins otherwise."""


class BagSource(MessageSource):
    """A .db3 file of rosbag2, or a ROS 1 .bag.

    A damaged one is refused by a RecordingError that names what mends it, also while it is read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ros1 = Ros1Messages() if path.suffix == '.bag' else None
        with damage_reported(path, mends=False), path.open('rb') as file:
            begin = file.read(16)
        if not begin.startswith(_BEGINS[path.suffix]):
            why = f'damaged, or no {path.suffix} file' if begin else 'empty'
            raise RecordingError(f'{path}: can not be read: it is {why}')
        with damage_reported(path):
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
