"""Opens recordings of every format: whole, split, truncated, compressed or of no use.

rosbag2 compresses with zstd: each message, or each file as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cached_property
import hashlib
from itertools import islice
from pathlib import Path, PurePath
import re
from tempfile import TemporaryDirectory
from typing import Any, Final, TYPE_CHECKING

from slam_observer_ros.common.errors import message_of, RecordingError, YamlError
from slam_observer_ros.common.files import load_yaml, not_special, plain_value
from slam_observer_ros.recordings.mcap_source import McapSource, NONE_LEFT
from slam_observer_ros.recordings.sources import (
    by_key,
    damage_reported,
    Loss,
    MessageSource,
    RawMessage,
    ros2_type,
    SplitSource,
    Topic,
)

if TYPE_CHECKING:
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
            from rosbags import rosbag1, rosbag2  # which few recordings need

            self._reader = (rosbag2 if self._ros1 is None else rosbag1).Reader(path)
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
                if self._ros1 is not None:
                    converted = self._ros1.to_cdr(data, topic.message_type, topic.definition)
                    yield RawMessage(topic, stamp_ns, converted)
                else:
                    yield RawMessage(topic, stamp_ns, data)

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _topic(self, connection: Connection) -> Topic:
        return self._topics[_part(connection).key]


def _part(connection: Connection) -> Topic:
    name = ros2_type(connection.msgtype)
    return Topic(connection.topic, name, connection.msgcount, connection.msgdef.data)


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


COMPRESSED = '.zstd'
"""Suffix of a file that was compressed as a whole, behind the one of its format."""

MAX_METADATA_BYTES = 10_000_000
"""Bytes of a metadata.yaml that is read; a recording of a thousand files has a tenth of them."""


_BLOCK_BYTES = 1 << 20


def open_source(path: Path) -> tuple[MessageSource, str | None]:
    """Open a .mcap, .db3 or .bag file or a rosbag2 directory.

    Also returns a warning, if only a part of it could be read, as of a damaged MCAP file. Raises
    a RecordingError that says in one line what to do if there is nothing to read.
    """
    try:
        not_special(path)
    except FileNotFoundError as error:
        raise RecordingError(f'{path}: no such file or directory') from error
    except OSError as error:
        raise RecordingError(message_of(error)) from error
    if path.is_dir():
        return _open_directory(path)
    if path.suffix == COMPRESSED:
        return _open_compressed(path)
    if path.suffix not in FORMATS:
        raise RecordingError(
            f'{path}: not a recording; give a {", ".join(FORMATS)} file or a rosbag2 directory'
        )
    source, warning = FORMATS[path.suffix](path)
    if path.suffix == '.bag':  # ROS 1 compresses no messages, and the first may be unreadable
        return source, warning
    try:
        return decompressed(source), warning
    except RecordingError:
        source.close()
        raise


def files_of(path: Path) -> list[Path]:
    """List the files that a recording consists of, compressed ones as well."""
    if not path.is_dir():
        return [path]
    parts = (*FORMATS, 'metadata.yaml')
    return [file for file in sorted(path.iterdir()) if any(part in file.name for part in parts)]


def _open_directory(path: Path) -> tuple[MessageSource, str | None]:
    metadata = path / 'metadata.yaml'
    if not metadata.exists():
        return open_source(_only_file(path))
    if not metadata.is_file():
        raise RecordingError(f'{metadata} is no file')
    names, stated_count = _read_metadata(path)
    found = [_existing(path / name) for name in names]
    files = [file for file in found if file is not None]
    if not files:  # renamed, or the metadata is damaged
        files = [_only_file(path, 'that metadata.yaml does not list')]
    missing = [name for name, file in zip(names, found, strict=True) if file is None]
    if len(names) < 2:
        missing = []
    source, warning = _open_parts(path, files, missing, stated_count)
    stems = {file.name.removesuffix(COMPRESSED) for file in files}
    others = [f.name for f in _storage_files(path) if f.name.removesuffix(COMPRESSED) not in stems]
    if others:  # as after a power cut, or put there by hand
        unlisted = f'{path}: metadata.yaml does not list {", ".join(others)}, left out'
        warning = f'{warning}; {unlisted}' if warning else unlisted
    return source, warning


def _existing(file: Path) -> Path | None:
    """Return a file that metadata names, which somebody may have decompressed or compressed."""
    names = (file.name, file.name.removesuffix(COMPRESSED), f'{file.name}{COMPRESSED}')
    return next((file.with_name(name) for name in names if file.with_name(name).exists()), None)


def _open_parts(
    path: Path, files: Sequence[Path], missing: Sequence[str], stated_count: int
) -> tuple[MessageSource, str | None]:
    """Open what can be read of a recording's files; raise the first error if nothing can."""
    opened: list[tuple[MessageSource, str | None]] = []
    errors: list[Exception] = []
    lost_bytes = 0
    for file in files:
        try:
            opened.append(open_source(file))
        except (RecordingError, OSError) as error:
            errors.append(error)
            lost_bytes += file.stat().st_size if file.exists() else 0
    if not opened:
        raise errors[0]
    loss = Loss(lost_bytes, is_cut_off=bool(errors or missing))
    source = SplitSource([source for source, _ in opened], loss, stated_count)
    warnings = [warning for _, warning in opened if warning] + [str(error) for error in errors]
    if missing:
        lost = f': {count} messages' if (count := source.loss.message_count) else ''
        warnings.append(f'{path}: {", ".join(missing)} is missing{lost}')
    if len(opened) == 1 and not missing and not errors and not source.loss.message_count:
        return opened[0]
    return source, '; '.join(warnings) or None


