"""Figures of a simulation: those of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.evaluation.plots.drawing import (
    BLUE,
    END,
    GREY,
    is_flat,
    LANDMARKS,
    legend_below,
    PATH,
    save,
    STYLE,
    TRACKS,
    TRUE_END,
    TRUE_LANDMARKS,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.alignment import rigid_alignment


@mpl.rc_context(STYLE)
def plot_lyapunov(
    path: Path,
    times_s: FloatArray,
    log10_lyapunov: FloatArray,
    slope_per_s: float | None = None,
) -> Path:
    """Draw the Lyapunov function (34) over times (k,), as the paper's Fig. 3.

    Where ``log10_lyapunov`` (k,) is -inf nothing is drawn. The slope, decades per second, is that
    fitted after the transient.
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
    return save(figure, path)


@mpl.rc_context(STYLE)
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

    """
    # The rigid correction
    second_half = slice(len(truth) // 2, None)
    known = np.isfinite(landmark_tracks[-1]).all(axis=-1)
    correction = rigid_alignment(
        np.concatenate([estimate.positions[second_half], landmark_tracks[-1, known]]),
        np.concatenate([truth.positions[second_half], true_landmarks[known]]),
    )
    estimate = estimate.moved(correction)
    tracks = se3.transform(correction, landmark_tracks[:, known])

    # All tracks are one line, with a break after each.
    breaks = np.full((1, tracks.shape[1], 3), np.nan)
    joined = np.concatenate([tracks, breaks]).swapaxes(0, 1).reshape(-1, 3)

    flat = is_flat(np.concatenate([truth.positions, true_landmarks]))
    figure = Figure(figsize=(7.2, 6.2) if flat else (7.2, 5.2))
    axes: Any = figure.add_subplot() if flat else _space_view(figure)
    for points, style in [
        (truth.positions, TRUE_PATH),
        (truth.positions[-1:], TRUE_END),
        (true_landmarks, TRUE_LANDMARKS),
        (estimate.positions, PATH),
        (estimate.positions[-1:], END),
        (joined, TRACKS),
        (tracks[-1], LANDMARKS),
    ]:
        axes.plot(*points.T[: 2 if flat else 3], **style)
    axes.set(title='Configuration after the rigid correction', xlabel='x [m]', ylabel='y [m]')
    if flat:
        axes.set_aspect('equal')
    else:
        limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        axes.set_box_aspect(np.ptp(limits, axis=1), zoom=1.1)
    legend_below(figure, axes, columns=5)
    return save(figure, path)


def _space_view(figure: Figure) -> Any:
    # matplotlib's three-dimensional axes carry no types, hence Any.
    axes: Any = figure.add_subplot(projection='3d', elev=32.0, azim=-58.0)
    axes.set_zlabel('z [m]')
    axes.zaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color('white')
    return axes
