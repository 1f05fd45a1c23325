"""How exact the truth of Starry Night is: ``python benchmark/studies/oracle.py``.

An oracle is given the true landmarks, and its pose in each image is the one that fits the points
seen in it best. What it is off by from the recorded poses no estimator can do much better than:
recorded attitude and camera disagree. So estimators are scored against the fitted poses as well.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import sys

import _above  # noqa: F401 (finds the modules of the folder above)
from estimators import ONLINE, Run, run_online, Snapshot
import numpy as np
from scores import score
from worlds import starry_night, World

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.recordings.trajectory import Trajectory

LEAST_SEEN = 4
"""Points in an image from which on a pose is fitted: three leave nothing over to average."""

ITERATIONS = 10
"""Gauss–Newton steps of a fit, from the unweighted one."""

SCORED = ('riccati', 'textbook EKF')


def main() -> None:
    """Print the oracle's error, and the estimators' against both kinds of truth."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    recorded = starry_night()
    fitted = fitted_poses(recorded)
    known = recorded.landmarks.ids, recorded.landmarks.world_points
    poses = zip(fitted.stamps_ns.tolist(), fitted.poses, strict=True)
    oracle = Run([Snapshot(stamp_ns, pose, *known) for stamp_ns, pose in poses], cpu_s=0.0)
    fitted_world = replace(recorded, truth=fitted)
    lines = ['| configuration error, m | recorded poses | fitted poses |', '|---|---|---|']
    lines += [f'| oracle | {score(oracle, recorded).configuration_rmse_m:.3f} | |']
    for name in SCORED:
        run = run_online(ONLINE[name](recorded.settings), recorded.events)
        run = only_at(run, fitted)
        errors = [score(run, world).configuration_rmse_m for world in (recorded, fitted_world)]
        lines += [f'| {name} | {errors[0]:.3f} | {errors[1]:.3f} |']
    sys.stdout.write('\n'.join(lines) + '\n')


def only_at(run: Run, trajectory: Trajectory) -> Run:
    """Return a run at the stamps of a trajectory only."""
    stamps_ns = set(trajectory.stamps_ns.tolist())
    kept = [snapshot for snapshot in run.snapshots if snapshot.stamp_ns in stamps_ns]
    return replace(run, snapshots=kept)


def fitted_poses(world: World) -> Trajectory:
    """Return the poses that fit the images of at least ``LEAST_SEEN`` known points best."""
    noise = ObservationNoise(world.settings)
    true_points = dict(
        zip(world.landmarks.ids.tolist(), world.landmarks.world_points, strict=True)
    )
    stamps_ns, poses = [], []
    for event in world.events:
        if not isinstance(event, ObservationEvent) or len(event.ids) < LEAST_SEEN:
            continue
        targets = np.array([true_points[i] for i in event.ids.tolist()])
        poses.append(fitted_pose(event.points, targets, noise.covariances(event)))
        stamps_ns.append(event.stamp_ns)
    return Trajectory.from_samples(stamps_ns, poses)


def fitted_pose(points: FloatArray, targets: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return the likeliest pose (4, 4) of points (m, 3) seen with covariances (m, 3, 3)."""
    pose = rigid_alignment(points, targets)
    for _ in range(ITERATIONS):
        R, world = pose[:3, :3], se3.transform(pose, points)
        W = np.linalg.inv(R @ covariances @ R.T)
        J = np.concatenate([-so3.hat(world), np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        JW = J.swapaxes(1, 2) @ W
        gradient = (JW @ (targets - world)[:, :, None]).sum(axis=0)[:, 0]
        pose = se3.exp(np.linalg.solve((JW @ J).sum(axis=0), gradient)) @ pose
    return pose


if __name__ == '__main__':
    main()
