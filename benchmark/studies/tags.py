"""Tags with orientations against their positions alone, where few are in view.

``python benchmark/studies/tags.py`` drives a camera by hand past 20 tags for two laps, with at
most one, two or five of them in view, and prints errors and consistency, means over ``--runs``
seeds with the standard error of each ANEES. All estimators are given the same points and
velocities.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
import logging
import sys

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from odometry import Event
from worlds import drive, Loop, simulated_settings, World

from slam_observer_ros.common.process import use_one_thread
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import so3
from slam_observer_ros.models.calibration import without_calibration
from slam_observer_ros.runs.metrics import ConfigurationError
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import flipped

MAX_SEEN = (1, 2, 5)
SIGMAS_RAD = (0.02, 0.05, 0.15)
FLIPPED_SHARE = 0.1
TAG_TILT_RAD = 0.5
"""Standard deviation about each axis by which tags are turned."""


@dataclass(frozen=True, slots=True)
class Case:
    """What of tags is used, and how they are seen."""

    name: str
    sigma_rad: float = 0.0  # of each axis of an orientation; 0: positions only
    flipped_share: float = 0.0
    relinearises: bool = True


CASES = (
    Case('positions, not relinearised', relinearises=False),
    Case('positions'),
    Case(f'with orientations, {SIGMAS_RAD[1]:g} rad, not relinearised', SIGMAS_RAD[1], 0.0, False),
    *(Case(f'with orientations, {sigma:g} rad', sigma) for sigma in SIGMAS_RAD),
    Case(f'{SIGMAS_RAD[1]:g} rad, {FLIPPED_SHARE:.0%} flipped', SIGMAS_RAD[1], FLIPPED_SHARE),
)


def main() -> None:
    """Print a table for each number of tags in view."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=8, metavar='N', help='seeds (default: 8)')
    parser.add_argument(
        '--seen', type=int, nargs='+', default=MAX_SEEN, metavar='N', help='most tags in view'
    )
    args = parser.parse_args()
    use_one_thread()
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    for max_seen in args.seen:
        sys.stdout.write(f'\nAt most {max_seen} in view, {args.runs} runs\n\n')
        print_table([np.array(runs(case, max_seen, args.runs)) for case in CASES])


def print_table(scores: Sequence[FloatArray]) -> None:
    """Print scores (runs, 5) of each case; ratios are to positions that are not relinearised."""
    head = ('', 'configuration', 'ratio', 'heading', 'ANEES: configuration', 'heading', 'pose')
    sys.stdout.write('| ' + ' | '.join(head) + ' |\n' + '|---' * len(head) + '|\n')
    first_m = np.mean(scores[0][:, 0])
    for case, of_runs in zip(CASES, scores, strict=True):
        error_m, heading_rad, *anees = np.mean(of_runs, axis=0)
        errors = np.std(of_runs[:, 2:], axis=0) / np.sqrt(max(len(of_runs) - 1, 1))
        cells = [f'{error_m:.3f} m', f'× {error_m / first_m:.2f}', f'{heading_rad:.3f} rad']
        cells += [f'{value:.2f} ± {own:.2f}' for value, own in zip(anees, errors, strict=True)]
        sys.stdout.write(f'| {case.name} | ' + ' | '.join(cells) + ' |\n')
    sys.stdout.flush()


def runs(case: Case, max_seen: int, count: int) -> list[FloatArray]:
    """Return the scores of each seed."""
    return [score(case, *drive_past_tags(case, max_seen, seed)) for seed in range(count)]


def drive_past_tags(case: Case, max_seen: int, seed: int) -> tuple[World, list[Event]]:
    """Drive past tags, and return what is seen of them: poses, if the case has orientations."""
    loop = Loop('stereo_inertial', 60.0, 120.0, 20, 5.0, 5, max_seen=max_seen)
    world = drive(loop, without_calibration(simulated_settings(loop.config)), seed)
    rng = orientation_rng(seed)
    tags = tilted_tags(loop.landmarks, rng)
    flip_rng = np.random.default_rng([seed, loop.landmarks])
    events: list[Event] = []
    for event in world.events:
        if isinstance(event, ObservationEvent) and case.sigma_rad:
            noise = so3.exp(case.sigma_rad * rng.standard_normal((len(event.ids), 3)))
            R = true_pose(world, event.stamp_ns)[:3, :3]
            Z = R.T @ tags[event.ids] @ noise
            flips = flip_rng.random(len(Z)) < case.flipped_share
            Z[flips] = flipped(Z[flips], event.points[flips])
            event = replace(event, orientations=Z)
        events.append(event)
    return world, events


def orientation_rng(seed: int) -> np.random.Generator:
    """Return what draws how the tags are turned, and then the noise of what is seen of that."""
    return np.random.default_rng(seed + 99)


def tilted_tags(count: int, rng: np.random.Generator) -> FloatArray:
    """Return how the tags are turned (count, 3, 3), the first that ``rng`` draws."""
    return so3.exp(TAG_TILT_RAD * rng.standard_normal((count, 3)))


def true_pose(world: World, stamp_ns: int) -> FloatArray:
    """Return the pose (4, 4) at the stamp of an event."""
    pose: FloatArray = world.truth.poses[np.searchsorted(world.truth.stamps_ns, stamp_ns)]
    return pose


def settings_of(case: Case, world: World) -> Settings:
    """Return the settings of an estimator for a case."""
    return replace(
        world.settings,
        use_tag_orientation=case.sigma_rad > 0.0,
        orientation_noise=case.sigma_rad or world.settings.orientation_noise,
        relinearization_interval=world.settings.relinearization_interval * case.relinearises,
    )


def score(case: Case, world: World, events: Sequence[Event]) -> FloatArray:
    """Return errors of configuration, m, and heading, rad, and ANEES of both and the pose."""
    estimator, configuration = Estimator(settings_of(case, world)), ConfigurationError()
    errors, covariances = [], []
    for event in events:
        estimator.add(event)
        if not isinstance(event, ObservationEvent) or estimator.pose_covariance is None:
            continue
        truth, pose = true_pose(world, event.stamp_ns), estimator.pose
        configuration.add(
            event.stamp_ns,
            pose,
            estimator.landmark_ids,
            estimator.world_points,
            truth,
            world.landmarks,
            estimator.configuration_covariance,
        )
        turn = so3.log(pose[:3, :3] @ truth[:3, :3].T)
        errors.append(np.concatenate([turn, pose[:3, 3] - truth[:3, 3]]))
        covariances.append(estimator.pose_covariance)
    e, P = np.array(errors[1:]), np.array(covariances[1:])  # the first is exact by definition
    of_pose = np.einsum('ki,ki->k', e, np.linalg.solve(P, e[:, :, None])[:, :, 0]) / 6.0
    return np.array(
        [
            configuration.rmse_m or np.nan,
            np.sqrt(np.mean(e[:, 2] ** 2)),
            configuration.anees or np.nan,
            np.mean(e[:, 2] ** 2 / P[:, 2, 2]),
            np.mean(of_pose),
        ]
    )


if __name__ == '__main__':
    main()
