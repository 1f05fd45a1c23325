"""Figures: the paper's of a simulation, and of a map where one look finds the robot.

They are drawn without pyplot, so that nobody's settings change. The colours are by Okabe and Ito:
colour-blind readers can distinguish them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np

from slam_observer_ros.common.errors import EvaluationError, failing
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.recordings.trajectory import Trajectory
from slam_observer_ros.runs.metrics import Decay

BLUE, RED, GREEN = '#0072B2', '#D55E00', '#009E73'
ORANGE, PURPLE, BLACK = '#E69F00', '#CC79A7', '#1B1F24'
PALE_BLUE = '#7FB8DA'

# The dictionaries are Any: matplotlib's types list the settings of its own version only.
STYLE: Any = {
    'figure.constrained_layout.use': True, 'figure.dpi': 150, 'savefig.dpi': 'figure',
    'font.size': 10, 'axes.titlesize': 11, 'axes.titleweight': 'bold',
    'axes.titlelocation': 'left', 'axes.spines.top': False, 'axes.spines.right': False,
    'axes.edgecolor': '#555555', 'axes.axisbelow': True, 'axes.grid': True,
    'grid.color': '#DDDDDD', 'grid.linewidth': 0.6, 'lines.linewidth': 1.4,
    'lines.solid_joinstyle': 'round', 'legend.frameon': False, 'legend.fontsize': 9,
    'agg.path.chunksize': 20_000,
    'pdf.fonttype': 42,  # publishers refuse matplotlib's default
    'svg.fonttype': 'none',  # text that can be searched and edited
    'svg.hashsalt': 'slam_observer_ros',  # the same figure is the same file
}  # fmt: skip

SUFFIXES = ('png', 'svg', 'pdf')

_NO_DATES: Any = {'png': {}, 'svg': {'Date': None}, 'pdf': {'CreationDate': None}}

# The true path is wide and pale, so that an estimate that lies on it hides nothing.
TRUE_PATH: Any = {'color': PALE_BLUE, 'linestyle': '-', 'linewidth': 3.0, 'label': 'true path'}
PATH: Any = {'color': RED, 'linestyle': '-.', 'label': 'estimated path'}
TRUE_END: Any = {'color': PALE_BLUE, 'marker': 's', 'linestyle': 'none', 'zorder': 4}
END: Any = {**TRUE_END, 'color': RED, 'markerfacecolor': 'none', 'zorder': 5, 'label': 'end'}
START: Any = {
    'color': RED, 'marker': 'D', 'markersize': 3.5, 'linestyle': 'none', 'zorder': 4,
    'label': 'start',
}  # fmt: skip
TRUE_LANDMARKS: Any = {
    'color': BLUE, 'marker': '*', 'markersize': 10, 'linestyle': 'none', 'zorder': 4,
    'label': 'true landmarks',
}  # fmt: skip
TRACKS: Any = {
    'color': GREEN, 'linestyle': '-.', 'linewidth': 1.2,
    'label': 'landmark estimates on their way',
}  # fmt: skip
LANDMARKS: Any = {
    'color': GREEN, 'marker': 'o', 'markersize': 9, 'markerfacecolor': 'none',
    'markeredgewidth': 1.5, 'linestyle': 'none', 'zorder': 5, 'label': 'estimated landmarks',
}  # fmt: skip

_PLANAR_RATIO = 0.01  # a scene lower than this part of its width is drawn from above


def is_flat(points: FloatArray) -> bool:
    """Return whether points (k, 3) are to be drawn from above."""
    if not len(points):
        return True
    width, depth, height = np.ptp(points, axis=0)
    return bool(height <= _PLANAR_RATIO * max(width, depth))


def legend_below(figure: Figure, named: Axes, columns: int) -> None:
    """Write what is drawn in axes below all axes of a figure, which make room for it.

    Not ``loc='outside lower center'``: matplotlib 3.6 of Ubuntu 24.04 doesn't know it.
    """
    legend = figure.legend(
        *named.get_legend_handles_labels(), loc='lower center', ncols=columns, borderaxespad=0.0
    )
    height = legend.get_window_extent().height / figure.bbox.height
    layout: Any = figure.get_layout_engine()
    layout.set(rect=(0.0, height, 1.0, 1.0 - height))


def save(figure: Figure, path: Path) -> Path:
    """Write a file of one of SUFFIXES, return its path; raise an EvaluationError if that fails."""
    suffix = path.suffix.removeprefix('.')
    with failing(EvaluationError, f"can't write {path}"):
        figure.savefig(path, format=suffix, metadata=_NO_DATES[suffix])
    return path


@mpl.rc_context(STYLE)
def plot_lyapunov(
    path: Path, times_s: FloatArray, log10_lyapunov: FloatArray, decay: Decay | None = None
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
        line = decay.log10_at_zero + decay.slope_per_s * times_s
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

    The poses ``estimate`` and ``truth`` are at the same k > 0 stamps, and so are the
    ``landmark_tracks`` (k, n, 3) in the estimate's world, metres, NaN before a landmark is
    first seen. The ``true_landmarks`` are (n, 3), metres.
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
    # A low scene in space needs little height.
    spans_m = np.ptp(scene, axis=0)
    space_height_in = 4.4 + 2.6 * float(spans_m[2] / max(spans_m.max(), 1e-30))
    figure = Figure(figsize=(7.2, 6.2 if flat else space_height_in))
    space: Any = {} if flat else {'projection': '3d', 'elev': 32.0, 'azim': -58.0}
    axes: Any = figure.add_subplot(**space)  # of three dimensions they carry no types
    if not flat:
        axes.set_zlabel('z [m]', labelpad=-2.0)
        axes.zaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color('white')
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
