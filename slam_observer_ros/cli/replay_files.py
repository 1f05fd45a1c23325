"""The files that a replay writes."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
import dataclasses
import logging
from pathlib import Path

from slam_observer_ros.cli.options import named_path
from slam_observer_ros.cli.outputs import check_inputs_are_kept, check_outputs, recording_path
from slam_observer_ros.cli.replay_outcome import ReplayOutcome
from slam_observer_ros.cli.replay_request import Records
from slam_observer_ros.common.errors import SlamObserverError, UsageError
from slam_observer_ros.mapping.map_file import map_files, write_map
from slam_observer_ros.recordings.opening import files_of
from slam_observer_ros.recordings.trajectory import write_tum

logger = logging.getLogger(__name__)


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
        help='one page for any browser, without a network: map, errors, residuals, consistency '
        'and calibration over time, whose figures it saves as PNG or SVG',
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
    outputs.add_argument(
        '--explain',
        type=int,
        metavar='ID',
        help='print the life of a landmark, too: when it was new, the residual of each '
        'observation, and why points of it were not used',
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')


def records_of(args: argparse.Namespace) -> Records:
    """Return what is to be kept of a run for the files that are asked for."""
    return Records(
        poses=args.tum is not None,
        nis=args.json,
        whole_run=args.report is not None or args.explain is not None,
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
    check_inputs_are_kept(files, read | loaded)
    check_inputs_are_kept({'--map': args.map}, read)
    check_outputs([args.map, *files.values()], args.force)


def write_files(
    args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str, summary: Mapping[str, str]
) -> tuple[dict[str, Path], list[str]]:
    """Write what was asked for; return what was written, and why something was not."""
    title = args.recording.name
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(outcome.trajectory, path)),
        ('map', args.map, lambda path: _write_map(outcome, map_frame, path)),
        ('report', args.report, lambda path: write_report_of(title, outcome, summary, path)),
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
