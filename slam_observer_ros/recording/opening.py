"""Opens recordings of every format: whole, split, truncated, compressed or of no use."""

from __future__ import annotations

from collections.abc import Sequence
import mmap
from pathlib import Path, PurePath

from slam_observer_ros.common.errors import RecordingError, YamlError
from slam_observer_ros.common.yaml_files import load_yaml, plain_value
from slam_observer_ros.recording.mcap_source import McapSource
from slam_observer_ros.recording.salvage import MendedSource, SalvagedSource
from slam_observer_ros.recording.salvage_formats import is_intact_mcap, SCANS
from slam_observer_ros.recording.sources import BagSource, Loss, MessageSource, SplitSource

FILE_SUFFIXES = ('.mcap', '.db3', '.bag')

MAX_METADATA_BYTES = 10_000_000
"""Bytes of a metadata.yaml that is read; that of a thousand files has a tenth of them."""

_ZSTD_SUFFIX = '.zstd'
_ZSTD_MAGIC = bytes.fromhex('28b52ffd')


def open_source(path: Path) -> tuple[MessageSource, str | None]:
    """Open a .mcap, .db3 or .bag file or a rosbag2 directory, damaged or not.

    Also returns a warning, if only a part of it could be read. Raises a RecordingError that says
    in one line what to do if there is nothing to read.
    """
    if not path.exists():
        raise RecordingError(f'{path}: no such file or directory')
    if path.is_dir():
        return _open_directory(path)
    if path.suffix == _ZSTD_SUFFIX:
        raise RecordingError(_how_to_decompress(path))
    if path.suffix not in FILE_SUFFIXES:
        raise RecordingError(
            f'{path}: not a recording; give a {", ".join(FILE_SUFFIXES)} file '
            'or a rosbag2 directory'
        )
    source, warning = _open_file(path)
    try:
        if path.suffix != '.bag':  # ROS 1 compresses no messages, and the first may be unreadable
            _refuse_compressed_messages(path, source)
    except RecordingError:
        source.close()
        raise
    return source, warning


def files_of(path: Path) -> list[Path]:
    """List the files that a recording consists of, compressed ones as well."""
    if not path.is_dir():
        return [path]
    parts = (*FILE_SUFFIXES, 'metadata.yaml')
    return [file for file in sorted(path.iterdir()) if any(part in file.name for part in parts)]


def _open_directory(path: Path) -> tuple[MessageSource, str | None]:
    metadata = path / 'metadata.yaml'
    if not metadata.exists():
        return open_source(_only_file(path))
    if not metadata.is_file():
        raise RecordingError(f'{metadata} is no file')
    listed, files = _listed_files(path), _storage_files(path)
    missing = [file.name for file in listed if not file.exists()]
    if missing and len(listed) > 1:
        raise RecordingError(
            f'{path}: incomplete; metadata.yaml lists {", ".join(missing)} as well: add what is '
            'missing, or replay the files that are there one by one'
        )
    try:
        whole = BagSource(path)
        if not files:
            return whole, None  # each file is compressed as a whole
        for file in files:
            if file.suffix == '.mcap':
                _check_sums(file, whole)
        if [file.suffix for file in files] == ['.mcap'] and not whole.compresses_messages:
            return MendedSource(McapSource(files[0], whole), lambda: _open_parts(files)[0]), None
        return MendedSource(whole, lambda: _open_parts(files)[0]), None
    except RecordingError:
        # A recorder that was killed leaves a truncated file, which its metadata calls whole.
        parts = files if len(files) == 1 else [file for file in listed if file in files]
        if len(parts) < max(len(listed), 1):
            raise
        return _open_parts(parts)


def _open_parts(files: Sequence[Path]) -> tuple[MessageSource, str | None]:
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
    warnings = [warning for _, warning in opened if warning] + [str(error) for error in errors]
    loss = Loss(lost_bytes, is_cut_off=bool(errors))
    return SplitSource([source for source, _ in opened], loss), '; '.join(warnings) or None


