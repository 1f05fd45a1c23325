"""The runs that are done: a JSON line each, appended when a run is finished and never changed.

Each shard has a file of its own, so that no two programs write to one; what one reads is all of
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import fcntl
from io import FileIO
import json
import logging
import os
from pathlib import Path
import sys
from typing import Any

from slam_observer_ros.cli.figures import FIGURES
from slam_observer_ros.common.digits import json_text
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.files import unfinished_file

Line = dict[str, Any]

FILES = ('report', 'trajectory')
"""What may be written of a run; the line has where, or null."""

_NEEDED = {
    'run': str,
    'recording': str,
    'recording_sha256': str,
    'version': str,
    'settings': dict,
    'grid': dict,
    'warnings': list,
}

logger = logging.getLogger(__name__)


def log_name(kind: str, shard: tuple[int, int]) -> str:
    """Return the name of a shard's file: of ``runs`` that are done, or have ``failed``."""
    number, count = shard
    return f'{kind}.jsonl' if count == 1 else f'{kind}-{number}-of-{count}.jsonl'


def read_logs(directory: Path) -> dict[str, Line]:
    """Return the lines of all files in a directory, by their runs; warn of what is no run.

    What was run again, for files that were not asked for at first, has the files of all its lines.
    """
    lines: dict[str, Line] = {}
    for file in sorted(directory.glob('runs*.jsonl')):
        for line in _runs_of(file) if file.is_file() else ():
            before = lines.get(line['run'], {})
            files = {kind: line.get(kind) or before.get(kind) for kind in FILES}
            lines[line['run']] = line | files
    return lines


@contextmanager
def opened_log(path: Path) -> Iterator[RunLog]:
    """Give the file to append to; an OutputError is raised if another batch is writing to it."""
    with path.open('a+b', buffering=0) as file:  # what does not fit is not tried again at the end
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f'{path}: another batch is writing to it') from error
        file.seek(0)
        end = file.read().rpartition(b'\n')[2]
        if end and _parsed(end):  # an editor has left out the end of the last line
            file.write(b'\n')
        else:  # a power cut has: that run is to be done again
            file.seek(-len(end), os.SEEK_END)
            file.truncate()
        yield RunLog(path, file)


class RunLog:
    """Appends lines."""

    def __init__(self, path: Path, file: FileIO) -> None:
        self._path, self._file = path, file

    def append(self, line: Mapping[str, object]) -> None:
        """Append a line, in one piece; it is on the disk when this returns."""
        left = json_text(line).encode() + b'\n'
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            raise OutputError(f"can't write {self._path}: {error.strerror}") from error


def write_failures(path: Path, failures: Iterable[Mapping[str, object]]) -> None:
    """Write the runs that failed, a line each; without any there is no such file."""
    lines = [json_text(failure) + '\n' for failure in failures]
    if not lines:
        path.unlink(missing_ok=True)
        return
    with unfinished_file(path) as file:
        file.writelines(lines)


def _runs_of(path: Path) -> Iterator[Line]:
    """Give the lines of a file that are runs; what follows the last end of a line is none yet."""
    faults: list[str] = []
    for number, text in enumerate(path.read_bytes().rpartition(b'\n')[0].splitlines(), 1):
        line = _parsed(text)
        if fault := _fault_of(line):
            faults.append(f'line {number}: {fault}')
        else:
            yield line
    if faults:
        logger.warning(
            '%s: %d lines are no runs of a batch, and left out (%s).', path, len(faults), faults[0]
        )


def _parsed(text: bytes) -> Any:
    """Return what a line says, None if it is no JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _fault_of(line: object) -> str:
    """Return why a line is none of a run, as the index reads it; '' if it is one."""
    if not isinstance(line, dict):
        return 'no JSON object'
    for name, kind in _NEEDED.items():
        if not isinstance(line.get(name), kind):
            return f"it has no '{name}' as a run has"
    if not all(isinstance(warning, str) for warning in line['warnings']):
        return 'a warning is no text'
    for name in FIGURES:
        if not (line.get(name) is None or _is_finite(line[name])):
            return f"'{name}' is no number"
    wrong = [kind for kind in FILES if not isinstance(line.get(kind), str | None)]
    return f"'{wrong[0]}' is no file" if wrong else ''


def _is_finite(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return -sys.float_info.max <= value <= sys.float_info.max
