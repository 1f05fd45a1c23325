"""What a run shows, in words: where its error grew and what happened there, and what to change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import calibration_problems, MAX_REJECTED
from slam_observer_ros.evaluation.metrics import TrajectoryErrors
from slam_observer_ros.geometry import so3
from slam_observer_ros.report.noise_advice import noise_advice
from slam_observer_ros.report.reported_run import ReportedRun

MAX_GROWTHS = 3
GROWTH_SHARE = 0.25
"""Part of the largest error that a growth must reach to be named."""

NOTABLE_GAP_S = 0.5
"""Time without a used landmark that is named where the error grew."""

TOO_CONFIDENT = 1.5
"""NIS or NEES per degree of freedom beyond which the noise that is stated does not fit."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence, and the time that it is about, seconds; None if that is the whole run."""

    text: str
    start_s: float | None = None
    end_s: float | None = None


def findings(run: ReportedRun) -> list[Finding]:
    """Return what is worth knowing of a run, the most important first."""
    advice = [Finding(text) for text in noise_advice(run)]
    unused = [Finding(run.nothing_used)] if run.nothing_used else []
    return [*unused, *_growths(run), *_consistency(run), *advice, *_calibration(run)]


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


def _growths(run: ReportedRun) -> list[Finding]:
    if run.errors is None:
        return []
    seconds = run.seconds(run.errors.estimate.stamps_ns)
    errors_m = np.linalg.norm(run.errors.errors[:, 3:], axis=1)
    return [
        Finding(
            f'The position error grew from {errors_m[start]:.2g} to {errors_m[end]:.2g} m at '
            f'{seconds[start]:.0f} to {seconds[end]:.0f} s: '
            f'{_circumstances(run, run.errors, start, end)}.',
            float(seconds[start]),
            float(seconds[end]),
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


def _consistency(run: ReportedRun) -> list[Finding]:
    found = []
    nis = run.innovations.mean_nis
    if nis is not None and nis > TOO_CONFIDENT:
        found.append(
            Finding(
                f'Innovations are {np.sqrt(nis):.1f} × as large as the noise that is stated '
                'explains: state more noise of the points or of the velocity (Tune the noise).'
            )
        )
    if run.anees is not None and run.anees > TOO_CONFIDENT:
        found.append(
            Finding(
                f'The errors of the pose are {np.sqrt(run.anees):.1f} × as large as its '
                f'covariance states (ANEES {run.anees:.1f}): state more noise (Tune the noise).'
            )
        )
    weights = run.innovations.weights
    rejected = float(np.mean(weights == 0.0)) if len(weights) else 0.0
    if rejected > MAX_REJECTED:
        found.append(
            Finding(
                f'{100.0 * rejected:.0f} % of what was seen of known landmarks was rejected, '
                'which is more than outliers: are ids, frames and noise right?'
            )
        )
    return found


def _calibration(run: ReportedRun) -> list[Finding]:
    advice = [part.advice for part in run.calibration if part.advice]
    return [Finding(text) for text in [*calibration_problems(run.calibration), *advice]]
