"""What it costs to state the odometry's noise wrong, and what its factors make up for.

``python benchmark/studies/motion_noise.py`` runs each world with the noise of turning and driving
stated right, three times too small and three times too large, for each ``motion_noise_factor``. A
row has the configuration error, also over the one of ``stated``, stated right; ANEES; the factors
of turning and driving, of standard deviations; CPU time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import logging
import sys
import time
from typing import Any

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.recordings.trajectory import interpolate
from slam_observer_ros.runs.metrics import ConfigurationError
from slam_observer_ros.settings.estimator_settings import Settings

WORLDS = ('simulated loop, wheeled', 'simulated loop, 3D stereo', 'cityTrees10000')
MODES = ('stated', 'at_least_stated', 'auto')
STATED = (1.0, 1.0 / 3.0, 3.0)
PERIOD_NS = 5_000_000_000
"""Time between two samples of ANEES."""

NOISE = tuple(
    f'{part}_{kind}_noise' for part in ('angular', 'linear') for kind in ('velocity', 'scale')
)


def main() -> None:
    """Print a row for each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='NAME', help='worlds whose name has NAME')
    parser.add_argument('--stated', type=float, nargs='+', default=STATED, metavar='FACTOR')
    parser.add_argument('--modes', nargs='+', default=MODES, metavar='MODE')
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    for name in worlds.names() if args.only else WORLDS:
        if args.only.lower() in name.lower():
            world, right_m = worlds.load(name), None
            for stated in args.stated:
                for mode in args.modes:
                    settings = replace(
                        with_noise(world.settings, stated), motion_noise_factor=mode
                    )
                    error, cpu_s, factors = run(world, settings)
                    right_m = error.rmse_m if right_m is None else right_m
                    sys.stdout.write(
                        f'{name:26} × {stated:<5.3g} {mode:16} {error.rmse_m:7.4f} m '
                        f'{(error.rmse_m or 0.0) / (right_m or 1.0):6.3f} × '
                        f'ANEES {error.anees or 0.0:5.2f}  {factors}  {cpu_s:5.1f} s\n'
                    )
                    sys.stdout.flush()


def with_noise(settings: Settings, factor: float) -> Settings:
    """Return settings that state the noise of the velocity so many times as large."""
    noise: dict[str, Any] = {name: getattr(settings, name) for name in NOISE}
    for name, values in noise.items():
        noise[name] = tuple(factor * value for value in values)
    return replace(settings, **noise)


def run(world: World, settings: Settings) -> tuple[ConfigurationError, float, str]:
    """Return the errors of a run, its CPU time, and the factors that were found."""
    estimator, error = Estimator(settings), ConfigurationError()
    seen = [event for event in world.events if isinstance(event, ObservationEvent)]
    true_poses, covered = interpolate(world.truth, np.array([event.stamp_ns for event in seen]))
    poses = iter(zip(true_poses, covered.tolist(), strict=True))
    cpu_s, next_ns = 0.0, 0
    for event in world.events:
        start_s = time.process_time()
        estimator.add(event)
        cpu_s += time.process_time() - start_s
        if not isinstance(event, ObservationEvent):
            continue
        true_pose, is_covered = next(poses)
        if not is_covered or not len(estimator.landmark_ids):
            continue
        is_due = event.stamp_ns >= next_ns
        next_ns = event.stamp_ns + PERIOD_NS if is_due else next_ns
        error.add(
            event.stamp_ns,
            estimator.pose,
            estimator.landmark_ids,
            estimator.world_points,
            true_pose,
            world.landmarks_at(event.stamp_ns),
            estimator.configuration_covariance if is_due else None,
        )
    factors = ' '.join(f'{one.factor:5.2f}' for one in estimator.motion_factors)
    return error, cpu_s, factors


if __name__ == '__main__':
    main()
