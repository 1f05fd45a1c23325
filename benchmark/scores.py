"""Errors of a run: the numbers in the tables."""

from __future__ import annotations

from collections import Counter
from dataclasses import astuple, dataclass, replace

from estimators import Run, Snapshot
import numpy as np
from worlds import World

from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.recordings.trajectory import interpolate, Trajectory
from slam_observer_ros.runs.metrics import (
    ConfigurationError,
    landmark_rmse_m,
    trajectory_errors,
)


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


def score(run: Run, world: World, has_ids: bool = True) -> Scores:
    """Compare a run with the truth; without ids there is no error of the map on its own."""
    final = run.snapshots[-1]
    compared = _compared(run, world) if has_ids else run.snapshots
    trajectory = Trajectory.from_samples(
        [snapshot.stamp_ns for snapshot in run.snapshots],
        [snapshot.pose for snapshot in run.snapshots],
    )
    errors = trajectory_errors(trajectory, world.truth)
    return Scores(
        _configuration_rmse_m(compared, world),
        errors.ate_rmse_m,
        errors.heading_rmse_rad,
        landmark_rmse_m(final.ids, final.world_points, world.landmarks_at(final.stamp_ns))
        if has_ids
        else float('nan'),
        run.cpu_s,
    )


def mean_scores(scores: list[Scores]) -> Scores:
    """Return the mean of each score over several runs."""
    return Scores(*np.mean([astuple(one) for one in scores], axis=0).tolist())


def _compared(run: Run, world: World) -> list[Snapshot]:
    """Return the snapshots without landmarks that were seen less than ``confirmations`` times.

    The observer shows a landmark only then. To compare the same landmarks, the rule is applied to
    all estimators.
    """
    counts: Counter[int] = Counter()
    snapshots = []
    # Smoothing has no pose of an observation none of whose points was believed.
    by_stamp = {snapshot.stamp_ns: snapshot for snapshot in run.snapshots}
    for event in world.events:
        if not isinstance(event, ObservationEvent):
            continue
        counts.update(event.ids.tolist())
        if event.stamp_ns not in by_stamp:
            continue
        snapshot = by_stamp[event.stamp_ns]
        often = [counts[i] >= world.settings.confirmations for i in snapshot.ids.tolist()]
        kept = np.flatnonzero(often)
        points = snapshot.world_points[kept]
        snapshots.append(replace(snapshot, ids=snapshot.ids[kept], world_points=points))
    return snapshots


def _configuration_rmse_m(snapshots: list[Snapshot], world: World) -> float:
    """Return the RMS of the configuration error over the observations that the truth covers."""
    stamps_ns = np.array([snapshot.stamp_ns for snapshot in snapshots])
    true_poses, covered = interpolate(world.truth, stamps_ns)
    error = ConfigurationError()
    for i in np.flatnonzero(covered):
        estimate = snapshots[i]
        error.add(
            estimate.stamp_ns,
            estimate.pose,
            estimate.ids,
            estimate.world_points,
            true_poses[i],
            world.landmarks_at(estimate.stamp_ns),
        )
    return float('nan') if error.rmse_m is None else error.rmse_m
