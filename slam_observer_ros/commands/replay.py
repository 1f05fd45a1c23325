"""``slam-observer replay``: a recording through the estimator."""

from __future__ import annotations

import argparse
from collections import Counter
import dataclasses
from dataclasses import dataclass
import logging
from pathlib import Path

from slam_observer_ros.commands.console import print_json, print_table, show_progress
from slam_observer_ros.commands.errors import UsageError
from slam_observer_ros.commands.options import add_settings_options, read_settings
from slam_observer_ros.commands.outputs import (
    add_force_option,
    check_outputs,
    check_plots,
    filled_directory,
)
from slam_observer_ros.estimates import Hindsight
from slam_observer_ros.evaluation.metrics import Report, TrajectoryErrors
from slam_observer_ros.evaluation.plots import plot_errors, plot_map, plot_residuals
from slam_observer_ros.evaluation.trajectory import Trajectory, write_tum
from slam_observer_ros.landmark_map import LandmarkMap
from slam_observer_ros.recording.map_file import read_map, write_map
from slam_observer_ros.recording.reader import (
    open_recording,
    Recording,
    TAG_FRAME_PREFIX,
    Truth,
)
from slam_observer_ros.recording.topics import SelectedTopics, TopicNames
from slam_observer_ros.replay import (
    Accuracy,
    measure,
    measure_hindsight,
    Replay,
    replay,
    trajectory_of,
)

logger = logging.getLogger(__name__)

MALFORMED = 'malformed'
"""Reason under which messages that can't be decoded are counted."""

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
    topics = parser.add_argument_group(
        'topics', 'found by their types; a name is needed only where two fit'
    )
    for option, what in (
        ('--velocity-topic', 'Twist, TwistStamped, TwistWithCovarianceStamped or Odometry'),
        ('--landmarks-topic', 'PointCloud or PointCloud2 with ids, or /tf with fiducials'),
        ('--pose-truth-topic', 'true pose'),
        ('--landmark-truth-topic', 'true landmarks'),
    ):
        topics.add_argument(option, metavar='TOPIC', help=what)
    topics.add_argument(
        '--base-frame',
        metavar='FRAME',
        help='frame whose pose is estimated; other sensors are placed in it by /tf_static '
        '(default: that of the velocities)',
    )
    topics.add_argument(
        '--tag-frame-prefix',
        metavar='PREFIX',
        default=TAG_FRAME_PREFIX,
        help="fiducials on /tf: a tag's frame before its id (default: %(default)s); family:id "
        'is known, too',
    )
    parser.add_argument(
        '--load-map',
        type=Path,
        metavar='FILE',
        help='known landmarks, as --map writes them: the estimate is then in their frame',
    )
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='estimate trajectory and map in hindsight, too: the outputs are of these then',
    )
    outputs = parser.add_argument_group('outputs')
    outputs.add_argument('--tum', type=Path, metavar='FILE', help='trajectory, as evo reads it')
    outputs.add_argument('--map', type=Path, metavar='FILE', help='landmarks, as YAML')
    outputs.add_argument('--plot', type=Path, metavar='DIR', help=f'draw {", ".join(FIGURES)}')
    outputs.add_argument('--json', action='store_true', help='print one JSON object')
    add_force_option(parser)
    add_settings_options(parser)
    parser.set_defaults(run=run)


@dataclass(frozen=True, slots=True)
class _Outcome:
    """A replay and all that is told about it; what is smoothed is None if it wasn't asked for."""

    result: Replay
    truth: Truth
    accuracy: Accuracy
    report: Report
    hindsight: Hindsight | None = None
    smoothed_errors: TrajectoryErrors | None = None
    smoothed_landmark_rmse_m: float | None = None


