"""What errors and innovations of a run show: where they grew, and which noise is too small.

With true poses each axis of the motion is judged by itself; without, the time since landmarks were
last used shows whether motion or points are at fault.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slam_observer_ros.common.errors import significant
from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.estimates import Innovations
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.recordings.trajectory import interpolate, Trajectory
from slam_observer_ros.runs.metrics import TrajectoryErrors
from slam_observer_ros.runs.reported_run import ReportedRun

MAX_GROWTHS = 3
GROWTH_SHARE = 0.25
"""Part of the largest error that a growth must reach to be named."""

NOTABLE_GAP_S = 0.5
"""Time without a used landmark that is named where the error grew."""

MAX_ANEES = 1.5
"""ANEES beyond which the noise that is stated does not fit."""

WINDOW_NS = 5 * NANOSECONDS_PER_SECOND
"""Motions that are compared: long enough that the truth's own noise is small beside theirs."""

MIN_WINDOWS = 20

TOO_LITTLE = 1.5
"""Errors over what is stated, beyond which a noise figure is named."""

LONG_S = 1.0
"""Time without landmarks after which an innovation is mostly due to the motion."""

MIN_DEGREES = 60
"""Degrees of freedom of innovations whose mean says something."""


def of_errors(run: ReportedRun) -> Iterator[Finding]:
    """Judge where the error grew, and which noise explains less than what is seen."""
    yield from _of_growth(run)
    if run.anees is not None and run.anees > MAX_ANEES:
        yield found('overconfident_pose', factor=np.sqrt(run.anees), anees=run.anees)
    if run.errors is not None:
        yield from _of_axes(run)
    yield from _of_gaps(run.innovations)


def growth_windows(seconds: FloatArray, errors_m: FloatArray) -> list[tuple[int, int]]:
    """Return rows (first, last) between which the error rose the most, without overlaps."""
    if len(seconds) < 2:
        return []
    window_s = max(10.0, (seconds[-1] - seconds[0]) / 40.0)
    ends = np.minimum(np.searchsorted(seconds, seconds + window_s), len(seconds) - 1)
    rises = errors_m[ends] - errors_m
    found: list[tuple[int, int]] = []
    for start in np.argsort(-rises).tolist():
        end = int(ends[start])
        if rises[start] < GROWTH_SHARE * errors_m.max() or len(found) == MAX_GROWTHS:
            break
        if all(end <= other_start or start >= other_end for other_start, other_end in found):
            found.append((start, end))
    return [_trimmed(errors_m, start, end) for start, end in found]


def _trimmed(errors_m: FloatArray, start: int, end: int) -> tuple[int, int]:
    """Return the rows of the largest error in a window, and of the least one before it."""
    largest = start + int(np.argmax(errors_m[start : end + 1]))
    return start + int(np.argmin(errors_m[start : largest + 1])), largest


def _of_growth(run: ReportedRun) -> list[Finding]:
    if run.errors is None:
        return []
    seconds = run.seconds(run.errors.estimate.stamps_ns)
    errors_m = np.linalg.norm(run.errors.errors[:, 3:], axis=1)
    return [
        replace(
            found(
                'error_growth',
                before_m=errors_m[start],
                after_m=errors_m[end],
                start_s=seconds[start],
                end_s=seconds[end],
                circumstances=_circumstances(run, run.errors, start, end),
            ),
            start_s=float(seconds[start]),
            end_s=float(seconds[end]),
        )
        for start, end in growth_windows(seconds, errors_m)
    ]


def _circumstances(run: ReportedRun, errors: TrajectoryErrors, start: int, end: int) -> str:
    """Say what was seen, and how the robot moved, from one row of the errors to another."""
    poses = errors.truth.poses[start : end + 1]
    stamps_ns = errors.estimate.stamps_ns[[start, end]]
    innovations = run.innovations
    during = (innovations.stamps_ns >= stamps_ns[0]) & (innovations.stamps_ns <= stamps_ns[1])
    used = int(np.count_nonzero(during & (innovations.weights > 0.0)))
    gated = int(np.count_nonzero(during & (innovations.weights == 0.0)))
    bounds_s = run.seconds(stamps_ns)
    driven_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    turns = so3.log(poses[1:, :3, :3] @ poses[:-1, :3, :3].swapaxes(-1, -2))
    turned_deg = np.degrees(np.linalg.norm(turns, axis=1).sum())
    seen = f'{used} observations of landmarks were used' if used else 'no landmark was used'
    blind = _blind(run, *bounds_s.tolist())
    rejected = f', {gated} rejected' if gated else ''
    return (
        f'{seen}{blind}{rejected}, while the robot drove {driven_m:.1f} m and turned '
        f'by {turned_deg:.0f}°'
    )


def _blind(run: ReportedRun, start_s: float, end_s: float) -> str:
    """Say how long nothing was used at a time, between two times; '' if that is usual."""
    if len(run.gaps_s):
        overlaps_s = np.ptp(np.clip(run.gaps_s, start_s, end_s), axis=1)
        first_s, last_s = run.gaps_s[int(np.argmax(overlaps_s))]
        if overlaps_s.max() >= 0.5 * (end_s - start_s):
            return f' (none for {last_s - first_s:.0f} s, from {first_s:.0f} to {last_s:.0f} s)'
    used_s = run.used_s[(run.used_s > start_s) & (run.used_s < end_s)]
    longest_s = float(np.diff(np.concatenate([[start_s], used_s, [end_s]])).max())
    return f' (none for up to {longest_s:.1f} s)' if longest_s >= NOTABLE_GAP_S else ''


def _of_axes(run: ReportedRun) -> Iterator[Finding]:
    """Judge the noise of each axis of the motion by the true motion."""
    ratios = motion_ratios(run)
    if ratios is None:
        return
    for axis in (2, 3, 4) if run.settings.two_d_mode else range(6):
        ratio = float(ratios[axis])
        if ratio > TOO_LITTLE:
            kind, motion = ('angular', 'turns') if axis < 3 else ('linear', 'ways')
            yield found(
                'axis_noise',
                turn_or_way=kind,
                axis='xyz'[axis % 3],
                ratio=significant(ratio, 2),
                motion=motion,
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


def _of_gaps(innovations: Innovations) -> Iterator[Finding]:
    """Judge the innovations after a time without landmarks, and the others."""
    since_s = np.diff(to_s(innovations.update_stamps_ns), prepend=np.nan)
    of_points = _ratio(innovations, since_s <= LONG_S)
    of_motion = _ratio(innovations, since_s > LONG_S)
    if of_points > TOO_LITTLE:
        yield found('point_noise', ratio=significant(of_points, 2))
    # What points explain is part of all innovations.
    if of_motion > TOO_LITTLE * max(of_points, 1.0):
        yield found('motion_noise', gap_s=LONG_S, ratio=significant(of_motion, 2))


def _ratio(innovations: Innovations, is_chosen: BoolArray) -> float:
    """Return how large innovations are for what is stated; 1 where they are too few."""
    known = is_chosen & (innovations.degrees_of_freedom > 0)
    total = int(innovations.degrees_of_freedom[known].sum())
    if total < MIN_DEGREES:
        return 1.0
    return float(np.sqrt(np.nansum(innovations.nis[known]) / total))
