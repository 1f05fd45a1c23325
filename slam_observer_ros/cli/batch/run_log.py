"""The runs that are done: one JSON line each, appended when a run is finished and never changed.

Each shard has a file of its own, so that no two programs write to one; what one reads is all of
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import fcntl
import json
import os
from pathlib import Path
from typing import Any, BinaryIO

from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.output_files import unfinished_file

Line = dict[str, Any]


def log_name(kind: str, shard: tuple[int, int]) -> str:
    """Return the name of a shard's file: of ``runs`` that are done, or have ``failed``."""
    number, count = shard
    return f'{kind}.jsonl' if count == 1 else f'{kind}-{number}-of-{count}.jsonl'


def read_logs(directory: Path) -> dict[str, Line]:
    """Return the lines of all files in a directory, by their runs."""
    lines: dict[str, Line] = {}
    for file in sorted(directory.glob('runs*.jsonl')):
        for line in _whole_lines(file, file.read_bytes()):
            lines.setdefault(line['run'], line)
    return lines


@contextmanager
def opened_log(path: Path) -> Iterator[RunLog]:
    """Give the file to append to; an OutputError is raised if another batch is writing to it."""
    with path.open('a+b') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f'{path}: another batch is writing to it') from error
        # A line that a power cut has left without an end is of a run that is to be done again.
        file.seek(0)
        content = file.read()
        file.truncate(content.rfind(b'\n') + 1)
        yield RunLog(file)


class RunLog:
    """Appends lines."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def append(self, line: Mapping[str, object]) -> None:
        """Append a line, in one piece; it is on the disk when this returns."""
        self._file.write(json.dumps(line, allow_nan=False).encode() + b'\n')
        self._file.flush()
        os.fsync(self._file.fileno())


def write_failures(path: Path, failures: Iterable[Mapping[str, object]]) -> None:
    """Write the runs that failed, a line each; without any there is no such file."""
    lines = [json.dumps(failure) + '\n' for failure in failures]
    if not lines:
        path.unlink(missing_ok=True)
        return
    with unfinished_file(path) as file:
        file.writelines(lines)


def _whole_lines(path: Path, content: bytes) -> Iterator[Line]:
    for number, text in enumerate(content[: content.rfind(b'\n') + 1].splitlines(), 1):
        try:
            line = json.loads(text)
        except ValueError as error:
            raise OutputError(f'{path}, line {number}: no JSON') from error
        if not (isinstance(line, dict) and isinstance(line.get('run'), str)):
            raise OutputError(f'{path}, line {number}: no run of a batch')
        yield line
