"""What ``slam-observer replay`` tells of its outcome."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
import logging
from pathlib import Path

from slam_observer_ros.accuracy import Accuracy, measure, measure_smoothed
from slam_observer_ros.commands.console import print_table
from slam_observer_ros.commands.errors import UsageError
from slam_observer_ros.commands.replay_checks import list_dropped
from slam_observer_ros.estimates import (
    MOST_REJECTED,
    point_share,
    Smoothed,
    UNUSED_POINTS,
    used_points,
)
from slam_observer_ros.evaluation.metrics import TrajectoryErrors
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.recording.truth import Truth
from slam_observer_ros.replay import Replay

MALFORMED = 'malformed'
"""Reason under which messages that can't be decoded are counted."""

MOST_UNMAPPED = 0.5
"""Share of the points beyond which they are more than what a map lacks."""

NEARLY_ALL = 0.99
"""Share of the trajectory that the truth covers, up to which it is told."""

LANDMARK_FATES = ('moved', 'forgotten', 'unsupported')
"""What befalls landmarks that are in the map."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Report:
    """What a run did and how accurate it was; None is what was not measured.

    Attributes
    ----------
    events : int
        Events taken in, dropped ones included.
    duration_s : float
        Time that the recording spans, seconds.
    seconds : float
        CPU time that the estimator took, see :class:`.Replay`.
    landmarks : int
        Landmarks in the final map.
    dropped : dict of str to int
        Events dropped, by reason.
    ate_rmse_m, rotation_rmse_rad, heading_rmse_rad : float or None
        See :class:`.TrajectoryErrors`; None without truth.
    landmark_rmse_m : float or None
        See :class:`.LandmarkErrors`; None without truth.
    configuration_rmse_m : float or None
        See :class:`.ConfigurationError`; None without truth.
    anees : float or None
        Of the pose, per degree of freedom; None without truth or covariance.
    localised_after_s : float or None
        Time until the place in a loaded map was found, from when on the trajectory has poses,
        seconds; None without such a map.
    unaligned_rmse_m : float or None
        See :class:`.TrajectoryErrors`; None without truth or such a map.

    """

    events: int
    duration_s: float
    seconds: float
    landmarks: int
    dropped: dict[str, int]
    ate_rmse_m: float | None = None
    rotation_rmse_rad: float | None = None
    heading_rmse_rad: float | None = None
    landmark_rmse_m: float | None = None
    configuration_rmse_m: float | None = None
    anees: float | None = None
    localised_after_s: float | None = None
    unaligned_rmse_m: float | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """A replay and all that is told about it; what is smoothed is None if it wasn't asked for.

    ``missing_ids`` is what :meth:`.Recording.missing_ids` says of the landmarks.
    """

    result: Replay
    truth: Truth
    accuracy: Accuracy
    report: Report
    missing_ids: str = ''
    smoothed: Smoothed | None = None
    smoothed_errors: TrajectoryErrors | None = None
    smoothed_landmark_rmse_m: float | None = None


def unused_messages(recording: Recording, selected: SelectedTopics) -> Counter[str]:
    """Count the messages that did not become events, by reason."""
    malformed = sum(recording.malformed[topic.name] for topic in selected.inputs)
    return recording.dropped + Counter({MALFORMED: malformed})


def outcome_of(
    recording: Recording,
    selected: SelectedTopics,
    result: Replay,
    truth: Truth,
    unused: Counter[str],
) -> Outcome:
    """Measure a replay; ``unused`` is what :func:`unused_messages` has counted."""
    accuracy = measure(result, truth)
    report = Report(
        events=result.events + unused.total(),
        duration_s=recording.duration_s,
        seconds=result.seconds,
        landmarks=len(result.estimator.landmark_ids),
        dropped=dict(result.estimator.dropped + unused),
        landmark_rmse_m=accuracy.landmark_rmse_m,
        configuration_rmse_m=accuracy.configuration_rmse_m,
        anees=accuracy.anees,
    )
    if result.in_known_map and len(result.trajectory):
        localised_after_s = result.seconds_until(result.trajectory.stamps_ns[0])
        report = replace(report, localised_after_s=localised_after_s)
    if accuracy.pose_errors is not None:
        report = replace(
            report,
            ate_rmse_m=accuracy.pose_errors.ate_rmse_m,
            rotation_rmse_rad=accuracy.pose_errors.rotation_rmse_rad,
            heading_rmse_rad=accuracy.pose_errors.heading_rmse_rad,
        )
        if result.in_known_map:
            report = replace(report, unaligned_rmse_m=accuracy.pose_errors.unaligned_rmse_m)
    _warn_of_missing_stamps(recording)
    _warn_of_rejections(result)
    _warn_of_unmapped(result)
    _warn_of_unused_poses(recording, selected, result)
    return Outcome(result, truth, accuracy, report, recording.missing_ids(selected.landmarks))


def _warn_of_missing_stamps(recording: Recording) -> None:
    """Say which times were used, if publishers don't fill in header.stamp."""
    if recording.unstamped:
        logger.warning(
            'Stamps are zero on %s; %d messages have the time of their reception instead.',
            ', '.join(recording.unstamped),
            recording.unstamped.total(),
        )