def run(args: argparse.Namespace) -> None:
    """Replay a recording, and write what was asked for."""
    settings = read_settings(args)
    if args.smooth and settings.gains != 'riccati':
        raise UsageError(f'--smooth needs riccati gains, not {settings.gains}')
    check_outputs([args.tum, args.map], args.force)
    check_plots(args.plot, FIGURES, args.force)
    landmark_map = None if args.load_map is None else read_map(args.load_map)
    names = TopicNames(
        args.velocity_topic, args.landmarks_topic, args.pose_truth_topic, args.landmark_truth_topic
    )
    with open_recording(args.recording) as recording:
        if recording.warning:
            logger.warning('%s', recording.warning)
        selected = recording.find_topics(names)
        base_frame = _base_frame(args, recording, selected)
        truth = recording.truth(selected)
        events = show_progress(
            recording.events(selected, base_frame, args.tag_frame_prefix),
            'replaying',
            recording.event_count(selected),
        )
        result = replay(events, settings, truth, landmark_map)
        outcome = _outcome(recording, selected, result, truth)
    if args.smooth:
        outcome = _smoothed(outcome)
    _write_files(args, outcome)
    if args.json:
        print_json(_as_json(outcome))
    else:
        _print_summary(args, selected, outcome)


def _base_frame(args: argparse.Namespace, recording: Recording, selected: SelectedTopics) -> str:
    """Return the base frame; warn of sensors whose place in it is unknown."""
    frames = recording.frames(selected, args.tag_frame_prefix)
    base_frame: str = args.base_frame or frames[0]
    for frame, what in zip(frames, ('velocities', 'landmarks'), strict=True):
        if not base_frame or frame in ('', base_frame) or recording.connects(base_frame, frame):
            continue
        logger.warning(
            'The %s are in frame %s, which /tf_static does not connect with %s; they are taken '
            'to be the same.',
            what,
            frame,
            base_frame,
        )
    return base_frame


def _outcome(
    recording: Recording, selected: SelectedTopics, result: Replay, truth: Truth
) -> _Outcome:
    accuracy = measure(result, truth)
    dropped = Counter(result.estimator.dropped)
    malformed = sum(
        recording.malformed[topic.name] for topic in (selected.velocity, selected.landmarks)
    )
    if malformed:
        dropped[MALFORMED] = malformed
    report = Report(
        events=result.events + malformed,
        duration_s=recording.duration_s,
        seconds=result.seconds,
        landmarks=len(result.estimator.landmark_ids),
        dropped=dict(dropped),
        landmark_rmse_m=accuracy.landmark_rmse_m,
        configuration_rmse_m=accuracy.configuration_rmse_m,
        anees=accuracy.anees,
    )
    if accuracy.pose_errors is not None:
        report = dataclasses.replace(
            report,
            ate_rmse_m=accuracy.pose_errors.ate_rmse_m,
            rotation_rmse_rad=accuracy.pose_errors.rotation_rmse_rad,
            heading_rmse_rad=accuracy.pose_errors.heading_rmse_rad,
        )
    return _Outcome(result, truth, accuracy, report)


def _smoothed(outcome: _Outcome) -> _Outcome:
    """Add what the whole recording tells in hindsight."""
    estimator = outcome.result.estimator
    hindsight = estimator.smooth()
    if len(hindsight.stamps_ns) < estimator.counts['observation']:
        logger.warning(
            'Only the last %d observations are smoothed; --set hindsight_window=0 for all.',
            len(hindsight.stamps_ns),
        )
    errors, landmark_rmse_m = measure_hindsight(hindsight, outcome.truth)
    return dataclasses.replace(
        outcome,
        hindsight=hindsight,
        smoothed_errors=errors,
        smoothed_landmark_rmse_m=landmark_rmse_m,
    )


