"""Ranges alone: Plaza 1 and 2, in a survey of the anchors and without.

``python benchmark/studies/half_points.py`` prints errors against the truth by the shipped
``uwb.yaml``. By how much the ranges, which are 7 % long, are so is not known. The data is not
shipped: it is read from ``plaza`` in the folder that SLAM_OBSERVER_DATA names.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
import sys
import time

import numpy as np

from slam_observer_ros.cli.options import find_config
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.metrics import trajectory_errors
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.events import Event, ObservationEvent, RANGE, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

DATA = Path(os.environ.get('SLAM_OBSERVER_DATA', '../shared/data')) / 'plaza'
SURVEY_M, START_M, START_RAD = 0.05, 0.05, 0.05


def main() -> None:
    """Print a row for each run, in the surveyed map and without one."""
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)
    for run in (1, 2):
        for is_surveyed in (True, False):
            sys.stdout.write(f'{row(run, is_surveyed)}\n')


def row(run: int, is_surveyed: bool) -> str:
    """Drive once; return position error after alignment, ANEES of the position, and CPU time."""
    events, truth, anchors = read(run)
    start = truth.poses[0]
    poses: list[tuple[int, FloatArray]] = []
    nees: list[float] = []

    def note(update: Update) -> None:
        covariance = estimator.pose_covariance
        poses.append((update.stamp_ns, update.pose))
        if covariance is not None and covariance[3, 3] > 0.0:
            at = np.searchsorted(truth.stamps_ns, update.stamp_ns).clip(max=len(truth) - 1)
            off = (update.pose[:3, 3] - truth.poses[at, :3, 3])[:2]
            nees.append(float(off @ np.linalg.solve(covariance[3:5, 3:5], off)) / 2.0)

    estimator = Estimator(settings(), initial_pose=start, on_update=note)
    if is_surveyed:
        sigmas = np.array([0.0, 0.0, START_RAD, START_M, START_M, 0.0])
        estimator.load_map(anchors, start, np.diag(sigmas**2))
    start_s = time.process_time()
    for event in events:
        estimator.add(event)
    estimator.flush()
    seconds = time.process_time() - start_s
    estimate = Trajectory.from_samples([each for each, _ in poses], [pose for _, pose in poses])
    ate_m = trajectory_errors(estimate, truth).ate_rmse_m
    name = 'surveyed' if is_surveyed else 'unknown anchors'
    return f'Plaza {run}, {name:16} ATE {ate_m:.3f} m, ANEES {np.mean(nees):.2f}, {seconds:.1f} s'


def settings() -> Settings:
    """Return what ``uwb.yaml`` says of the estimator."""
    known = {each.name for each in table(Settings)}
    values = read_parameter_file(find_config('uwb')).items()
    return from_parameters(Settings, {key: value for key, value in values if key in known})


def read(run: int) -> tuple[list[Event], Trajectory, LandmarkMap]:
    """Return what was recorded in the order of its stamps, the true poses, and the anchors."""
    ways, truth, ranges, anchors = (
        np.loadtxt(DATA / f'plaza{run}_{name}.csv', delimiter=',', skiprows=1)
        for name in ('dr', 'gt', 'td', 'tl')
    )
    turn_rad = np.pi if run == 2 else 0.0  # its truth has the robot's back in front
    poses = [pose_of(x, y, yaw + turn_rad) for _, x, y, yaw in truth]
    stamps_ns = [round(1e9 * stamp_s) for stamp_s in truth[:, 0]]
    events: list[Event] = [
        VelocityEvent(round(1e9 * t_s), np.array([0, 0, turn, way, 0, 0]) / dt_s, is_mean=True)
        for t_s, dt_s, (way, turn) in zip(
            ways[:-1, 0], np.diff(ways[:, 0]), ways[1:, 1:], strict=True
        )
        if dt_s > 0.0
    ]
    kinds = np.array([RANGE])
    events += [
        ObservationEvent(
            round(1e9 * t_s), np.array([int(anchor)]), np.array([[range_m, 0, 0]]), kinds=kinds
        )
        for t_s, _, anchor, range_m in ranges
    ]
    events.sort(key=lambda event: event.stamp_ns)
    n = len(anchors)
    points = np.column_stack([anchors[:, 1:3], np.zeros(n)])
    covariances = np.tile(SURVEY_M**2 * np.eye(3), (n, 1, 1))
    survey = LandmarkMap(anchors[:, 0].astype(np.int64), points, covariances, np.zeros(n, int))
    return events, Trajectory.from_samples(stamps_ns, poses), survey


def pose_of(x: float, y: float, yaw: float) -> FloatArray:
    """Return a pose (4, 4) in the plane."""
    return se3.from_rpy((x, y, 0.0, 0.0, 0.0, yaw))


if __name__ == '__main__':
    main()
