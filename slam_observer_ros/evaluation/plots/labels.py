"""Names beside the points of a figure, where there is room for them."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray

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
