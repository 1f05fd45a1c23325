"""The files that a replay writes; what draws them is imported where it is asked for."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
import dataclasses
import logging
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.options import named_path
from slam_observer_ros.cli.outputs import (
    add_result_options,
    check_inputs_are_kept,
    check_outputs,
    check_plots,
    figure_files,
    filled_directory,
    recording_path,
)
from slam_observer_ros.cli.replay_outcome import ReplayOutcome
from slam_observer_ros.cli.replay_request import Records
from slam_observer_ros.common.errors import SlamObserverError, UsageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.evaluation.consistency import nees_over_time, shape_covariances
from slam_observer_ros.evaluation.trajectory import Trajectory, write_tum
from slam_observer_ros.geometry import se3
from slam_observer_ros.known_map.map_file import map_files, write_map
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.runs.reported_run import Replay

logger = logging.getLogger(__name__)

FIGURES = ('map', 'errors', 'residuals')

MAX_ELLIPSES = 300
"""Landmarks of more would hide each other's, and their joint covariance costs the cube of them."""


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for what is written, and ``--json``."""
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        '--tum',
        type=named_path,
        metavar='FILE',
        help='trajectory, as evo reads it, at most 20 poses a second',
    )
    outputs.add_argument('--map', type=named_path, metavar='FILE', help='landmarks, as YAML')
    outputs.add_argument(
        '--report',
        type=named_path,
        metavar='OUT.html',
        help='one page for any browser, without a network: map, residuals, consistency and '
        'calibration over time',
    )
    outputs.add_argument(
        '--mcap',
        type=recording_path,
        metavar='OUT.mcap',
        help='the estimate as the node would have published it, for Foxglove and others',
    )
    outputs.add_argument(
        '--with-inputs', action='store_true', help='--mcap has the messages that came in, too'
    )
    add_result_options(outputs, FIGURES)


def records_of(args: argparse.Namespace) -> Records:
    """Return what is to be kept of a run for the files that are asked for."""
    return Records(
        poses=args.tum is not None,
        nis=args.json,
        whole_run=any(output is not None for output in (args.report, args.plot)),
        map=args.map is not None,
        mcap=args.mcap,
        with_inputs=args.with_inputs,
        overwrite=args.force,
    )


def check_files(args: argparse.Namespace, config: Path | None) -> None:
    """Refuse outputs that are in the way of what is there; --map may update the map loaded."""
    if args.with_inputs and args.mcap is None:
        raise UsageError('--with-inputs is for --mcap')
    read = {f'the recording {args.recording}': files_of(args.recording)}
    if config is not None:
        read['the file of --config'] = [config]
    loaded = {} if args.load_map is None else {'the file of --load-map': map_files(args.load_map)}
    files = {'--tum': args.tum, '--report': args.report, '--mcap': args.mcap}
    figures = () if args.plot is None else figure_files(args, FIGURES)
    drawn = {f'{name} of --plot,': args.plot / name for name in figures}
    check_inputs_are_kept(files | drawn, read | loaded)
    check_inputs_are_kept({'--map': args.map}, read)
    outputs = [args.map, *files.values()]
    check_outputs(outputs, args.force)
    check_plots(args, FIGURES, outputs)


def write_files(
    args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str, summary: Mapping[str, str]
) -> tuple[dict[str, Path], list[str]]:
    """Write what was asked for; return what was written, and why something was not."""
    title = args.recording.name
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(outcome.trajectory, path)),
        ('map', args.map, lambda path: _write_map(outcome, map_frame, path)),
        ('report', args.report, lambda path: write_report_of(title, outcome, summary, path)),
        ('figures', args.plot, lambda path: _draw(args, outcome, path)),
    )
    written: dict[str, Path] = {} if args.mcap is None else {'recording': args.mcap}
    errors: list[str] = []
    for name, path, write in outputs:
        if path is None:
            continue
        try:
            write(path)
            written[name] = path
        except (SlamObserverError, OSError) as error:
            errors.append(str(error))
    return written, errors


def _write_map(outcome: ReplayOutcome, map_frame: str, path: Path) -> None:
    estimator, smoothed = outcome.result.estimator, outcome.smoothed
    landmark_map = dataclasses.replace(estimator.landmark_map, frame_id=map_frame)
    moving = len(estimator.landmark_ids) - len(landmark_map.ids)
    if moving:
        logger.warning('%d landmarks that move are left out of the map.', moving)
    if smoothed is not None:
        # The covariances stay: what the filter knows of the map in the end is smoothed, too.
        landmark_map = dataclasses.replace(
            landmark_map,
            world_points=smoothed.world_points,
            orientations=None if landmark_map.orientations is None else smoothed.orientations,
        )
    write_map(path, landmark_map, estimator.settings)


def write_report_of(
    title: str, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path
) -> None:
    """Write the page that shows a run, with the lines of the table that is printed."""
    from slam_observer_ros.report.page import write_report  # which few replays need

    logged = {finding.text() for finding in outcome.findings}
    warnings = [warning for warning in outcome.warnings if warning not in logged]
    write_report(path, outcome.shown, title, summary, outcome.findings, warnings)


def _draw(args: argparse.Namespace, outcome: ReplayOutcome, directory: Path) -> None:
    from slam_observer_ros.evaluation.replay_plots import plot_residuals

    names = figure_files(args, FIGURES)
    with filled_directory(directory, names) as unfinished:
        of_map, of_errors, of_residuals = (unfinished / name for name in names)
        _draw_map(outcome, of_map)
        _draw_errors(outcome, of_errors)
        plot_residuals(
            of_residuals,
            outcome.shown.innovations,
            outcome.result.estimator.settings,
            outcome.dropped,
            outcome.events,
        )


def _draw_map(outcome: ReplayOutcome, path: Path) -> None:
    from slam_observer_ros.evaluation.map_plot import plot_map

    result, truth, smoothed = outcome.result, outcome.truth, outcome.smoothed
    has_errors = outcome.trajectory_errors is not None
    plot_map(
        path,
        outcome.trajectory,
        result.estimator.landmark_ids if smoothed is None else smoothed.ids,
        result.estimator.world_points if smoothed is None else smoothed.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if has_errors else None,
        truth.landmarks,
        covariances=None if smoothed is not None else _landmark_covariances(result),
        is_smoothed=smoothed is not None,
    )


def _landmark_covariances(result: Replay) -> FloatArray | None:
    """Return those of the landmarks (n, 3, 3) in a loaded map; otherwise of the map's shape."""
    estimator, update = result.estimator, result.estimator.last_update
    count = len(estimator.landmark_ids)
    if result.in_known_map:
        return estimator.landmark_covariances
    if update is None or not 0 < count <= MAX_ELLIPSES:
        return None
    joint = estimator.configuration_covariance(np.arange(count))
    if joint is None:
        return None
    seen = se3.transform(se3.inverse(update.pose), estimator.world_points)
    R = update.pose[:3, :3]
    covariances: FloatArray = R @ shape_covariances(seen, joint) @ R.T
    return covariances


def _draw_errors(outcome: ReplayOutcome, path: Path) -> None:
    """Draw the errors of what is written, unless the truth covers nothing of it."""
    from slam_observer_ros.evaluation.replay_plots import plot_errors

    result, errors = outcome.result, outcome.trajectory_errors
    if errors is None:
        return
    if outcome.smoothed is not None:
        plot_errors(path, errors, is_smoothed=True)
        return
    covariances, nees = result.pose_covariances, None
    is_anchored = not result.in_known_map
    if covariances is not None and (outcome.accuracy.anees is not None or not is_anchored):
        nees = nees_over_time(errors, covariances[errors.covered], is_anchored)
    plot_errors(
        path,
        errors,
        nees,
        result.configuration if result.configuration.values_m else None,
        is_anchored=is_anchored,
    )
