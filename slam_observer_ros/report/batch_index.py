"""The page at the end of a batch: tables of many runs, which a click on a heading sorts.

They show which setting and which run is the best by a score.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Mapping, Sequence
from html import escape
import json
import math
import os
from pathlib import Path
import re
from typing import Any
from urllib.parse import quote

import numpy as np

from slam_observer_ros.common.errors import significant
from slam_observer_ros.estimates import used_points
from slam_observer_ros.report.page import asset, write_page
from slam_observer_ros.report.summary import ACCURACY_ROWS, FIGURES
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import table

INDEX = 'index.html'

Line = dict[str, Any]
"""A run that is done, as the log has it."""

FILES = ('report', 'trajectory')
"""What may be written of a run; the line has where, or null."""

SCORES = tuple(name for name in ACCURACY_ROWS if 'anees' not in name)
"""Figures whose least value is the best."""

CONSISTENCY = ('anees', 'configuration_anees', 'nis')
"""Figures that are 1 where all is as stated: a mean of them says less than their range."""

_DEFAULTS = {row.name: row.default for row in table(Settings)}


def write_index(directory: Path, lines: Mapping[str, Line], score: str) -> None:
    """Write index.html of all runs of a directory; raise an OutputError if it can't be written."""
    runs = sorted(lines.values(), key=lambda line: (_score(line, score), line['recording']))
    names = _varying(runs)
    figures = [name for name in FIGURES if any(run.get(name) is not None for run in runs)]
    recordings = {run['recording_sha256'] for run in runs}
    summary = (
        f'{len(runs)} runs of {len(recordings)} recordings. The best (★) has least {score}. '
        'A click on a heading sorts.'
    )
    parts = {
        'STYLE': asset('report.css'),
        'SCRIPT': asset('index.js'),
        'TITLE': escape(directory.resolve().name),
        'SUMMARY': escape(summary),
        'TABLES': _settings_table(runs, names, figures, score)
        + '\n'
        + _runs_table(runs, names, figures, score),
    }
    write_page(directory / INDEX, 'index.html', parts)


def _table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], best: Container[int]
) -> str:
    """Return a table of cells; the ``best`` rows are marked."""
    of_columns = ''.join(
        f'<th scope="col"><button type="button">{_breakable(name)}</button></th>'
        for name in headings
    )
    of_rows = '\n'.join(
        f'<tr{" class=best" if number in best else ""}>{"".join(row)}</tr>'
        for number, row in enumerate(rows)
    )
    return (
        f'<section class="{title.lower()}"><h2>{title}</h2><div class="wide"><table>\n'
        f'<thead><tr>{of_columns}</tr></thead>\n<tbody>\n{of_rows}\n</tbody>'
        '</table></div></section>'
    )


def _cell(value: float | str | None) -> str:
    if value is None:
        return '<td class="number"></td>'
    if isinstance(value, str):
        return f'<td>{_breakable(value)}</td>'
    text = str(value) if isinstance(value, int) else significant(value)
    return f'<td class="number" data-value="{value!r}">{text}</td>'


def _range_cell(values: Sequence[float]) -> str:
    """Return a cell from the least to the largest of numbers that should be 1.

    It is sorted by the worst.
    """
    worst = max(abs(math.log(max(one, 1e-300))) for one in (min(values), max(values)))
    text = f'{significant(min(values))} – {significant(max(values))}'
    return f'<td class="number" data-value="{worst!r}">{text}</td>'


def _links_cell(run: Line) -> str:
    """Return a cell that leads to the files of a run, beside the page."""
    links = (
        f'<a href="{escape(quote(run[kind], errors="replace"))}">{kind}</a>'
        for kind in FILES
        if run.get(kind)
    )
    return f'<td class="links">{" ".join(links)}</td>'


def _folded_cell(texts: Sequence[str]) -> str:
    """Return a cell that shows how many texts there are, and the texts at a click."""
    if not texts:
        return '<td></td>'
    items = ''.join(f'<li>{escape(text)}</li>' for text in texts)
    return f'<td><details><summary>{len(texts)}</summary><ul>{items}</ul></details></td>'


def _breakable(text: str) -> str:
    """Return a text that a narrow column breaks within its paths and names, but in no word."""
    return re.sub('([/_])', r'\1<wbr>', escape(text))


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
) -> str:
    """Return means over recordings, by setting, the best first."""
    groups: defaultdict[tuple[str, ...], list[Line]] = defaultdict(list)
    for run in runs:
        groups[tuple(_text(run, name) for name in names)].append(run)

    def mean(group: Sequence[Line], name: str) -> float | None:
        values = [float(run[name]) for run in group if run.get(name) is not None]
        return float(np.mean(values)) if len(values) == len(group) else None

    def figure_cell(group: Sequence[Line], name: str) -> str:
        values = [float(run[name]) for run in group if run.get(name) is not None]
        if name not in CONSISTENCY:
            return _cell(mean(group, name))
        return _range_cell(values) if len(values) == len(group) else _cell(None)

    def mean_score(group: Sequence[Line]) -> float:
        value = mean(group, score)
        return math.inf if value is None else value

    # One that has done fewer recordings is not comparable: they may have been the easy ones.
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), mean_score(item[1])))
    rows = [
        [*map(_cell, key), _cell(len(group)), *(figure_cell(group, name) for name in figures)]
        for key, group in ordered
    ]
    has_best = bool(ordered) and math.isfinite(mean_score(ordered[0][1]))
    headings = [
        *names,
        'recordings',
        *(f'{name}, {"range" if name in CONSISTENCY else "mean"}' for name in figures),
    ]
    return _table('Settings', headings, rows, {0} if has_best else ())


def _runs_table(
    runs: Sequence[Line], names: Sequence[str], figures: Sequence[str], score: str
) -> str:
    """Return all runs; the best of each recording is marked."""
    rows: list[list[str]] = []
    best: dict[str, int] = {}
    # What all names begin with, down to the folder that they share, is left out.
    folders = [run['recording'].rpartition('/')[0].split('/') for run in runs]
    shared = os.path.commonprefix(folders)  # noqa: RUF071 (names of folders, not characters)
    folder = '/'.join([*shared, '']) if shared else ''
    for number, run in enumerate(runs):
        if math.isfinite(_score(run, score)):
            best.setdefault(run['recording_sha256'], number)
        counts = run.get('used')
        is_known = isinstance(counts, dict) and all(isinstance(n, int) for n in counts.values())
        rows.append(
            [
                _cell(run['recording'].removeprefix(folder)),
                _links_cell(run),
                *(_cell(_text(run, name)) for name in names),
                # 0 is nothing at all, or the velocities alone.
                _cell(used_points(Counter(counts)) if is_known else None),
                *(_cell(run.get(name)) for name in figures),
                _folded_cell(run['warnings']),
                _cell(run['run']),
            ]
        )
    headings = ['recording', 'files', *names, 'points used', *figures, 'warnings', 'run']
    return _table('Runs', headings, rows, set(best.values()))
