"""Figures of trajectories over each other, and of a map's check."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.evaluation.drawing import (
    BLACK,
    GREEN,
    legend_below,
    ORANGE,
    RED,
    save,
    STYLE,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.trajectory import Trajectory

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
