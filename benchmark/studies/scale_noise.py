"""Scales of the odometry where its noise is in proportion to speed: how far off, and how sure.

``python benchmark/studies/scale_noise.py`` drives random halls, whose wheels are off by a scale
and by white noise that grows with the true speed, as the settings state both. It prints the mean
and the root mean square of the errors of the scales that are found, over what is said of them.
"""

from __future__ import annotations

import argparse
import logging
import math
import sys

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from threadpoolctl import threadpool_limits

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

DURATION_S = 90.0
DENSITY, SCALE_NOISES, SCALE = 0.005, (0.02, 0.05, 0.1), 0.03
RATES_HZ, EVERY = (10, 20, 50), (1, 2, 5, 10, 20)  # of velocities; how many per observation
SIDE_M, LANDMARKS, VIEW_RAD = 30.0, 40, 2.4
GOAL_S, ACCELERATIONS = 3.0, np.array([1.0, 0.5])  # of turning and driving: rad/s², m/s²


def main() -> None:
    """Print a row for each hall, and the figures of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=range(40), metavar='SEED')
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    errors = []
    for seed in args.seeds:
        errors.append(error_over_deviation(seed))
        sys.stdout.write(f'{seed}: turning {errors[-1][0]:.2f} σ, driving {errors[-1][1]:.2f} σ\n')
    mean, rms = np.mean(errors, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
    for name, one, spread in zip(('turning', 'driving'), mean, rms, strict=True):
        sys.stdout.write(f'{name}: {one:.2f} σ on average, RMS {spread:.2f} σ\n')


def error_over_deviation(seed: int) -> FloatArray:
    """Return how far off the scales of turning and driving are found, (2,), in σ."""
    rng = np.random.default_rng(seed)
    noises, off = rng.choice(SCALE_NOISES, 2), rng.normal(0.0, SCALE, 2)
    rate_hz, every = int(rng.choice(RATES_HZ)), int(rng.choice(EVERY))
    reach_m, range_noise, bearing_noise = rng.uniform((4.0, 0.01, 0.003), (10.0, 0.05, 0.02))
    landmarks = rng.uniform(-0.5, 0.5, (LANDMARKS, 3)) * (SIDE_M, SIDE_M, 0.0)
    estimator = Estimator(
        Settings(
            two_d_mode=True,
            reorder_window=0.0,
            angular_velocity_noise=(0.0, 0.0, DENSITY),
            linear_velocity_noise=(DENSITY, DENSITY, 0.0),
            angular_scale_noise=(0.0, 0.0, float(noises[0])),
            linear_scale_noise=(float(noises[1]), 0.0, 0.0),
            angular_scale_stddev=(0.0, 0.0, 0.05),
            linear_scale_stddev=(0.05, 0.0, 0.0),
            observation_model='range_bearing',
            range_noise=range_noise,
            bearing_noise=bearing_noise,
        )
    )
    pose, dt_s, moves, goal = np.eye(4), 1.0 / rate_hz, np.zeros(2), np.zeros(2)
    for step in range(round(DURATION_S * rate_hz)):
        stamp_ns, next_ns = (10**9 + round(k * 1e9 * dt_s) for k in (step, step + 1))
        if step % round(GOAL_S * rate_hz) == 0:
            goal = rng.uniform((-0.6, 0.2), (0.6, 1.0))
        outside = np.linalg.norm(pose[:2, 3]) > 0.4 * SIDE_M
        home = math.atan2(-pose[1, 3], -pose[0, 3]) - math.atan2(pose[1, 0], pose[0, 0])
        turn = np.clip(math.remainder(home, math.tau), -0.8, 0.8) if outside else goal[0]
        most = ACCELERATIONS * dt_s
        moves = moves + np.clip([turn - moves[0], goal[1] - moves[1]], -most, most)
        noisy = rng.normal(moves, np.hypot(DENSITY, noises * moves) / math.sqrt(dt_s))
        estimator.add(VelocityEvent(stamp_ns, _twist(noisy / (1.0 + off))))
        pose = pose @ se3.exp(dt_s * _twist(moves))
        if step % every == 0:
            points = se3.transform(se3.inverse(pose), landmarks)
            ranges = np.linalg.norm(points, axis=1)
            bearings = np.arctan2(points[:, 1], points[:, 0])
            ids = np.flatnonzero((ranges < reach_m) & (np.abs(bearings) < 0.5 * VIEW_RAD))
            bearings = rng.normal(bearings[ids], bearing_noise)
            rays = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(len(ids))])
            seen = rng.normal(ranges[ids], range_noise)[:, None] * rays
            estimator.add(ObservationEvent(next_ns, ids, seen))
    estimator.flush()
    found = {one.name: one for one in estimator.calibration}
    scales = [found['angular_scale_z'], found['linear_scale_x']]
    return np.array(
        [(one.value - 1.0 - k) / one.deviation for one, k in zip(scales, off, strict=True)]
    )


def _twist(moves: FloatArray) -> FloatArray:
    return np.array([0.0, 0.0, moves[0], moves[1], 0.0, 0.0])


if __name__ == '__main__':
    main()
