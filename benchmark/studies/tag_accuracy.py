"""How well a wheeled robot is localised among AprilTags, by their number and size, simulated.

``python benchmark/studies/tag_accuracy.py`` prints the table of docs/nav2.md. The hall is as in
``make robot``; a smaller number of tags is every second or every fourth of them.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from importlib import import_module
from pathlib import Path
import sys

import numpy as np

from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

sys.path.append(str(Path(__file__).resolve().parents[2] / 'demo'))
hall = import_module('hall')

PARAMS_FILE = Path(__file__).resolve().parents[2] / 'config' / 'tags_on_tf.yaml'
EVERY = (4, 2, 1)
SIZES_M = (0.08, 0.16, 0.32)
RATE_HZ, PER_IMAGE = 50, 5
SURVEY_SIGMA_M = 0.01
SETTLED_S = 10.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--duration', type=float, default=300.0, help='simulated seconds')
    parser.add_argument('--seeds', type=int, default=2, help='runs a cell')
    args = parser.parse_args()
    lines = ['| tags on the walls | ' + ' | '.join(f'edge {s:g} m' for s in SIZES_M) + ' |']
    lines.append('| --- ' * (len(SIZES_M) + 1) + '|')
    for every in EVERY:
        cells = [cell(every, size_m, args.seeds, args.duration) for size_m in SIZES_M]
        lines.append(f'| {len(hall.TAG_SPOTS[::every])} | ' + ' | '.join(cells) + ' |')
    sys.stdout.write('\n'.join(lines) + '\n')


def cell(every: int, size_m: float, seeds: int, duration_s: float) -> str:
    """Return the RMS error of position and heading over some runs."""
    errors = np.concatenate([run(every, size_m, seed, duration_s) for seed in range(seeds)])
    position_m = np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1)))
    heading_deg = np.degrees(np.sqrt(np.mean(errors[:, 2] ** 2)))
    return f'{100.0 * position_m:.1f} cm, {heading_deg:.1f}°'


def settings(size_m: float) -> Settings:
    """Return the settings of the parameter file, with the noise of the range for a tag's size."""
    known = {row.name for row in table(Settings)}
    given = read_parameter_file(PARAMS_FILE)
    chosen = from_parameters(Settings, {k: v for k, v in given.items() if k in known})
    return replace(chosen, range_scale_noise=chosen.range_scale_noise * hall.TAG_SIZE_M / size_m)


def run(every: int, size_m: float, seed: int, duration_s: float) -> np.ndarray:
    """Drive about the hall; return errors of x, y and heading (n, 3) while localised."""
    random = np.random.default_rng(seed)
    tags = hall.tag_poses()[::every]
    estimator = Estimator(settings(size_m))
    estimator.load_map(surveyed(tags, random))
    odometry, truth, errors = hall.WheelOdometry(random), hall.true_pose(0.0), []
    for step in range(1, round(duration_s * RATE_HZ) + 1):
        before, truth = truth, hall.true_pose(step / RATE_HZ)
        odometry.advance(before, truth, 1.0 / RATE_HZ)
        stamp_ns = to_ns(step / RATE_HZ)
        turn, forward = odometry.turn_rad_s, odometry.forward_m_s
        estimator.add(VelocityEvent(stamp_ns, np.array([0.0, 0.0, turn, forward, 0.0, 0.0])))
        if step % PER_IMAGE:
            continue
        off = random.standard_normal((len(tags), 7))
        if seen := hall.sightings(truth, tags, off, size_m):
            points = se3.transform(hall.CAMERA, np.array([pose[:3, 3] for pose in seen.values()]))
            estimator.add(ObservationEvent(stamp_ns, np.array(list(seen)), points))
        at_ns = estimator.stamp_ns
        if estimator.is_localised and at_ns is not None and step > SETTLED_S * RATE_HZ:
            errors.append(error_of(hall.true_pose(at_ns * 1e-9), estimator.pose))
    return np.array(errors).reshape(-1, 3)


def surveyed(tags: np.ndarray, random: np.random.Generator) -> LandmarkMap:
    """Return the map of the tags, each measured to a centimetre."""
    points = tags[:, :3, 3] + random.normal(0.0, SURVEY_SIGMA_M, (len(tags), 3))
    covariances = np.tile(SURVEY_SIGMA_M**2 * np.eye(3), (len(tags), 1, 1))
    return LandmarkMap(np.arange(len(tags)), points, covariances, np.zeros(len(tags), np.int64))


def error_of(truth: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the error of x, y and heading (3,)."""
    turn = pose[:3, :3] @ truth[:3, :3].T
    return np.array([*(pose[:2, 3] - truth[:2, 3]), np.arctan2(turn[1, 0], turn[0, 0])])


if __name__ == '__main__':
    main()