def _read_metadata(directory: Path) -> tuple[list[str], int]:
    """Return the names of a recording's files and its number of messages; none if damaged.

    Raise a RecordingError if metadata.yaml can't be read or has too many bytes.
    """
    try:
        content = load_yaml(directory / 'metadata.yaml', MAX_METADATA_BYTES, plain_value)
        stated = content['rosbag2_bagfile_information']
        names = [PurePath(name).name for name in stated['relative_file_paths']]
        count = stated.get('message_count')
        return names, count if type(count) is int else 0
    except OSError as error:
        raise RecordingError(f'{directory}: can not read metadata.yaml: {error}') from error
    except (YamlError, ValueError, LookupError, TypeError, AttributeError):
        return [], 0


def _only_file(directory: Path, why: str = 'without metadata.yaml') -> Path:
    """Return the one file of a directory without metadata.yaml, or with one that is of no use."""
    files = _storage_files(directory)
    if len(files) == 1:
        return files[0]
    if files:
        raise RecordingError(
            f"{directory}: {len(files)} files {why}; run 'ros2 bag reindex' on it"
        )
    raise RecordingError(f'{directory}: no rosbag2 directory: there is no .mcap or .db3 in it')


def _storage_files(path: Path) -> list[Path]:
    suffixes = [suffix + end for suffix in ('.mcap', '.db3') for end in ('', COMPRESSED)]
    return [file for file in sorted(path.iterdir()) if file.name.endswith(tuple(suffixes))]


def _open_compressed(path: Path) -> tuple[MessageSource, str | None]:
    """Open a file that was compressed as a whole, by a copy that lasts until it is closed."""
    copy, directory = decompressed_file(path)
    try:
        source, warning = open_source(copy)
    except RecordingError as error:
        directory.cleanup()
        raise RecordingError(str(error).replace(str(copy), str(path))) from error
    warning = warning and warning.replace(str(copy), str(path))
    return DecompressedSource(source, directory), warning


