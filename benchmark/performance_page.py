"""docs/performance.md, its picture, and the figures behind them."""

from __future__ import annotations

import json
import re
from typing import Any, TypeAlias, TypedDict

from cost_tables import Table, Tables
from estimators import EKF, ISAM2, ISAM2_DEFAULT
import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
import worlds

from slam_observer_ros.runs.figures import BLACK, GREEN, PURPLE, RED, save, STYLE

FIGURES = worlds.CHECKOUT / 'benchmark' / 'performance.json'
PAGE = worlds.CHECKOUT / 'docs' / 'performance.md'
PICTURE = worlds.CHECKOUT / 'docs' / 'images' / 'performance.png'
BLOCK = re.compile(r'(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end -->)', re.DOTALL)

SUMMARY = 'summary'

BARS = (
    ('`replay --json` of MRCLAM 6, robot 1, with its config / reading it', 'replay', 0, 0, '≤ 3'),
    ('`replay --json` of MRCLAM 6, robot 1, with defaults / reading it', 'replay', 1, 0, '≤ 3'),
    (f'estimator / {ISAM2}, Starry Night', 'worlds', 'Starry Night', 0, '≤ 0.05'),
    (f'estimator / {ISAM2}, mean of MRCLAM 6', 'worlds', 'MRCLAM 6, mean', 0, '≤ 0.05'),
    (f'estimator / {ISAM2_DEFAULT}, worst world', 'worlds', 'highest', 1, '≤ 0.3'),
    ('800 landmarks passed by / iSAM2, QR', 'passing', 'riccati', 0, '≤ 1'),
    ('2000 landmarks passed by / iSAM2, QR', 'passing', 'riccati', 1, '≤ 1'),
    ('5000 landmarks known, 20 seen at 20 Hz: cores', 'large', 'riccati', 0, '< 0.5'),
    ('200 of 200 landmarks seen: ms', 'crowd', 'riccati', 0, '≤ 10'),
    ('live node / echo node, CPU', 'node', 'observer_node', 0, '≤ 1.8'),
    ('live node / echo node, latency', 'node', 'observer_node', 1, '≤ 1.5'),
    ('`slam-observer --help` / `import numpy`', 'start', 0, 0, '≤ 2'),
)
"""What is wanted: a text, the table, the row and the column of the figure, and its bar."""

DRAWN: dict[str, Any] = {
    'constant': {'color': BLACK, 'marker': 's'},
    'riccati': {'color': GREEN, 'marker': '^'},
    EKF: {'color': RED, 'marker': 'o'},
    ISAM2_DEFAULT: {'color': PURPLE, 'marker': 'v'},
    ISAM2: {'color': PURPLE, 'marker': '*', 'linestyle': '--'},
}
"""Estimators in the picture, and how they are drawn."""


class Measured(TypedDict):
    """When and where a part was measured; ``load`` is the last minute's before."""

    date: str
    processor: str
    cores: int
    load: float


class Part(TypedDict):
    """What was measured together."""

    measured: Measured
    tables: Tables


Figures: TypeAlias = dict[str, Part]
"""The latest figures of each part."""


def read_figures() -> Figures:
    """Return the figures that the page has."""
    if not FIGURES.exists():
        return {}
    figures: Figures = json.loads(FIGURES.read_text(encoding='utf-8'))
    return figures


def part_text(part: Part) -> str:
    """Return the tables of a part as Markdown."""
    return '\n'.join(_table_text(table, part['measured']) for table in part['tables'].values())


def write(figures: Figures) -> None:
    """Rewrite the tables of the page, and the picture."""
    blocks = {SUMMARY: _summary_text(figures)}
    for part in figures.values():
        for name, table in part['tables'].items():
            blocks[name] = _table_text(table, part['measured'])

    def fill(match: re.Match[str]) -> str:
        return match[1] + blocks.get(match['name'], '\nnot measured yet\n\n') + match[3]

    PAGE.write_text(BLOCK.sub(fill, PAGE.read_text(encoding='utf-8')), encoding='utf-8')
    if 'steps' in figures:
        draw(figures['steps']['tables'])


@mpl.rc_context(STYLE)
def draw(tables: Tables) -> None:
    """Draw the cost of a step against landmarks known and landmarks seen."""
    figure = Figure(figsize=(10.0, 4.0))
    known, seen = figure.subplots(1, 2, sharey=True)
    _draw_costs(known, tables['known'], 'landmarks known, three of them seen')
    _draw_costs(seen, tables['seen'], 'landmarks seen, of 300 known')
    known.set_title('CPU time of a step, as a multiple of the cheapest')
    known.legend(fontsize=8)
    save(figure, PICTURE)


def _draw_costs(axes: Axes, table: Table, label: str) -> None:
    counts = [int(column.rpartition(' ')[2]) for column in table['columns']]
    for name, row in table['rows'].items():
        axes.plot(counts, np.array(row, dtype=np.float64), label=name, **DRAWN[name])
    axes.set_xscale('log')
    axes.set_yscale('log')
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_xlabel(label)


def _table_text(table: Table, measured: Measured) -> str:
    lines = [_row(['', *table['columns']]), '|---' * (len(table['columns']) + 1) + '|']
    lines += [_row([name, *map(_number, row)]) for name, row in table['rows'].items()]
    return '\n'.join(['', *lines, '', f'*{_where(measured)}*', '', ''])


def _summary_text(figures: Figures) -> str:
    lines = [_row(['', 'measured', 'wanted', '']), '|---|---|---|---|']
    for text, name, row, column, bar in BARS:
        for part in figures.values():
            if name in part['tables']:
                value = _value(part['tables'][name], row, column)
                lines.append(_row([text, _number(value), bar, part['measured']['date']]))
    return '\n'.join(['', *lines, '', ''])


def _value(table: Table, row: str | int, column: int) -> float | None:
    rows = table['rows']
    values = list(rows.values())[row] if isinstance(row, int) else rows[row]
    return values[column]


def _where(measured: Measured) -> str:
    return (
        f'{measured["date"]}: {measured["processor"]}, {measured["cores"]} cores, '
        f'load before {measured["load"]:g}'
    )


def _row(cells: list[str]) -> str:
    return f'| {" | ".join(cells)} |'


def _number(value: float | None) -> str:
    """Return a number with some three digits."""
    if value is None:
        return '–'
    decimals = next((d for limit, d in ((100.0, 0), (10.0, 1), (1.0, 2)) if value >= limit), 3)
    return f'{value:.{decimals}f}'
