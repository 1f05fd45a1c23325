"""What the user sees: messages and progress on standard error, results on standard output."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import json
import logging
import sys
from typing import TypeVar

from rich.console import Console
from rich.progress import track

from slam_observer_ros.common.tables import table_of

PROGRAM = 'slam-observer'

_Item = TypeVar('_Item')

_stderr = Console(stderr=True, highlight=False)


class MessageHandler(logging.Handler):
    """Shows log records as ``slam-observer: warning: …``, a line each."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one record."""
        show_message(record.levelname.lower(), record.getMessage())


class _Keeper(logging.Handler):
    """Keeps the warnings, as text."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.warnings: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one record."""
        self.warnings.append(' '.join(record.getMessage().split()))


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Give a list that the package's warnings are added to, beside being shown."""
    keeper, package_logger = _Keeper(), logging.getLogger('slam_observer_ros')
    package_logger.addHandler(keeper)
    try:
        yield keeper.warnings
    finally:
        package_logger.removeHandler(keeper)


def show_message(kind: str, text: str) -> None:
    """Write ``slam-observer: kind: text`` to standard error, above any progress bar."""
    line = f'{PROGRAM}: {kind}: {" ".join(text.split())}'
    _stderr.print(line, markup=False, soft_wrap=True)


def show_progress(items: Iterable[_Item], description: str, total: int) -> Iterator[_Item]:
    """Pass items on, with a progress bar on standard error where that is a terminal."""
    yield from track(
        items,
        description,
        total=total,
        console=_stderr,
        transient=True,
        disable=not _stderr.is_terminal,
    )


def print_json(result: Mapping[str, object]) -> None:
    """Print one JSON object, on one line, on standard output."""
    sys.stdout.write(json.dumps(result, allow_nan=False) + '\n')


def print_table(title: str, rows: Mapping[str, str]) -> None:
    """Print names and values on standard output."""
    Console(highlight=False, markup=False).print(table_of(title, rows))
