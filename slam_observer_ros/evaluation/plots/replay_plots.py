"""Figures of a replay: its errors, its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.common.units import to_s
from slam_observer_ros.evaluation.configuration_error import ConfigurationError
from slam_observer_ros.evaluation.metrics import TrajectoryErrors
from slam_observer_ros.evaluation.plots.drawing import (
    BLUE,
    GREEN,
    is_flat,
    LEGEND_ABOVE,
    RED,
    save,
    STYLE,
)

_MAX_BAND = 2.0
"""A panel shows the band as far as this times the largest error: else nobody sees the errors."""

_GAP_S = 2.0
"""Errors further apart than this are not joined: nobody knows what was between them."""

_RESIDUALS_IN, _BAR_IN = 3.2, 0.24
"""Height of the residuals, and of the bar of a reason, inches."""

_TITLE_IN, _TIMES_IN = 0.3, 0.45
"""Room for a title, and for an axis of times."""

# With points, so that one error alone between two gaps is seen.
_LINE: Any = {'linewidth': 0.9, 'marker': '.', 'markersize': 1.0}


@mpl.rc_context(STYLE)
def plot_errors(
    path: Path,
    errors: TrajectoryErrors,
    covariances: FloatArray | None = None,
    configuration: ConfigurationError | None = None,
    *,
    in_known_map: bool = False,
    is_smoothed: bool = False,
) -> Path:
    """Draw position and heading errors over time, with the band that three sigma allow.

    The errors are those of k poses after the alignment. The pose covariances (k, 6, 6) are in the
    estimate's world axes, rotation vector before position, and relative to the first pose, or
    ``in_known_map`` those in its frame. The gauge-free ``configuration`` has a panel of its own.
    """
    panels = {'x [m]': (3, 1.0), 'y [m]': (4, 1.0), 'z [m]': (5, 1.0)}
    if is_flat(errors.truth.positions):
        del panels['z [m]']
    panels['heading [°]'] = (2, np.degrees(1.0))
    start_ns = int(errors.estimate.stamps_ns[0])
    times_s = _seconds_since(start_ns, errors.estimate.stamps_ns)
    rows = len(panels) + (configuration is not None)
    figure = Figure(figsize=(7.5, 0.6 + 1.7 * rows))
    stack = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    limits = None if covariances is None else 3.0 * _deviations(covariances, errors.alignment)
    for axes, (name, (column, unit)) in zip(stack, panels.items(), strict=False):
        _draw_errors(axes, times_s, unit * errors.errors[:, column])
        axes.set_ylabel(name)
        if limits is not None:
            _draw_band(axes, times_s, unit * limits[:, column], in_known_map)
    if configuration is not None:
        _draw_configuration(stack[-1], start_ns, configuration)
    if limits is not None:
        stack[0].legend(**LEGEND_ABOVE)
    whose = ' of the smoothed trajectory' if is_smoothed else ''
    stack[0].set_title(f'Errors{whose} after rigid alignment')
    stack[-1].set_xlabel('time [s]')
    figure.align_ylabels(stack)
    return save(figure, path)


def _draw_errors(axes: Axes, times_s: FloatArray, errors: FloatArray) -> None:
    """Draw errors with zero in the middle."""
    axes.axhline(0.0, color='#555555', linewidth=0.6)
    axes.plot(*_broken_at_gaps(times_s, errors), color=RED, **_LINE)
    limit = 1.1 * float(np.abs(errors).max()) or 1.0
    axes.set_ylim(-limit, limit)
    axes.margins(x=0.01)


def _draw_configuration(axes: Axes, start_ns: int, configuration: ConfigurationError) -> None:
    times_s = _seconds_since(start_ns, np.array(configuration.stamps_ns, dtype=np.int64))
    line = _broken_at_gaps(times_s, np.array(configuration.values_m))
    axes.plot(*line, color=GREEN, **_LINE)
    axes.set_ylim(bottom=0.0)
    axes.margins(x=0.01)
    axes.set_ylabel('configuration [m]')


def _broken_at_gaps(times_s: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a line with a break wherever there is nothing to draw for long."""
    after = np.flatnonzero(np.diff(times_s) > _GAP_S) + 1
    return np.insert(times_s, after, np.nan), np.insert(errors, after, np.nan)


