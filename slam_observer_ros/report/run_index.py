"""One page with tables of many runs, which a click on a heading sorts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
import math
from pathlib import Path
import re

from slam_observer_ros.common.digits import significant
from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.report.page import asset


@dataclass(frozen=True, slots=True)
class Links:
    """A cell that leads to files beside the page, by what they are called."""

    files: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Folded:
    """A cell of texts, of which their number is shown until it is clicked."""

    texts: Sequence[str]


@dataclass(frozen=True, slots=True)
class Range:
    """A cell from the least to the largest of numbers that should be 1, sorted by the worst."""

    least: float
    largest: float


Cell = int | float | str | Links | Folded | Range | None


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
    if isinstance(value, Links):
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
