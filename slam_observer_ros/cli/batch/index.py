"""The page at the end of a batch: which setting and which run is the best by a score."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
import json
import math
import os
from pathlib import Path
from urllib.parse import quote

import numpy as np

from slam_observer_ros.cli.batch.run_log import FILES, Line
from slam_observer_ros.cli.figures import ACCURACY_ROWS, FIGURES
from slam_observer_ros.estimates import used_points
from slam_observer_ros.report.run_index import (
    Cell,
    Folded,
    IndexTable,
    Links,
    Range,
    write_index_page,
)
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import table

INDEX = 'index.html'

SCORES = tuple(name for name in ACCURACY_ROWS if 'anees' not in name)
"""Figures of which the least is the best."""

CONSISTENCY = ('anees', 'configuration_anees', 'nis')
"""Figures that are 1 where all is as stated: a mean of them says less than their range."""

POINTS_USED = 'points used'

_DEFAULTS = {row.name: row.default for row in table(Settings)}


def write_index(directory: Path, lines: Mapping[str, Line], score: str) -> None:
    """Write index.html of all runs of a directory."""
    runs = sorted(lines.values(), key=lambda line: (_score(line, score), line['recording']))
    names = _varying(runs)
    figures = [name for name in FIGURES if any(run.get(name) is not None for run in runs)]
    runs = [run | {POINTS_USED: _points_used(run)} for run in runs]
    recordings = {run['recording_sha256'] for run in runs}
    tables = [
        _settings_table(runs, names, figures, score),
        _runs_table(runs, names, figures, score),
    ]
    summary = (
        f'{len(runs)} runs of {len(recordings)} recordings. The best (★) has least {score}. '
        'A click on a heading sorts.'
    )
    write_index_page(directory / INDEX, directory.resolve().name, summary, tables)


def _score(run: Line, score: str) -> float:
    value = run.get(score)
    return math.inf if value is None else float(value)


def _varying(runs: Sequence[Line]) -> list[str]:
    """Return the names of what runs differ in: settings, the grid's inputs, version."""
    values: defaultdict[str, set[str]] = defaultdict(set)
    names = {name for run in runs for name in (*run['settings'], *run['grid'])} | {'version'}
    for run in runs:
        for name in names:
            values[name].add(_text(run, name))
    return sorted(name for name in names if len(values[name]) > 1)


def _text(run: Line, name: str) -> str:
    if name == 'version':
        return str(run['version'])
    default = run['grid'].get(name, _DEFAULTS.get(name))
    value = run['settings'].get(name, default)
    return value if isinstance(value, str) else json.dumps(value)


def _settings_table(
    runs: Sequence[Line], names: Sequence[str], figures: Sequence[str], score: str
) -> IndexTable:
    """Return means over recordings, by setting, the best first."""
    groups: defaultdict[tuple[str, ...], list[Line]] = defaultdict(list)
    for run in runs:
        groups[tuple(_text(run, name) for name in names)].append(run)
    # One that has done fewer recordings is not comparable: they may have been the easy ones.
    ordered = sorted(
        groups.items(), key=lambda group: (-len(group[1]), _mean(group[1], score, math.inf))
    )
    rows: list[list[Cell]] = [
        [*key, len(group), *(_over_recordings(group, name) for name in figures)]
        for key, group in ordered
    ]
    has_best = bool(ordered) and math.isfinite(_mean(ordered[0][1], score, math.inf) or 0.0)
    headings = [
        *names,
        'recordings',
        *(f'{name}, {"range" if name in CONSISTENCY else "mean"}' for name in figures),
    ]
    return IndexTable('Settings', headings, rows, frozenset({0} if has_best else ()))


def _mean(runs: Sequence[Line], name: str, unknown: float | None = None) -> float | None:
    values = [float(run[name]) for run in runs if run.get(name) is not None]
    return float(np.mean(values)) if len(values) == len(runs) else unknown


def _over_recordings(runs: Sequence[Line], name: str) -> Cell:
    """Return the mean of a figure; of one that is right at 1 the range, which no mean hides."""
    if name not in CONSISTENCY:
        return _mean(runs, name)
    values = [float(run[name]) for run in runs if run.get(name) is not None]
    return Range(min(values), max(values)) if len(values) == len(runs) else None


def _points_used(run: Line) -> int | None:
    """Return how many points a run has used; 0 is nothing at all, or the velocities alone."""
    counts = run.get('used')
    is_known = isinstance(counts, dict) and all(isinstance(n, int) for n in counts.values())
    return used_points(Counter(counts)) if is_known else None


def _runs_table(
    runs: Sequence[Line], names: Sequence[str], figures: Sequence[str], score: str
) -> IndexTable:
    """Return all runs; the best of each recording is marked."""
    rows: list[list[Cell]] = []
    best: dict[str, int] = {}
    folder = _folder_of_all(runs)
    for number, run in enumerate(runs):
        if math.isfinite(_score(run, score)):
            best.setdefault(run['recording_sha256'], number)
        rows.append(
            [
                run['recording'].removeprefix(folder),
                Links([(kind, _address(run[kind])) for kind in FILES if run.get(kind)]),
                *(_text(run, name) for name in names),
                run[POINTS_USED],
                *(run.get(name) for name in figures),
                Folded(run['warnings']),
                run['run'],
            ]
        )
    headings = ['recording', 'files', *names, POINTS_USED, *figures, 'warnings', 'run']
    return IndexTable('Runs', headings, rows, frozenset(best.values()))


def _folder_of_all(runs: Sequence[Line]) -> str:
    """Return what the names of all recordings begin with, down to the folder that they share."""
    folders = [run['recording'].rpartition('/')[0].split('/') for run in runs]
    shared = os.path.commonprefix(folders)  # noqa: RUF071 (names of folders, not characters)
    return '/'.join([*shared, '']) if shared else ''


def _address(file: str) -> str:
    return quote(file, errors='replace')