def _warn_of_rejections(result: Replay) -> None:
    """Say what may be wrong if more points were rejected than a sensor has outliers."""
    share = point_share(result.estimator.counts, 'rejected_landmark')
    if share > MOST_REJECTED:
        logger.warning(
            '%.0f %% of the points were rejected: look at the signs, units and frames of the '
            'velocity and of the points, then at their noise%s.',
            100.0 * share,
            ', and whether the map is still true' if result.in_known_map else '',
        )


def _warn_of_unmapped(result: Replay) -> None:
    """Say what may be wrong if most points are of no landmark of a map that does not grow."""
    settings = result.estimator.settings
    share = point_share(result.estimator.counts, 'unmapped_landmark')
    is_growing = not result.in_known_map or settings.localization_mode == 'off'
    if share > MOST_UNMAPPED and not is_growing:
        logger.warning(
            '%.0f %% of the points are of no landmark of the map: is it the map of this place%s?',
            100.0 * share,
            ', and did the robot start where it was said to' if settings.set_initial_pose else '',
        )


def _warn_of_unused_poses(recording: Recording, selected: SelectedTopics, result: Replay) -> None:
    """Say where the motion is, if an odometry's velocities are all zero and its poses are not."""
    poses = result.dead_reckoning.poses
    stands_still = len(poses) > 0 and bool((poses == poses[0]).all())
    if stands_still and recording.poses_move(selected.velocity):
        logger.warning(
            'All velocities on %s are zero, but its poses move; '
            'try --velocity-source pose_differences.',
            selected.velocity.name,
        )


def with_smoothed(outcome: Outcome) -> Outcome:
    """Add what the whole recording tells in hindsight.

    Raises
    ------
    UsageError
        If the history holds no observation.

    """
    smoothed = outcome.result.estimator.smooth()
    if not len(smoothed.stamps_ns):
        raise UsageError(f'nothing to smooth: no observation since {smoothed.since}')
    if len(smoothed.stamps_ns) < outcome.result.observations:
        logger.warning(
            'Only the last %d observations are smoothed: those since %s.',
            len(smoothed.stamps_ns),
            smoothed.since,
        )
    errors, landmark_rmse_m = measure_smoothed(smoothed, outcome.truth)
    return replace(
        outcome,
        smoothed=smoothed,
        smoothed_errors=errors,
        smoothed_landmark_rmse_m=landmark_rmse_m,
    )


def as_json(outcome: Outcome) -> dict[str, object]:
    """Return the figures as ``--json`` prints them."""
    calibration = outcome.result.estimator.calibration
    return asdict(outcome.report) | {
        'used': dict(outcome.result.estimator.counts),
        'calibration': {part.name: asdict(part) for part in calibration},
        'dead_reckoning_ate_rmse_m': _ate_rmse_m(outcome.accuracy.dead_reckoning_errors),
        'smoothed_ate_rmse_m': _ate_rmse_m(outcome.smoothed_errors),
        'smoothed_landmark_rmse_m': outcome.smoothed_landmark_rmse_m,
    }


