"""What the command line says: results on standard output, messages and progress beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
import logging
import sys
from typing import Any, TYPE_CHECKING, TypeVar

from slam_observer_ros.common.errors import json_text
from slam_observer_ros.common.process import leaving_at_once

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PROGRAM = 'slam-observer'

_FOREVER_S = 1e9

_Item = TypeVar('_Item')


class MessageHandler(logging.Handler):
    """Shows log records as ``slam-observer: warning: …``, a line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one record."""
        show_message(record.levelname.lower(), record.getMessage())


def show_message(kind: str, text: str) -> None:
    """Write ``slam-observer: kind: text`` to standard error, above any progress bar."""
    if sys.stderr is not None:  # a shell may have closed it
        sys.stderr.write(f'{PROGRAM}: {kind}: {" ".join(text.split())}\n')


@contextmanager
def progress_bar(description: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Give a function to be called with how much was done of a ``total``, or of no known one.

    That shows on standard error, where that is a terminal.
    """
    progress = _progress()
    console = progress.Console(stderr=True, highlight=False)
    if not console.is_terminal:
        yield lambda _: None
        return
    columns = (
        progress.TextColumn('{task.description}'),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(),
        progress.TimeRemainingColumn(),
    )
    # Each step may take minutes: all of them judge the time left, not the last 30 seconds.
    with progress.Progress(
        *columns, console=console, transient=True, speed_estimate_period=_FOREVER_S
    ) as shown:
        task = shown.add_task(description, total=total)
        yield lambda count: shown.advance(task, count)


def show_progress(items: Iterable[_Item], description: str, total: int) -> Iterator[_Item]:
    """Pass items on, with a progress bar; one that has a length is so many of the ``total``."""

    def passed_on() -> Iterator[_Item]:
        with progress_bar(description, total) as advance:
            for item in items:
                yield item
                advance(len(item) if isinstance(item, Sized) else 1)

    _progress()  # now: Ctrl-C ends an import at once, and would leave a file that has been begun
    return passed_on()


def _progress() -> Any:
    with leaving_at_once():
        from rich import progress
    return progress


def print_json(result: Mapping[str, object]) -> None:
    """Print one JSON object, on one line, on standard output."""
    sys.stdout.write(json_text(result) + '\n')


def print_table(title: str, rows: Mapping[str, str]) -> None:
    """Print names and values on standard output."""
    _console().print(table_of(title, rows))


def _console() -> Console:
    with leaving_at_once():
        from rich.console import Console
    return Console(highlight=False, markup=False)


def print_columns(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a line for each of ``rows`` on standard output; its first entry is its name."""
    console = _console()
    from rich.table import Table

    shown = Table(title=title, title_justify='left')
    for number, heading in enumerate(headings):
        shown.add_column(heading, overflow='fold', justify='right' if number else 'left')
    for row in rows:
        shown.add_row(*row)
    console.print(shown)


def table_of(title: str, rows: Mapping[str, str]) -> Table:
    """Return a table of names and values; a narrow terminal folds it and shortens nothing."""
    with leaving_at_once():
        from rich.table import Table

    table = Table(title=title, title_justify='left', show_header=False)
    for _ in ('name', 'value'):
        table.add_column(overflow='fold')
    for name, value in rows.items():
        table.add_row(name, value)
    return table
