"""Whether a change left every estimate as it was: one digest a run, of all that is estimated.

``python benchmark/digests.py --save before`` keeps the estimates; after the change
``python benchmark/digests.py --compare before`` prints the same digests and, where one differs,
by how much at most, relative to the largest entry of its kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from hashlib import blake2b
import logging
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np
import outliers
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import DESIGNS
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap

MAP_NOISE_M = 0.03
"""Standard deviation of the surveyed map in which a run is localised, metres."""

Estimates = dict[str, list[FloatArray]]


def main() -> None:
    """Run everything and print the digests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='NAME', help='runs whose name has NAME')
    parser.add_argument('--save', type=Path, metavar='DIR', help='keep all estimates in DIR')
    parser.add_argument('--compare', type=Path, metavar='DIR', help='compare with those in DIR')
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    total_s = 0.0
    for name, run in runs():
        if args.only.lower() not in name.lower():
            continue
        start_s = time.process_time()
        estimates = run()
        cpu_s = time.process_time() - start_s
        total_s += cpu_s
        difference = compared(estimates, args.compare / file_name(name)) if args.compare else ''
        sys.stdout.write(f'{digest(estimates)}  {cpu_s:6.2f} s  {name}{difference}\n')
        sys.stdout.flush()
        if args.save:
            args.save.mkdir(parents=True, exist_ok=True)
            flat: dict[str, Any] = {kind: flattened(arrays) for kind, arrays in estimates.items()}
            np.savez(args.save / file_name(name), **flat)
    sys.stdout.write(f'{"":32}  {total_s:6.2f} s  in all\n')


def runs() -> Iterator[tuple[str, Callable[[], Estimates]]]:
    """Yield the name of each run, and what runs it."""
    for name in worlds.names():
        world = worlds.load(name)
        for gains in DESIGNS:
            yield f'{name}, {gains}', partial(estimate, world, gains)
        yield f'{name}, smoothed', partial(smooth, world)
        yield f'{name}, without ids', partial(estimate, outliers.without_ids(world), 'riccati')
        worse = outliers.with_outliers(world, seed=0)
        yield f'{name}, outliers, riccati', partial(estimate, worse, 'riccati')
        for gains in DESIGNS:
            for mode in ('off', 'uncertain', 'fixed'):
                run = partial(localise, world.part(0.0, 200.0), gains, mode)
                yield f'{name}, in a map ({mode}), {gains}', run


def estimate(world: World, gains: str) -> Estimates:
    """Return all that is estimated after each observation."""
    return observed(Estimator(replace(world.settings, gains=gains)), world)


def localise(world: World, gains: str, mode: str) -> Estimates:
    """Return the same with a surveyed map that was loaded at the start."""
    settings = replace(world.settings, gains=gains, localization_mode=mode)
    truth, rng = world.landmarks, np.random.default_rng(0)
    noise = MAP_NOISE_M * rng.standard_normal(truth.world_points.shape)
    if settings.two_d_mode:
        noise[:, 2] = 0.0
    covariances = np.tile(MAP_NOISE_M**2 * np.eye(3), (len(noise), 1, 1))
    counts = np.full(len(noise), 10)
    estimator = Estimator(settings)
    estimator.load_map(LandmarkMap(truth.ids, truth.world_points + noise, covariances, counts))
    return observed(estimator, world)


def smooth(world: World) -> Estimates:
    """Return the smoothed trajectory and map."""
    estimator = Estimator(replace(world.settings, gains='riccati', smoothing_window=0))
    observed(estimator, world)
    smoothed = estimator.smooth()
    return {'poses': list(smoothed.poses), 'points': [smoothed.world_points]}


def observed(estimator: Estimator, world: World) -> Estimates:
    """Feed a world to an estimator."""
    estimates: Estimates = {
        kind: [] for kind in ('poses', 'points', 'ids', 'pose_covariances', 'covariances', 'extra')
    }
    for event in world.events:
        estimator.add(event)
        if not isinstance(event, ObservationEvent):
            continue
        estimates['poses'].append(estimator.pose)
        estimates['points'].append(estimator.world_points)
        estimates['ids'].append(estimator.landmark_ids.astype(np.float64))
        if estimator.pose_covariance is not None:
            estimates['pose_covariances'].append(estimator.pose_covariance)
        if estimator.landmark_covariances is not None:
            estimates['covariances'].append(estimator.landmark_covariances)
    estimator.flush()
    calibration = [(entry.value, entry.deviation) for entry in estimator.calibration]
    estimates['extra'] = [np.array(calibration).ravel(), estimator.body_velocity]
    return estimates


def digest(estimates: Estimates) -> str:
    """Return a digest of every bit."""
    hashed = blake2b(digest_size=16)
    for arrays in estimates.values():
        for array in arrays:
            hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def flattened(arrays: list[FloatArray]) -> FloatArray:
    """Return all numbers in one row."""
    return np.concatenate([np.empty(0), *(array.ravel() for array in arrays)])


def compared(estimates: Estimates, path: Path) -> str:
    """Return how far estimates are from those that were saved, in words."""
    with np.load(path) as saved:
        before = {kind: saved[kind] for kind in saved.files}
    after = {kind: flattened(arrays) for kind, arrays in estimates.items()}
    worst = 0.0
    for kind, numbers in before.items():
        if numbers.shape != after[kind].shape:
            return f'   {kind}: DIFFERENT NUMBER of landmarks'
        if len(numbers):
            largest = float(np.abs(numbers).max()) or 1.0
            worst = max(worst, float(np.abs(after[kind] - numbers).max()) / largest)
    return '   equal' if worst == 0.0 else f'   differs by {worst:.1e}'


def file_name(name: str) -> str:
    """Return the name of a run's file."""
    return ''.join(c if c.isalnum() else '_' for c in name) + '.npz'


if __name__ == '__main__':
    main()
