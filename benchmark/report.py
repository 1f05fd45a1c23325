"""Tables, document and figure of the benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
import math
from pathlib import Path
import re
from textwrap import fill
from typing import Any, TypeAlias

import estimators
from estimators import BATCH, EKF, ISAM2, ISAM2_DEFAULT, SMOOTHED, UNCALIBRATED
import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from monte_carlo import BATCH as BATCH_OF_RUNS
from monte_carlo import Consistency
import numpy as np
from scores import Scores
from variants import CLEAN, FALSE_POINTS, LEFT_OUT, NO_IDS, OUTLIER_COLUMNS, OUTLIERS, WORST

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.placement import DESIGNS
from slam_observer_ros.runs.figures import BLACK, GREEN, RED, save, STYLE

LEFT_OUT_COLUMN = 'riccati, these points left out'
GROWTH_COLUMNS = (*OUTLIER_COLUMNS, 'riccati' + WORST, LEFT_OUT_COLUMN)

DRAWN: dict[str, dict[str, Any]] = {
    column: {'color': colour, 'marker': marker}
    for column, colour, marker in zip((*DESIGNS, EKF), (BLACK, GREEN, RED), 's^o', strict=True)
}
"""Estimators in the figure, and how they are drawn."""

RATIO_TICKS = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0)

STARRY_NIGHT = 'Starry Night'
MRCLAM_MEAN = 'MRCLAM 6, mean'

Table: TypeAlias = dict[str, dict[str, Scores]]
"""World → column → scores."""

Tables: TypeAlias = dict[str, Table]
"""Variant → table."""

Worth: TypeAlias = dict[str, list[tuple[Scores, Scores]]]
"""Feature and data → scores with the feature and without it, of each run."""

AIMS = (
    ('configuration_rmse_m', 'riccati', ISAM2, 'mean ≤ 1, each ≤ 1.15'),
    ('configuration_rmse_m', 'riccati', ISAM2_DEFAULT, ''),
    ('configuration_rmse_m', UNCALIBRATED, ISAM2, ''),
    ('configuration_rmse_m', EKF, 'riccati', '≥ 0.98'),
    ('ate_rmse_m', 'riccati', ISAM2, '≤ 1'),
    ('ate_rmse_m', SMOOTHED, BATCH, '≤ 1.02'),
    ('cpu_s', 'riccati', ISAM2, '≤ 0.2'),
    ('cpu_s', 'riccati', ISAM2_DEFAULT, ''),
)
"""Metric, two estimators, and what the ratio of the first to the second should be."""

SUMMARY_TITLE = 'In short'
SUMMARY_COLUMNS = (
    STARRY_NIGHT,
    MRCLAM_MEAN,
    'MRCLAM 6, highest',
    'lowest',
    'highest',
    'aim',
)

METRICS: dict[str, tuple[str, int]] = {
    'configuration_rmse_m': ('Configuration error, m', 3),
    'ate_rmse_m': ('Position ATE RMSE, m', 3),
    'heading_rmse_rad': ('Heading RMSE, rad', 3),
    'landmark_rmse_m': ('Landmark RMSE, m', 3),
    'cpu_s': ('CPU time, s', 2),
}
"""Title and decimals of each table."""

PRINTED_ONLY = ('heading_rmse_rad', 'landmark_rmse_m', 'cpu_s')
"""Metrics whose tables the page does not have."""

OUTLIERS_TITLE = 'Growth of the configuration error with 5 % gross outliers and 1 % swapped ids'
NO_IDS_TITLE = 'Configuration error and CPU time with and without ids'
NO_IDS_COLUMNS = tuple(
    f'{case}, {unit}'
    for unit in ('m', 's')
    for case in ('with', 'without', 'and with 5 % false points')
)

WORTH_TITLE = 'What features are worth: configuration error with and without'
WORTH_COLUMNS = ('with, m', 'without, m', 'with / without', 'lowest', 'highest', 'CPU time')

BATCHES_TITLE = f'inside, {BATCH_OF_RUNS} runs at a time'
CONSISTENCY_COLUMNS = ('inside', BATCHES_TITLE, 'pose', 'landmarks')


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """All that the benchmark measured.

    Attributes
    ----------
    tables : Tables
        Scores.
    worth : Worth
        Scores with and without single features.
    consistency : dict
        Loop → estimator → ANEES over time; empty if it was left out.
    runs : int
        Monte Carlo runs.

    """

    tables: Tables
    worth: Worth
    consistency: dict[str, dict[str, Consistency]]
    runs: int


def tables(results: Results, left_out: Sequence[str] = ()) -> str:
    """Return the tables as Markdown, but for some metrics'."""
    sections = _comparison(results.tables, left_out) if results.tables[CLEAN] else []
    if results.worth:
        rows = {case: _worth(runs) for case, runs in results.worth.items()}
        sections.append(_table(WORTH_TITLE, rows, WORTH_COLUMNS))
    for loop, columns in results.consistency.items():
        title = f'ANEES of {results.runs} runs: {loop}'
        sections.append(_table(title, _consistency(columns), CONSISTENCY_COLUMNS))
    return '\n'.join(sections)


