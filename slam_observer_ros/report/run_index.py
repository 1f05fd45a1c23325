"""One page with tables of many runs, which a click on a heading sorts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from slam_observer_ros.common.errors import OutputError
from slam_observer_ros.common.output_files import unfinished_file
from slam_observer_ros.report.page import asset

Cell = float | str | None


@dataclass(frozen=True, slots=True)
class Link:
    """A cell that leads to a file beside the page."""

    text: str
    href: str


@dataclass(frozen=True, slots=True)
class IndexTable:
    """A table; ``best`` are the rows that are marked. A cell of None is empty."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Cell | Link]]
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
        f'<th scope="col"><button type="button">{escape(name)}</button></th>'
        for name in table.headings
    )
    rows = '\n'.join(
        f'<tr{" class=best" if number in table.best else ""}>{"".join(map(_cell, row))}</tr>'
        for number, row in enumerate(table.rows)
    )
    return (
        f'<section><h2>{escape(table.title)}</h2><div class="wide"><table>\n'
        f'<thead><tr>{headings}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div></section>'
    )


def _cell(value: Cell | Link) -> str:
    if value is None:
        return '<td class="number"></td>'
    if isinstance(value, Link):
        return f'<td><a href="{escape(value.href)}">{escape(value.text)}</a></td>'
    if isinstance(value, str):
        return f'<td>{escape(value)}</td>'
    return f'<td class="number" data-value="{value!r}">{value:.4g}</td>'
