"""Figures of a replay, as PNG files: its map, its errors, its residuals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
import numpy as np

from slam_observer_ros.evaluation.configuration_error import ConfigurationError
from slam_observer_ros.evaluation.drawing import (
    BLUE,
    END,
    GREEN,
    is_flat,
    LANDMARKS,
    LEGEND_ABOVE,
    LEGEND_BELOW,
    PATH,
    RED,
    save,
    STYLE,
    TRUE_END,
    TRUE_LANDMARKS,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.metrics import trajectory_errors, TrajectoryErrors
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.events import is_automatic, LandmarkTruth
from slam_observer_ros.geometry import se3
from slam_observer_ros.types import FloatArray, IntArray

_MOST_LABELS = 80
"""Maps with more landmarks than this are drawn without ids, which would cover each other."""

_GAP_S = 2.0
"""Errors further apart than this are not joined: nobody knows what was between them."""

# With points, so that one error alone between two gaps is seen.
_LINE: Any = {'linewidth': 0.9, 'marker': '.', 'markersize': 1.0}


@mpl.rc_context(STYLE)
def plot_map(
    path: Path,
    estimate: Trajectory,
    ids: IntArray,
    world_points: FloatArray,
    truth: Trajectory | None = None,
    landmark_truth: LandmarkTruth | None = None,
) -> Path:
    """Draw a replay's path and map over the truth, from above and, unless flat, from the side.

    With a true path the estimate is moved by the alignment of :func:`trajectory_errors`.

    Parameters
    ----------
    path : Path
        PNG file to write.
    estimate : Trajectory
        Estimated poses.
    ids : IntArray
        (n,) landmarks in the final map.
    world_points : FloatArray
        (n, 3) their estimated positions, metres.
    truth : Trajectory, optional
        True poses.
    landmark_truth : LandmarkTruth, optional
        True landmarks in the world of ``truth``; drawn only together with it.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    EvaluationError
        The file can't be written, or the truth covers no pose of the estimate.

    """
    if truth is not None:
        alignment = trajectory_errors(estimate, truth).alignment
        estimate, world_points = estimate.moved(alignment), se3.transform(alignment, world_points)
        # Else paths that are long the same seem to end at different places.
        truth = truth.during(estimate)
    else:
        landmark_truth = None
    layers = _map_layers(estimate, world_points, truth, landmark_truth)
    drawn = np.concatenate([points for points, _ in layers])
    drawn = drawn if len(drawn) else np.zeros((1, 3))
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    margin = 0.06 * float(np.max(high - low)) or 1.0
    low, high = low - margin, high + margin

    upward = [1] if is_flat(layers[0][0]) else [1, 2]
    spans = (high - low)[upward]
    height = float(np.clip(1.5 + 6.3 * spans.sum() / (high - low)[0], 4.0, 9.0))
    figure = Figure(figsize=(7.2, height))
    panels = figure.subplots(len(upward), 1, squeeze=False, height_ratios=spans)[:, 0]
    for axes, up in zip(panels, upward, strict=True):
        for points, style in layers:
            axes.plot(points[:, 0], points[:, up], **style)
        axes.set(xlim=(low[0], high[0]), ylim=(low[up], high[up]), aspect='equal')
        axes.set_ylabel(f'{"xyz"[up]} [m]')
    named = ~is_automatic(ids)
    if np.sum(named) <= _MOST_LABELS:
        _label_landmarks(panels[0], ids[named], world_points[named], landmark_truth)
    aligned = '' if truth is None else ' after rigid alignment'
    panels[0].set_title(f'Trajectory and map{aligned}')
    panels[-1].set_xlabel('x [m]')
    figure.align_ylabels(panels)
    figure.legend(*panels[-1].get_legend_handles_labels(), **LEGEND_BELOW)
    return save(figure, path)


def _map_layers(
    estimate: Trajectory,
    world_points: FloatArray,
    truth: Trajectory | None,
    landmark_truth: LandmarkTruth | None,
) -> list[tuple[FloatArray, Any]]:
    """List what a map shows, first what lies lowest: points (k, 3) and how they are drawn."""
    layers: list[tuple[FloatArray, Any]] = [
        (estimate.positions, {**PATH, 'linestyle': '-', 'linewidth': 0.9}),
        (estimate.positions[-1:], END),
        (world_points, {**LANDMARKS, 'label': 'estimated landmarks'}),
    ]
    if truth is not None:
        layers[:0] = [(truth.positions, TRUE_PATH), (truth.positions[-1:], TRUE_END)]
    if landmark_truth is not None:
        layers.append((landmark_truth.world_points, TRUE_LANDMARKS))
    return layers


def _label_landmarks(
    axes: Axes, ids: IntArray, world_points: FloatArray, landmark_truth: LandmarkTruth | None
) -> None:
    """Write each id beside its estimate, on the side away from the true landmark."""
    away = np.ones((len(ids), 2))
    if landmark_truth is not None:
        _, rows, true_rows = np.intersect1d(ids, landmark_truth.ids, return_indices=True)
        errors = world_points[rows] - landmark_truth.world_points[true_rows]
        away[rows] = np.where(errors[:, :2] < 0.0, -1.0, 1.0)
    for landmark_id, point, (right, up) in zip(ids.tolist(), world_points, away, strict=True):
        axes.annotate(
            str(landmark_id),
            (point[0], point[1]),
            xytext=(5.0 * right, 4.0 * up),
            textcoords='offset points',
            horizontalalignment='left' if right > 0 else 'right',
            verticalalignment='bottom' if up > 0 else 'top',
            fontsize=8,
            color='#004D38',
            zorder=3,  # above paths, below markers, which the halo would erase
            path_effects=[withStroke(linewidth=2.5, foreground='white')],
        )


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
        _draw_residuals(left, stamps_ns, lengths_m)
        _draw_dropped(right, dropped, events)
    else:
        axes = figure.add_subplot()
        _draw_residuals(axes, stamps_ns, lengths_m)
        axes.set_title(f'Residuals; none of {events} events dropped')
    return save(figure, path)


def _draw_residuals(axes: Axes, stamps_ns: IntArray, lengths_m: FloatArray) -> None:
    axes.set(title='Residuals', xlabel='time [s]', ylabel='residual [m]')
    positive = lengths_m > 0.0
    if not positive.any():
        axes.text(0.5, 0.5, 'no residuals', transform=axes.transAxes, ha='center', va='center')
        axes.set(xticks=[], yticks=[])
        return
    axes.set_yscale('log')
    times_s = _seconds_since(int(stamps_ns.min()), stamps_ns)[positive]
    lengths_m = lengths_m[positive]
    axes.plot(times_s, lengths_m, '.', color=BLUE, markersize=2.5, alpha=0.35)
    median = float(np.median(lengths_m))
    axes.axhline(median, color=RED, linestyle='--', label=f'median {median:.3g} m')
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
    return (stamps_ns - start_ns) / 1e9