def rewritten(page: str, results: Results) -> str:
    """Return the text of docs/benchmark.md with other tables below its introduction."""
    return page[: page.index(f'## {SUMMARY_TITLE}\n')] + tables(results, PRINTED_ONLY)


def _comparison(tables: Tables, left_out: Sequence[str]) -> list[str]:
    """Return the tables that compare estimators."""
    sections = [_table(SUMMARY_TITLE, _summary(tables), SUMMARY_COLUMNS)]
    for metric, (title, decimals) in METRICS.items():
        if metric not in left_out:
            cells = _cells(tables[CLEAN], metric, decimals)
            sections.append(_table(title, cells, estimators.COLUMNS))
    sections.append(_table(OUTLIERS_TITLE, _growth(tables), GROWTH_COLUMNS))
    if tables[NO_IDS]:
        sections.append(_table(NO_IDS_TITLE, _without_ids(tables), NO_IDS_COLUMNS))
    return sections


def to_json(results: Results) -> dict[str, Any]:
    """Return all numbers as JSON's types; null where an estimator failed."""
    converted: dict[str, Any] = {
        variant: {
            world: {
                column: {name: _or_null(value) for name, value in asdict(scores).items()}
                for column, scores in columns.items()
            }
            for world, columns in table.items()
        }
        for variant, table in results.tables.items()
    }
    converted['features'] = _worth_to_json(results.worth)
    converted['monte_carlo_runs'] = results.runs
    converted['consistency'] = {
        loop: {
            name: {
                'times_s': consistency.times_s.tolist(),
                'pose_anees': consistency.pose.tolist(),
                'landmark_anees': consistency.landmarks.tolist(),
                'band': consistency.band,
                'inside': consistency.inside,
                'batches_inside': [batch.inside for batch in consistency.batches],
            }
            for name, consistency in columns.items()
        }
        for loop, columns in results.consistency.items()
    }
    return converted


@mpl.rc_context(STYLE)
def draw(results: Results, path: Path) -> None:
    """Draw the configuration errors and the ANEES over time."""
    loops = results.consistency
    figure = Figure(figsize=(10.0, 3.6 + 2.8 * bool(loops)))
    grid = figure.add_gridspec(1 + bool(loops), max(len(loops), 1))
    _draw_ratios(figure.add_subplot(grid[0, :]), results.tables[CLEAN])
    for i, (loop, columns) in enumerate(loops.items()):
        _draw_consistency(figure.add_subplot(grid[1, i]), loop, columns)
    save(figure, path)


def _table(title: str, rows: dict[str, dict[str, str]], columns: tuple[str, ...]) -> str:
    """Return a Markdown table with a heading."""
    lines = [f'## {title}', '', f'| | {" | ".join(columns)} |', '|---' * (len(columns) + 1) + '|']
    for name, cells in rows.items():
        lines.append(f'| {name} | {" | ".join(cells.get(column, "") for column in columns)} |')
    return '\n'.join([*lines, ''])


