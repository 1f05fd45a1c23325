"""Recordings that rosbag2 compressed with zstd: each message, or each file as a whole."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from slam_observer_ros.recording.sources import (
    Loss,
    MessageSource,
    RawMessage,
    Topic,
)

SUFFIX = '.zstd'

_MAGIC = bytes.fromhex('28b52ffd')
"""How what is compressed begins, and no message in CDR does."""

_SHOWN = 10
"""First messages that are looked at; one may be damaged."""


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
    is_compressed = any(_is_compressed(bytes(raw.data[: len(_MAGIC)])) for raw in first)
    return DecompressedSource(source) if is_compressed else source


def decompressed_file(path: Path) -> tuple[Path, TemporaryDirectory[str]]:
    """Decompress a file, as far as it is whole; return where, and what removes it again."""
    import zstandard  # which few recordings need

    directory = TemporaryDirectory(prefix='slam_observer_')
    copy = Path(directory.name, path.name.removesuffix(SUFFIX))
    with path.open('rb') as source, copy.open('wb') as target:
        try:
            zstandard.ZstdDecompressor().copy_stream(source, target)
        except zstandard.ZstdError:
            target.flush()  # what follows the damage is missed by who reads the copy
    return copy, directory


def _is_compressed(data: bytes) -> bool:
    return data.startswith(_MAGIC)


def _decompressed(data: bytes) -> bytes:
    import zstandard

    if not _is_compressed(data):
        return data
    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return b''
