"""A run in Rerun: in its viewer, or as a file for it.

This module needs rerun-sdk, and is imported where Rerun is asked for. Colours are those of the
figures; ellipsoids hold 95 %. The time is that since the first event of the run, as in the report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from slam_observer_ros.common.files import destination, unfinished_directory
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Instant
from slam_observer_ros.evaluation.consistency import normalised_squared_errors
from slam_observer_ros.geometry import so3
from slam_observer_ros.runs.reported_run import ReportedRun

TIMELINE = 'time'
RED, GREEN, ORANGE = (213, 94, 0), (0, 158, 115), (230, 159, 0)
PALE_RED, PALE_GREEN, PALE_BLUE = (213, 94, 0, 90), (0, 158, 115, 90), (127, 184, 218)

CHI_95_SPACE = 2.795483482915108
"""Half-axes, in standard deviations, of the ellipsoid that holds 95 % in space."""

LEAST_HALF_M = 1e-3
"""Half-axes of an ellipsoid that is flat, which would not be seen from the side."""


def show_in_rerun(run: ReportedRun, title: str, path: Path | None) -> None:
    """Write a run to a file, whole or not at all, or open the viewer with it if that is None."""
    stream = rr.RecordingStream('slam_observer_ros')
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    if path is None:
        stream.spawn(default_blueprint=_blueprint(run))
        _log(stream, run, title)
        stream.flush()
        return
    target = destination(path)
    with unfinished_directory(target.parent) as directory:
        file = directory / target.name
        stream.save(file, default_blueprint=_blueprint(run))
        _log(stream, run, title)
        stream.disconnect()  # it writes the end of the file
        file.replace(target)


def _blueprint(run: ReportedRun) -> rrb.Blueprint:
    """Return which views there are, and what is in each."""
    plots = [
        rrb.TimeSeriesView(name='position error [m]', contents='/plots/position/**'),
        rrb.TimeSeriesView(name='residuals [σ]', contents='/plots/residual_sigma/**'),
        rrb.TimeSeriesView(name='NEES, NIS per degree of freedom', contents='/plots/fit/**'),
    ]
    if run.instants and run.instants[-1].calibration:
        plots.append(rrb.TimeSeriesView(name='calibration', contents='/plots/calibration/**'))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(name='map', origin='/world', contents='/world/**'),
            rrb.Vertical(*plots),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE),
        collapse_panels=True,
    )


def _log(stream: rr.RecordingStream, run: ReportedRun, title: str) -> None:
    stream.send_recording_name(title)
    stream.log('world', rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_path(stream, run)
    _log_truth(stream, run)
    for instant, seconds in zip(run.instants, run.instants_s.tolist(), strict=True):
        stream.set_time(TIMELINE, duration=seconds)
        _log_instant(stream, instant)
    _log_residuals(stream, run)
    _log_curves(stream, run)


def _log_path(stream: rr.RecordingStream, run: ReportedRun) -> None:
    trajectory = run.trajectory
    if not len(trajectory):
        return
    stream.log('world/path', rr.LineStrips3D([trajectory.positions], colors=[RED]), static=True)
    stream.log('world/robot', rr.TransformAxes3D(0.5), static=True)
    stream.send_columns(
        'world/robot',
        [rr.TimeColumn(TIMELINE, duration=run.seconds(trajectory.stamps_ns))],
        rr.Transform3D.columns(
            translation=trajectory.positions,
            quaternion=so3.to_quaternion(trajectory.rotations),
        ),
    )


def _log_truth(stream: rr.RecordingStream, run: ReportedRun) -> None:
    """Log the truth where the estimate should have it."""
    if run.errors is not None:
        positions = run.errors.aligned_truth.positions
        stream.log(
            'world/true_path', rr.LineStrips3D([positions], colors=[PALE_BLUE]), static=True
        )
    if (landmarks := run.aligned_landmarks) is not None:
        points = rr.Points3D(
            landmarks.world_points, colors=[PALE_BLUE], radii=rr.Radius.ui_points(5)
        )
        stream.log('world/true_landmarks', points, static=True)


def _log_instant(stream: rr.RecordingStream, instant: Instant) -> None:
    points = instant.world_points
    labels = [str(landmark_id) for landmark_id in instant.ids.tolist()]
    radii = rr.Radius.ui_points(4)
    stream.log('world/landmarks', rr.Points3D(points, colors=[GREEN], radii=radii, labels=labels))
    if instant.landmark_covariances is not None:
        ellipsoids = _ellipsoids(points, instant.landmark_covariances, PALE_GREEN)
        stream.log('world/landmark_uncertainty', ellipsoids)
    if instant.pose_covariance is not None:
        position = instant.pose[None, :3, 3]
        ellipsoid = _ellipsoids(position, instant.pose_covariance[None, 3:, 3:], PALE_RED)
        stream.log('world/robot_uncertainty', ellipsoid)


def _ellipsoids(
    points: FloatArray, covariances: FloatArray, color: tuple[int, ...]
) -> rr.Ellipsoids3D:
    variances, axes = np.linalg.eigh(covariances)
    axes *= np.linalg.det(axes)[:, None, None]  # a rotation, not a reflection
    half_m = CHI_95_SPACE * np.sqrt(np.maximum(variances, 0.0))
    return rr.Ellipsoids3D(
        centers=points,
        half_sizes=np.maximum(half_m, LEAST_HALF_M),
        quaternions=so3.to_quaternion(axes),
        colors=[color],
    )


def _log_residuals(stream: rr.RecordingStream, run: ReportedRun) -> None:
    """Log a line from where each landmark was expected to where it was seen."""
    innovations = run.innovations
    stamps_ns, starts = np.unique(innovations.stamps_ns, return_index=True)
    ends = np.append(starts[1:], len(innovations.stamps_ns))
    instants_ns = np.array([instant.stamp_ns for instant in run.instants], dtype=np.int64)
    before = np.maximum(np.searchsorted(instants_ns, stamps_ns, side='right') - 1, 0)
    for stamp_ns, start, end, row in zip(stamps_ns, starts, ends, before, strict=True):
        instant = run.instants[row]
        _, seen, rows = np.intersect1d(
            innovations.ids[start:end], instant.ids, return_indices=True
        )
        points = instant.world_points[rows]
        lines = np.stack([points, points + innovations.residuals[start:end][seen]], axis=1)
        stream.set_time(TIMELINE, duration=float(run.seconds(stamp_ns)))
        stream.log('world/residuals', rr.LineStrips3D(lines, colors=[ORANGE]))


def _log_curves(stream: rr.RecordingStream, run: ReportedRun) -> None:
    innovations = run.innovations
    for landmark_id in np.unique(innovations.ids).tolist():
        of_it = innovations.ids == landmark_id
        entity = f'plots/residual_sigma/landmark_{landmark_id}'
        stream.log(entity, rr.SeriesPoints(), static=True)
        _send(
            stream, entity, run.seconds(innovations.stamps_ns[of_it]), innovations.distances[of_it]
        )
    known = innovations.degrees_of_freedom > 0
    if known.any():
        nis = innovations.nis[known] / innovations.degrees_of_freedom[known]
        _send(stream, 'plots/fit/NIS', run.seconds(innovations.update_stamps_ns[known]), nis)
    if run.errors is not None:
        error_m = np.linalg.norm(run.errors.errors[:, 3:], axis=1)
        _send(
            stream, 'plots/position/aligned', run.seconds(run.errors.estimate.stamps_ns), error_m
        )
    _log_anchored(stream, run)
    for part in run.calibration:
        factor, unit = part.for_people
        seconds, parts = run.calibration_over_time(part.name)
        name = f'plots/calibration/{part.name}'
        if unit:
            stream.log(name, rr.SeriesLines(names=[f'{part.name} [{unit}]']), static=True)
        _send(stream, name, seconds, factor * np.array([each.value for each in parts]))


def _log_anchored(stream: rr.RecordingStream, run: ReportedRun) -> None:
    """Log the errors from the first pose on, and how large they are for what is stated."""
    anchored = run.anchored_errors()
    if anchored is None:
        return
    errors, rows = anchored
    seconds = run.instants_s[rows]
    _send(stream, 'plots/position/from_first_pose', seconds, np.linalg.norm(errors[:, 3:], axis=1))
    covariances = [run.instants[row].pose_covariance for row in rows.tolist()]
    stated = [covariance for covariance in covariances if covariance is not None]
    if len(stated) < len(covariances):
        return
    nees, degrees = normalised_squared_errors(errors, np.array(stated))
    usable = degrees > 0
    _send(stream, 'plots/fit/NEES', seconds[usable], nees[usable] / degrees[usable])


def _send(
    stream: rr.RecordingStream, entity: str, seconds: FloatArray, values: FloatArray
) -> None:
    columns: Any = rr.Scalars.columns(scalars=values)
    stream.send_columns(entity, [rr.TimeColumn(TIMELINE, duration=seconds)], columns)
