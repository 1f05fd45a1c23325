"""What came of a run as rows of a table, and as ``--json`` prints it."""

from __future__ import annotations

from dataclasses import asdict
import math
from pathlib import Path

from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import significant
from slam_observer_ros.estimates import point_share, Reason, used_points
from slam_observer_ros.runs.metrics import TrajectoryErrors
from slam_observer_ros.runs.result import list_dropped, Result
from slam_observer_ros.settings.parameter_table import changed_names

ACCURACY_ROWS = {
    'ate_rmse_m': ('position error (ATE), RMS', 'm after alignment'),
    'dead_reckoning_ate_rmse_m': ('of the velocities alone', 'm after alignment'),
    'unaligned_rmse_m': ('position error, not aligned', "m if the truth is in the map's frame"),
    'heading_rmse_rad': ('heading error, RMS', '° after alignment'),
    'landmark_rmse_m': ('landmark error, RMS', 'm after alignment'),
    'configuration_rmse_m': ('configuration error, RMS', 'm, not aligned'),
    'anees': ('ANEES of the pose', '(1 is consistent)'),
    'configuration_anees': ('ANEES of the configuration', '(1 is consistent)'),
    'unsmoothed_ate_rmse_m': ('of the part that is smoothed, online', 'm after alignment'),
    'smoothed_ate_rmse_m': ('smoothed: position error, RMS', 'm after alignment'),
    'smoothed_landmark_rmse_m': ('smoothed: landmark error, RMS', 'm after alignment'),
}
"""Figures of ``--json`` that are in the table, their names there and their units."""

FIGURES = (*ACCURACY_ROWS, 'nis', 'seconds')  # what runs are compared by
NEARLY_ALL = 0.99  # share of the trajectory that the truth covers, up to which it is printed

LANDMARK_CHANGES = ('moved', 'forgotten', 'unsupported', 'doubled')
"""What may happen to landmarks of the map; counted under these names."""


def identity(recording: Path, sha256: str, result: Result) -> dict[str, object]:
    """Return what was replayed, by what, as ``--json`` has it first."""
    settings = result.settings
    return {
        'recording': str(recording),
        'recording_sha256': sha256,
        'version': __version__,
        'settings': {name: getattr(settings, name) for name in changed_names(settings)},
        'warnings': [str(one) for one in result.logged],
    }


def as_json(result: Result) -> dict[str, object]:
    """Return the figures as ``--json`` prints them; null is what was not measured."""
    run, selected, configuration = result.run, result.selected, result.run.configuration
    estimator, errors, after = run.estimator, result.errors, result.smoothed
    return {
        'velocity_topic': selected.velocity.name,
        'landmarks_topic': selected.landmarks.name,
        'imu_topic': None if selected.imu is None else selected.imu.name,
        'gains': estimator.settings.gains,
        'events': result.events,
        'duration_s': result.duration_s,
        'seconds': run.seconds,
        'landmarks': len(estimator.landmark_ids),
        'dropped': result.dropped,
        'lost': result.lost,
        'findings': [finding.as_json() for finding in result.findings],
        'used': dict(estimator.counts),
        'calibration': {part.name: asdict(part) for part in estimator.calibration},
        'motion_factors': {part.name: asdict(part) for part in estimator.motion_factors},
        'map': estimator.map_name or None,
        'localised_after_s': result.localised_after_s,
        'truth_covered': None if errors is None else errors.covered_share,
        'ate_rmse_m': _ate_rmse_m(errors),
        'unaligned_rmse_m': errors.unaligned_rmse_m if errors and run.in_known_map else None,
        'rotation_rmse_rad': None if errors is None else errors.rotation_rmse_rad,
        'heading_rmse_rad': None if errors is None else errors.heading_rmse_rad,
        'landmark_rmse_m': result.landmark_rmse_m,
        'configuration_rmse_m': configuration.rmse_m,
        'anees': result.anees,
        'configuration_anees': configuration.anees,
        'nis': result.nis,
        'dead_reckoning_ate_rmse_m': _ate_rmse_m(result.dead_reckoning_errors),
        'unsmoothed_ate_rmse_m': None if after is None else _ate_rmse_m(after.online_errors),
        'smoothed_ate_rmse_m': None if after is None else _ate_rmse_m(after.pose_errors),
        'smoothed_landmark_rmse_m': None if after is None else after.landmark_rmse_m,
        'smoothed_slips': None if after is None else after.estimate.slips,
    }


