"""``slam-observer replay``: a recording through the estimator."""

from __future__ import annotations

import argparse
from dataclasses import replace

from slam_observer_ros.cli.console import kept_warnings, print_json, print_table
from slam_observer_ros.cli.options import add_settings_options, named_path, read_given
from slam_observer_ros.cli.outputs import add_force_option
from slam_observer_ros.cli.replay_files import (
    add_output_options,
    check_files,
    records_of,
    write_files,
)
from slam_observer_ros.cli.replay_outcome import ReplayOutcome, with_logged
from slam_observer_ros.cli.replay_request import add_run_options, read_request, warn_of_unused
from slam_observer_ros.cli.replay_run import replayed
from slam_observer_ros.cli.replay_summary import as_json, identity, summary_rows
from slam_observer_ros.common.errors import LossError, OutputError
from slam_observer_ros.recording.opening import sha256_of
from slam_observer_ros.settings.input_settings import InputSettings


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Run a recording through the observer, as the node would have, and compare '
        'the outcome with the truth if the recording holds it.'
    )
    parser.add_argument(
        'recording',
        type=named_path,
        metavar='RECORDING',
        help='.mcap, .db3 or ROS 1 .bag file, or rosbag2 directory',
    )
    add_run_options(parser)
    add_output_options(parser)
    parser.add_argument(
        '--strict',
        action='store_true',
        help='end with exit code 3 if anything of the recording was lost: if it is damaged, cut '
        'off, or has malformed messages; or if no velocity or no observation of it was used',
    )
    add_force_option(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Replay a recording, and write what was asked for."""
    with kept_warnings() as warnings:
        given = read_given(args)
        request = read_request(args, given, args.recording)
        check_files(args, given.file)
        warn_of_unused(args, given)
        outcome, map_frame = replayed(replace(request, records=records_of(args)))
    _write_and_print(args, with_logged(outcome, warnings), map_frame)


def _write_and_print(args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str) -> None:
    """Write and print all that can be, and only then say what could not be written."""
    rows = summary_rows(outcome)
    written, errors = write_files(args, outcome, map_frame, rows)
    if args.json:
        sha256 = sha256_of(args.recording)
        print_json(identity(args.recording, sha256, outcome) | as_json(outcome))
    else:
        rows |= {name: str(path) for name, path in written.items()}
        print_table(str(args.recording), rows)
    if errors:
        raise OutputError('; '.join(errors))
    if args.strict and any(outcome.lost.values()):
        raise LossError(f'{args.recording}: a part of it was lost, which --strict does not allow')
    if args.strict and outcome.unused_input:
        raise LossError(f'{args.recording}: --strict does not allow this: {outcome.unused_input}')
