"""What the page draws over time."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.runs.consistency import (
    average_nees_band,
    CHI_SQUARE_95,
    normalised_squared_errors,
)
from slam_observer_ros.runs.reported_run import ReportedRun

MAX_PATH = 4000
"""Poses that are drawn, of the path and of its errors."""

MAX_GROUPS = 150
"""Points of the curve of NIS, each the mean of as many observations as that takes."""

MIN_GROUP = 10


def errors(run: ReportedRun) -> dict[str, Json]:
    """Return position errors and the half-axis of the stated 95 % ellipse, metres.

    The heading errors are in degrees, after the alignment.
    """
    seconds = run.instants_s
    curves: dict[str, Json] = {
        't': rounded(seconds, 2),
        'bound_m': rounded(_bounds_m(run), 3),
        'lyapunov_t': rounded(run.seconds(run.innovations.update_stamps_ns), 2),
        'lyapunov': _log10(run.innovations.lyapunov),
    }
    if run.errors is not None:
        curves['heading_t'], curves['heading_deg'] = _over_time(
            run, run.errors.estimate.stamps_ns, np.degrees(run.errors.errors[:, 2])
        )
    if run.smoothed_errors is not None:
        stamps_ns = run.smoothed_errors.estimate.stamps_ns
        curves['smoothed_t'], curves['smoothed_m'] = _over_time(
            run, stamps_ns, run.smoothed_errors.distances_m
        )
        _, curves['smoothed_heading_deg'] = _over_time(
            run, stamps_ns, np.degrees(run.smoothed_errors.errors[:, 2])
        )
    if run.configuration.values_m:
        curves['configuration_t'], curves['configuration_m'] = _over_time(
            run, np.array(run.configuration.stamps_ns), np.array(run.configuration.values_m)
        )
    anchored = run.anchored_errors()
    if anchored is not None:
        of_poses, rows = anchored
        error_m = np.full(len(seconds), np.nan)
        error_m[rows] = np.linalg.norm(of_poses[:, 3:], axis=1)
        curves['drift_m'] = rounded(error_m, 3)
    return curves


def _over_time(run: ReportedRun, stamps_ns: IntArray, values: FloatArray) -> tuple[Json, Json]:
    """Return seconds of the run and values at these, of no more than MAX_PATH stamps (k,)."""
    some = thinned(len(stamps_ns), MAX_PATH)
    return rounded(run.seconds(stamps_ns[some]), 2), rounded(values[some], 3)


def thinned(count: int, most: int) -> slice:
    """Return rows at equal steps, of ``count`` no more than ``most``."""
    return slice(None, None, max(1, -(-count // most)))


def _log10(values: FloatArray) -> Json:
    return rounded(np.log10(np.where(values > 0.0, values, np.nan)), 2)


def _bounds_m(run: ReportedRun) -> FloatArray:
    covariances = [instant.pose_covariance for instant in run.instants]
    return np.array(
        [
            np.nan
            if covariance is None
            else np.sqrt(CHI_SQUARE_95 * max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))
            for covariance in covariances
        ]
    )


def consistency(run: ReportedRun) -> dict[str, Json]:
    """Return NEES of the pose and NIS, each per degree of freedom, with their 95 % bands."""
    curves = _nis(run)
    anchored = run.anchored_errors()
    if anchored is None:
        return curves
    of_poses, rows = anchored
    known = [index for index, row in enumerate(rows) if _has_covariance(run, int(row))]
    if not known:
        return curves
    covariances = np.array([run.instants[rows[index]].pose_covariance for index in known])
    nees, degrees = normalised_squared_errors(of_poses[known], covariances)
    usable = degrees > 0  # the first pose is exact
    if not usable.any():
        return curves
    return curves | {
        'nees_t': rounded(run.instants_s[rows[known]][usable], 2),
        'nees': rounded(nees[usable] / degrees[usable], 3),
        'nees_band': rounded(np.array(average_nees_band(int(degrees[usable].max()), 1)), 3),
    }


def _has_covariance(run: ReportedRun, row: int) -> bool:
    return run.instants[row].pose_covariance is not None


def _nis(run: ReportedRun) -> dict[str, Json]:
    innovations = run.innovations
    known = np.flatnonzero(innovations.degrees_of_freedom > 0)
    if not len(known):
        return {}
    group = max(MIN_GROUP, -(-len(known) // MAX_GROUPS))
    starts = np.arange(0, len(known), group)
    degrees = np.add.reduceat(innovations.degrees_of_freedom[known], starts)
    nis = np.add.reduceat(innovations.nis[known], starts) / degrees
    middles = np.minimum(starts + group // 2, len(known) - 1)
    bands = np.array([average_nees_band(int(count), 1) for count in degrees])
    return {
        'nis_t': rounded(run.seconds(innovations.update_stamps_ns[known[middles]]), 2),
        'nis': rounded(nis, 3),
        'nis_low': rounded(bands[:, 0], 3),
        'nis_high': rounded(bands[:, 1], 3),
        'nis_group': group,
    }


def calibration(run: ReportedRun) -> list[Json]:
    """Return what was estimated of the velocity's calibration, and its standard deviation."""
    return [_calibration_curve(run, part.name) for part in run.calibration]


def _calibration_curve(run: ReportedRun, name: str) -> dict[str, Json]:
    seconds, parts = run.calibration_over_time(name)
    factor, unit = parts[-1].for_people
    return {
        'name': name,
        'unit': unit,
        'nominal': factor * parts[-1].nominal,
        't': rounded(seconds, 2),
        'value': rounded(factor * np.array([part.value for part in parts]), 5),
        'deviation': rounded(factor * np.array([part.deviation for part in parts]), 5),
    }


def drops(run: ReportedRun) -> list[Json]:
    """Return the messages dropped until each instant, by reason."""
    reasons = sorted({reason for instant in run.instants for reason in instant.dropped})
    return [
        {'reason': reason, 'count': [instant.dropped[reason] for instant in run.instants]}
        for reason in reasons
    ]


Json: TypeAlias = Any
"""What json.dumps takes without NaN."""


def rounded(values: FloatArray, digits: int) -> list[Any]:
    """Return nested lists, rounded, with None for what is not finite."""
    numbers = np.round(np.asarray(values, dtype=np.float64), digits)
    listed = numbers.astype(object)
    listed[~np.isfinite(numbers)] = None
    return list(listed.tolist())
