"""Figures of simulations and replays, as PNG files.

Figures are drawn without pyplot, so importing or calling this module changes neither matplotlib's
backend nor its settings. Colours are those of Okabe and Ito, told apart by colour-blind readers.
"""

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

from slam_observer_ros.evaluation.alignment import align
from slam_observer_ros.evaluation.errors import EvaluationError
from slam_observer_ros.evaluation.metrics import (
    ConfigurationError,
    trajectory_errors,
    TrajectoryErrors,
)
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.events import is_automatic, LandmarkTruth
from slam_observer_ros.geometry import se3
from slam_observer_ros.types import FloatArray, IntArray

BLUE, RED, GREEN, GREY = '#0072B2', '#D55E00', '#009E73', '#7F7F7F'

# The dictionaries are Any: matplotlib's types list the settings of its own version only.
_STYLE: Any = {
    'figure.constrained_layout.use': True,
    'savefig.dpi': 150,
    'font.size': 10,
    'axes.titlesize': 11,
    'axes.titleweight': 'bold',
    'axes.titlelocation': 'left',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.edgecolor': '#555555',
    'axes.axisbelow': True,
    'axes.grid': True,
    'grid.color': '#DDDDDD',
    'grid.linewidth': 0.6,
    'lines.linewidth': 1.4,
    'lines.solid_joinstyle': 'round',
    'legend.frameon': False,
    'legend.fontsize': 9,
    'agg.path.chunksize': 20_000,
}

# The true path is wide and pale, so that an estimate that lies on it hides nothing.
_TRUE_PATH: Any = {'color': '#7FB8DA', 'linestyle': '-', 'linewidth': 3.0, 'label': 'true path'}
_TRUE_END: Any = {'color': BLUE, 'marker': '*', 'markersize': 12, 'linestyle': 'none', 'zorder': 4}
_PATH: Any = {'color': RED, 'linestyle': '-.', 'label': 'estimated path'}
_END: Any = {
    'color': RED, 'marker': 'o', 'markersize': 8, 'markerfacecolor': 'none',
    'markeredgewidth': 1.5, 'linestyle': 'none', 'zorder': 5,
}  # fmt: skip
_TRUE_LANDMARKS: Any = {**_TRUE_END, 'markersize': 10, 'label': 'true landmarks'}
_TRACKS: Any = {'color': GREEN, 'linestyle': '-.', 'linewidth': 1.2, 'label': 'landmark estimates'}
_LANDMARKS: Any = {**_END, 'color': GREEN, 'markersize': 9}
_LEGEND_BELOW: Any = {'loc': 'upper center', 'bbox_to_anchor': (0.5, 0.0), 'ncols': 4}
_LEGEND_ABOVE: Any = {'loc': 'lower right', 'bbox_to_anchor': (1.0, 1.0), 'borderaxespad': 0.2}

_PLANAR_RATIO = 0.01
"""A scene lower than this part of its width is drawn from above."""

_MOST_LABELS = 80
"""Maps with more landmarks than this are drawn without ids, which would cover each other."""


@mpl.rc_context(_STYLE)
def plot_lyapunov(
    path: Path,
    times_s: FloatArray,
    log10_lyapunov: FloatArray,
    slope_per_s: float | None = None,
) -> Path:
    """Draw the Lyapunov function (34) over time, as the paper's Fig. 3.

    Parameters
    ----------
    path : Path
        PNG file to write.
    times_s : FloatArray
        (k,) times, seconds.
    log10_lyapunov : FloatArray
        (k,) decimal logarithm of L; where L is zero, -inf, nothing is drawn.
    slope_per_s : float, optional
        Fitted slope after the transient, drawn beside the curve.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    EvaluationError
        The file can't be written.

    """
    finite = np.isfinite(log10_lyapunov)
    times_s, log10_lyapunov = times_s[finite], log10_lyapunov[finite]
    figure = Figure(figsize=(7.0, 4.2))
    axes = figure.add_subplot()
    axes.plot(times_s, log10_lyapunov, color=BLUE, label=r'$\log_{10}\,\mathcal{L}$')
    if slope_per_s is not None and len(times_s) > 0:
        middle = int(np.argmin(np.abs(log10_lyapunov - log10_lyapunov.mean())))
        line = log10_lyapunov[middle] + slope_per_s * (times_s - times_s[middle])
        label = f'exponential, {slope_per_s:.3f} per second'.replace('-', '\N{MINUS SIGN}')
        shown = line >= log10_lyapunov.min()
        axes.plot(times_s[shown], line[shown] + 1.0, color=GREY, linestyle='--', label=label)
        axes.legend(loc='upper right')
    axes.set(
        title='Lyapunov function of the observer',
        xlabel='time [s]',
        ylabel=r'$\log_{10}\,\mathcal{L}$',
    )
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 4, 5, 10]))
    axes.margins(x=0.01)
    return _save(figure, path)


