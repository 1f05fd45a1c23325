"""Output files: refused before the work if they are in the way, and never half-written."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import os
from pathlib import Path

from slam_observer_ros.cli.options import named_path
from slam_observer_ros.common.errors import EvaluationError, OutputError, UsageError
from slam_observer_ros.common.files import destination, unfinished_directory


def add_force_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--force``."""
    parser.add_argument('--force', action='store_true', help='replace files that exist already')


def add_result_options(parser: argparse._ActionsContainer, figures: Iterable[str]) -> None:
    """Add ``--plot``, its format, and ``--json``."""
    parser.add_argument(
        '--plot',
        type=named_path,
        metavar='DIR',
        help=f'draw the figures {", ".join(figures)}',
    )
    parser.add_argument(
        '--plot-format',
        choices=('png', 'svg', 'pdf'),
        default='png',
        help='what the figures are written as (default png)',
    )
    parser.add_argument('--json', action='store_true', help='print one JSON object')


def recording_path(text: str) -> Path:
    """Take the name of a recording to be made, as an argparse type."""
    path = Path(text)
    if path.suffix != '.mcap':
        raise argparse.ArgumentTypeError(f"recordings are .mcap files, so not '{text}'")
    return path


def check_outputs(files: Iterable[Path | None], force: bool) -> None:
    """Raise a UsageError if a file can't be written, or not without ``force``; None is none."""
    wanted = [file for file in files if file is not None]
    for number, file in enumerate(wanted):
        if file.is_dir():
            raise UsageError(f'{file} is a directory; give the name of a file')
        real = Path(os.path.realpath(file))  # which fails in no circle of links
        if real.is_symlink():
            raise UsageError(f'{file} is a link to itself; give another name')
        if file.exists() and not file.is_file():
            raise UsageError(f'{file} is there, and no regular file; give another name')
        if file.exists() and not force:
            raise UsageError(f'{file} exists already; give another name, or --force to replace it')
        if not file.parent.is_dir():
            raise UsageError(f'{file}: there is no directory {file.parent}; make it first')
        if not os.access(file.parent, os.W_OK):
            raise UsageError(f'{file}: nothing may be written to {file.parent}')
        if real in [Path(os.path.realpath(other)) for other in wanted[:number]]:
            raise UsageError(f'{file} is named for two outputs')


def check_inputs_are_kept(
    outputs: Mapping[str, Path | None], inputs: Mapping[str, Iterable[Path]]
) -> None:
    """Raise a UsageError if an output would replace a file which is read, by whatever name.

    Outputs are by option, None where not asked for; inputs by what they are.
    """
    read = {os.path.realpath(file): what for what, files in inputs.items() for file in files}
    for option, file in outputs.items():
        if file is not None and (what := read.get(os.path.realpath(file))) is not None:
            raise UsageError(f'{option} {file} would replace {what}; give another name')


def figure_files(args: argparse.Namespace, figures: Iterable[str]) -> list[str]:
    """Return the names of the files of figures, in the format that is asked for."""
    return [f'{name}.{args.plot_format}' for name in figures]


def check_plots(
    args: argparse.Namespace, figures: Iterable[str], others: Iterable[Path | None]
) -> None:
    """Raise a UsageError if the figures can't be written to the directory of ``--plot``.

    It need not exist, but its parent must; ``others`` are the other outputs.
    """
    directory: Path | None = args.plot
    if directory is None:
        return
    check_directory(directory)
    files = [directory / name for name in figure_files(args, figures)]
    written = {os.path.realpath(file) for file in (directory, *files)}
    for other in others:
        if other is not None and os.path.realpath(other) in written:
            raise UsageError(f'{other} is named for two outputs')
    if directory.is_dir():
        check_outputs(files, args.force)


def check_directory(directory: Path) -> None:
    """Raise a UsageError if a directory is not there, and can't be made."""
    if directory.is_dir():
        return
    if os.path.lexists(directory):
        raise UsageError(f'{directory} is no directory; give the name of one')
    if not directory.parent.is_dir():
        raise UsageError(f'{directory}: there is no directory {directory.parent}; make it first')
    if not os.access(directory.parent, os.W_OK):
        raise UsageError(f'{directory}: nothing may be written to {directory.parent}')


@contextmanager
def filled_directory(directory: Path) -> Iterator[Path]:
    """Give a directory to write in, whose files go to ``directory`` when all are written.

    Raises an OutputError if that fails.
    """
    beside = directory if directory.is_dir() else directory.parent
    try:
        with unfinished_directory(beside) as unfinished:
            try:
                yield unfinished
            except EvaluationError as error:  # which names a directory that is gone then
                raise OutputError(str(error).replace(str(unfinished), str(directory))) from error
            directory.mkdir(exist_ok=True)
            for file in sorted(unfinished.iterdir()):
                file.replace(destination(directory / file.name))
    except OSError as error:
        reason = error.strerror or error  # its whole text names a directory that is gone by now
        raise OutputError(f"can't write figures to {directory}: {reason}") from error