def _write_files(args: argparse.Namespace, outcome: _Outcome) -> None:
    estimator, hindsight = outcome.result.estimator, outcome.hindsight
    landmark_map = estimator.landmark_map
    trajectory = outcome.result.trajectory
    if hindsight is not None:
        landmark_map = dataclasses.replace(landmark_map, world_points=hindsight.world_points)
        trajectory = trajectory_of(hindsight)
    if args.tum is not None:
        write_tum(trajectory, args.tum)
    if args.map is not None:
        write_map(args.map, landmark_map, estimator.settings)
    if args.plot is not None:
        with filled_directory(args.plot) as unfinished:
            _draw(outcome, trajectory, landmark_map, unfinished)


def _draw(
    outcome: _Outcome, trajectory: Trajectory, landmark_map: LandmarkMap, directory: Path
) -> None:
    result, truth = outcome.result, outcome.truth
    plot_map(
        directory / 'map.png',
        trajectory,
        landmark_map.ids,
        landmark_map.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if outcome.accuracy.pose_errors else None,
        truth.landmarks,
    )
    if outcome.smoothed_errors is not None:
        plot_errors(directory / 'errors.png', outcome.smoothed_errors)
    elif outcome.accuracy.pose_errors is not None:
        errors, covariances = outcome.accuracy.pose_errors, result.pose_covariances
        plot_errors(
            directory / 'errors.png',
            errors,
            None if covariances is None else covariances[errors.covered],
            result.configuration if result.configuration.values_m else None,
        )
    plot_residuals(
        directory / 'residuals.png',
        result.residual_stamps_ns,
        result.residuals,
        outcome.report.dropped,
        outcome.report.events,
    )


def _as_json(outcome: _Outcome) -> dict[str, object]:
    return dataclasses.asdict(outcome.report) | {
        'dead_reckoning_ate_rmse_m': _ate_rmse_m(outcome.accuracy.dead_reckoning_errors),
        'smoothed_ate_rmse_m': _ate_rmse_m(outcome.smoothed_errors),
        'smoothed_landmark_rmse_m': outcome.smoothed_landmark_rmse_m,
    }


def _ate_rmse_m(errors: TrajectoryErrors | None) -> float | None:
    return None if errors is None else errors.ate_rmse_m


def _print_summary(args: argparse.Namespace, selected: SelectedTopics, outcome: _Outcome) -> None:
    report = outcome.report
    rows = {
        'velocity topic': str(selected.velocity),
        'landmarks topic': str(selected.landmarks),
        'events': f'{report.events} over {report.duration_s:.1f} s',
        'estimator': f'{outcome.result.estimator.settings.gains} gains, '
        f'{report.seconds:.2f} s of CPU time',
        'landmarks': str(report.landmarks),
        'dropped': ', '.join(f'{n} {reason}' for reason, n in report.dropped.items()) or 'none',
    }
    rows |= _accuracy_rows(outcome)
    rows |= {
        name: str(path)
        for name, path in (('trajectory', args.tum), ('map', args.map), ('figures', args.plot))
        if path is not None
    }
    print_table(str(args.recording), rows)


def _accuracy_rows(outcome: _Outcome) -> dict[str, str]:
    report = outcome.report
    figures = {
        'position error (ATE), RMS': (report.ate_rmse_m, 'm after alignment'),
        'of the velocities alone': (
            _ate_rmse_m(outcome.accuracy.dead_reckoning_errors),
            'm after alignment',
        ),
        'heading error, RMS': (report.heading_rmse_rad, 'rad after alignment'),
        'landmark error, RMS': (report.landmark_rmse_m, 'm after alignment'),
        'configuration error, RMS': (report.configuration_rmse_m, 'm, not aligned'),
        'ANEES': (report.anees, '(1 is honest)'),
        'smoothed: position error, RMS': (
            _ate_rmse_m(outcome.smoothed_errors),
            'm after alignment',
        ),
        'smoothed: landmark error, RMS': (outcome.smoothed_landmark_rmse_m, 'm after alignment'),
    }
    rows = {
        name: f'{value:.3f} {unit}' for name, (value, unit) in figures.items() if value is not None
    }
    return rows or {'accuracy': 'not known: the recording holds no truth to compare with'}
