"""Figures of a replay: its errors, its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.digits import significant
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Innovations
from slam_observer_ros.evaluation.consistency import average_nees_band, NeesOverTime
from slam_observer_ros.evaluation.drawing import (
    BLACK,
    BLUE,
    GREEN,
    is_flat,
    LEGEND_ABOVE,
    ORANGE,
    plain_decades,
    PURPLE,
    RED,
    save,
    STYLE,
)
from slam_observer_ros.evaluation.metrics import ConfigurationError, TrajectoryErrors
from slam_observer_ros.settings.estimator_settings import Settings

_LEAST_NEES = 1e-3
"""Where the error crosses zero the NEES does, too: that is nothing to see."""

_GAP_S = 2.0
"""Errors further apart than this are not joined: nobody knows what was between them."""

_MANY = 5000
"""Points that a vector file has as a picture: as shapes, no viewer would show them at once."""

_RESIDUALS_IN, _BAR_IN = 3.2, 0.24
"""Height of the residuals, and of the bar of a reason, inches."""

_TITLE_IN, _TIMES_IN = 0.3, 0.65
"""Room for a title, and for an axis of times and a legend."""

_LEGEND_PT = 24.0
"""Room between a title and its axes for one line of legend."""

# With points, so that one error alone between two gaps is seen.
_LINE: Any = {'linewidth': 0.9, 'marker': '.', 'markersize': 1.0}


@mpl.rc_context(STYLE)
def plot_errors(
    path: Path,
    errors: TrajectoryErrors,
    nees: NeesOverTime | None = None,
    configuration: ConfigurationError | None = None,
    *,
    is_anchored: bool = True,
    is_smoothed: bool = False,
) -> Path:
    """Draw position and heading errors over time, and whether they are as large as stated.

    The errors are those after the alignment. The NEES and the gauge-free ``configuration`` have
    panels of their own; the NEES is of the errors from the first pose on if it ``is_anchored``.
    """
    panels = {'x [m]': (3, 1.0), 'y [m]': (4, 1.0), 'z [m]': (5, 1.0)}
    if is_flat(errors.truth.positions):
        del panels['z [m]']
    panels['heading [°]'] = (2, np.degrees(1.0))
    start_ns = int(errors.estimate.stamps_ns[0])
    times_s = _seconds_since(start_ns, errors.estimate.stamps_ns)
    rows = len(panels) + (configuration is not None) + (nees is not None)
    figure = Figure(figsize=(7.5, 0.6 + 1.5 * rows))
    stack = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, (column, unit)) in zip(stack, panels.items(), strict=False):
        _draw_errors(axes, times_s, unit * errors.errors[:, column])
        axes.set_ylabel(name)
    if configuration is not None:
        _draw_configuration(stack[len(panels)], start_ns, configuration)
    if nees is not None:
        _draw_nees(stack[-1], start_ns, nees, is_anchored)
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


def _draw_nees(axes: Axes, start_ns: int, nees: NeesOverTime, is_anchored: bool) -> None:
    """Draw the NEES over the band in which it lies where covariances are honest."""
    band: Any = {'color': BLUE, 'alpha': 0.16, 'linewidth': 0.0, 'zorder': 0.5}
    axes.axhspan(*nees.band, **band, label='95 % if the covariance is right')
    times_s = _seconds_since(start_ns, nees.stamps_ns)
    axes.plot(*_broken_at_gaps(times_s, nees.values), color=PURPLE, **_LINE)
    axes.set(yscale='log', ylabel='NEES per d.o.f.')
    axes.set_ylim(bottom=max(axes.get_ylim()[0], _LEAST_NEES))
    plain_decades(axes)
    axes.margins(x=0.01)
    axes.legend(**LEGEND_ABOVE)
    errors = 'error from the first pose on' if is_anchored else 'error after rigid alignment'
    axes.set_title(f'NEES of the pose: {errors}', fontsize=10, fontweight='normal')


@mpl.rc_context(STYLE)
def plot_residuals(
    path: Path,
    innovations: Innovations,
    settings: Settings,
    dropped: Mapping[str, int],
    events: int,
) -> Path:
    """Draw the residuals over time, and how many events were dropped and why.

    They are drawn in standard deviations, in metres where the gains know none. ``dropped`` counts
    by reason; ``events`` are all, dropped ones included.
    """
    are_there = bool(innovations.residuals_m.any())
    heights_in = [_RESIDUALS_IN] * are_there + [_BAR_IN * len(dropped)] * bool(dropped)
    heights_in = heights_in or [_BAR_IN]
    height_in = sum(heights_in) + _TITLE_IN * len(heights_in) + _TIMES_IN * are_there
    figure = Figure(figsize=(9.5, height_in))
    panels = figure.subplots(len(heights_in), squeeze=False, height_ratios=heights_in)[:, 0]
    title = 'Residuals' if dropped else f'Residuals; none of {events} events dropped'
    panels[0].set_title(title, pad=_LEGEND_PT if are_there else None)
    if are_there:
        _draw_residuals(panels[0], innovations, settings)
    elif not dropped:
        centre: Any = {'transform': panels[0].transAxes, 'ha': 'center', 'va': 'center'}
        panels[0].text(0.5, 0.5, 'no residuals', **centre)
        panels[0].set(xticks=[], yticks=[])
    if dropped:
        _draw_dropped(panels[-1], dropped)
        of_all = f'{sum(dropped.values())} of {events} events dropped'
        panels[-1].set_title(of_all if are_there else f'{of_all}; no residuals')
    return save(figure, path)


def _draw_residuals(axes: Axes, innovations: Innovations, settings: Settings) -> None:
    distances, lengths_m = innovations.distances, innovations.residuals_m
    is_scaled = bool(distances.any())
    axes.set(xlabel='time [s]', ylabel='residual [σ]' if is_scaled else 'residual [m]')
    axes.set(yscale='log')
    values = distances if is_scaled else lengths_m
    positive, weights = values > 0.0, innovations.weights
    times_s = _seconds_since(int(innovations.stamps_ns.min()), innovations.stamps_ns)
    for label, kind, style in (
        ('', weights == 1.0, {'marker': '.', 'color': BLUE, 'markersize': 2.5, 'alpha': 0.35}),
        (
            'down-weighted',
            (weights > 0.0) & (weights < 1.0),
            {'marker': '^', 'color': ORANGE, 'markersize': 3.0},
        ),
        ('rejected', weights == 0.0, {'marker': 'x', 'color': RED, 'markersize': 4.0}),
    ):
        shown = kind & positive
        if shown.any():
            named: Any = {'label': f'{np.sum(kind)} {label}'} if label else {}
            marks: Any = {'linestyle': 'none', 'rasterized': np.sum(shown) > _MANY} | style
            axes.plot(times_s[shown], values[shown], **marks, **named)
    median, median_m = float(np.median(values)), float(np.median(lengths_m))
    name = f'median {significant(median_m)} m'
    if is_scaled:
        name = f'median {significant(median)} σ ({significant(median_m)} m)'
        _draw_expected(axes, settings)
    line: Any = {'color': BLACK, 'linestyle': '--', 'linewidth': 1.0}
    axes.axhline(median, **line, label=name)
    axes.margins(x=0.01)
    plain_decades(axes)
    below_title: Any = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 1.0), 'borderaxespad': 0.2}
    axes.legend(**below_title, ncols=5, columnspacing=1.4, handlelength=1.6)


def _draw_expected(axes: Axes, settings: Settings) -> None:
    """Draw where 95 % of the residuals lie if all noise is as stated, and the gate."""
    dimensions = 2 if settings.two_d_mode else 3
    low, high = np.sqrt(dimensions * np.array(average_nees_band(dimensions, 1)))
    band: Any = {'color': BLUE, 'alpha': 0.12, 'linewidth': 0.0, 'zorder': 0.5}
    axes.axhspan(low, high, **band, label='95 % as stated')
    axes.axhline(settings.rejection_threshold, color=RED, linewidth=1.0, label='gate')


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
