"""How all figures are drawn: without pyplot, so that nobody's settings change.

Colours are those of Okabe and Ito, which colour-blind readers can distinguish. Names stand beside
the points of a figure where there is room for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
import numpy as np

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import BoolArray, FloatArray

BLUE, RED, GREEN = '#0072B2', '#D55E00', '#009E73'
ORANGE, PURPLE, BLACK = '#E69F00', '#CC79A7', '#1B1F24'
PALE_BLUE = '#7FB8DA'

# The dictionaries are Any: matplotlib's types list the settings of its own version only.
STYLE: Any = {
    'figure.constrained_layout.use': True,
    'figure.dpi': 150,  # also before it is saved: where there is room is measured then
    'savefig.dpi': 'figure',
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
    'pdf.fonttype': 42,  # publishers refuse matplotlib's default
    'svg.fonttype': 'none',  # text that can be searched and edited
    'svg.hashsalt': 'slam_observer_ros',  # the same figure is the same file
}

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
ELLIPSES: Any = {
    'color': GREEN, 'linestyle': '-', 'linewidth': 0.9, 'zorder': 3.5,
    'label': '95 % ellipses',
}  # fmt: skip
LANDMARKS: Any = {
    'color': GREEN, 'marker': 'o', 'markersize': 9, 'markerfacecolor': 'none',
    'markeredgewidth': 1.5, 'linestyle': 'none', 'zorder': 5, 'label': 'estimated landmarks',
}  # fmt: skip
LINKS: Any = {'color': '#333333', 'linestyle': '-', 'linewidth': 0.9, 'zorder': 4.5}
LEGEND_ABOVE: Any = {'loc': 'lower right', 'bbox_to_anchor': (1.0, 1.0), 'borderaxespad': 0.2}

_FEW_DECADES = 300.0
"""Ratio of the limits of a logarithmic axis up to which there is room for 1, 2 and 5."""

_PLANAR_RATIO = 0.01
"""A scene lower than this part of its width is drawn from above."""


def is_flat(points: FloatArray) -> bool:
    """Return whether points (k, 3) are to be drawn from above."""
    if not len(points):
        return True
    width, depth, height = np.ptp(points, axis=0)
    return bool(height <= _PLANAR_RATIO * max(width, depth))


def legend_below(figure: Figure, named: Axes, columns: int) -> None:
    """Write what is drawn in axes below all axes of a figure, which make room for it.

    Not ``loc='outside lower center'``: matplotlib 3.6, that of Ubuntu 24.04, doesn't know it.
    """
    legend = figure.legend(
        *named.get_legend_handles_labels(), loc='lower center', ncols=columns, borderaxespad=0.0
    )
    height = legend.get_window_extent().height / figure.bbox.height
    layout: Any = figure.get_layout_engine()
    layout.set(rect=(0.0, height, 1.0, 1.0 - height))


def plain_decades(axes: Axes) -> None:
    """Write numbers as 0.5 and 20 on a logarithmic axis, whose limits are set, not as powers."""
    low, high = axes.get_ylim()
    subs = (1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _position: f'{value:g}'))
    axes.yaxis.set_minor_formatter(NullFormatter())


def save(figure: Figure, path: Path) -> Path:
    """Write a file of one of SUFFIXES, return its path; raise an EvaluationError if that fails."""
    suffix = path.suffix.removeprefix('.')
    try:
        figure.savefig(path, format=suffix, metadata=_NO_DATES[suffix])
    except OSError as error:
        raise EvaluationError(f"can't write {path}: {error.strerror}") from error
    return path


_MARKER_PT = 5.5
"""Radius of a marker."""

_GAP_PT = 1.0
"""Room between a marker and its label."""

_NEAR_PT = 14.0
"""Markers nearer than this touch: of several it matters where their middle is."""

_HALO_PT = 1.25
"""What a label erases round itself."""

_ANGLES = np.arange(16) * np.pi / 8.0
_DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""(16, 2) where a label may be, seen from its point."""


def label_points(
    axes: Axes, names: Sequence[str], points: FloatArray, markers: FloatArray
) -> None:
    """Write each name beside its point, if there it hits no marker and no name written before.

    Of all sides that is tried first which leads away from what else is drawn near it. The layout
    of the figure must be done. The names are those of ``points`` (n, 2), the most important ones
    first; ``markers`` (m, 2) must not be hit, and have the points among them.
    """
    px = axes.figure.dpi / 72.0
    obstacles = axes.transData.transform(markers)
    middles, halves = np.empty((2, 0, 2))  # of the labels that were written
    for name, point in zip(names, points, strict=True):
        label = _label(axes, name, point)
        half = np.array(label.get_window_extent().size) / 2.0 + _HALO_PT * px
        start = axes.transData.transform(point)
        candidates = start + _ways_to_middle(
            half, _way_from_others(start, obstacles, _NEAR_PT * px), px
        )
        free = np.all(np.abs(candidates - axes.bbox.min) >= half, axis=1)
        free &= np.all(np.abs(axes.bbox.max - candidates) >= half, axis=1)
        free &= ~_hits_label(candidates, half, middles, halves)
        free &= ~_touches_marker(candidates, half, obstacles, _MARKER_PT * px)
        if not free.any():
            label.remove()
            continue
        middle = candidates[np.argmax(free)]
        label.xyann = tuple((middle - start) / px)
        middles, halves = np.vstack([middles, middle]), np.vstack([halves, half])


def _label(axes: Axes, name: str, point: FloatArray) -> Annotation:
    return axes.annotate(
        name,
        (point[0], point[1]),
        xytext=(0.0, 0.0),
        textcoords='offset points',
        horizontalalignment='center',
        verticalalignment='center',
        fontsize=8,
        color='#004D38',
        zorder=3,  # above paths, below markers
        path_effects=[withStroke(linewidth=2.0 * _HALO_PT, foreground='white')],
    )


def _ways_to_middle(half: FloatArray, away: FloatArray, px: float) -> FloatArray:
    """Return the ways (16, 2) from a marker to the middle of its label, the best one first."""
    directions = _DIRECTIONS[np.argsort(-_DIRECTIONS @ away, kind='stable')]
    to_middle = np.clip(np.sqrt(2.0) * directions, -1.0, 1.0) * half
    return np.asarray((_MARKER_PT + _GAP_PT) * px * directions + to_middle)


def _way_from_others(point: FloatArray, markers: FloatArray, near: float) -> FloatArray:
    """Return the way (2,) that leads away from markers (m, 2), the nearest above all."""
    apart = point - markers
    return np.asarray((apart / (np.sum(apart**2, axis=1, keepdims=True) + near**2)).sum(axis=0))


def _hits_label(
    candidates: FloatArray, half: FloatArray, middles: FloatArray, halves: FloatArray
) -> BoolArray:
    """Return at which candidates (k, 2) a label would hit one that is written."""
    apart = np.abs(candidates[:, None] - middles)
    return np.asarray(np.any(np.all(apart < half + halves, axis=-1), axis=-1))


def _touches_marker(
    candidates: FloatArray, half: FloatArray, obstacles: FloatArray, radius: float
) -> BoolArray:
    """Return at which candidates (k, 2) a label would touch a marker."""
    apart = np.maximum(np.abs(candidates[:, None] - obstacles) - half, 0.0)
    return np.asarray(np.any(np.linalg.norm(apart, axis=-1) < radius, axis=-1))
