"""Errors of a run: the numbers in the tables."""

from __future__ import annotations

from dataclasses import dataclass

from estimators import Run
import numpy as np
from worlds import World

from slam_observer_ros.evaluation.metrics import (
    ConfigurationError,
    landmark_errors,
    trajectory_errors,
)
from slam_observer_ros.evaluation.trajectory import interpolate, Trajectory
from slam_observer_ros.events import LandmarkTruth


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors of one estimator on one world; NaN where there is nothing to measure.

    Attributes
    ----------
    configuration_rmse_m : float
        RMS over all observations of the gauge-free error; no alignment.
    ate_rmse_m, heading_rmse_rad : float
        Of the poses right after the observations, after one rigid alignment of their positions.
    landmark_rmse_m : float
        Of the final map, after a rigid alignment of its own.
    cpu_s : float
        CPU time of the estimator alone, seconds.

    """

    configuration_rmse_m: float
    ate_rmse_m: float
    heading_rmse_rad: float
    landmark_rmse_m: float
    cpu_s: float


FAILED = Scores(*[float('nan')] * 5)
"""Of an estimator that gave up."""


def score(run: Run, world: World, labels: dict[int, int] | None = None) -> Scores:
    """Compare a run with the truth; ``labels`` maps an estimator's own ids to the true ones."""
    final = run.snapshots[-1]
    landmarks = world.landmarks if labels is None else _relabelled(world.landmarks, labels)
    trajectory = Trajectory.from_samples(
        [snapshot.stamp_ns for snapshot in run.snapshots],
        [snapshot.pose for snapshot in run.snapshots],
    )
    errors = trajectory_errors(trajectory, world.truth)
    return Scores(
        configuration_rmse_m(run, world, landmarks),
        errors.ate_rmse_m,
        errors.heading_rmse_rad,
        landmark_errors(final.ids, final.world_points, landmarks).rmse_m,
        run.cpu_s,
    )


def configuration_rmse_m(run: Run, world: World, landmarks: LandmarkTruth) -> float:
    """Return the RMS of the configuration error over the observations that the truth covers."""
    stamps_ns = np.array([snapshot.stamp_ns for snapshot in run.snapshots])
    true_poses, covered = interpolate(world.truth, stamps_ns)
    error = ConfigurationError()
    for i in np.flatnonzero(covered):
        snapshot = run.snapshots[i]
        error.add(
            snapshot.stamp_ns,
            snapshot.pose,
            snapshot.ids,
            snapshot.world_points,
            true_poses[i],
            landmarks,
        )
    return error.rmse_m if error.rmse_m is not None else float('nan')


def _relabelled(landmarks: LandmarkTruth, labels: dict[int, int]) -> LandmarkTruth:
    """Return the truth under an estimator's own ids; two of them may mean one landmark."""
    row = {landmark_id: i for i, landmark_id in enumerate(landmarks.ids.tolist())}
    points = landmarks.world_points[[row[true_id] for true_id in labels.values()]]
    return LandmarkTruth(np.array(list(labels), dtype=np.int64), points)
