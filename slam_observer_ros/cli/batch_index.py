"""The page at the end of a batch: tables of many runs, which a click on a heading sorts.

They show which setting and which run is the best by a score.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
import json
import math
import os
from pathlib import Path
import re
from urllib.parse import quote

import numpy as np

from slam_observer_ros.cli.batch_jobs import FILES, Line
from slam_observer_ros.common.errors import OutputError, significant
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.estimates import used_points
from slam_observer_ros.report.page import asset
from slam_observer_ros.runs.accuracy import ACCURACY_ROWS, FIGURES
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import table


@dataclass(frozen=True, slots=True)
class FileLinks:
    """A cell that leads to files beside the page, by what they are called."""

    files: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Folded:
    """A cell of texts: how many is shown, and a click shows them."""

    texts: Sequence[str]


@dataclass(frozen=True, slots=True)
class Range:
    """A cell from the least to the largest of numbers that should be 1, sorted by the worst."""

    least: float
    largest: float


Cell = int | float | str | FileLinks | Folded | Range | None


@dataclass(frozen=True, slots=True)
class IndexTable:
    """A table; ``best`` are the rows that are marked. A cell of None is empty."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    best: frozenset[int] = frozenset()


def write_index_page(path: Path, title: str, summary: str, tables: Sequence[IndexTable]) -> None:
    """Write the page; it is whole or not there. Raises an OutputError if it can't be written."""
    page = asset('index.html')
    parts = {
        'STYLE': asset('report.css'),
        'SCRIPT': asset('index.js'),
        'TITLE': escape(title),
        'SUMMARY': escape(summary),
        'TABLES': '\n'.join(map(_table, tables)),
    }
    for mark, part in parts.items():
        page = page.replace(f'@{mark}@', part)
    try:
        with unfinished_file(path) as file:
            file.write(page.encode(errors='replace').decode())  # names may be no Unicode
    except OSError as error:
        raise OutputError(f"can't write {path}: {error.strerror}") from error


def _table(table: IndexTable) -> str:
    headings = ''.join(
        f'<th scope="col"><button type="button">{_breakable(name)}</button></th>'
        for name in table.headings
    )
    rows = '\n'.join(
        f'<tr{" class=best" if number in table.best else ""}>{"".join(map(_cell, row))}</tr>'
        for number, row in enumerate(table.rows)
    )
    return (
        f'<section class="{escape(table.title.lower())}"><h2>{escape(table.title)}</h2>'
        '<div class="wide"><table>\n'
        f'<thead><tr>{headings}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div></section>'
    )


def _cell(value: Cell) -> str:
    if value is None:
        return '<td class="number"></td>'
    if isinstance(value, FileLinks):
        links = (f'<a href="{escape(href)}">{escape(text)}</a>' for text, href in value.files)
        return f'<td class="links">{" ".join(links)}</td>'
    if isinstance(value, Folded):
        return f'<td>{_folded(value.texts)}</td>'
    if isinstance(value, str):
        return f'<td>{_breakable(value)}</td>'
    if isinstance(value, Range):
        worst = max(abs(math.log(max(one, 1e-300))) for one in (value.least, value.largest))
        text = f'{significant(value.least)} – {significant(value.largest)}'
        return f'<td class="number" data-value="{worst!r}">{text}</td>'
    text = str(value) if isinstance(value, int) else significant(value)
    return f'<td class="number" data-value="{value!r}">{text}</td>'


def _folded(texts: Sequence[str]) -> str:
    if not texts:
        return ''
    items = ''.join(f'<li>{escape(text)}</li>' for text in texts)
    return f'<details><summary>{len(texts)}</summary><ul>{items}</ul></details>'


def _breakable(text: str) -> str:
    """Return a text that a narrow column breaks within its paths and names, but in no word."""
    return re.sub('([/_])', r'\1<wbr>', escape(text))


INDEX = 'index.html'

SCORES = tuple(name for name in ACCURACY_ROWS if 'anees' not in name)
"""Figures whose least value is the best."""

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
                FileLinks(
                    [(kind, quote(run[kind], errors='replace')) for kind in FILES if run.get(kind)]
                ),
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
