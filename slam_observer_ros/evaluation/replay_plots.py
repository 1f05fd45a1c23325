"""Figures of a replay, as PNG files: its errors, its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np

from slam_observer_ros.evaluation.configuration_error import ConfigurationError
from slam_observer_ros.evaluation.drawing import (
    BLUE,
    GREEN,
    is_flat,
    LEGEND_ABOVE,
    RED,
    save,
    STYLE,
)
from slam_observer_ros.evaluation.metrics import TrajectoryErrors
from slam_observer_ros.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.units import to_s

_GAP_S = 2.0
"""Errors further apart than this are not joined: nobody knows what was between them."""

# With points, so that one error alone between two gaps is seen.
_LINE: Any = {'linewidth': 0.9, 'marker': '.', 'markersize': 1.0}


@mpl.rc_context(STYLE)
def plot_errors(
    path: Path,
    errors: TrajectoryErrors,
    covariances: FloatArray | None = None,
    configuration: ConfigurationError | None = None,
) -> Path:
    """Draw position and heading errors over time, with the band that three sigma allow.

    The errors are those after the alignment; the covariances are relative to the first pose, or
    in the frame of a map that was loaded.

    Parameters
    ----------
    path : Path
        PNG file to write.
    errors : TrajectoryErrors
        Errors of k poses after the alignment.
    covariances : FloatArray, optional
        (k, 6, 6) pose covariances in the estimate's world axes: rotation vector, position.
    configuration : ConfigurationError, optional
        Gauge-free error, drawn in a panel of its own.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    EvaluationError
        The file can't be written.

    """
    flat = is_flat(errors.truth.positions)
    panels = {'x [m]': (3, 1.0), 'y [m]': (4, 1.0), 'z [m]': (5, 1.0)}
    if flat:
        del panels['z [m]']
    panels['heading [°]'] = (2, np.degrees(1.0))
    deviations = None if covariances is None else _deviations(covariances, errors.alignment)

    start_ns = int(errors.estimate.stamps_ns[0])
    times_s = _seconds_since(start_ns, errors.estimate.stamps_ns)
    rows = len(panels) + (configuration is not None)
    figure = Figure(figsize=(7.5, 0.6 + 1.7 * rows))
    stack = figure.subplots(rows, 1, sharex=True)
    for axes, (name, (column, unit)) in zip(stack, panels.items(), strict=False):
        if deviations is not None:
            _draw_band(axes, times_s, 3.0 * unit * deviations[:, column])
        axes.plot(*_broken_at_gaps(times_s, unit * errors.errors[:, column]), color=RED, **_LINE)
        _centre_on_zero(axes, unit * errors.errors[:, column])
        axes.set_ylabel(name)
        axes.margins(x=0.01)
    if configuration is not None:
        times = _seconds_since(start_ns, np.array(configuration.stamps_ns, dtype=np.int64))
        values_m = np.array(configuration.values_m)
        stack[-1].plot(*_broken_at_gaps(times, values_m), color=GREEN, **_LINE)
        stack[-1].set_ylim(bottom=0.0)
        stack[-1].margins(x=0.01)
        stack[-1].set_ylabel('configuration [m]')
    stack[0].set_title('Errors after rigid alignment')
    if deviations is not None:
        stack[0].legend(**LEGEND_ABOVE)
    stack[-1].set_xlabel('time [s]')
    figure.align_ylabels(stack)
    return save(figure, path)


def _broken_at_gaps(times_s: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a line with a break wherever there is nothing to draw for long."""
    after = np.flatnonzero(np.diff(times_s) > _GAP_S) + 1
    return np.insert(times_s, after, np.nan), np.insert(errors, after, np.nan)


def _deviations(covariances: FloatArray, alignment: FloatArray) -> FloatArray:
    """Turn covariances into the truth's axes; return the (k, 6) standard deviations."""
    turn = np.kron(np.eye(2), alignment[:3, :3])
    variances = np.einsum('ij,kjl,il->ki', turn, covariances, turn, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _draw_band(axes: Axes, times_s: FloatArray, limit: FloatArray) -> None:
    axes.fill_between(
        times_s, -limit, limit, color=BLUE, alpha=0.16, linewidth=0.0, label='±3σ before alignment'
    )  # fmt: skip


def _centre_on_zero(axes: Axes, errors: FloatArray) -> None:
    """Keep zero in the middle and the errors visible, even under a very wide band."""
    largest = 1.1 * float(np.abs(errors).max())
    allowed = max(map(abs, axes.get_ylim()))
    limit = max(largest, min(allowed, 4.0 * largest)) or 1.0
    axes.set_ylim(-limit, limit)
    axes.axhline(0.0, color='#555555', linewidth=0.6)


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

    Parameters
    ----------
    path : Path
        PNG file to write.
    stamps_ns : IntArray
        (m,) stamp of each residual, nanoseconds.
    residuals : FloatArray
        (m, 3) residuals r_i of the landmarks seen, metres.
    rejected : BoolArray
        (m,) which of them were too large to be used.
    dropped : mapping of str to int
        Dropped events by reason.
    events : int
        All events, dropped ones included.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    EvaluationError
        The file can't be written.

    """
    figure = Figure(figsize=(9.5, 4.0))
    lengths_m = np.linalg.norm(residuals, axis=-1)
    if dropped:
        left, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
        _draw_residuals(left, stamps_ns, lengths_m, rejected)
        _draw_dropped(right, dropped, events)
    else:
        axes = figure.add_subplot()
        _draw_residuals(axes, stamps_ns, lengths_m, rejected)
        axes.set_title(f'Residuals; none of {events} events dropped')
    return save(figure, path)


def _draw_residuals(
    axes: Axes, stamps_ns: IntArray, lengths_m: FloatArray, rejected: BoolArray
) -> None:
    axes.set(title='Residuals', xlabel='time [s]', ylabel='residual [m]')
    positive = lengths_m > 0.0
    if not positive.any():
        axes.text(0.5, 0.5, 'no residuals', transform=axes.transAxes, ha='center', va='center')
        axes.set(xticks=[], yticks=[])
        return
    axes.set_yscale('log')
    times_s = _seconds_since(int(stamps_ns.min()), stamps_ns)[positive]
    lengths_m, rejected = lengths_m[positive], rejected[positive]
    used_s, used_m = times_s[~rejected], lengths_m[~rejected]
    axes.plot(used_s, used_m, '.', color=BLUE, markersize=2.5, alpha=0.35)
    if rejected.any():
        cross: Any = {'color': RED, 'markersize': 4.0, 'label': f'{np.sum(rejected)} rejected'}
        axes.plot(times_s[rejected], lengths_m[rejected], 'x', **cross)
    median = float(np.median(lengths_m))
    axes.axhline(median, color='#333333', linestyle='--', label=f'median {median:.3g} m')
    axes.margins(x=0.01)
    axes.legend(**LEGEND_ABOVE)


def _draw_dropped(axes: Axes, dropped: Mapping[str, int], events: int) -> None:
    reasons = sorted(dropped, key=lambda reason: dropped[reason])
    bars = axes.barh(
        [reason.replace('_', ' ') for reason in reasons],
        [dropped[reason] for reason in reasons],
        color=BLUE,
        height=0.6,
    )
    axes.bar_label(bars, padding=3, fontsize=9)
    axes.margins(x=0.2)
    axes.grid(visible=False, axis='y')
    axes.set_title('Dropped events')
    axes.set_xlabel(f'{sum(dropped.values())} of {events} events')
    axes.xaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))


def _seconds_since(start_ns: int, stamps_ns: IntArray) -> FloatArray:
    return to_s(stamps_ns - start_ns)
