"""``slam-observer replay``: a recording through the estimator, and what is printed of it."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
import math
from pathlib import Path

from slam_observer_ros.cli.console import kept_warnings, print_columns, print_json, print_table
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
from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import LossError, OutputError, UsageError
from slam_observer_ros.estimates import point_share, Reason, used_points
from slam_observer_ros.estimator.event_warnings import listed
from slam_observer_ros.recordings.opening import sha256_of
from slam_observer_ros.runs.accuracy import ACCURACY_ROWS, figure_text
from slam_observer_ros.runs.input_health import list_dropped
from slam_observer_ros.runs.metrics import TrajectoryErrors
from slam_observer_ros.runs.reported_run import Replay, Sighting
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import changed_names


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
    life = [] if args.explain is None else outcome.shown.life(args.explain)
    written, errors = write_files(args, outcome, map_frame, rows)
    if args.json:
        sha256 = sha256_of(args.recording)
        figures = identity(args.recording, sha256, outcome) | as_json(outcome)
        if args.explain is not None:
            figures['landmark'] = {'id': args.explain, 'life': [asdict(line) for line in life]}
        print_json(figures)
    else:
        rows |= {name: str(path) for name, path in written.items()}
        print_table(str(args.recording), rows)
        if life:
            _print_life(args.explain, life)
    if errors:
        raise OutputError('; '.join(errors))
    if args.explain is not None and not life:
        seen = listed(outcome.shown.seen_ids)
        raise UsageError(f'--explain: no point had the id {args.explain}; there are {seen}')
    if args.strict and any(outcome.lost.values()):
        raise LossError(f'{args.recording}: a part of it was lost, which --strict does not allow')
    if args.strict and outcome.unused_input:
        raise LossError(f'{args.recording}: --strict does not allow this: {outcome.unused_input}')


def _print_life(landmark_id: int, life: Sequence[Sighting]) -> None:
    """Print what came of each observation of a landmark, and of the landmark itself."""
    lines = []
    for each in life:
        has_residual = not math.isnan(each.sigmas)
        residual = (f'{each.sigmas:.2f}', f'{each.residual_m:.3f}') if has_residual else ('–', '–')
        lines.append((f'{each.seconds:9.3f}  {each.what}', *residual))
    print_columns(f'landmark {landmark_id}', ('time, s', 'residual, σ', 'm'), lines)


NEARLY_ALL = 0.99
"""Share of the trajectory that the truth covers, up to which it is printed."""

LANDMARK_CHANGES = ('moved', 'forgotten', 'unsupported', 'doubled')
"""What may happen to landmarks of the map; counted under these names."""


def identity(recording: Path, sha256: str, outcome: ReplayOutcome) -> dict[str, object]:
    """Return what was replayed, by what, as ``--json`` has it first."""
    settings = outcome.result.estimator.settings
    return {
        'recording': str(recording),
        'recording_sha256': sha256,
        'version': __version__,
        'settings': {name: getattr(settings, name) for name in changed_names(settings)},
        'warnings': list(outcome.warnings),
    }


def as_json(outcome: ReplayOutcome) -> dict[str, object]:
    """Return the figures as ``--json`` prints them; null is what was not measured."""
    estimator, accuracy = outcome.result.estimator, outcome.accuracy
    errors, after = accuracy.pose_errors, outcome.smoothed_accuracy
    selected = outcome.selected
    return {
        'velocity_topic': selected.velocity.name,
        'landmarks_topic': selected.landmarks.name,
        'imu_topic': None if selected.imu is None else selected.imu.name,
        'gains': estimator.settings.gains,
        'events': outcome.events,
        'duration_s': outcome.duration_s,
        'seconds': outcome.result.seconds,
        'landmarks': len(estimator.landmark_ids),
        'dropped': outcome.dropped,
        'lost': outcome.lost,
        'findings': [finding.as_json() for finding in outcome.findings],
        'used': dict(estimator.counts),
        'calibration': {part.name: asdict(part) for part in estimator.calibration},
        'motion_factors': {part.name: asdict(part) for part in estimator.motion_factors},
        'map': estimator.map_name or None,
        'localised_after_s': outcome.localised_after_s,
        'truth_covered': outcome.truth_covered,
        'ate_rmse_m': _ate_rmse_m(errors),
        'unaligned_rmse_m': outcome.unaligned_rmse_m,
        'rotation_rmse_rad': None if errors is None else errors.rotation_rmse_rad,
        'heading_rmse_rad': None if errors is None else errors.heading_rmse_rad,
        'landmark_rmse_m': accuracy.landmark_rmse_m,
        'configuration_rmse_m': accuracy.configuration_rmse_m,
        'anees': accuracy.anees,
        'configuration_anees': accuracy.configuration_anees,
        'nis': None if outcome.recorder is None else outcome.recorder.mean_nis,
        'dead_reckoning_ate_rmse_m': _ate_rmse_m(accuracy.dead_reckoning_errors),
        'unsmoothed_ate_rmse_m': None if after is None else _ate_rmse_m(after.online_errors),
        'smoothed_ate_rmse_m': None if after is None else _ate_rmse_m(after.pose_errors),
        'smoothed_landmark_rmse_m': None if after is None else after.landmark_rmse_m,
        'smoothed_slips': None if outcome.smoothed is None else outcome.smoothed.slips,
    }


def _ate_rmse_m(errors: TrajectoryErrors | None) -> float | None:
    return None if errors is None else errors.ate_rmse_m


def summary_rows(outcome: ReplayOutcome) -> dict[str, str]:
    """Return the figures as text, by their names."""
    selected = outcome.selected
    estimator = outcome.result.estimator
    note = f', {outcome.missing_ids}' if outcome.missing_ids else ''
    rows = {'used': outcome.unused_input} if outcome.unused_input else {}
    rows |= {
        'velocity topic': str(selected.velocity),
        'landmarks topic': f'{selected.landmarks}{note}',
        **({} if selected.imu is None else {'Imu topic': str(selected.imu)}),
        'events': f'{outcome.events} over {outcome.duration_s:.1f} s',
        'estimator': f'{estimator.settings.gains} gains, '
        f'{outcome.result.seconds:.2f} s of CPU time',
        'landmarks': _landmarks_text(len(estimator.landmark_ids), estimator.counts),
        'observed points': _points_text(estimator.counts),
        'dropped': list_dropped(outcome.dropped),
    }
    if outcome.loss or outcome.lost['malformed']:
        rows['lost'] = _loss_text(outcome)
    if slips := estimator.counts['slip']:
        rows['slips'] = f'{slips} × the robot was not where odometry had it'
        if outcome.smoothed is not None:
            rows['slips'] += f'; all that was seen confirms {outcome.smoothed.slips}'
    if unexpected := estimator.counts['unexpected_place']:
        rows['unexpected places'] = f'{unexpected} × nothing seen was where the map has it'
    if outcome.localised_after_s is not None:
        rows['pose in the map'] = _localisation_text(outcome.result, outcome.localised_after_s)
    rows |= {part.name: str(part) for part in estimator.calibration}
    rows |= {f'noise of {part.name}': str(part) for part in estimator.motion_factors}
    return rows | _accuracy_rows(outcome)


def _loss_text(outcome: ReplayOutcome) -> str:
    parts = []
    if outcome.loss:
        parts.append(str(outcome.loss))
    if malformed := outcome.lost['malformed']:
        parts.append(f'{malformed} malformed messages')
    return ', '.join(parts)


def _localisation_text(result: Replay, localised_after_s: float) -> str:
    name = f' in {result.estimator.map_name}' if result.estimator.map_name else ''
    found = f'found after {localised_after_s:.1f} s{name}, where the trajectory begins'
    if result.estimator.settings.set_initial_pose and localised_after_s == 0.0:
        found = f'given at the start{name}'
    lost = result.estimator.counts['lost']
    return f'{found}; lost {lost} × and searched again' if lost else found


def _landmarks_text(landmarks: int, counts: Counter[str]) -> str:
    changed = {change: counts[f'{change}_landmark'] for change in LANDMARK_CHANGES}
    changes = [f'{count} {change}' for change, count in changed.items() if count]
    return ', '.join([str(landmarks), *changes])


def _points_text(counts: Counter[str]) -> str:
    """Say how many points were used, and why the others were not."""
    parts = [f'{used_points(counts)} used']
    parts += [
        f'{counts[reason.value]} {reason.words} '
        f'({100.0 * point_share(counts, reason.value):.1f} %)'
        for reason in Reason
        if counts[reason.value]
    ]
    return ', '.join(parts)


def _covered_rows(outcome: ReplayOutcome) -> dict[str, str]:
    """Say of how much of the trajectory the figures are, if not of nearly all."""
    share = outcome.truth_covered
    if share is None or share > NEARLY_ALL:
        return {}
    return {'truth': f'covers {100.0 * share:.1f} % of the trajectory'}


def _accuracy_rows(outcome: ReplayOutcome) -> dict[str, str]:
    figures = as_json(outcome)
    if figures['unsmoothed_ate_rmse_m'] == figures['ate_rmse_m']:  # all of it is smoothed
        figures['unsmoothed_ate_rmse_m'] = None
    rows = _covered_rows(outcome) | {
        name: figure_text(key, figure, unit)
        for key, (name, unit) in ACCURACY_ROWS.items()
        if isinstance(figure := figures[key], float)
    }
    if rows:
        return rows
    has_truth = len(outcome.truth.stamps_ns) > 0 or outcome.truth.landmarks is not None
    why = 'the truth fits nothing estimated'
    if not has_truth:
        why = 'the recording holds no truth to compare with'
    return {'accuracy': f'not known: {why}'}
