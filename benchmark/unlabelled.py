"""What it costs to map without ids: configuration error, consistency and CPU time over those with.

``python benchmark/unlabelled.py`` prints a row a run, and the means over runs of one kind: of
landmarks with ids, without, and without but with 5 % false points.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
import logging
import sys
import time

import numpy as np
import outliers
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.metrics import ConfigurationError
from slam_observer_ros.evaluation.trajectory import interpolate
from slam_observer_ros.events import ObservationEvent

NEES_EVERY = 10
"""Observations from one covariance of the configuration to the next: these cost O(n³)."""

MRCLAM_S = 600.0
"""How much of each MRCLAM run is taken by default, seconds."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one run."""

    rmse_m: float  # of the configuration
    anees: float
    cpu_s: float
    landmarks: int


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='NAME', help='runs whose name has NAME')
    parser.add_argument('--seeds', type=int, default=5, help='loops, and draws of false points')
    parser.add_argument('--mrclam-s', type=float, default=MRCLAM_S, help='of each MRCLAM run')
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    sys.stdout.write(
        '| run | landmarks | error with ids, m | without | + false | ANEES with ids '
        '| without | + false | CPU with ids, s | without | + false |\n' + '| --- ' * 11 + '|\n'
    )
    kinds: dict[str, list[list[float]]] = {}
    for kind, name, world, draws in runs(args.seeds, args.mrclam_s):
        if args.only.lower() in name.lower():
            figures = measured(name, world, draws)
            kinds.setdefault(kind, []).append(figures)
    for kind, rows in kinds.items():
        means = np.mean(rows, axis=0)
        sys.stdout.write(
            f'{kind}, mean of {len(rows)}: error {means[0]:.2f} ×, with false points '
            f'{means[1]:.2f} ×; ANEES {means[2]:.2f}, {means[3]:.2f}; CPU {means[4]:.1f} ×, '
            f'{means[5]:.1f} ×\n'
        )


def runs(seeds: int, mrclam_s: float) -> Iterator[tuple[str, str, World, range]]:
    """Yield the kind of each run, its name, the run, and its draws of false points."""
    loop = worlds.WHEELED_LOOP
    for seed in range(seeds):
        world = worlds.drive(loop, worlds.simulated_settings(loop.config), seed)
        yield 'loops', f'loop, seed {seed}', world, range(seed, seed + 1)
    if worlds.data_folder().is_dir():
        yield 'Starry Night', 'Starry Night', worlds.load('Starry Night'), range(1)
        for robot in range(1, 6):
            world = worlds.load(f'MRCLAM 6, robot {robot}').part(0.0, mrclam_s)
            yield 'MRCLAM 6', f'MRCLAM 6, robot {robot}', world, range(min(seeds, 4))


def measured(name: str, world: World, draws: range) -> list[float]:
    """Run a world with ids and without, print its row, and return what it is over that with."""
    with_ids = run(world)
    without = run(outliers.without_ids(world))
    false = [run(outliers.with_false_points(world, draw)) for draw in draws]
    error_m, anees, cpu_s = np.mean([(one.rmse_m, one.anees, one.cpu_s) for one in false], axis=0)
    counts = [with_ids.landmarks, without.landmarks, *(one.landmarks for one in false)]
    sys.stdout.write(
        f'| {name} | {", ".join(map(str, counts))} | {with_ids.rmse_m:.3f} | '
        f'{without.rmse_m / with_ids.rmse_m:.2f} × | {error_m / with_ids.rmse_m:.2f} × | '
        f'{with_ids.anees:.2f} | {without.anees:.2f} | {anees:.2f} | {with_ids.cpu_s:.1f} | '
        f'{without.cpu_s / with_ids.cpu_s:.1f} × | {cpu_s / with_ids.cpu_s:.1f} × |\n'
    )
    sys.stdout.flush()
    return [
        without.rmse_m / with_ids.rmse_m,
        error_m / with_ids.rmse_m,
        without.anees,
        anees,
        without.cpu_s / with_ids.cpu_s,
        cpu_s / with_ids.cpu_s,
    ]


def run(world: World) -> Outcome:
    """Feed a world to the estimator, and compare each state with the truth."""
    estimator = Estimator(replace(world.settings, gains='riccati'))
    error, cpu_s, start_s, count = ConfigurationError(), 0.0, time.process_time(), 0
    for event in world.events:
        estimator.add(event)
        if not isinstance(event, ObservationEvent):
            continue
        cpu_s += time.process_time() - start_s
        true_pose, is_covered = interpolate(world.truth, np.array([event.stamp_ns]))
        update = estimator.last_update
        if is_covered[0] and update is not None:
            count += 1
            error.add(
                event.stamp_ns,
                estimator.pose,
                estimator.landmark_ids,
                estimator.world_points,
                true_pose[0],
                world.landmarks_at(event.stamp_ns),
                None if count % NEES_EVERY else estimator.configuration_covariance,
                update.ids[~update.rejected],
            )
        start_s = time.process_time()
    return Outcome(
        error.rmse_m or float('nan'),
        error.anees or float('nan'),
        cpu_s,
        len(estimator.landmark_ids),
    )


if __name__ == '__main__':
    main()
