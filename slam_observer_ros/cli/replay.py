"""``slam-observer replay``: a recording through the estimator, and what is written of it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict, replace
import logging
import math
import os
from pathlib import Path

from slam_observer_ros.cli.console import print_columns, print_json, print_table, show_progress
from slam_observer_ros.cli.options import (
    add_run_options,
    add_settings_options,
    check_outputs,
    FORCE,
    options,
    read_given,
    read_request,
    warn_of_unused,
)
from slam_observer_ros.common.errors import LossError, OutputError, SlamObserverError, UsageError
from slam_observer_ros.common.findings import kept_warnings
from slam_observer_ros.estimator.event_warnings import listed
from slam_observer_ros.events import UNKNOWN_ID
from slam_observer_ros.mapping.map_file import map_files, write_map
from slam_observer_ros.recordings.opening import files_of, sha256_of
from slam_observer_ros.recordings.trajectory import write_tum
from slam_observer_ros.report.page import write_report
from slam_observer_ros.report.summary import as_json, identity, summary_rows
from slam_observer_ros.runs.replay import result_of
from slam_observer_ros.runs.result import Result
from slam_observer_ros.settings.node_settings import InputSettings

logger = logging.getLogger(__name__)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command, and its description."""
    parser.description = (
        'Run a recording through the observer, as the node would have, and compare '
        'the outcome with the truth if the recording holds it.'
    )
    options(parser, 'recording RECORDING: .mcap, .db3 or ROS 1 .bag file, or rosbag2 directory')
    add_run_options(parser)
    options(
        parser.add_argument_group('outputs'),
        """
        --tum FILE: trajectory, as evo reads it, at most 20 poses a second
        --map FILE: landmarks, as YAML
        --report OUT.html: one page for any browser, without a network: map, errors, residuals,
            consistency and calibration over time, whose figures it saves as PNG or SVG
        --mcap OUT.mcap: the estimate as the node would have published it, for Foxglove and others
        --with-inputs: --mcap has the messages that came in, too
        --explain ID: print the life of a landmark, too: when it was new, the residual of each
            observation, and why points of it were not used
        --json: print one JSON object
        """,
    )
    options(
        parser,
        f"""
        --strict: end with exit code 3 if anything of the recording was lost: if it is damaged, cut
            off, or has malformed messages; or if no velocity or no observation of it was used
        {FORCE}
        """,
    )
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Replay a recording; write and print all that can be, and only then say what could not be."""
    with kept_warnings() as warnings:
        given = read_given(args)
        request = replace(
            read_request(args, given, args.recording),
            keeps_poses=args.tum is not None,
            keeps_nis=args.json,
            keeps_run=args.report is not None or args.explain is not None,
            keeps_map=args.map is not None,
            mcap=args.mcap,
            with_inputs=args.with_inputs,
            overwrite=args.force,
        )
        _check_files(args, given.file)
        warn_of_unused(args, given)
        result = result_of(request, lambda events, n: show_progress(events, 'replaying', n))
    result = replace(result, logged=warnings)
    title = args.recording.name
    rows, life = summary_rows(result), [] if args.explain is None else result.life(args.explain)
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(result.trajectory, path)),
        ('map', args.map, lambda path: _write_map(result, path)),
        ('report', args.report, lambda path: write_report(path, result, title, rows)),
    )
    written = {} if args.mcap is None else {'recording': str(args.mcap)}
    errors: list[str] = []
    for name, path, write in outputs:
        if path is not None:
            try:
                write(path)
                written[name] = str(path)
            except (SlamObserverError, OSError) as error:
                errors.append(str(error))
    if args.json:
        figures = identity(args.recording, sha256_of(args.recording), result) | as_json(result)
        if args.explain is not None:
            figures['landmark'] = {'id': args.explain, 'life': [asdict(line) for line in life]}
        print_json(figures)
    else:
        print_table(str(args.recording), rows | written)
        lines = []
        for each in life:
            known = (f'{each.sigmas:.2f}', f'{each.residual_m:.3f}')
            residual = ('–', '–') if math.isnan(each.sigmas) else known
            lines.append((f'{each.seconds:9.3f}  {each.what}', *residual))
        if lines:
            print_columns(f'landmark {args.explain}', ('time, s', 'residual, σ', 'm'), lines)
    if errors:
        raise OutputError('; '.join(errors))
    if args.explain is not None and not life:
        ids = {each.landmark_id for each in result.run.estimator.outcomes}
        seen = sorted(ids.union(result.innovations.ids.tolist()) - {UNKNOWN_ID})
        raise UsageError(
            f'--explain: no point had the id {args.explain}; there are {listed(seen)}'
        )
    if args.strict and any(result.lost.values()):
        raise LossError(f'{args.recording}: a part of it was lost, which --strict does not allow')
    if args.strict and result.unused_input:
        raise LossError(f'{args.recording}: --strict does not allow this: {result.unused_input}')


def _check_files(args: argparse.Namespace, config: Path | None) -> None:
    """Refuse outputs that are in the way of what is there; --map may update the map loaded."""
    if args.with_inputs and args.mcap is None:
        raise UsageError('--with-inputs is for --mcap')
    read = {f'the recording {args.recording}': files_of(args.recording)}
    if config is not None:
        read['the file of --config'] = [config]
    if args.load_map is not None:
        updated = None if args.map is None else os.path.realpath(args.map)
        loaded = [f for f in map_files(args.load_map) if os.path.realpath(f) != updated]
        read['the file of --load-map'] = loaded
    files = {'--map': args.map, '--tum': args.tum, '--report': args.report, '--mcap': args.mcap}
    check_outputs(files, args.force, read)


def _write_map(result: Result, path: Path) -> None:
    estimator = result.run.estimator
    landmark_map = replace(estimator.landmark_map, frame_id=result.map_frame)
    moving = len(estimator.landmark_ids) - len(landmark_map.ids)
    if moving:
        logger.warning('%d landmarks that move are left out of the map.', moving)
    if result.smoothed is not None:
        smoothed = result.smoothed.estimate
        # The covariances stay: what the filter knows of the map in the end is smoothed, too.
        landmark_map = replace(
            landmark_map,
            world_points=smoothed.world_points,
            orientations=None if landmark_map.orientations is None else smoothed.orientations,
        )
    write_map(path, landmark_map, estimator.settings)
