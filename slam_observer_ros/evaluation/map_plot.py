"""Figure of a replay, as a PNG file: its path and its map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
import numpy as np

from slam_observer_ros.evaluation.drawing import (
    END,
    is_flat,
    LANDMARKS,
    PATH,
    save,
    STYLE,
    TRUE_END,
    TRUE_LANDMARKS,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.metrics import trajectory_errors
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.events import is_automatic
from slam_observer_ros.geometry import se3
from slam_observer_ros.truth import LandmarkTruth
from slam_observer_ros.types import FloatArray, IntArray

_MAX_LABELS = 80
"""Maps with more landmarks than this are drawn without ids, which would cover each other."""

_LABEL_RIGHT_PT, _LABEL_UP_PT = 8.0, 12.0
"""From the middle of a marker to its label's side, however long that is, and to its middle."""

_PANELS_IN = 6.3
"""Largest width and height of what is drawn, inches."""

_LABELS_IN, _LEGEND_IN = 0.7, 0.9
"""Room for the labels of an axis, and for the title and two lines of legend."""

_NEAR = 0.03
"""Markers nearer than this share of the map touch: of several it matters where their middle is."""


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

    views = [(0, 1)] if is_flat(layers[0][0]) else [(0, 1), _side_view(high - low)]
    figure, panels = _panels(views, high - low)
    for axes, (across, up) in zip(panels, views, strict=True):
        for points, style in layers:
            axes.plot(points[:, across], points[:, up], **style)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect='equal')
        axes.set(xlabel=f'{"xyz"[across]} [m]', ylabel=f'{"xyz"[up]} [m]')
    named = ~is_automatic(ids)
    if np.sum(named) <= _MAX_LABELS:
        _label_landmarks(panels[0], ids[named], world_points[named], landmark_truth)
    aligned = '' if truth is None else ' after rigid alignment'
    figure.suptitle(f'Trajectory and map{aligned}', fontsize=11, fontweight='bold')
    figure.align_ylabels(panels)
    figure.legend(*panels[-1].get_legend_handles_labels(), loc='outside lower center', ncols=3)
    return save(figure, path)


def _side_view(spans_m: FloatArray) -> tuple[int, int]:
    """Return the axes, across and up, of a view from the side that shows the longer one."""
    return (1, 2) if spans_m[1] > spans_m[0] else (0, 2)


def _panels(views: list[tuple[int, int]], spans_m: FloatArray) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each view, all at one scale.

    One below the other if they share the axis across; else side by side.
    """
    widths_m, heights_m = (spans_m[list(axis)] for axis in zip(*views, strict=True))
    side_by_side = len({across for across, _ in views}) > 1
    if side_by_side:
        width_m, height_m = widths_m.sum(), heights_m.max()
        layout: dict[str, Any] = {'ncols': len(views), 'width_ratios': widths_m}
    else:
        width_m, height_m = widths_m[0], heights_m.sum()
        layout = {'nrows': len(views), 'height_ratios': heights_m}
    in_per_m = min(_PANELS_IN / width_m, _PANELS_IN / height_m)
    width_in = in_per_m * width_m + _LABELS_IN * layout.get('ncols', 1)
    height_in = in_per_m * height_m + _LABELS_IN * layout.get('nrows', 1) + _LEGEND_IN
    figure = Figure(figsize=(max(width_in, 5.0), height_in))
    return figure, figure.subplots(squeeze=False, **layout).ravel().tolist()


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
        (world_points, LANDMARKS),
    ]
    if truth is not None:
        layers[:0] = [(truth.positions, TRUE_PATH), (truth.positions[-1:], TRUE_END)]
    if landmark_truth is not None:
        layers.append((landmark_truth.world_points, TRUE_LANDMARKS))
    return layers


def _label_landmarks(
    axes: Axes, ids: IntArray, world_points: FloatArray, landmark_truth: LandmarkTruth | None
) -> None:
    """Write each id beside its estimate, on the side away from what else is drawn near it."""
    true_points = [] if landmark_truth is None else [landmark_truth.world_points]
    markers = np.concatenate([world_points, *true_points])[:, :2]
    for landmark_id, point in zip(ids.tolist(), world_points, strict=True):
        right, up = _away(point[:2], markers)
        side = 'left' if right > 0.0 else 'right'
        axes.annotate(
            str(landmark_id),
            (point[0], point[1]),
            xytext=(_LABEL_RIGHT_PT * right, _LABEL_UP_PT * up),
            textcoords='offset points',
            horizontalalignment=side if abs(right) > abs(up) else 'center',
            verticalalignment='center',
            fontsize=8,
            color='#004D38',
            zorder=3,  # above paths, below markers, which the halo would erase
            path_effects=[withStroke(linewidth=2.5, foreground='white')],
        )


def _away(point: FloatArray, markers: FloatArray) -> FloatArray:
    """Return the direction (2,) that leads away from markers (m, 2), the nearest above all."""
    apart = point - markers
    near_m = _NEAR * float(np.ptp(markers, axis=0).max()) or 1.0  # else a single one
    push = (apart / (np.sum(apart**2, axis=1, keepdims=True) + near_m**2)).sum(axis=0)
    length = float(np.linalg.norm(push))
    return push / length if length > 0.0 else np.array([1.0, 0.0])