@mpl.rc_context(_STYLE)
def plot_configuration(
    path: Path,
    estimate: Trajectory,
    truth: Trajectory,
    landmark_tracks: FloatArray,
    true_landmarks: FloatArray,
) -> Path:
    """Draw robot and landmark trajectories after the rigid correction, as the paper's Fig. 4.

    The correction is fitted to the final map and the second half of the path, where the
    transient is over. Flat scenes are drawn from above, others in three dimensions.

    Parameters
    ----------
    path : Path
        PNG file to write.
    estimate, truth : Trajectory
        Poses at the same k stamps, k > 0.
    landmark_tracks : FloatArray
        (k, n, 3) landmark estimates at these stamps in the estimate's world, metres; NaN before
        a landmark is first seen.
    true_landmarks : FloatArray
        (n, 3) true landmarks, metres.

    Returns
    -------
    Path
        ``path``.

    Raises
    ------
    EvaluationError
        The file can't be written.

    """
    settled = slice(len(truth) // 2, None)
    known = np.isfinite(landmark_tracks[-1]).all(axis=-1)
    correction = align(
        np.concatenate([estimate.positions[settled], landmark_tracks[-1, known]]),
        np.concatenate([truth.positions[settled], true_landmarks[known]]),
    )
    estimate = estimate.moved(correction)
    tracks = se3.transform(correction, landmark_tracks[:, known])

    # All tracks are one line with a break after each, so that the legend names them once.
    breaks = np.full((1, tracks.shape[1], 3), np.nan)
    joined = np.concatenate([tracks, breaks]).swapaxes(0, 1).reshape(-1, 3)

    flat = _is_flat(np.concatenate([truth.positions, true_landmarks]))
    figure = Figure(figsize=(7.2, 6.2) if flat else (7.2, 5.2))
    axes: Any = figure.add_subplot() if flat else _space_view(figure)
    for points, style in [
        (truth.positions, _TRUE_PATH),
        (truth.positions[-1:], _TRUE_END),
        (true_landmarks, _TRUE_LANDMARKS),
        (estimate.positions, _PATH),
        (estimate.positions[-1:], _END),
        (joined, _TRACKS),
        (tracks[-1], _LANDMARKS),
    ]:
        axes.plot(*points.T[: 2 if flat else 3], **style)
    axes.set(title='Configuration after the rigid correction', xlabel='x [m]', ylabel='y [m]')
    if flat:
        axes.set_aspect('equal')
        axes.legend(**_LEGEND_BELOW, borderaxespad=4.0)
    else:
        limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        axes.set_box_aspect(np.ptp(limits, axis=1), zoom=1.2)
        axes.legend(**_LEGEND_BELOW)
    return _save(figure, path)


@mpl.rc_context(_STYLE)
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
    else:
        landmark_truth = None
    layers = _map_layers(estimate, world_points, truth, landmark_truth)
    drawn = np.concatenate([points for points, _ in layers])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    margin = 0.06 * float(np.max(high - low)) or 1.0
    low, high = low - margin, high + margin

    upward = [1] if _is_flat(layers[0][0]) else [1, 2]
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
    panels[-1].legend(**_LEGEND_BELOW, borderaxespad=4.0)
    return _save(figure, path)


def _map_layers(
    estimate: Trajectory,
    world_points: FloatArray,
    truth: Trajectory | None,
    landmark_truth: LandmarkTruth | None,
) -> list[tuple[FloatArray, Any]]:
    """List what a map shows, first what lies lowest: points (k, 3) and how they are drawn."""
    layers: list[tuple[FloatArray, Any]] = [
        (estimate.positions, {**_PATH, 'linestyle': '-', 'linewidth': 0.9}),
        (estimate.positions[-1:], _END),
        (world_points, {**_LANDMARKS, 'label': 'estimated landmarks'}),
    ]
    if truth is not None:
        layers[:0] = [(truth.positions, _TRUE_PATH), (truth.positions[-1:], _TRUE_END)]
    if landmark_truth is not None:
        layers.append((landmark_truth.world_points, _TRUE_LANDMARKS))
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
            zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground='white')],
        )


