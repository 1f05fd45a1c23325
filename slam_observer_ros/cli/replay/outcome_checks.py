"""What a replay must have, and what it gives reason to warn of, before it is reported."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
import logging
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.replay.dropped import list_dropped, unused_messages
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.estimates import (
    calibration_problems,
    MAX_REJECTED,
    MAX_REJECTED_ORIENTATIONS,
    point_share,
    UNUSED_POINTS,
)
from slam_observer_ros.events import is_automatic
from slam_observer_ros.inputs.event_builder import NO_TRANSFORM
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.observer.designs import DESIGNS
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.runs.replay import Replay
from slam_observer_ros.settings.input_settings import InputSettings, POSE_DIFFERENCES

MAX_UNMAPPED = 0.5
"""Share of the points beyond which they are more than what a map has not got yet."""

PLACE_THE_SENSOR = (
    '--set sensor_pose=[X,Y,Z,ROLL,PITCH,YAW] places a sensor that is not on /tf, '
    '--base-frame names another frame of the robot'
)
"""What to do where /tf does not connect sensor and robot."""

logger = logging.getLogger(__name__)


def warn_of_resets(result: Replay) -> None:
    """Warn if only a part of the recording is reported, because the clock jumped."""
    if not result.resets:
        return
    logger.warning(
        'Trajectory, map, errors and figures are only of the %.1f s after the last jump of the '
        'clock (%d in all).',
        result.seconds_until(result.estimator.stamp_ns or 0),
        result.resets,
    )


def check_used(
    args: argparse.Namespace,
    recording: Recording,
    selected: SelectedTopics,
    inputs: InputSettings,
    result: Replay,
) -> None:
    """Warn if no velocity was used, none of the Imu, or no observation.

    Raises a UsageError if ``--smooth``, ``--map`` or ``--load-map`` needs some of the last.
    """
    dropped = result.estimator.dropped + unused_messages(recording, selected)
    _warn_of_unused_velocities(selected, result, dropped)
    counts = result.estimator.counts
    # In a loaded map there may be none as its pose was not found, which check_localised reports.
    if result.observations or (counts['observed_point'] and not result.estimator.is_localised):
        return
    dropped = _unused_points(counts) + dropped
    why = f'observation was used (dropped: {list_dropped(dropped)})'
    if hint := _hint_where_none_was_used(recording, selected, inputs, dropped):
        why += f'; {hint}'
    if args.smooth or args.map is not None or args.load_map is not None:
        raise UsageError(f'no {why}; --smooth, --map and --load-map need some')
    logger.warning('No %s; the trajectory is that of the velocities alone.', why)


def _unused_points(counts: Counter[str]) -> Counter[str]:
    """Return how many observations had no point that is used, and why the points were not."""
    return Counter({'without a point that is used': counts['observation']}) + Counter(
        {f'points {why}': counts[name] for name, why in UNUSED_POINTS.items()}
    )


def _hint_where_none_was_used(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, dropped: Counter[str]
) -> str:
    """Return what may be wrong where no observation was used; empty if nothing is known."""
    is_unplaced = recording.dropped[NO_TRANSFORM] > 0
    if dropped and not is_unplaced:
        return ''
    missing_tags = recording.contents.missing_tags(selected, inputs.tag_frame_prefix)
    return missing_tags or (PLACE_THE_SENSOR if is_unplaced else '')


def _warn_of_unused_velocities(
    selected: SelectedTopics, result: Replay, dropped: Counter[str]
) -> None:
    if not result.estimator.counts['velocity']:
        logger.warning(
            'No velocity was used (dropped: %s); the landmarks alone move the robot.',
            list_dropped(dropped),
        )
    if selected.imu is not None and not result.angular_velocities:
        logger.warning(
            'No angular velocity of %s was used (dropped: %s); that of %s was taken.',
            selected.imu.name,
            list_dropped(dropped),
            selected.velocity.name,
        )


def check_localised(args: argparse.Namespace, result: Replay, maps: Sequence[LandmarkMap]) -> None:
    """Refuse an outcome that is not in the frame of the map that was loaded.

    Where the pose in it was found and lost again the trajectory is still of use, but not the map:
    a UsageError says if the pose was never found, or not at the end and the map is asked for.
    """
    if result.estimator.is_localised:
        return
    if result.localised_ns is None:
        raise UsageError(_never_found(args.load_map, result, maps))
    end_s = result.seconds_until(result.localised_ns[1])
    lost = f'the pose in the map {args.load_map} was lost after {end_s:.1f} s, and not found again'
    if args.map is not None or args.smooth:
        raise UsageError(f'{lost}; --map and --smooth need it at the end')
    logger.warning('%s; the trajectory ends there.', lost[0].upper() + lost[1:])


def _never_found(path: Path, result: Replay, maps: Sequence[LandmarkMap]) -> str:
    ids = np.concatenate([known.ids for known in maps])
    named = ids[~is_automatic(ids)]
    least = 'two' if result.estimator.settings.two_d_mode else 'three'
    if is_automatic(result.estimator.landmark_ids).any():
        return (
            f'the pose in the map {path} was not found: '
            f'{result.estimator.localisation_problem}{_advice(result)}'
        )
    return (
        f'the pose in the map {path} was not found: that takes {least} of its landmarks or more, '
        'recognised by their ids, well apart, and seen where the map has them; '
        f'{np.isin(named, result.estimator.landmark_ids).sum()} of its {len(ids)} were '
        f'seen{_advice(result)}'
    )


def _advice(result: Replay) -> str:
    """Return what to do if the landmarks seen did not determine the pose."""
    counts, settings = result.estimator.counts, result.estimator.settings
    if counts['unknown_id'] and not DESIGNS[settings.gains].has_joint_covariance:
        return f'; {counts["unknown_id"]} points without id take --gains riccati'
    if 2 * counts['repeated_id'] > counts['observed_point']:
        return f'; {counts["repeated_id"]} points were {UNUSED_POINTS["repeated_id"]}'
    if settings.set_initial_pose:
        return '; they contradict the pose that was given'
    return (
        '. Where the start is known: --set set_initial_pose=true '
        '--set initial_position=[X,Y,Z] --set initial_yaw=YAW'
    )


def warn_of_input(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, result: Replay
) -> None:
    """Say what of the recording, or of the settings, is likely to be wrong."""
    if recording.loss and not recording.warning:
        logger.warning('%s: damaged; %s.', recording.path, recording.loss)
    _warn_of_missing_stamps(recording)
    _warn_of_rejections(result)
    _warn_of_calibration(result)
    _warn_of_unmapped(result)
    if inputs.velocity_source != POSE_DIFFERENCES:
        _warn_of_unused_poses(recording, selected, result)


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
    if share > MAX_REJECTED:
        logger.warning(
            '%.0f %% of the points were rejected: look at the signs, units and frames of the '
            'velocity and of the points, then at their noise%s.',
            100.0 * share,
            ', and whether the map is still true' if result.in_known_map else '',
        )
    share = point_share(result.estimator.counts, 'rejected_orientation')
    if share > MAX_REJECTED_ORIENTATIONS and result.in_known_map:
        logger.warning(
            'The orientations of %.0f %% of the points were rejected: has the map other tag axes '
            'than the detector (slam-observer map convert --tag-axes)?',
            100.0 * share,
        )


def _warn_of_calibration(result: Replay) -> None:
    """Say what may be wrong if nobody can mean an estimate, and how sensors are really mounted."""
    calibration = result.estimator.calibration
    advice = [part.advice for part in calibration if part.advice]
    noisier = [part.problem for part in result.estimator.motion_factors if part.problem]
    for text in [*calibration_problems(calibration), *advice, *noisier]:
        logger.warning('%s', text)


def _warn_of_unmapped(result: Replay) -> None:
    """Say what may be wrong if most points are of no landmark of a map that does not grow."""
    settings = result.estimator.settings
    share = point_share(result.estimator.counts, 'unmapped_landmark')
    is_growing = not result.in_known_map or settings.localization_mode == 'off'
    if share > MAX_UNMAPPED and not is_growing:
        logger.warning(
            '%.0f %% of the points are of no landmark of the map: is it the map of this place%s?',
            100.0 * share,
            ', and did the robot start where it was said to' if settings.set_initial_pose else '',
        )


def _warn_of_unused_poses(recording: Recording, selected: SelectedTopics, result: Replay) -> None:
    """Say where the motion is, if an odometry's velocities are not those of its poses."""
    poses = result.dead_reckoning.poses
    stands_still = len(poses) > 1 and bool((poses == poses[0]).all())
    if stands_still and recording.contents.poses_move(selected.velocity):
        logger.warning(
            'All velocities on %s are zero, but its poses move; '
            'try --velocity-source pose_differences.',
            selected.velocity.name,
        )
        return
    problem = recording.contents.twist_problem(selected.velocity, selected.imu is None)
    if problem and not stands_still:
        logger.warning(
            'The twist on %s %s; try --velocity-source pose_differences.',
            selected.velocity.name,
            problem,
        )
