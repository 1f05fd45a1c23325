"""Figures: the paper's of a simulation, and of a map where one look finds the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.evaluation.drawing import (
    BLACK,
    END,
    GREEN,
    is_flat,
    LANDMARKS,
    legend_below,
    ORANGE,
    PALE_BLUE,
    PATH,
    RED,
    save,
    START,
    STYLE,
    TRACKS,
    TRUE_END,
    TRUE_LANDMARKS,
    TRUE_PATH,
)
from slam_observer_ros.evaluation.metrics import Decay
from slam_observer_ros.evaluation.trajectory import Trajectory
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.se3 import rigid_alignment


@mpl.rc_context(STYLE)
def plot_lyapunov(
    path: Path,
    times_s: FloatArray,
    log10_lyapunov: FloatArray,
    decay: Decay | None = None,
) -> Path:
    """Draw the Lyapunov function (34) over times (k,), as the paper's Fig. 3.

    Where ``log10_lyapunov`` (k,) is -inf nothing is drawn. The ``decay`` is that fitted after the
    transient.
    """
    finite = np.isfinite(log10_lyapunov)
    times_s, log10_lyapunov = times_s[finite], log10_lyapunov[finite]
    figure = Figure(figsize=(7.0, 4.2))
    axes = figure.add_subplot()
    level: Any = {'color': PALE_BLUE, 'linewidth': 3.0}
    axes.plot(times_s, log10_lyapunov, **level, label=r'$\log_{10}\,\mathcal{L}$')
    if decay is not None and len(times_s) > 0:
        line = decay.log10_at(times_s)
        shown = line >= log10_lyapunov.min()
        label = f'fit after the transient, {decay.slope_per_s:.3f} per second'
        fit: Any = {'color': BLACK, 'linestyle': '--', 'linewidth': 1.2}
        axes.plot(times_s[shown], line[shown], **fit, label=label.replace('-', '\N{MINUS SIGN}'))
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
        File to write, of one of the SUFFIXES.
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

    scene = np.concatenate([truth.positions, true_landmarks])
    flat = is_flat(scene)
    figure = Figure(figsize=(7.2, 6.2) if flat else (7.2, _space_height_in(np.ptp(scene, axis=0))))
    axes: Any = figure.add_subplot() if flat else _space_view(figure)
    for points, style in [
        (truth.positions, TRUE_PATH),
        (truth.positions[-1:], TRUE_END),
        (true_landmarks, TRUE_LANDMARKS),
        (estimate.positions, PATH),
        (estimate.positions[-1:], END),
        (joined, TRACKS),
        (tracks[-1], LANDMARKS),
        (estimate.positions[:1], START),
    ]:
        axes.plot(*points.T[: 2 if flat else 3], **style)
    axes.set(title='Configuration after the rigid correction', xlabel='x [m]', ylabel='y [m]')
    if flat:
        axes.set_aspect('equal')
    else:
        limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        axes.set_box_aspect(np.ptp(limits, axis=1), zoom=1.25)
    legend_below(figure, axes, columns=4)
    return save(figure, path)


def _space_height_in(spans_m: FloatArray) -> float:
    """Return the height of a figure of a scene in space, inches: a low scene needs little."""
    share = float(spans_m[2] / max(spans_m[:2].max(), spans_m[2]))
    return 4.4 + 2.6 * share


def _space_view(figure: Figure) -> Any:
    # matplotlib's three-dimensional axes carry no types, hence Any.
    axes: Any = figure.add_subplot(projection='3d', elev=32.0, azim=-58.0)
    axes.set_zlabel('z [m]', labelpad=-2.0)
    axes.zaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color('white')
    return axes


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
