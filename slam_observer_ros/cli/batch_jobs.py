"""What a batch is to run, every recording with every setting, and the log of what is done.

A run that is done is a JSON line, appended when it is finished and never changed. Each shard has a
file of its own, so that no two programs write to one; what one reads is all of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import dataclasses
from dataclasses import dataclass
import fcntl
import glob
import hashlib
from io import FileIO
import itertools
import json
import logging
import os
from pathlib import Path
import re
import sys
from typing import Any

from slam_observer_ros.cli.options import parse_value
from slam_observer_ros.cli.replay_request import ReplayRequest
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import json_text, OutputError, shown, UsageError
from slam_observer_ros.common.files import not_special, unfinished_file
from slam_observer_ros.mapping.map_file import map_files
from slam_observer_ros.runs.accuracy import FIGURES
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import changed_names, suggestion, table, Value

logger = logging.getLogger(__name__)

_KNOWN = {row.name: row for row in (*table(InputSettings), *table(Settings))}

_ID_DIGITS = 16

Point = dict[str, Value]
"""Values of the parameters of ``--grid``, by name."""


@dataclass(frozen=True, slots=True)
class Job:
    """A run that is to be done; ``run_id`` is a hash of all that its figures depend on."""

    run_id: str
    recording_sha256: str
    point: Point
    request: ReplayRequest

    @property
    def recording(self) -> Path:
        """The recording that is replayed."""
        return self.request.recording

    @property
    def file_stem(self) -> str:
        """Name of its files, without a suffix; no other run has it."""
        return f'{self.recording.stem}-{self.run_id}'


def find_recordings(patterns: Iterable[str]) -> list[Path]:
    """Return the recordings that paths and patterns name, each once; ``**`` is any folders."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        paths = [pattern]
        if not Path(pattern).exists():
            paths = glob.glob(pattern, recursive=True)  # noqa: PTH207 (it may begin with /)
        if not paths:
            raise UsageError(f"no file is named '{pattern}'")
        found |= dict.fromkeys(Path(path) for path in sorted(paths))
    return list(found)


def grid_points(texts: Iterable[str]) -> list[Point]:
    """Return every combination of the values of ``--grid NAME=VALUE,VALUE…``."""
    axes: dict[str, list[Value]] = {}
    for text in texts:
        name, equals, values = text.partition('=')
        if not (name and equals and values):
            raise UsageError(f"--grid takes NAME=VALUE,VALUE…, not '{text}'")
        if name not in _KNOWN:
            raise UsageError(f"--grid: unknown parameter '{name}'{suggestion(name, _KNOWN)}")
        if name in axes:
            raise UsageError(f'--grid {name} is given twice')
        # Not at the commas of a [list]
        axes[name] = [
            _KNOWN[name].check(parse_value(value)) for value in re.split(r',(?![^\[]*\])', values)
        ]
        for number, value in enumerate(axes[name]):
            if value in axes[name][:number]:
                raise UsageError(f'--grid {name}: {shown(value)} is given twice')
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def shard_of(text: str) -> tuple[int, int]:
    """Take ``i/N``, 1 ≤ i ≤ N, as an argparse type."""
    found = re.fullmatch(r'(\d{1,6})/(\d{1,6})', text)
    number, count = (int(word) for word in found.groups()) if found else (0, 0)
    if not 1 <= number <= count:
        raise argparse.ArgumentTypeError(f"a shard is i/N with i from 1 to N, not '{text}'")
    return number, count


def part_of(recordings: Sequence[Path], points: int, shard: tuple[int, int]) -> list[range]:
    """Return which points a shard is to run of each recording: it takes runs in a row.

    So it has to read as few recordings as can be.
    """
    number, count = shard
    total = len(recordings) * points
    first, last = ((number - 1) * total // count, number * total // count)
    starts = range(0, total, points)
    return [range(max(first - at, 0), min(max(last - at, 0), points)) for at in starts]


def make_job(request: ReplayRequest, sha256: str, point: Point) -> Job:
    """Return the job of one recording at one point, whose values the request has."""
    maps = [] if request.load_map is None else map_files(request.load_map)
    map_bytes = b''.join(not_special(path).read_bytes() for path in maps)
    depends_on = {
        'recording': sha256,
        'version': __version__,
        'settings': _changed(request.settings),
        'inputs': _changed(request.inputs),
        'topics': dataclasses.astuple(request.topics),
        'map': _sha256_of_bytes(map_bytes) if maps else None,
        'smooth': request.smooth,
    }
    run_id = _sha256_of_bytes(json.dumps(depends_on, sort_keys=True).encode())[:_ID_DIGITS]
    return Job(run_id, sha256, point, request)


def _changed(settings: Settings | InputSettings) -> dict[str, object]:
    return {name: getattr(settings, name) for name in changed_names(settings)}


def _sha256_of_bytes(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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