def _listed_files(directory: Path) -> list[Path]:
    """List the files that metadata.yaml names; none if it is damaged, which rosbags reports.

    Raises a RecordingError if it can't be read, or has more bytes than any recording's.
    """
    try:
        metadata = load_yaml(directory / 'metadata.yaml', MAX_METADATA_BYTES, plain_value)
        names = metadata['rosbag2_bagfile_information']['relative_file_paths']
        return [directory / PurePath(name).name for name in names]
    except OSError as error:
        raise RecordingError(f'{directory}: can not read metadata.yaml: {error}') from error
    except (YamlError, ValueError, LookupError, TypeError):
        return []


def _only_file(directory: Path) -> Path:
    """Return the one file of a directory without metadata.yaml."""
    files = _storage_files(directory)
    if len(files) == 1:
        return files[0]
    if files:
        raise RecordingError(
            f"{directory}: {len(files)} files without metadata.yaml; run 'ros2 bag reindex' on it"
        )
    compressed = sorted(directory.glob(f'*{_ZSTD_SUFFIX}'))
    if compressed:
        raise RecordingError(_how_to_decompress(compressed[0]))
    raise RecordingError(f'{directory}: no rosbag2 directory (no metadata.yaml, .mcap or .db3)')


def _how_to_decompress(file: Path) -> str:
    return (
        f"{file}: compressed; run 'zstd -d' on it, or keep its metadata.yaml beside it and give "
        'the directory'
    )


def _storage_files(path: Path) -> list[Path]:
    return [file for file in sorted(path.iterdir()) if file.suffix in ('.mcap', '.db3')]


def _refuse_compressed_messages(path: Path, source: MessageSource) -> None:
    """Refuse a file whose messages are compressed one by one: only metadata.yaml says so."""
    first = next(iter(source.messages(source.topics)), None)
    if first is not None and bytes(first.data[: len(_ZSTD_MAGIC)]) == _ZSTD_MAGIC:
        raise RecordingError(
            f'{path}: its messages are compressed, which are read of a whole rosbag2 directory '
            'only: keep its metadata.yaml beside it and give the directory'
        )


def _open_file(path: Path) -> tuple[MessageSource, str | None]:
    try:
        whole = BagSource(path)
        if path.suffix == '.mcap':
            _check_sums(path, whole)
            return MendedSource(McapSource(path, whole), lambda: _salvaged(path)), None
        return MendedSource(whole, lambda: _salvaged(path)), None
    except RecordingError as error:
        return _salvage(path, error)


def _check_sums(path: Path, whole: BagSource) -> None:
    """Raise a RecordingError, with the file closed, if a chunk is not what was written."""
    with path.open('rb') as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if is_intact_mcap(data):
            return
    whole.close()
    raise RecordingError(f'{path}: can not be read: a chunk is damaged')


def _salvaged(path: Path) -> SalvagedSource:
    return SalvagedSource(path, SCANS[path.suffix])


def _salvage(path: Path, error: RecordingError) -> tuple[MessageSource, str | None]:
    source = _salvaged(path)
    if any(topic.count for topic in source.topics):
        return source, _left_out(path, source)
    if 'ros1' in source.other_encodings.values():
        raise RecordingError(
            f'{path}: its messages are of ROS 1, which are read of .bag files only; give the .bag '
            'that it was made of'
        ) from error
    raise RecordingError(f'{error}; no whole message is left') from error


def _left_out(path: Path, source: SalvagedSource) -> str | None:
    """Say what of a file is not read; None if all of it is."""
    if source.loss:
        count = sum(topic.count for topic in source.topics)
        used = f'only the {count} messages before that are used'
        if source.loss.seconds > 0.0:
            used = f'the {count} whole messages before and behind that are used'
        return f'{path}: cut off or damaged; {used}; {source.loss}'
    encodings = source.other_encodings.values()
    if not encodings:
        return None
    names = ', '.join(sorted({encoding or 'unnamed' for encoding in encodings}))
    return f'{path}: {len(encodings)} channels of other encodings are left out: {names}'