def _deviations(covariances: FloatArray, alignment: FloatArray) -> FloatArray:
    """Turn covariances into the truth's axes; return the (k, 6) standard deviations."""
    turn = np.kron(np.eye(2), alignment[:3, :3])
    variances = np.einsum('ij,kjl,il->ki', turn, covariances, turn, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _draw_band(axes: Axes, times_s: FloatArray, limit: FloatArray, in_known_map: bool) -> None:
    """Draw a band behind errors; a wide one runs off the panel, so that they stay visible."""
    relation = 'in the frame of the map' if in_known_map else 'relative to the first pose'
    shown = axes.get_ylim()[1]
    shown = max(shown, min(1.1 * float(limit.max()), _MAX_BAND * shown))
    label = f'±3σ {relation}, not aligned'
    axes.fill_between(
        times_s, -limit, limit, color=BLUE, alpha=0.16, linewidth=0.0, label=label, zorder=0.5
    )
    axes.set_ylim(-shown, shown)


@mpl.rc_context(STYLE)
def plot_residuals(
    path: Path,
    stamps_ns: IntArray,
    residuals: FloatArray,
    rejected: BoolArray,
    dropped: Mapping[str, int],
    events: int,
) -> Path:
    """Draw the residuals' lengths over time, and how many events were dropped and why.

    ``residuals`` (m, 3) are r_i of the landmarks seen, metres; ``rejected`` (m,) are those too
    large to be used. ``dropped`` counts by reason; ``events`` are all, dropped ones included.
    """
    lengths_m = np.linalg.norm(residuals, axis=-1)
    are_there = bool(lengths_m.any())
    heights_in = [_RESIDUALS_IN] * are_there + [_BAR_IN * len(dropped)] * bool(dropped)
    heights_in = heights_in or [_BAR_IN]
    height_in = sum(heights_in) + _TITLE_IN * len(heights_in) + _TIMES_IN * are_there
    figure = Figure(figsize=(9.5, height_in))
    panels = figure.subplots(len(heights_in), squeeze=False, height_ratios=heights_in)[:, 0]
    panels[0].set_title('Residuals' if dropped else f'Residuals; none of {events} events dropped')
    if are_there:
        _draw_residuals(panels[0], stamps_ns, lengths_m, rejected)
    elif not dropped:
        centre: Any = {'transform': panels[0].transAxes, 'ha': 'center', 'va': 'center'}
        panels[0].text(0.5, 0.5, 'no residuals', **centre)
        panels[0].set(xticks=[], yticks=[])
    if dropped:
        _draw_dropped(panels[-1], dropped)
        of_all = f'{sum(dropped.values())} of {events} events dropped'
        panels[-1].set_title(of_all if are_there else f'{of_all}; no residuals')
    return save(figure, path)


def _draw_residuals(
    axes: Axes, stamps_ns: IntArray, lengths_m: FloatArray, rejected: BoolArray
) -> None:
    axes.set(xlabel='time [s]', ylabel='residual [m]', yscale='log')
    positive = lengths_m > 0.0
    times_s = _seconds_since(int(stamps_ns.min()), stamps_ns)[positive]
    lengths_m, rejected = lengths_m[positive], rejected[positive]
    used_s, used_m = times_s[~rejected], lengths_m[~rejected]
    axes.plot(used_s, used_m, '.', color=BLUE, markersize=2.5, alpha=0.35)
    if rejected.any():
        label = f'{np.sum(rejected)} rejected by the gate'
        cross: Any = {'color': RED, 'markersize': 4.0, 'label': label}
        axes.plot(times_s[rejected], lengths_m[rejected], 'x', **cross)
    median = float(np.median(lengths_m))
    axes.axhline(median, color='#333333', linestyle='--', label=f'median {median:.3g} m')
    axes.margins(x=0.01)
    axes.legend(**LEGEND_ABOVE, ncols=2)


def _draw_dropped(axes: Axes, dropped: Mapping[str, int]) -> None:
    reasons = sorted(dropped, key=lambda reason: dropped[reason])
    counts = [dropped[reason] for reason in reasons]
    bars = axes.barh(reasons, counts, color=BLUE, height=0.6)
    names = [f'{dropped[reason]} {reason.replace("_", " ")}' for reason in reasons]
    axes.bar_label(bars, names, padding=3, fontsize=9)
    axes.set(xlim=(0.0, 2.0 * max(counts)), ylim=(-0.5, len(counts) - 0.5))  # room for names
    axes.set(xticks=[], yticks=[])
    axes.spines['bottom'].set_visible(False)


def _seconds_since(start_ns: int, stamps_ns: IntArray) -> FloatArray:
    return to_s(stamps_ns - start_ns)
