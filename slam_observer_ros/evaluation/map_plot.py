"""Figure of a replay: its path and its map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.evaluation.consistency import CHI_SQUARE_95, outlines
from slam_observer_ros.evaluation.drawing import (
    BLACK,
    ELLIPSES,
    END,
    GREEN,
    is_flat,
    label_points,
    LANDMARKS,
    legend_below,
    LINKS,
    ORANGE,
    PATH,
    RED,
    save,
    START,
    STYLE,
    TRUE_END,
    TRUE_LANDMARKS,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.metrics import trajectory_errors
from slam_observer_ros.evaluation.trajectory import LandmarkTruth, Trajectory
from slam_observer_ros.geometry import se3

_MAX_LABELS = 300
"""Of more landmarks than this few ids would find room, and it would take long to look for it."""

_MAX_SPREAD = 0.25
"""Part of the map's width that is added at each side for ellipses, at most."""

_PANELS_IN = 6.3
"""Largest width and height of what is drawn, inches."""

_LABELS_IN, _LEGEND_IN = 0.7, 0.9
"""Room for the labels of an axis, and for the title and two lines of legend."""

_Layer: TypeAlias = tuple[FloatArray, dict[str, Any]]
"""Points (k, 3) and how they are drawn."""


@mpl.rc_context(STYLE)
def plot_map(
    path: Path,
    estimate: Trajectory,
    ids: IntArray,
    world_points: FloatArray,
    truth: Trajectory | None = None,
    landmark_truth: LandmarkTruth | None = None,
    *,
    covariances: FloatArray | None = None,
    is_smoothed: bool = False,
) -> Path:
    """Draw a replay's path and map over the truth, from above and, unless flat, from the side.

    With a true path the estimate is moved by the alignment of :func:`trajectory_errors`. A line
    leads from each landmark to the true one of the same id. Ids are written where there is room.
    Raises an EvaluationError also if the truth covers too few poses.

    Parameters
    ----------
    path, estimate
        Where to draw which poses.
    ids, world_points : (n,), (n, 3)
        The final map, metres.
    truth, landmark_truth
        In one world; true landmarks are drawn only together with true poses.
    covariances : (n, 3, 3), optional
        Of the landmarks, along the axes of the estimate's world, m²; drawn as 95 % ellipses.
    is_smoothed
        What the title says of all this.

    """
    if truth is not None:
        alignment = trajectory_errors(estimate, truth).alignment
        estimate, world_points = estimate.moved(alignment), se3.transform(alignment, world_points)
        if covariances is not None:
            covariances = alignment[:3, :3] @ covariances @ alignment[:3, :3].T
        # Else paths that are long the same seem to end at different places.
        truth = truth.during(estimate)
    else:
        landmark_truth = None
    layers = _map_layers(estimate, ids, world_points, truth, landmark_truth)
    spread = None if covariances is None or not len(ids) else (world_points, covariances)
    figure, panels = _draw(
        layers, is_flat((estimate if truth is None else truth).positions), spread
    )
    title = 'Smoothed trajectory and map' if is_smoothed else 'Trajectory and map'
    if truth is not None:
        title += ' after rigid alignment'
    figure.suptitle(title, fontsize=11, fontweight='bold')
    named = ~is_automatic(ids)
    if 0 < np.sum(named) <= _MAX_LABELS:
        figure.draw_without_rendering()  # only then it is known where there is room
        _write_ids(panels[0], ids[named], world_points[named, :2], layers)
    return save(figure, path)


def _draw(
    layers: list[_Layer], flat: bool, spread: tuple[FloatArray, FloatArray] | None
) -> tuple[Figure, list[Axes]]:
    """Return a figure of layers, and its panels: from above and, unless flat, from the side.

    ``spread`` are points (n, 3) and their covariances (n, 3, 3), if known.
    """
    drawn = np.concatenate([np.zeros((0, 3)), *(points for points, _ in layers)])
    drawn = drawn if len(drawn) else np.zeros((1, 3))
    low, high = np.nanmin(drawn, axis=0), np.nanmax(drawn, axis=0)
    if spread is not None:
        low, high = _with_spread(low, high, *spread)
    margin = 0.06 * float(np.max(high - low)) or 1.0
    low, high = low - margin, high + margin

    views = [(0, 1)] if flat else [(0, 1), _side_view(high - low)]
    figure, panels = _panels(views, high - low)
    for axes, (across, up) in zip(panels, views, strict=True):
        for points, style in layers:
            axes.plot(points[:, across], points[:, up], **style)
        if spread is not None:
            axes.plot(*outlines(*spread, (across, up)).T, **ELLIPSES)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect='equal')
        axes.set(xlabel=f'{"xyz"[across]} [m]', ylabel=f'{"xyz"[up]} [m]')
    figure.align_ylabels(panels)
    legend_below(figure, panels[-1], columns=3)
    return figure, panels