def _ate_rmse_m(errors: TrajectoryErrors | None) -> float | None:
    return None if errors is None else errors.ate_rmse_m


def print_summary(
    recording: Path, selected: SelectedTopics, outcome: Outcome, written: Mapping[str, Path]
) -> None:
    """Print the figures as a table, and what was written where."""
    report = outcome.report
    note = f', {outcome.missing_ids}' if outcome.missing_ids else ''
    rows = {
        'velocity topic': str(selected.velocity),
        'landmarks topic': f'{selected.landmarks}{note}',
        **({} if selected.imu is None else {'Imu topic': str(selected.imu)}),
        'events': f'{report.events} over {report.duration_s:.1f} s',
        'estimator': f'{outcome.result.estimator.settings.gains} gains, '
        f'{report.seconds:.2f} s of CPU time',
        'landmarks': _told_landmarks(report.landmarks, outcome.result.estimator.counts),
        'observed points': _told_points(outcome.result.estimator.counts),
        'dropped': list_dropped(report.dropped),
    }
    if slips := outcome.result.estimator.counts['slip']:
        rows['slips'] = f'{slips} × the robot was not where odometry had it'
    if strange := outcome.result.estimator.counts['strange_place']:
        rows['strange places'] = f'{strange} × nothing seen was where the map has it'
    if report.localised_after_s is not None:
        rows['place in the map'] = _told_place(outcome.result, report.localised_after_s)
    rows |= {part.name: str(part) for part in outcome.result.estimator.calibration}
    rows |= _accuracy_rows(outcome)
    rows |= {name: str(path) for name, path in written.items()}
    print_table(str(recording), rows)


def _told_place(result: Replay, localised_after_s: float) -> str:
    told = f'found after {localised_after_s:.1f} s, where the trajectory begins'
    if result.estimator.settings.set_initial_pose:
        told = 'given at the start'
    lost = result.estimator.counts['lost']
    return f'{told}; lost {lost} × and searched anew' if lost else told


def _told_landmarks(landmarks: int, counts: Counter[str]) -> str:
    befell = {fate: counts[f'{fate}_landmark'] for fate in LANDMARK_FATES}
    told = [f'{count} {fate}' for fate, count in befell.items() if count]
    return ', '.join([str(landmarks), *told])


def _told_points(counts: Counter[str]) -> str:
    """Tell how many points were used, and what befell the others."""
    told = [f'{used_points(counts)} used']
    told += [
        f'{counts[name]} {fate} ({100.0 * point_share(counts, name):.1f} %)'
        for name, fate in UNUSED_POINTS.items()
        if counts[name]
    ]
    return ', '.join(told)


def _covered_rows(outcome: Outcome) -> dict[str, str]:
    """Tell of how much of the trajectory the figures are, if not of nearly all."""
    errors = outcome.accuracy.pose_errors
    if errors is None or errors.covered.mean() > NEARLY_ALL:
        return {}
    return {'truth': f'covers {100.0 * errors.covered.mean():.1f} % of the trajectory'}


def _accuracy_rows(outcome: Outcome) -> dict[str, str]:
    report = outcome.report
    figures = {
        'position error (ATE), RMS': (report.ate_rmse_m, 'm after alignment'),
        'of the velocities alone': (
            _ate_rmse_m(outcome.accuracy.dead_reckoning_errors),
            'm after alignment',
        ),
        'position error, not aligned': (
            report.unaligned_rmse_m,
            "m if the truth is in the map's frame",
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
    rows = _covered_rows(outcome) | {
        name: f'{value:.3f} {unit}' for name, (value, unit) in figures.items() if value is not None
    }
    if rows:
        return rows
    has_truth = len(outcome.truth.stamps_ns) > 0 or outcome.truth.landmarks is not None
    why = 'the truth fits nothing estimated'
    if not has_truth:
        why = 'the recording holds no truth to compare with'
    return {'accuracy': f'not known: {why}'}