def _or_null(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _number(value: float, decimals: int) -> str:
    return f'{value:.{decimals}f}' if np.isfinite(value) else 'failed'


def _worth_to_json(worth: Worth) -> dict[str, list[list[float | None]]]:
    """Return the errors with and without, of each run."""
    return {
        case: [[_or_null(one.configuration_rmse_m) for one in pair] for pair in runs]
        for case, runs in worth.items()
    }


def _percent(ratio: float) -> str:
    return f'{100.0 * (ratio - 1.0):+.0f} %' if np.isfinite(ratio) else 'failed'


def _values(table: Table, worlds: Iterable[str], column: str, metric: str) -> FloatArray:
    """Return one metric of one estimator on some worlds."""
    return np.array([getattr(table[world][column], metric) for world in worlds])


def _mrclam(table: Table) -> list[str]:
    return [world for world in table if 'MRCLAM' in world]


def _cells(table: Table, metric: str, decimals: int) -> dict[str, dict[str, str]]:
    """Return the rows of one metric's table: all worlds, and the mean of MRCLAM's robots."""
    rows = {
        world: {
            column: _number(getattr(scores, metric), decimals)
            for column, scores in columns.items()
        }
        for world, columns in table.items()
    }
    robots = _mrclam(table)
    if len(robots) > 1:
        rows['**MRCLAM 6, mean**'] = {
            column: _number(float(_values(table, robots, column, metric).mean()), decimals)
            for column in estimators.COLUMNS
        }
    return rows


def _growth(tables: Tables) -> dict[str, dict[str, str]]:
    rows = {}
    for world, clean in tables[CLEAN].items():
        worse = {LEFT_OUT_COLUMN: ('riccati', tables[LEFT_OUT][world]['riccati'])}
        worse |= {column: (column, scores) for column, scores in tables[OUTLIERS][world].items()}
        rows[world] = {
            title: _percent(
                scores.configuration_rmse_m
                / clean[column.removesuffix(WORST)].configuration_rmse_m
            )
            for title, (column, scores) in worse.items()
        }
    return rows


def _without_ids(tables: Tables) -> dict[str, dict[str, str]]:
    rows = {}
    for world, columns in tables[NO_IDS].items():
        worse = tables[FALSE_POINTS][world]['riccati']
        cases = tables[CLEAN][world]['riccati'], columns['riccati'], worse
        errors = [_number(scores.configuration_rmse_m, 3) for scores in cases]
        times = [_number(scores.cpu_s, 2) for scores in cases]
        rows[world] = dict(zip(NO_IDS_COLUMNS, errors + times, strict=True))
    return rows


def _consistency(columns: dict[str, Consistency]) -> dict[str, dict[str, str]]:
    """Return, for each estimator, how often its pose is in the band, and its ANEES' range."""
    rows = {}
    for name, consistency in columns.items():
        pose, landmarks = consistency.pose, consistency.landmarks
        rows[name] = {
            'inside': _inside([consistency]),
            BATCHES_TITLE: _inside(consistency.batches),
            'pose': f'{pose.mean():.2f} ({pose.min():.2f}–{pose.max():.2f})',
            'landmarks': f'{landmarks.mean():.2f} ({landmarks.min():.2f}–{landmarks.max():.2f})',
        }
    return rows


def _inside(consistencies: list[Consistency]) -> str:
    """Return how many checkpoints are in the band, for each one; all have the same band."""
    if not consistencies:
        return ''
    lower, upper = consistencies[0].band
    counts = ', '.join(str(one.inside) for one in consistencies)
    return f'{counts} of {len(consistencies[0].pose)} in {lower:.2f}–{upper:.2f}'


def _worth(runs: list[tuple[Scores, Scores]]) -> dict[str, str]:
    """Return a row: mean errors, and the ratios' geometric mean and extremes over all runs."""
    errors_m = np.array([[one.configuration_rmse_m for one in pair] for pair in runs])
    cpu_s = np.array([[one.cpu_s for one in pair] for pair in runs]).sum(axis=0)
    ratios, (on_m, off_m) = errors_m[:, 0] / errors_m[:, 1], errors_m.mean(axis=0)
    values = (on_m, off_m, math.exp(np.log(ratios).mean()), ratios.min(), ratios.max())
    cells = [_number(value, 3) for value in values] + [_number(cpu_s[0] / cpu_s[1], 2)]
    return dict(zip(WORTH_COLUMNS, cells, strict=True))


def _summary(tables: Tables) -> dict[str, dict[str, str]]:
    """Return the ratios by which the project is judged, beside its aims."""
    clean = tables[CLEAN]
    rows = {}
    for metric, top, bottom, aim in AIMS:
        title = METRICS[metric][0].split(',')[0]
        values = {
            world: (getattr(columns[top], metric), getattr(columns[bottom], metric))
            for world, columns in clean.items()
        }
        judged = {MRCLAM_MEAN} if metric != 'cpu_s' else {STARRY_NIGHT, MRCLAM_MEAN}
        rows[f'{title}: {top} / {bottom}'] = _with_aim(_ratios(values), aim, judged)
    for variant, column, label, aim in (
        (OUTLIERS, 'riccati', 'with outliers / without', '≤ 1.2'),
        (OUTLIERS, 'riccati' + WORST, 'with outliers, worst draw / without', ''),
        (LEFT_OUT, 'riccati', 'these points left out / all', ''),
        (NO_IDS, 'riccati', 'without ids / with', 'mean ≤ 1.3'),
        (FALSE_POINTS, 'riccati', 'without ids, with 5 % false points / with', ''),
    ):
        values = {
            world: (
                columns[column].configuration_rmse_m,
                clean[world]['riccati'].configuration_rmse_m,
            )
            for world, columns in tables[variant].items()
        }
        ratios = _ratios(values)
        rows[f'Configuration error: riccati, {label}'] = _with_aim(ratios, aim, {MRCLAM_MEAN})
    return rows


def _ratios(values: dict[str, tuple[float, float]]) -> dict[str, float]:
    """Return the ratio on Starry Night, of MRCLAM's means, and the extremes over all worlds."""
    ratios = {world: top / bottom for world, (top, bottom) in values.items()}
    robots = np.array([terms for world, terms in values.items() if 'MRCLAM' in world])
    finite = [ratio for ratio in ratios.values() if np.isfinite(ratio)]
    cells = {'lowest': min(finite), 'highest': max(finite)} if finite else {}
    if STARRY_NIGHT in ratios:
        cells[STARRY_NIGHT] = ratios[STARRY_NIGHT]
    if len(robots):
        cells[MRCLAM_MEAN] = robots[:, 0].mean() / robots[:, 1].mean()
        cells['MRCLAM 6, highest'] = (robots[:, 0] / robots[:, 1]).max()
    return cells


def _with_aim(ratios: dict[str, float], aim: str, judged: set[str]) -> dict[str, str]:
    """Return ratios with what was aimed at, those ``judged`` in bold where they miss it."""
    cells = {name: _number(ratio, 3) for name, ratio in ratios.items()}
    if bound := re.search(r'([≤≥]) ([\d.]+)', aim):
        sign = 1.0 if bound[1] == '≤' else -1.0
        for name in judged & ratios.keys():
            if sign * ratios[name] > sign * float(bound[2]):
                cells[name] = f'**{cells[name]}**'
    return {**cells, 'aim': aim}


def _draw_ratios(axes: Axes, table: Table) -> None:
    """Draw configuration errors as multiples of iSAM2's, one position for each world."""
    isam2 = _values(table, table, ISAM2, 'configuration_rmse_m')
    positions = np.arange(len(table))
    axes.axhline(1.0, color='#555555', linewidth=1.0, zorder=1)
    axes.text(-0.45, 1.0, 'iSAM2', fontsize=8, verticalalignment='bottom')
    for column, style in DRAWN.items():
        ratios = _values(table, table, column, 'configuration_rmse_m') / isam2
        axes.plot(positions, ratios, linestyle='none', label=column, **style)
    axes.set_yscale('log')
    axes.yaxis.set_major_locator(FixedLocator(RATIO_TICKS))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter('{x:g}')
    axes.set_xticks(
        positions, [fill(world, 12, break_long_words=False) for world in table], fontsize=8
    )
    axes.set_xlim(-0.5, len(table) - 0.5)
    axes.set_title("Configuration error as a multiple of iSAM2's")
    axes.legend(ncols=len(DRAWN), fontsize=8)


def _draw_consistency(axes: Axes, loop: str, columns: dict[str, Consistency]) -> None:
    for name, consistency in columns.items():
        axes.plot(consistency.times_s, consistency.pose, markersize=4, label=name, **DRAWN[name])
    band = next(iter(columns.values())).band  # that of the number of runs
    axes.axhspan(*band, color='#DDDDDD', zorder=0, label='95 % of consistent estimators')
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel('time [s]')
    axes.set_title(f'ANEES of the pose, {loop}')
    axes.legend(fontsize=8, loc='lower right')
