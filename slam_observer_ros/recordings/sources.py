"""Serialised messages out of recordings: what every source gives, and several parts of one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
import heapq
from itertools import groupby, islice
from pathlib import Path
import re
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.messages.cdr import Buffer

MOST_IN_BLOCK = 4096  # messages of a block at most
FEWEST_IN_BLOCK = 4  # messages that cost less one by one

SAME_TYPES = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}
"""Former names of types, whose bytes are the same."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic, its type as ROS 2 names it (ROS 1 types, too), and its number of messages.

    ``definition`` is how the file defines the type; empty if it does not.
    """

    name: str
    message_type: str
    count: int
    definition: str = field(default='', compare=False, repr=False)

    def __str__(self) -> str:
        return f'{self.name} ({self.message_type}, {self.count} messages)'

    @property
    def key(self) -> tuple[str, str]:
        """Name and type: what is recorded in parts, with both in common, is one topic."""
        return self.name, self.message_type


def by_key(parts: Iterable[Topic]) -> dict[tuple[str, str], Topic]:
    """Return topics, with the messages of all their parts."""
    topics: dict[tuple[str, str], Topic] = {}
    for part in parts:
        known = topics.get(part.key, replace(part, count=0))
        topics[part.key] = replace(known, count=known.count + part.count)
    return topics


def ros2_type(name: str) -> str:
    """Return a type's name as ROS 2 has it: ROS 1, DDS and some recorders write it otherwise."""
    parts = [part for part in re.split('/|::', name) if part not in ('', 'dds_')]
    if '::' in name and 'dds_' in name:
        parts[-1] = parts[-1].removesuffix('_')
    if len(parts) == 2:
        parts.insert(1, 'msg')
    full = '/'.join(parts)
    return SAME_TYPES.get(full, full)


def last_part(name: str) -> str:
    """Return what follows the last slash of a topic's name or a message type."""
    return name.rpartition('/')[2]


class RawMessage(NamedTuple):
    """One recorded message: its topic, receive time in nanoseconds, and CDR bytes."""

    topic: Topic
    receive_stamp_ns: int
    data: Buffer

    def messages(self) -> Iterator[RawMessage]:
        """Yield this one, as a block yields its own."""
        yield self


class RawBlock(NamedTuple):
    """Messages of one topic and size, received one after the other."""

    topic: Topic
    receive_stamps_ns: IntArray  # (k,)
    data: NDArray[np.uint8]  # (k, size) CDR bytes

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
    message_count : int
        Messages that were recorded, by what the files themselves count, and are not there.

    """

    byte_count: int = 0
    seconds: float = 0.0
    is_cut_off: bool = False
    message_count: int = 0

    def __bool__(self) -> bool:
        """Return whether anything is lost."""
        return self.byte_count > 0 or self.is_cut_off or self.message_count > 0

    def __str__(self) -> str:
        """Return the amount as text."""
        text = f'{self.byte_count} bytes and {self.seconds:.1f} s in between are lost'
        if self.message_count:
            counted = f'{self.message_count} messages'
            text = f'{counted}, {text}' if self.byte_count else f'{counted} are lost'
        return f'{text}, and what was cut off' if self.is_cut_off else text

    def __add__(self, other: Loss) -> Loss:
        """Return what is lost of two files."""
        return Loss(
            self.byte_count + other.byte_count,
            self.seconds + other.seconds,
            self.is_cut_off or other.is_cut_off,
            self.message_count + other.message_count,
        )


NOTHING_LOST = Loss()


class MessageSource(ABC):
    """An open recording, whatever its format; it was received from ``start_ns`` to ``end_ns``."""

    topics: tuple[Topic, ...]
    start_ns: int
    end_ns: int

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return NOTHING_LOST

    @abstractmethod
    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""

    def blocks(
        self, topics: Collection[Topic], together: Topic
    ) -> Iterator[RawMessage | RawBlock]:
        """Yield the same, the messages of one of the topics in blocks."""
        return in_blocks(self.messages(topics), together)

    def close(self) -> None:  # noqa: B027 (most are open only while they are read)
        """Close the file, if it is open while it is not read."""


class SplitSource(MessageSource):
    """The files that one recording was split into, and what is lost with the others.

    ``stated_count`` is how many messages the recording should have.
    """

    def __init__(
        self, parts: Sequence[MessageSource], loss: Loss = NOTHING_LOST, stated_count: int = 0
    ) -> None:
        self._loss, self._stated_count = loss, stated_count
        self._parts = sorted(parts, key=lambda part: part.start_ns)
        self._topics = by_key(topic for part in parts for topic in part.topics)
        self.topics = tuple(self._topics.values())
        self.start_ns = min(part.start_ns for part in parts)
        self.end_ns = max(part.end_ns for part in parts)

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        loss = sum((part.loss for part in self._parts), self._loss)
        missing = self._stated_count - sum(topic.count for topic in self.topics)
        return replace(loss, message_count=max(loss.message_count, missing))

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        parts = [self._messages_of(part, topics) for part in self._parts]
        return heapq.merge(*parts, key=lambda raw: raw.receive_stamp_ns)

    def close(self) -> None:
        """Close the file."""
        for part in self._parts:
            part.close()

    def _messages_of(self, part: MessageSource, topics: Collection[Topic]) -> Iterator[RawMessage]:
        whole = {topic: self._topics[topic.key] for topic in part.topics}
        wanted = [topic for topic in part.topics if whole[topic] in topics]
        for raw in part.messages(wanted):
            yield raw._replace(topic=whole[raw.topic])


def in_blocks(messages: Iterator[RawMessage], together: Topic) -> Iterator[RawMessage | RawBlock]:
    """Yield messages; ones of one topic and size that follow each other come in blocks."""

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


MENDED_BY: Final = {
    '.mcap': "'mcap recover'",
    '.db3': "'sqlite3 OLD.db3 .recover | sqlite3 NEW.db3'",
    '.bag': "'rosbag reindex'",
}
"""Programs of others that save the whole messages of a damaged file, by its suffix."""


@contextmanager
def damage_reported(path: Path, mends: bool = True) -> Iterator[None]:
    """Turn whatever the reading libraries raise into one line about the file, and its remedy.

    ``mends`` is whether another program may mend the file.

    Fed with damaged files they pass on AssertionError, OverflowError, MemoryError, and the errors
    of their decompressors and of SQLite: no list of classes is complete.
    """
    try:
        yield
    except (ImportError, RecordingError):  # of a package that is not installed; named already
        raise
    except Exception as error:
        said = (isinstance(error, OSError) and error.strerror) or str(error)
        reason = said.strip().split('\n')[0].rstrip('.') or type(error).__name__
        if isinstance(error, UnicodeError):  # bytes where text should be
            reason = f'it is damaged, or no {path.suffix} file'
        remedy = f'; mend it by {MENDED_BY[path.suffix]}' if mends else ''
        raise RecordingError(f'{path}: can not be read: {reason}{remedy}') from error