def _ate_rmse_m(errors: TrajectoryErrors | None) -> float | None:
    return None if errors is None else errors.ate_rmse_m


def summary_rows(result: Result) -> dict[str, str]:
    """Return the figures as text, by their names."""
    run, selected = result.run, result.selected
    estimator, counts, map_name = run.estimator, run.estimator.counts, run.estimator.map_name
    changed = {change: counts[f'{change}_landmark'] for change in LANDMARK_CHANGES}
    changes = [f', {count} {change}' for change, count in changed.items() if count]
    unused = [
        f', {counts[reason.value]} {reason.words} '
        f'({100.0 * point_share(counts, reason.value):.1f} %)'
        for reason in Reason
        if counts[reason.value]
    ]
    note = f', {result.missing_ids}' if result.missing_ids else ''
    rows = {'used': result.unused_input} if result.unused_input else {}
    rows |= {
        'velocity topic': str(selected.velocity),
        'landmarks topic': f'{selected.landmarks}{note}',
        **({} if selected.imu is None else {'Imu topic': str(selected.imu)}),
        'events': f'{result.events} over {result.duration_s:.1f} s',
        'estimator': f'{estimator.settings.gains} gains, {run.seconds:.2f} s of CPU time',
        'landmarks': f'{len(estimator.landmark_ids)}{"".join(changes)}',
        'observed points': f'{used_points(counts)} used{"".join(unused)}',
        'dropped': list_dropped(result.dropped),
    }
    malformed = result.lost['malformed']
    lost = [str(result.loss)] if result.loss else []
    if lost := lost + ([f'{malformed} malformed messages'] if malformed else []):
        rows['lost'] = ', '.join(lost)
    if slips := counts['slip']:
        rows['slips'] = f'{slips} × the robot was not where odometry had it'
        if result.smoothed is not None:
            rows['slips'] += f'; all that was seen confirms {result.smoothed.estimate.slips}'
    if unexpected := counts['unexpected_place']:
        rows['unexpected places'] = f'{unexpected} × nothing seen was where the map has it'
    if (after_s := result.localised_after_s) is not None:
        name = f' in {map_name}' if map_name else ''
        found = f'found after {after_s:.1f} s{name}, where the trajectory begins'
        if estimator.settings.set_initial_pose and after_s == 0.0:
            found = f'given at the start{name}'
        lost_again = f'; lost {counts["lost"]} × and searched again' if counts['lost'] else ''
        rows['pose in the map'] = found + lost_again
    rows |= {part.name: str(part) for part in estimator.calibration}
    rows |= {f'noise of {part.name}': str(part) for part in estimator.motion_factors}
    # Accuracy
    figures, accuracy = as_json(result), {}
    if figures['unsmoothed_ate_rmse_m'] == figures['ate_rmse_m']:  # all of it is smoothed
        figures['unsmoothed_ate_rmse_m'] = None
    share = figures['truth_covered']
    if isinstance(share, float) and share <= NEARLY_ALL:
        accuracy['truth'] = f'covers {100.0 * share:.1f} % of the trajectory'
    for key, (name, unit) in ACCURACY_ROWS.items():
        figure = figures[key]
        if isinstance(figure, float):
            number = math.degrees(figure) if key.endswith('_rad') else figure
            accuracy[name] = f'{significant(number)} {unit}'
    has_truth = len(result.truth.stamps_ns) > 0 or result.truth.landmarks is not None
    why = 'the truth fits nothing estimated'
    why = why if has_truth else 'the recording holds no truth to compare with'
    return rows | (accuracy or {'accuracy': f'not known: {why}'})
