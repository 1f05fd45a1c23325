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
    figure_files,
    filled_directory,
)
from slam_observer_ros.cli.replay.outcome import ReplayOutcome
from slam_observer_ros.cli.replay.rerun import check_rerun, VIEWER
from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.evaluation.trajectory import write_tum
from slam_observer_ros.known_map.map_file import map_files, write_map
from slam_observer_ros.recording.opening import files_of

logger = logging.getLogger(__name__)

FIGURES = ('map', 'errors', 'residuals')


def check_files(args: argparse.Namespace) -> None:
    """Refuse outputs that are in the way of what is there; --map may update the map loaded."""
    read = {f'the recording {args.recording}': files_of(args.recording)}
    if args.config is not None:
        read['the file of --config'] = [find_config(args.config)]
    loaded = {} if args.load_map is None else {'the file of --load-map': map_files(args.load_map)}
    files = {
        '--tum': args.tum,
        '--report': args.report,
        '--mcap': args.mcap,
        '--rerun': args.rerun or None,
    }
    figures = () if args.plot is None else figure_files(args, FIGURES)
    drawn = {f'{name} of --plot,': args.plot / name for name in figures}
    check_inputs_are_kept(files | drawn, read | loaded)
    check_inputs_are_kept({'--map': args.map}, read)
    outputs = [args.map, *files.values()]
    check_outputs(outputs, args.force)
    check_rerun(args)
    check_plots(args, FIGURES, outputs)


def write_files(
    args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str, summary: Mapping[str, str]
) -> tuple[dict[str, Path], list[str]]:
    """Write what was asked for; return what was written, and why something was not."""
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(outcome.trajectory, path)),
        ('map', args.map, lambda path: _write_map(outcome, map_frame, path)),
        ('report', args.report, lambda path: _write_report(args, outcome, summary, path)),
        ('Rerun file', args.rerun or None, lambda path: _show_in_rerun(args, outcome, summary)),
        ('figures', args.plot, lambda path: _draw_figures(args, outcome, path)),
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
    if args.rerun is VIEWER:
        _show_in_rerun(args, outcome, summary)
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


def _write_report(
    args: argparse.Namespace, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path
) -> None:
    from slam_observer_ros.cli.replay.drawn import write_report_of  # which takes a while to import

    write_report_of(args.recording.name, outcome, summary, path)


def _show_in_rerun(
    args: argparse.Namespace, outcome: ReplayOutcome, summary: Mapping[str, str]
) -> None:
    from slam_observer_ros.cli.replay.drawn import show_run_in_rerun

    path = None if args.rerun is VIEWER else args.rerun
    show_run_in_rerun(args.recording.name, outcome, summary, path)


def _draw_figures(args: argparse.Namespace, outcome: ReplayOutcome, directory: Path) -> None:
    from slam_observer_ros.cli.replay.drawn import draw_figures

    with filled_directory(directory, figure_files(args, FIGURES)) as unfinished:
        draw_figures(outcome, unfinished, args.plot_format)
