"""Tables of names and values for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.table import Table


def table_of(title: str, rows: Mapping[str, str]) -> Table:
    """Return a table of names and values; a narrow terminal folds it and shortens nothing."""
    table = Table(title=title, title_justify='left', show_header=False)
    for _ in ('name', 'value'):
        table.add_column(overflow='fold')
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def columns_of(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table with a line for each of ``rows``, whose first entry is its name."""
    table = Table(title=title, title_justify='left')
    for number, heading in enumerate(headings):
        table.add_column(heading, overflow='fold', justify='right' if number else 'left')
    for row in rows:
        table.add_row(*row)
    return table