def _with_spread(
    low: FloatArray, high: FloatArray, points: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return corners (3,) of a box that has the ellipses, too, unless they dwarf all else."""
    half = np.sqrt(CHI_SQUARE_95 * np.diagonal(covariances, axis1=1, axis2=2))
    most = _MAX_SPREAD * float(np.max(high - low))
    return (
        np.maximum(np.minimum(low, (points - half).min(axis=0)), low - most),
        np.minimum(np.maximum(high, (points + half).max(axis=0)), high + most),
    )


def _side_view(spans_m: FloatArray) -> tuple[int, int]:
    """Return the axes, across and up, of a view from the side that shows the longer one."""
    return (1, 2) if spans_m[1] > spans_m[0] else (0, 2)


def _panels(views: list[tuple[int, int]], spans_m: FloatArray) -> tuple[Figure, list[Axes]]:
    """Return panels at one scale: one below the other if they share the axis across."""
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
    ids: IntArray,
    world_points: FloatArray,
    truth: Trajectory | None,
    landmark_truth: LandmarkTruth | None,
) -> list[_Layer]:
    """List what a map shows, first what lies lowest, without what there is none of."""
    layers: list[_Layer] = [
        (estimate.positions, {**PATH, 'linestyle': '-', 'linewidth': 0.9}),
        (estimate.positions[:1], START),
        (estimate.positions[-1:], END),
        (world_points, LANDMARKS),
    ]
    if truth is not None:
        layers[:0] = [(truth.positions, TRUE_PATH), (truth.positions[-1:], TRUE_END)]
    if landmark_truth is not None:
        layers.append((landmark_truth.world_points, TRUE_LANDMARKS))
        layers.append((_links(ids, world_points, landmark_truth), LINKS))
    return [(points, style) for points, style in layers if len(points)]


def _links(ids: IntArray, world_points: FloatArray, truth: LandmarkTruth) -> FloatArray:
    """Return lines from landmarks to the true ones of the same ids, with a break after each."""
    _, rows, true_rows = np.intersect1d(ids, truth.ids, return_indices=True)
    ends = [world_points[rows], truth.world_points[true_rows], np.full((len(rows), 3), np.nan)]
    return np.stack(ends, axis=1).reshape(-1, 3)


def _write_ids(axes: Axes, ids: IntArray, points: FloatArray, layers: list[_Layer]) -> None:
    """Write ids beside their points (n, 2), where they hit no marker of any layer."""
    markers = np.concatenate([drawn[:, :2] for drawn, style in layers if 'marker' in style])
    label_points(axes, [str(landmark_id) for landmark_id in ids.tolist()], points, markers)


# Okabe and Ito's, with styles that differ where colours are not seen.
_COLOURS = ('#D55E00', '#009E73', '#0072B2', '#CC79A7', '#E69F00', '#000000')
_STYLES = ('-', '--', '-.', ':')


@mpl.rc_context(STYLE)
def plot_overlay(
    path: Path, trajectories: Mapping[str, Trajectory], truth: Trajectory | None
) -> Path:
    """Draw trajectories from above, which are in one frame, by their names; return the path."""
    figure = Figure(figsize=(7.0, 7.0))
    axes = figure.subplots()
    if truth is not None:
        axes.plot(*truth.positions[:, :2].T, **TRUE_PATH)
    for number, (name, trajectory) in enumerate(trajectories.items()):
        axes.plot(
            *trajectory.positions[:, :2].T,
            color=_COLOURS[number % len(_COLOURS)],
            linestyle=_STYLES[number % len(_STYLES)],
            linewidth=1.1,
            label=name,
        )
    axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
    axes.set_title('Trajectories' if truth is None else 'Trajectories, each after rigid alignment')
    legend_below(figure, axes, columns=int(np.clip(len(trajectories) + 1, 1, 3)))
    return save(figure, path)


@mpl.rc_context(STYLE)
def plot_map_check(
    path: Path,
    landmarks: FloatArray,
    places: FloatArray,
    are_found: BoolArray,
    see_too_few: BoolArray,
    another: FloatArray | None,
) -> Path:
    """Draw landmarks (n, 3), and places (q, 3) by what a look from there says; return the path.

    ``another`` (3,) is where one more landmark would do, or None.
    """
    figure = Figure(figsize=(7.0, 7.0))
    axes = figure.subplots()
    kinds = (
        (are_found, GREEN, 'found by one look'),
        (see_too_few & ~are_found, '#BBBBBB', 'too few in view'),
        (~are_found & ~see_too_few, ORANGE, 'fits elsewhere, too'),
    )
    size = float(np.clip(9000.0 / max(len(places), 1), 4.0, 60.0))
    for is_kind, colour, label in kinds:
        if is_kind.any():
            x, y = places[is_kind, :2].T
            label = f'{label} ({is_kind.mean():.0%})'
            axes.scatter(x, y, s=size, c=colour, marker='s', alpha=0.6, lw=0.0, label=label)
    axes.plot(*landmarks[:, :2].T, 'o', color=BLACK, markersize=3, zorder=3, label='landmarks')
    if another is not None:
        axes.plot(*another[:2], color=RED, marker='*', markersize=14, ls='none', label='one more')
    axes.set(xlabel='x [m]', ylabel='y [m]', aspect='equal')
    axes.set_title('Where one look finds the robot')
    legend_below(figure, axes, columns=3)
    return save(figure, path)
