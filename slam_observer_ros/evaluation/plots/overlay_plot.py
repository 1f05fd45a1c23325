"""Several trajectories over the true one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.evaluation.plots.drawing import legend_below, save, STYLE, TRUE_PATH
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