def _open_mcap(path: Path) -> tuple[MessageSource, str | None]:
    source = McapSource(path)
    encodings = source.other_encodings
    if any(topic.count for topic in source.topics) or not (source.loss or encodings):
        warning = _left_out(path, source)
        if encodings and warning is None:
            names = ', '.join(sorted(encodings))
            count = encodings.total()
            warning = f'{path}: {count} channels of other encodings are left out: {names}'
        return source, warning
    if 'ros1' in encodings:
        raise RecordingError(
            f'{path}: its messages are of ROS 1, which are read of .bag files only; give the .bag '
            'that it was made of'
        )
    if encodings and not source.loss:
        raise RecordingError(f'{path}: its messages are not of ROS, but {", ".join(encodings)}')
    raise RecordingError(f'{path}: {NONE_LEFT}')


def _left_out(path: Path, source: MessageSource) -> str | None:
    """Say what of a file is not read; None if all of it is."""
    loss = source.loss
    if loss.byte_count or loss.is_cut_off:
        count = sum(topic.count for topic in source.topics)
        used = f'only the {count} messages before that are used'
        if loss.seconds > 0.0:
            used = f'the {count} whole messages before and behind that are used'
        return f'{path}: cut off or damaged; {used}; {loss}'
    if loss:
        return f'{path}: its statistics count more messages than it holds: {loss}'
    return None


FORMATS: dict[str, Callable[[Path], tuple[MessageSource, str | None]]] = {
    '.mcap': _open_mcap,
    '.db3': lambda path: (BagSource(path), None),
    '.bag': lambda path: (BagSource(path), None),
}
"""How a file of each suffix is opened; a directory of rosbag2 has .mcap or .db3 files."""

_MAGIC = bytes.fromhex('28b52ffd')  # how what is compressed begins, and no message in CDR does
_SHOWN = 10  # first messages that are looked at; one may be damaged


class DecompressedSource(MessageSource):
    """A file whose messages may be compressed one by one.

    A message that is damaged is empty, and so counted as malformed. ``directory``, if the file is
    a copy in it, is removed when the file is closed.
    """

    def __init__(
        self, source: MessageSource, directory: TemporaryDirectory[str] | None = None
    ) -> None:
        self._source, self._directory = source, directory
        self.topics, self.start_ns, self.end_ns = source.topics, source.start_ns, source.end_ns

    @property
    def loss(self) -> Loss:
        """What has been found damaged so far."""
        return self._source.loss

    def messages(self, topics: Collection[Topic]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order in which they were received."""
        for raw in self._source.messages(topics):
            yield raw._replace(data=_decompressed(bytes(raw.data)))

    def close(self) -> None:
        """Close the file."""
        self._source.close()
        if self._directory is not None:
            self._directory.cleanup()


def decompressed(source: MessageSource) -> MessageSource:
    """Return a source of messages that are not compressed."""
    first = islice(source.messages(source.topics), _SHOWN)
    is_compressed = any(bytes(raw.data[: len(_MAGIC)]) == _MAGIC for raw in first)
    return DecompressedSource(source) if is_compressed else source


def decompressed_file(path: Path) -> tuple[Path, TemporaryDirectory[str]]:
    """Decompress a file, as far as it is whole; return where, and what removes it again."""
    import zstandard  # which few recordings need

    directory = TemporaryDirectory(prefix='slam_observer_')
    copy = Path(directory.name, path.name.removesuffix(COMPRESSED))
    with path.open('rb') as source, copy.open('wb') as target:
        try:
            zstandard.ZstdDecompressor().copy_stream(source, target)
        except zstandard.ZstdError:
            target.flush()  # what follows the damage is missed by who reads the copy
    return copy, directory


def _decompressed(data: bytes) -> bytes:
    import zstandard

    if not data.startswith(_MAGIC):
        return data
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return b''


def sha256_of(recording: Path) -> str:
    """Return the SHA-256 of a recording's files, one after the other, as hexadecimal digits."""
    digest = hashlib.sha256()
    for file in files_of(recording):
        with not_special(file).open('rb') as opened:
            while block := opened.read(_BLOCK_BYTES):
                digest.update(block)
    return digest.hexdigest()
