"""How all figures are drawn: without pyplot, so that nobody's settings change.

The colours are by Okabe and Ito: colour-blind readers can distinguish them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import FloatArray

BLUE, RED, GREEN = '#0072B2', '#D55E00', '#009E73'
ORANGE, PURPLE, BLACK = '#E69F00', '#CC79A7', '#1B1F24'
PALE_BLUE = '#7FB8DA'

# The dictionaries are Any: matplotlib's types list the settings of its own version only.
STYLE: Any = {
    'figure.constrained_layout.use': True,
    'figure.dpi': 150,
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
LANDMARKS: Any = {
    'color': GREEN, 'marker': 'o', 'markersize': 9, 'markerfacecolor': 'none',
    'markeredgewidth': 1.5, 'linestyle': 'none', 'zorder': 5, 'label': 'estimated landmarks',
}  # fmt: skip

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
    try:
        figure.savefig(path, format=suffix, metadata=_NO_DATES[suffix])
    except OSError as error:
        raise EvaluationError(f"can't write {path}: {error.strerror}") from error
    return path
