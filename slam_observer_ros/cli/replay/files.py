"""The files that a replay writes: trajectory, map and figures."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
import dataclasses
import logging
from pathlib import Path

from slam_observer_ros.cli.options import find_config
from slam_observer_ros.cli.outputs import (
    check_inputs_are_kept,
    check_outputs,
    check_plots,
    filled_directory,
)
from slam_observer_ros.cli.replay.outcome import ReplayOutcome
from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.evaluation.gaps import fill_gaps
from slam_observer_ros.evaluation.plots.map_plot import plot_map
from slam_observer_ros.evaluation.plots.replay_plots import plot_errors, plot_residuals
from slam_observer_ros.evaluation.trajectory import Trajectory, write_tum
from slam_observer_ros.known_map.map_file import write_map
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.report.page import write_report
from slam_observer_ros.report.reported_run import ReportedRun
from slam_observer_ros.runs.recorder import RunRecorder

logger = logging.getLogger(__name__)

FIGURES = ('map.png', 'errors.png', 'residuals.png')


def check_files(args: argparse.Namespace) -> None:
    """Refuse outputs that are in the way of what is there; --map may update the map loaded."""
    read = {f'the recording {args.recording}': files_of(args.recording)}
    if args.config is not None:
        read['the file of --config'] = [find_config(args.config)]
    loaded = {} if args.load_map is None else {'the file of --load-map': [args.load_map]}
    kept = {'--tum': args.tum, '--report': args.report, '--mcap': args.mcap}
    check_inputs_are_kept(kept, read | loaded)
    check_inputs_are_kept({'--map': args.map}, read)
    check_outputs([args.tum, args.map, args.report, args.mcap], args.force)
    check_plots(args.plot, FIGURES, args.force)


def write_files(
    args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str, summary: Mapping[str, str]
) -> tuple[dict[str, Path], list[str]]:
    """Write what was asked for; return what was written, and why something was not."""
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(outcome.trajectory, path)),
        ('map', args.map, lambda path: _write_map(outcome, map_frame, path)),
        ('report', args.report, lambda path: _write_report(args, outcome, summary, path)),
        ('figures', args.plot, lambda path: _draw_figures(outcome, path)),
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
        landmark_map = dataclasses.replace(landmark_map, world_points=smoothed.world_points)
    write_map(path, landmark_map, estimator.settings)


def _write_report(
    args: argparse.Namespace, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path
) -> None:
    recorder = outcome.recorder
    if not isinstance(recorder, RunRecorder):
        return
    estimator = outcome.result.estimator
    write_report(
        path,
        ReportedRun(
            title=args.recording.name,
            figures=summary,
            warnings=outcome.warnings,
            settings=estimator.settings,
            start_ns=outcome.result.start_ns,
            trajectory=outcome.result.trajectory,
            in_known_map=outcome.result.in_known_map,
            truth=outcome.truth,
            errors=outcome.accuracy.pose_errors,
            anees=outcome.accuracy.anees,
            instants=recorder.finish(estimator),
            innovations=recorder.innovations,
        ),
    )


def _draw_figures(outcome: ReplayOutcome, directory: Path) -> None:
    result = outcome.result
    with filled_directory(directory, FIGURES) as unfinished:
        _draw_map(outcome, unfinished / 'map.png')
        _draw_errors(outcome, unfinished / 'errors.png')
        plot_residuals(
            unfinished / 'residuals.png',
            result.residual_stamps_ns,
            result.residuals,
            result.rejected,
            outcome.dropped,
            outcome.events,
        )


def _draw_map(outcome: ReplayOutcome, path: Path) -> None:
    result, truth, smoothed = outcome.result, outcome.truth, outcome.smoothed
    trajectory = outcome.trajectory
    if smoothed is not None:
        trajectory = fill_gaps(trajectory, result.dead_reckoning)
    has_errors = outcome.trajectory_errors is not None
    plot_map(
        path,
        trajectory,
        result.estimator.landmark_ids if smoothed is None else smoothed.ids,
        result.estimator.world_points if smoothed is None else smoothed.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if has_errors else None,
        truth.landmarks,
        is_smoothed=smoothed is not None,
    )


def _draw_errors(outcome: ReplayOutcome, path: Path) -> None:
    """Draw the errors of what is written, unless the truth covers nothing of it."""
    result, errors = outcome.result, outcome.trajectory_errors
    if errors is None:
        return
    if outcome.smoothed is not None:
        plot_errors(path, errors, is_smoothed=True)
        return
    covariances = result.pose_covariances
    plot_errors(
        path,
        errors,
        None if covariances is None else covariances[errors.covered],
        result.configuration if result.configuration.values_m else None,
        in_known_map=result.in_known_map,
    )
