"""What a replay draws: the report and the figures; apart, as few replays need their libraries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slam_observer_ros.cli.replay.outcome import ReplayOutcome
from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.evaluation.consistency import nees_over_time
from slam_observer_ros.evaluation.map_shape import shape_covariances
from slam_observer_ros.evaluation.plots.map_plot import plot_map
from slam_observer_ros.evaluation.plots.replay_plots import plot_errors, plot_residuals
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.report.page import write_report
from slam_observer_ros.report.reported_run import ReportedRun
from slam_observer_ros.runs.recorder import RunRecorder
from slam_observer_ros.runs.replay import Replay

MAX_ELLIPSES = 300
"""Landmarks of more would hide each other's, and their joint covariance costs the cube of them."""


def write_report_of(
    title: str, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path
) -> None:
    """Write the report, with the lines of the table that is printed."""
    write_report(path, _reported_run(title, outcome, summary))


def show_run_in_rerun(
    title: str, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path | None
) -> None:
    """Write a file for Rerun, or open its viewer if that is None."""
    from slam_observer_ros.report.rerun_log import show_in_rerun  # which only some have

    show_in_rerun(_reported_run(title, outcome, summary), path)


def _reported_run(title: str, outcome: ReplayOutcome, summary: Mapping[str, str]) -> ReportedRun:
    recorder, estimator = outcome.recorder, outcome.result.estimator
    if not isinstance(recorder, RunRecorder):
        raise EvaluationError('nothing was recorded that could be shown')
    return ReportedRun(
        title=title,
        nothing_used=outcome.nothing_used,
        figures=summary,
        warnings=outcome.warnings,
        settings=estimator.settings,
        start_ns=outcome.result.start_ns,
        trajectory=outcome.result.trajectory,
        dead_reckoning=outcome.result.dead_reckoning,
        in_known_map=outcome.result.in_known_map,
        truth=outcome.truth,
        errors=outcome.accuracy.pose_errors,
        anees=outcome.accuracy.anees,
        instants=recorder.finish(estimator),
        innovations=recorder.innovations,
    )


def draw_figures(outcome: ReplayOutcome, directory: Path, suffix: str) -> None:
    """Draw the figures into a directory that is there, as files of one kind."""
    _draw_map(outcome, directory / f'map.{suffix}')
    _draw_errors(outcome, directory / f'errors.{suffix}')
    if isinstance(outcome.recorder, RunRecorder):
        plot_residuals(
            directory / f'residuals.{suffix}',
            outcome.recorder.innovations,
            outcome.result.estimator.settings,
            outcome.dropped,
            outcome.events,
        )


def _draw_map(outcome: ReplayOutcome, path: Path) -> None:
    result, truth, smoothed = outcome.result, outcome.truth, outcome.smoothed
    has_errors = outcome.trajectory_errors is not None
    plot_map(
        path,
        outcome.trajectory,
        result.estimator.landmark_ids if smoothed is None else smoothed.ids,
        result.estimator.world_points if smoothed is None else smoothed.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if has_errors else None,
        truth.landmarks,
        covariances=None if smoothed is not None else _landmark_covariances(result),
        is_smoothed=smoothed is not None,
    )


def _landmark_covariances(result: Replay) -> FloatArray | None:
    """Return those of the landmarks (n, 3, 3) in a loaded map; otherwise of the map's shape."""
    estimator, update = result.estimator, result.estimator.last_update
    count = len(estimator.landmark_ids)
    if result.in_known_map:
        return estimator.landmark_covariances
    if update is None or not 0 < count <= MAX_ELLIPSES:
        return None
    joint = estimator.configuration_covariance(np.arange(count))
    if joint is None:
        return None
    seen = se3.transform(se3.inverse(update.pose), estimator.world_points)
    R = update.pose[:3, :3]
    covariances: FloatArray = R @ shape_covariances(seen, joint) @ R.T
    return covariances


def _draw_errors(outcome: ReplayOutcome, path: Path) -> None:
    """Draw the errors of what is written, unless the truth covers nothing of it."""
    result, errors = outcome.result, outcome.trajectory_errors
    if errors is None:
        return
    if outcome.smoothed is not None:
        plot_errors(path, errors, is_smoothed=True)
        return
    covariances, nees = result.pose_covariances, None
    is_anchored = not result.in_known_map
    if covariances is not None and (outcome.accuracy.anees is not None or not is_anchored):
        nees = nees_over_time(errors, covariances[errors.covered], is_anchored)
    plot_errors(
        path,
        errors,
        nees,
        result.configuration if result.configuration.values_m else None,
        is_anchored=is_anchored,
    )
