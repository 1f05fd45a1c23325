"""``slam-observer replay``: a recording through the estimator."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import dataclasses
import logging
from pathlib import Path

from slam_observer_ros.cli.console import print_json, show_progress
from slam_observer_ros.cli.options import add_settings_options, find_config, read_settings
from slam_observer_ros.cli.outputs import (
    add_force_option,
    check_inputs_stay,
    check_outputs,
    check_plots,
    figures_path,
    filled_directory,
)
from slam_observer_ros.cli.replay.replay_checks import (
    check_place,
    check_used,
    tell_restart,
    warn_of_input,
)
from slam_observer_ros.cli.replay.replay_inputs import (
    add_input_options,
    check_frames,
    INPUT_NAMES,
    INSTEAD,
    read_inputs,
    topic_names,
    warn_of_unused,
    with_base_frame,
)
from slam_observer_ros.cli.replay.replay_outcome import outcome_of, ReplayOutcome, with_smoothed
from slam_observer_ros.cli.replay.replay_report import as_json, print_summary
from slam_observer_ros.cli.replay.timing_checks import warn_of_timing
from slam_observer_ros.common.errors import OutputError, SlamObserverError, UsageError
from slam_observer_ros.evaluation.gaps import fill_gaps
from slam_observer_ros.evaluation.plots.map_plot import plot_map
from slam_observer_ros.evaluation.plots.replay_plots import plot_errors, plot_residuals
from slam_observer_ros.evaluation.trajectory import Trajectory, write_tum
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_file import read_map, write_map
from slam_observer_ros.recording.opening import files_of
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.runs.accuracy import trajectory_of
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings

logger = logging.getLogger(__name__)

FIGURES = ('map.png', 'errors.png', 'residuals.png')


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the command line."""
    parser = commands.add_parser(
        'replay',
        help='run a recording through the observer',
        description='Run a recording through the observer, as the node would have, and compare '
        'the outcome with the truth if the recording holds it.',
    )
    parser.add_argument(
        'recording',
        type=Path,
        metavar='RECORDING',
        help='.mcap, .db3 or ROS 1 .bag file, or rosbag2 directory',
    )
    add_input_options(parser)
    parser.add_argument(
        '--load-map',
        type=Path,
        metavar='FILE',
        help='known landmarks, as --map writes them: the estimate is then in their frame, and has '
        'no ANEES of the pose (nor of the configuration, if they are fixed)',
    )
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='estimate trajectory and map in hindsight, too; --tum and --map then write these',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument(
        '--tum',
        type=Path,
        metavar='FILE',
        help='trajectory, as evo reads it, at most 20 poses a second',
    )
    outputs.add_argument('--map', type=Path, metavar='FILE', help='landmarks, as YAML')
    outputs.add_argument(
        '--plot', type=figures_path, metavar='DIR', help=f'draw {", ".join(FIGURES)}'
    )
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    add_force_option(parser)
    add_settings_options(parser, InputSettings)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Replay a recording, and write what was asked for."""
    defaults = {'hindsight_window': 0} if args.smooth else {}
    settings = read_settings(args, INPUT_NAMES, INSTEAD, **defaults)
    inputs = read_inputs(args)
    if args.smooth and settings.gains != 'riccati':
        raise UsageError(f'--smooth needs riccati gains, not {settings.gains}')
    _check_files(args)
    warn_of_unused(args, settings)
    landmark_map = None if args.load_map is None else read_map(args.load_map)
    outcome = _replay(args, settings, inputs, landmark_map)
    _give_out(args, outcome, _frame_of_outputs(inputs, landmark_map))


def _replay(
    args: argparse.Namespace,
    settings: Settings,
    inputs: InputSettings,
    landmark_map: LandmarkMap | None,
) -> ReplayOutcome:
    """Replay a recording; tell what may be wrong with it, or with what is asked of it."""
    with Recording(args.recording) as recording:
        if recording.warning:
            logger.warning('%s', recording.warning)
        selected = recording.find_topics(topic_names(args), inputs)
        inputs = with_base_frame(inputs, recording, selected)
        check_frames(inputs)
        truth = recording.truth(selected, inputs.base_frame)
        truth = truth.flattened() if settings.two_d_mode else truth
        events = show_progress(
            recording.events(selected, inputs, settings.velocity_timeout),
            'replaying',
            recording.event_count(selected),
        )
        result = replay(events, settings, truth, landmark_map)
        tell_restart(result)
        check_used(args, recording, selected, inputs, result)
        if landmark_map is not None:
            check_place(args, result, landmark_map)
        outcome = outcome_of(recording, selected, result, truth)
        warn_of_input(recording, selected, result)
        warn_of_timing(recording, selected, settings.velocity_timeout)
    return with_smoothed(outcome) if args.smooth else outcome


def _frame_of_outputs(inputs: InputSettings, landmark_map: LandmarkMap | None) -> str:
    """Return the frame of what is written: that of the map that was loaded, if one was."""
    if landmark_map is None or landmark_map.frame_id == inputs.map_frame:
        return inputs.map_frame
    logger.warning(
        "The map is in frame '%s', and so is what is written; the node takes it with "
        'map_frame: %s only.',
        landmark_map.frame_id,
        landmark_map.frame_id,
    )
    return landmark_map.frame_id


def _check_files(args: argparse.Namespace) -> None:
    """Refuse outputs that are in the way of what is there; --map may update the map loaded."""
    read = {f'the recording {args.recording}': files_of(args.recording)}
    if args.config is not None:
        read['the file of --config'] = [find_config(args.config)]
    loaded = {} if args.load_map is None else {'the file of --load-map': [args.load_map]}
    check_inputs_stay({'--tum': args.tum}, read | loaded)
    check_inputs_stay({'--map': args.map}, read)
    check_outputs([args.tum, args.map], args.force)
    check_plots(args.plot, FIGURES, args.force)


def _give_out(args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str) -> None:
    """Write and print all that can be, and only then say what could not be written."""
    written, errors = _write_files(args, outcome, map_frame)
    if args.json:
        print_json(as_json(outcome))
    else:
        print_summary(args.recording, outcome, written)
    if errors:
        raise OutputError('; '.join(errors))


def _write_files(
    args: argparse.Namespace, outcome: ReplayOutcome, map_frame: str
) -> tuple[dict[str, Path], list[str]]:
    """Write what was asked for; return what was written, and why something was not."""
    smoothed = outcome.smoothed
    trajectory = outcome.result.trajectory if smoothed is None else trajectory_of(smoothed)
    outputs: tuple[tuple[str, Path | None, Callable[[Path], object]], ...] = (
        ('trajectory', args.tum, lambda path: write_tum(trajectory, path)),
        ('map', args.map, lambda path: _write_map(outcome, map_frame, path)),
        ('figures', args.plot, lambda path: _draw(outcome, trajectory, path)),
    )
    written: dict[str, Path] = {}
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
        # The covariances stay: what the filter knows of the map in the end is hindsight, too.
        landmark_map = dataclasses.replace(landmark_map, world_points=smoothed.world_points)
    write_map(path, landmark_map, estimator.settings)


def _draw(outcome: ReplayOutcome, trajectory: Trajectory, directory: Path) -> None:
    with filled_directory(directory, FIGURES) as unfinished:
        _draw_figures(outcome, trajectory, unfinished)


def _draw_figures(outcome: ReplayOutcome, trajectory: Trajectory, directory: Path) -> None:
    result, truth, estimator = outcome.result, outcome.truth, outcome.result.estimator
    smoothed = outcome.smoothed
    errors = outcome.accuracy.pose_errors if smoothed is None else outcome.smoothed_errors
    plot_map(
        directory / 'map.png',
        trajectory if smoothed is None else fill_gaps(trajectory, result.dead_reckoning),
        estimator.landmark_ids if smoothed is None else smoothed.ids,
        estimator.world_points if smoothed is None else smoothed.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if errors is not None else None,
        truth.landmarks,
        in_hindsight=smoothed is not None,
    )
    if outcome.smoothed_errors is not None:
        plot_errors(directory / 'errors.png', outcome.smoothed_errors, in_hindsight=True)
    elif errors is not None:
        covariances = result.pose_covariances
        plot_errors(
            directory / 'errors.png',
            errors,
            None if covariances is None else covariances[errors.covered],
            result.configuration if result.configuration.values_m else None,
            in_known_map=result.in_known_map,
        )
    plot_residuals(
        directory / 'residuals.png',
        result.residual_stamps_ns,
        result.residuals,
        result.rejected,
        outcome.dropped,
        outcome.events,
    )
