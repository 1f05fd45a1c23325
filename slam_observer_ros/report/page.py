"""One HTML file with style, script, plotting library and numbers inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
import math
from pathlib import Path
import sys

import numpy as np

from slam_observer_ros.common import __version__
from slam_observer_ros.common.errors import json_text, OutputError
from slam_observer_ros.common.files import unfinished_file
from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.messages.estimate_messages import half_sights
from slam_observer_ros.recordings.trajectory import interpolate
from slam_observer_ros.report.curves import (
    calibration,
    consistency,
    drops,
    errors,
    Json,
    MAX_PATH,
    rounded,
    thinned,
)
from slam_observer_ros.runs.reported_run import ReportedRun
from slam_observer_ros.settings.parameter_table import changed_names, table

_PARTS = {
    'STYLE': 'report.css',
    'PLOTTING_LIBRARY': 'plotly-basic.min.js',
    'SCRIPT': 'report.js',
}


def write_report(
    path: Path,
    run: ReportedRun,
    title: str,
    figures: Mapping[str, str],
    findings: Sequence[Finding],
    warnings: Sequence[str],
) -> None:
    """Write the report of a run; it is whole or not there. Raises an OutputError if it can't.

    ``figures`` are shown as a table; ``warnings`` are what no finding says.
    """
    text = {
        'title': title,
        'figures': [[name, value] for name, value in figures.items()],
        'findings': [finding.as_json() | {'text': finding.text()} for finding in findings],
        'warnings': list(warnings),
    }
    page = asset('page.html')
    for mark, name in _PARTS.items():
        page = page.replace(f'@{mark}@', asset(name), 1)
    # In a script element only `<` could end it.
    numbers = json_text(text | report_data(run), is_compact=True)
    page = page.replace('@NUMBERS@', numbers.replace('<', '\\u003c'), 1)
    try:
        with unfinished_file(path) as file:
            file.write(page)
    except OSError as error:
        raise OutputError(f"can't write {path}: {error.strerror}") from error


def asset(name: str) -> str:
    """Return the text of a file that pages are made of."""
    return (resources.files(__package__) / 'assets' / name).read_text(encoding='utf-8')


MAX_RESIDUALS = 6000
MAX_ELLIPSES = 40_000
"""Landmarks of all instants together that are drawn."""

FLAT = 0.05
"""Height of a map over its width, below which only its plan is drawn."""

UPPER = np.triu_indices(3)
"""Entries of a covariance that the page has: xx, xy, xz, yy, yz, zz."""


def report_data(run: ReportedRun) -> dict[str, Json]:
    """Return all that the page shows of a run."""
    return {
        'settings': _settings(run),
        'versions': [
            ['slam_observer_ros', __version__],
            ['Python', sys.version.split()[0]],
            ['numpy', np.__version__],
        ],
        'is_flat': _is_flat(run),
        'gaps': rounded(run.gaps_s, 2),
        'path': _path(run),
        'instants': _instants(run),
        'smoothed': _smoothed(run),
        'landmarks': _landmarks(run),
        'true_landmarks': _true_landmarks(run),
        'errors': errors(run),
        'consistency': consistency(run),
        'residuals': _residuals(run),
        'outcomes': _outcomes(run),
        'gate': run.settings.rejection_threshold,
        'calibration': calibration(run),
        'drops': drops(run),
    }


def _settings(run: ReportedRun) -> list[Json]:
    settings = run.settings
    defaults = {row.name: row.default for row in table(type(settings))}
    return [
        [name, str(getattr(settings, name)), str(defaults[name])]
        for name in changed_names(settings)
    ]


def _is_flat(run: ReportedRun) -> bool:
    points = [run.trajectory.positions]
    if run.instants:
        points.append(run.instants[-1].world_points)
    extent = np.ptp(np.concatenate(points), axis=0) if len(points[0]) else np.zeros(3)
    return bool(extent[2] <= FLAT * max(extent[0], extent[1]))


def _path(run: ReportedRun) -> dict[str, Json]:
    trajectory = run.trajectory
    some = thinned(len(trajectory), MAX_PATH)
    stamps_ns, positions = trajectory.stamps_ns[some], trajectory.positions[some]
    path: dict[str, Json] = {
        't': rounded(run.seconds(stamps_ns), 2),
        'xyz': rounded(positions.T, 3),
    }
    if run.errors is not None:
        true_poses, _ = interpolate(run.errors.aligned_truth, stamps_ns)
        path['true_xyz'] = rounded(true_poses[:, :3, 3].T, 3)
        path['error_m'] = rounded(np.linalg.norm(positions - true_poses[:, :3, 3], axis=1), 3)
    return path


def _smoothed(run: ReportedRun) -> Json:
    """Return the smoothed path and map in the world of the estimate; None if not asked for."""
    if run.smoothed is None or run.smoothed_points is None:
        return None
    positions = run.smoothed.positions[thinned(len(run.smoothed), MAX_PATH)]
    return {'xyz': rounded(positions.T, 3), 'points': rounded(run.smoothed_points.T, 3)}


def _instants(run: ReportedRun) -> dict[str, Json]:
    """Return robot and map at instants, with the covariances of their positions."""
    total = sum(len(instant.ids) for instant in run.instants)
    some = run.instants[thinned(total, MAX_ELLIPSES)]
    seconds = run.seconds(np.array([instant.stamp_ns for instant in some], dtype=np.int64))
    poses = np.array([instant.pose for instant in some]).reshape(-1, 4, 4)
    halves = [
        (np.empty((0, 3)), np.empty((0, 3)))
        if instant.seen is None
        else half_sights(instant.seen, instant.ids, instant.world_points)
        for instant in some
    ]
    return {
        't': rounded(seconds, 2),
        'xyz': rounded(poses[:, :3, 3], 3),
        'ahead': rounded(poses[:, :3, 0], 3),
        'robot': [_covariances(_position_covariance(instant.pose_covariance)) for instant in some],
        'ids': [instant.ids.tolist() for instant in some],
        'points': [rounded(instant.world_points.T, 3) for instant in some],
        'covariances': [_covariances(instant.landmark_covariances) for instant in some],
        'rings': [rounded(rings, 3) for rings, _ in halves],
        'rays': [rounded(ends, 3) for _, ends in halves],
    }


def _position_covariance(pose_covariance: FloatArray | None) -> FloatArray | None:
    return None if pose_covariance is None else pose_covariance[None, 3:, 3:]


def _covariances(covariances: FloatArray | None) -> Json:
    """Return the six entries of each covariance, m², with three digits."""
    if covariances is None:
        return None
    return [
        [float(f'{entry:.3g}') for entry in entries]
        for entries in covariances[:, UPPER[0], UPPER[1]].tolist()
    ]


def _true_landmarks(run: ReportedRun) -> Json:
    truth = run.aligned_landmarks
    if truth is None:
        return None
    return {'ids': truth.ids.tolist(), 'xyz': rounded(truth.world_points.T, 3)}


def _landmarks(run: ReportedRun) -> list[Json]:
    """Return a row for each landmark of the map: what was seen of it, and how well it fits."""
    if not run.instants:
        return []
    innovations, last = run.innovations, run.instants[-1]
    true_points = {}
    if (truth := run.aligned_landmarks) is not None:
        true_points = dict(zip(truth.ids.tolist(), truth.world_points, strict=True))
    rows: list[Json] = []
    for row, landmark_id in enumerate(last.ids.tolist()):
        of_it = innovations.ids == landmark_id
        used = of_it & (innovations.weights > 0.0)
        true_point = true_points.get(landmark_id)
        error_m = math.nan
        if true_point is not None:
            error_m = float(np.linalg.norm(last.world_points[row] - true_point))
        deviation_m = math.nan
        if last.landmark_covariances is not None:
            deviation_m = math.sqrt(max(np.trace(last.landmark_covariances[row]), 0.0))
        rows.append(
            [
                landmark_id,
                int(np.count_nonzero(of_it)),
                int(np.count_nonzero(of_it & (innovations.weights == 0.0))),
                int(np.count_nonzero(used & (innovations.weights < 1.0))),
                int(np.count_nonzero(of_it & innovations.moved)),
                *rounded(
                    np.array(
                        [
                            _rms(innovations.residuals_m[used]),
                            _rms(innovations.distances[used]),
                            deviation_m,
                            error_m,
                        ]
                    ),
                    3,
                ),
            ]
        )
    return rows


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _residuals(run: ReportedRun) -> dict[str, Json]:
    """Return residuals in σ: of a great many the suspicious ones, and some of the others."""
    innovations = run.innovations
    shown = _shown(innovations.weights, innovations.distances) | innovations.moved
    return {
        't': rounded(run.seconds(innovations.stamps_ns[shown]), 2),
        'id': innovations.ids[shown].tolist(),
        'sigma': rounded(innovations.distances[shown], 2),
        'm': rounded(innovations.residuals_m[shown], 3),
        'weight': rounded(innovations.weights[shown], 2),
        'moved': np.flatnonzero(innovations.moved[shown]).tolist(),
        'left_out': int(np.count_nonzero(~shown)),
    }


def _outcomes(run: ReportedRun) -> dict[str, Json]:
    """Return what became of landmarks, and why points were not used that have no residual."""
    each = run.without_residual
    each = each[thinned(len(each), MAX_RESIDUALS)]
    stamps_ns = np.array([one.stamp_ns for one in each], dtype=np.int64)
    return {
        't': rounded(run.seconds(stamps_ns), 2),
        'id': [one.landmark_id for one in each],
        'what': [one.what.words for one in each],
    }


def _shown(weights: FloatArray, distances: FloatArray) -> BoolArray:
    if len(weights) <= MAX_RESIDUALS:
        return np.ones(len(weights), dtype=np.bool_)
    suspicious = np.flatnonzero((weights < 1.0) | (distances > 3.0))
    suspicious = suspicious[thinned(len(suspicious), MAX_RESIDUALS // 2)]
    shown = np.zeros(len(weights), dtype=np.bool_)
    shown[thinned(len(weights), MAX_RESIDUALS // 2)] = True
    shown[suspicious] = True
    return shown
