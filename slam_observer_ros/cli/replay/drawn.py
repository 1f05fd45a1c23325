"""What a replay draws: the report and the figures; apart, as few replays need their libraries."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from slam_observer_ros.cli.replay.outcome import ReplayOutcome
from slam_observer_ros.evaluation.gaps import fill_gaps
from slam_observer_ros.evaluation.plots.map_plot import plot_map
from slam_observer_ros.evaluation.plots.replay_plots import plot_errors, plot_residuals
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.report.page import write_report
from slam_observer_ros.report.reported_run import ReportedRun
from slam_observer_ros.runs.recorder import RunRecorder


def write_report_of(
    title: str, outcome: ReplayOutcome, summary: Mapping[str, str], path: Path
) -> None:
    """Write the report, with the lines of the table that is printed."""
    recorder = outcome.recorder
    if not isinstance(recorder, RunRecorder):
        return
    estimator = outcome.result.estimator
    write_report(
        path,
        ReportedRun(
            title=title,
            figures=summary,
            warnings=outcome.warnings,
            settings=estimator.settings,
            start_ns=outcome.result.start_ns,
            trajectory=outcome.result.trajectory,
            in_known_map=outcome.result.in_known_map,
            truth=outcome.truth,
            errors=outcome.accuracy.pose_errors,
            anees=outcome.accuracy.anees,
            instants=recorder.finish(estimator),
            innovations=recorder.innovations,
        ),
    )


def draw_figures(outcome: ReplayOutcome, directory: Path) -> None:
    """Draw the figures into a directory that is there."""
    result = outcome.result
    _draw_map(outcome, directory / 'map.png')
    _draw_errors(outcome, directory / 'errors.png')
    plot_residuals(
        directory / 'residuals.png',
        result.residual_stamps_ns,
        result.residuals,
        result.rejected,
        outcome.dropped,
        outcome.events,
    )


def _draw_map(outcome: ReplayOutcome, path: Path) -> None:
    result, truth, smoothed = outcome.result, outcome.truth, outcome.smoothed
    trajectory = outcome.trajectory
    if smoothed is not None:
        trajectory = fill_gaps(trajectory, result.dead_reckoning)
    has_errors = outcome.trajectory_errors is not None
    plot_map(
        path,
        trajectory,
        result.estimator.landmark_ids if smoothed is None else smoothed.ids,
        result.estimator.world_points if smoothed is None else smoothed.world_points,
        Trajectory(truth.stamps_ns, truth.poses) if has_errors else None,
        truth.landmarks,
        is_smoothed=smoothed is not None,
    )


def _draw_errors(outcome: ReplayOutcome, path: Path) -> None:
    """Draw the errors of what is written, unless the truth covers nothing of it."""
    result, errors = outcome.result, outcome.trajectory_errors
    if errors is None:
        return
    if outcome.smoothed is not None:
        plot_errors(path, errors, is_smoothed=True)
        return
    covariances = result.pose_covariances
    plot_errors(
        path,
        errors,
        None if covariances is None else covariances[errors.covered],
        result.configuration if result.configuration.values_m else None,
        in_known_map=result.in_known_map,
    )
