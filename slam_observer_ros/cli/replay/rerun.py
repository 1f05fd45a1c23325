"""``replay --rerun``: the run in Rerun's viewer, or as a file for it."""

from __future__ import annotations

import argparse
from importlib.util import find_spec
from pathlib import Path

from slam_observer_ros.common.errors import UsageError

VIEWER = False
"""What is given in place of a file to have the viewer opened."""


def add_rerun_option(outputs: argparse._ArgumentGroup) -> None:
    """Add ``--rerun``."""
    outputs.add_argument(
        '--rerun',
        nargs='?',
        type=_rerun_file,
        const=VIEWER,
        metavar='OUT.rrd',
        help='a file for Rerun, or its viewer if no file is given (needs rerun-sdk)',
    )


def check_rerun(args: argparse.Namespace) -> None:
    """Raise a UsageError if Rerun is asked for and not installed."""
    if args.rerun is not None and find_spec('rerun') is None:
        raise UsageError("--rerun needs rerun-sdk: 'pip install rerun-sdk'")


def _rerun_file(text: str) -> Path:
    path = Path(text)
    if path.suffix != '.rrd':
        raise argparse.ArgumentTypeError(
            f"files for Rerun are .rrd files, so not '{text}'; without one give --rerun last"
        )
    return path
