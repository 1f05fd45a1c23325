"""What the options of a replay ask for, which other commands have, too."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from slam_observer_ros.cli.options import named_path, read_settings
from slam_observer_ros.cli.replay.input_options import (
    add_input_options,
    INPUT_NAMES,
    INSTEAD,
    read_inputs,
)
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.observer.designs import DESIGNS
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings


@dataclass(frozen=True, slots=True)
class Asked:
    """What the options of a replay ask for, checked."""

    settings: Settings
    inputs: InputSettings


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a recording is replayed, beside those of settings."""
    add_input_options(parser)
    parser.add_argument(
        '--load-map',
        type=named_path,
        metavar='FILE',
        help='known landmarks, as --map writes them, or a folder of such maps, in one of which '
        'the robot is found: the estimate is then in their frame, and has no ANEES of the pose '
        '(nor of the configuration, if they are fixed)',
    )
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='estimate trajectory and map from all observations together, too; --tum and --map '
        'then write these',
    )


def read_asked(args: argparse.Namespace) -> Asked:
    """Read settings; raise a SlamObserverError if they are wrong, or don't fit the options."""
    defaults = {'smoothing_window': 0} if args.smooth else {}
    settings = read_settings(args, INPUT_NAMES, INSTEAD, **defaults)
    inputs = read_inputs(args)
    check_smooth(args, settings)
    return Asked(settings, inputs)


def check_smooth(args: argparse.Namespace, settings: Settings) -> None:
    """Raise a UsageError if there is something to smooth, and gains that can't."""
    if args.smooth and not DESIGNS[settings.gains].has_joint_covariance:
        raise UsageError(f'--smooth needs riccati gains, not {settings.gains}')


def without_outputs(args: argparse.Namespace, recording: Path) -> argparse.Namespace:
    """Return the options of a replay that writes nothing, and of which --json could be printed.

    ``args`` has those of :func:`add_run_options`; what they set is in :class:`Asked`.
    """
    outputs = dict.fromkeys(('tum', 'map', 'report', 'mcap', 'rerun', 'plot'))
    others: dict[str, object] = {'with_inputs': False, 'json': True, 'force': True}
    read: dict[str, object] = {'recording': recording, 'config': None, 'set': []}
    return argparse.Namespace(**vars(args) | outputs | others | read)
