"""Which noise figures explain less than what is seen.

With true poses each axis of the motion is judged by itself; without, the time since landmarks were
last used shows whether motion or points are at fault.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from slam_observer_ros.common.digits import significant
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND, to_s
from slam_observer_ros.evaluation.run_record import Innovations
from slam_observer_ros.evaluation.trajectory import interpolate, Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.report.reported_run import ReportedRun

WINDOW_NS = 5 * NANOSECONDS_PER_SECOND
"""Motions that are compared: long enough that the truth's own noise is small beside theirs."""

MIN_WINDOWS = 20

TOO_LITTLE = 1.5
"""Errors over what is stated, beyond which a noise figure is named."""

LONG_S = 1.0
"""Time without landmarks after which an innovation is mostly that of the motion."""

MIN_DEGREES = 60
"""Degrees of freedom of innovations whose mean says something."""


def noise_advice(run: ReportedRun) -> Iterator[str]:
    """Yield what to change, a sentence for each noise figure."""
    if run.errors is not None:
        yield from _axes(run)
    yield from _gaps(run.innovations)


def _axes(run: ReportedRun) -> Iterator[str]:
    ratios = motion_ratios(run)
    if ratios is None:
        return
    for axis in (2, 3, 4) if run.settings.two_d_mode else range(6):
        ratio = float(ratios[axis])
        if ratio > TOO_LITTLE:
            kind, motion = ('angular', 'turns') if axis < 3 else ('linear', 'ways')
            yield (
                f'{kind}_velocity_noise and {kind}_scale_noise of {"xyz"[axis % 3]} explain '
                f'{significant(ratio, 2)} × less than what is seen of measured {motion} against '
                'the truth: state more (Tune the noise).'
            )


def motion_ratios(run: ReportedRun) -> FloatArray | None:
    """Return how large the errors of the motion are for what is stated: (6,), angular first.

    Of each axis, over windows of 5 s, less a constant scale and bias. None if there are too few.
    """
    true, measured = _motions(run)
    if len(true) < MIN_WINDOWS:
        return None
    window_s = to_s(WINDOW_NS)
    errors = se3.log(se3.inverse(true) @ measured)
    motions = se3.log(true)
    left = np.array([_without_calibration(motions[:, axis], errors[:, axis]) for axis in range(6)])
    s = run.settings
    density = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
    scale = np.array([*s.angular_scale_noise, *s.linear_scale_noise])
    stated = density**2 * window_s + (scale * motions) ** 2 / window_s
    # A turn within a window moves its end sideways: half-way on average.
    way_squared = np.sum(motions[:, 3:] ** 2, axis=1, keepdims=True)
    stated[:, 3:] += way_squared / 3.0 * stated[:, :3].sum(axis=1, keepdims=True)
    means = stated.mean(axis=0)
    return np.asarray(np.sqrt(np.mean(left.T**2, axis=0) / np.where(means > 0.0, means, np.inf)))


def _motions(run: ReportedRun) -> tuple[FloatArray, FloatArray]:
    """Return true and measured motions (w, 4, 4) of windows that both cover."""
    truth = Trajectory(run.truth.stamps_ns, run.truth.poses)
    delay_s = next((p.value for p in run.calibration if p.name == 'velocity_delay'), 0.0)
    first, last = run.dead_reckoning.stamps_ns[[0, -1]].tolist()
    edges_ns = np.arange(first, last, WINDOW_NS, dtype=np.int64)
    true, is_true = interpolate(truth, edges_ns)
    delay_ns = round(delay_s * NANOSECONDS_PER_SECOND)
    measured, is_measured = interpolate(run.dead_reckoning, edges_ns - delay_ns)
    both = is_true & is_measured
    usable = both[1:] & both[:-1]
    return (
        (se3.inverse(true[:-1]) @ true[1:])[usable],
        (se3.inverse(measured[:-1]) @ measured[1:])[usable],
    )


def _without_calibration(motions: FloatArray, errors: FloatArray) -> FloatArray:
    """Return errors (w,) less what a constant scale and a bias explain of them."""
    design = np.column_stack([motions, np.ones(len(motions))])
    fit, *_ = np.linalg.lstsq(design, errors, rcond=None)
    left: FloatArray = errors - design @ fit
    return left


def _gaps(innovations: Innovations) -> Iterator[str]:
    """Judge the innovations after a time without landmarks, and the others."""
    since_s = np.diff(to_s(innovations.update_stamps_ns), prepend=np.nan)
    of_points = _ratio(innovations, since_s <= LONG_S)
    of_motion = _ratio(innovations, since_s > LONG_S)
    if of_points > TOO_LITTLE:
        yield (
            f'While landmarks are seen the noise explains {significant(of_points, 2)} × less than '
            'what is seen: state more noise of the points (Tune the noise).'
        )
    # What points explain is part of all innovations.
    if of_motion > TOO_LITTLE * max(of_points, 1.0):
        yield (
            f'After {LONG_S:g} s without landmarks the noise explains '
            f'{significant(of_motion, 2)} × less than what is seen: state more noise of the '
            'velocity (Tune the noise).'
        )


def _ratio(innovations: Innovations, is_chosen: BoolArray) -> float:
    """Return how large innovations are for what is stated; 1 where they are too few."""
    known = is_chosen & (innovations.degrees_of_freedom > 0)
    total = int(innovations.degrees_of_freedom[known].sum())
    if total < MIN_DEGREES:
        return 1.0
    return float(np.sqrt(np.nansum(innovations.nis[known]) / total))
