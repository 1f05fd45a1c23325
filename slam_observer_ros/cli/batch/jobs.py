"""What a batch is to run: every recording with every setting, and which run that is."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import dataclasses
from dataclasses import dataclass, replace
import glob
import hashlib
import itertools
import json
from pathlib import Path
import re

from slam_observer_ros import __version__
from slam_observer_ros.cli.console import kept_warnings
from slam_observer_ros.cli.options import parse_value
from slam_observer_ros.cli.replay.files import write_report_of
from slam_observer_ros.cli.replay.request import Records, ReplayRequest
from slam_observer_ros.cli.replay.run import replayed
from slam_observer_ros.cli.replay.summary import as_json, identity, summary_rows
from slam_observer_ros.common.errors import shown, UsageError
from slam_observer_ros.common.files import not_special
from slam_observer_ros.evaluation.trajectory import write_tum
from slam_observer_ros.known_map.map_file import map_files
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings
from slam_observer_ros.settings.parameter_table import changed_names, suggestion, table, Value

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
        paths = [pattern] if Path(pattern).exists() else _glob(pattern)
        if not paths:
            raise UsageError(f"no file is named '{pattern}'")
        found |= dict.fromkeys(Path(path) for path in sorted(paths))
    return list(found)


def _glob(pattern: str) -> list[str]:
    return glob.glob(pattern, recursive=True)  # noqa: PTH207 (it may begin with /)


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


REPORTS, TRAJECTORIES = 'reports', 'trajectories'
"""Folders of ``--out`` for files of the runs."""


@dataclass(frozen=True, slots=True)
class Work:
    """Does the jobs of a batch, and writes those files of each that are asked for."""

    out: Path
    writes_reports: bool
    writes_trajectories: bool
    version: str = __version__

    def __call__(self, job: Job) -> dict[str, object]:
        """Do a run, write its files, and return its line of the log."""
        if self.version != __version__:
            raise UsageError(f'this worker has version {__version__}, the batch {self.version}')
        report = self._file(REPORTS, job, '.html') if self.writes_reports else None
        tum = self._file(TRAJECTORIES, job, '.tum') if self.writes_trajectories else None
        records = Records(poses=tum is not None, whole_run=report is not None)
        with kept_warnings() as warnings:
            outcome, _ = replayed(replace(job.request, records=records), shows_progress=False)
        outcome = replace(outcome, warnings=warnings)
        if tum is not None:
            write_tum(outcome.trajectory, tum)
        if report is not None:
            write_report_of(job.file_stem, outcome, summary_rows(outcome), report)
        return {
            'run': job.run_id,
            'grid': job.point,
            'report': self._relative(report),
            'trajectory': self._relative(tum),
            **identity(job.recording, job.recording_sha256, outcome),
            **as_json(outcome),
        }

    def _file(self, folder: str, job: Job, suffix: str) -> Path:
        return self.out / folder / f'{job.file_stem}{suffix}'

    def _relative(self, file: Path | None) -> str | None:
        return None if file is None else file.relative_to(self.out).as_posix()