@mpl.rc_context(_STYLE)
def plot_errors(
    path: Path,
    errors: TrajectoryErrors,
    covariances: FloatArray | None = None,
    configuration: ConfigurationError | None = None,
) -> Path:
    """Draw position and heading errors over time, with the band that three sigma allow.

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
    flat = _is_flat(errors.truth.positions)
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
        axes.plot(times_s, unit * errors.errors[:, column], color=RED, linewidth=1.0)
        _centre_on_zero(axes, unit * errors.errors[:, column])
        axes.set_ylabel(name)
        axes.margins(x=0.01)
    if configuration is not None:
        times = _seconds_since(start_ns, np.array(configuration.stamps_ns, dtype=np.int64))
        stack[-1].plot(times, configuration.values_m, color=GREEN, linewidth=1.0)
        stack[-1].set_ylim(bottom=0.0)
        stack[-1].margins(x=0.01)
        stack[-1].set_ylabel('configuration [m]')
    stack[0].set_title('Errors after rigid alignment')
    if deviations is not None:
        stack[0].legend(**_LEGEND_ABOVE)
    stack[-1].set_xlabel('time [s]')
    figure.align_ylabels(stack)
    return _save(figure, path)


def _deviations(covariances: FloatArray, alignment: FloatArray) -> FloatArray:
    """Turn covariances into the truth's axes; return the (k, 6) standard deviations."""
    turn = np.kron(np.eye(2), alignment[:3, :3])
    variances = np.einsum('ij,kjl,il->ki', turn, covariances, turn, optimize=True)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def _draw_band(axes: Axes, times_s: FloatArray, limit: FloatArray) -> None:
    axes.fill_between(
        times_s, -limit, limit, color=BLUE, alpha=0.16, linewidth=0.0, label='±3σ'
    )  # fmt: skip


def _centre_on_zero(axes: Axes, errors: FloatArray) -> None:
    """Keep zero in the middle and the errors visible, even under a very wide band."""
    largest = 1.1 * float(np.abs(errors).max())
    allowed = max(map(abs, axes.get_ylim()))
    limit = max(largest, min(allowed, 4.0 * largest)) or 1.0
    axes.set_ylim(-limit, limit)
    axes.axhline(0.0, color='#555555', linewidth=0.6)


@mpl.rc_context(_STYLE)
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
    return _save(figure, path)


def _draw_residuals(axes: Axes, stamps_ns: IntArray, lengths_m: FloatArray) -> None:
    axes.set(title='Residuals', xlabel='time [s]', ylabel='residual [m]', yscale='log')
    positive = lengths_m > 0.0
    if not positive.any():
        return
    times_s = _seconds_since(int(stamps_ns.min()), stamps_ns)[positive]
    lengths_m = lengths_m[positive]
    axes.plot(times_s, lengths_m, '.', color=BLUE, markersize=2.5, alpha=0.35)
    median = float(np.median(lengths_m))
    axes.axhline(median, color=RED, linestyle='--', label=f'median {median:.3g} m')
    axes.margins(x=0.01)
    axes.legend(**_LEGEND_ABOVE)


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


def _is_flat(points: FloatArray) -> bool:
    width, depth, height = np.ptp(points, axis=0)
    return bool(height <= _PLANAR_RATIO * max(width, depth))


def _seconds_since(start_ns: int, stamps_ns: IntArray) -> FloatArray:
    return (stamps_ns - start_ns) / 1e9


def _space_view(figure: Figure) -> Any:
    # matplotlib's three-dimensional axes carry no types, hence Any.
    axes: Any = figure.add_subplot(projection='3d', elev=32.0, azim=-58.0)
    axes.set_zlabel('z [m]')
    axes.zaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color('white')
    return axes


def _save(figure: Figure, path: Path) -> Path:
    try:
        figure.savefig(path, format='png')
    except OSError as error:
        raise EvaluationError(f"can't write {path}: {error.strerror}") from error
    return path
