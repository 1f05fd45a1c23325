"""Which landmarks lie near a point, without searching the whole map for each."""

from __future__ import annotations

from typing import Any

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray

MAX_LOOSE = 256
"""Landmarks newer than the tree that are searched one by one before it is built again."""


class LandmarkIndex:
    """A k-d tree over landmarks that move a little all the time.

    Every correction moves landmarks by less than the search is wide. So the tree is kept while
    the largest shift since it was built is below that, and the search is widened by the shift.
    """

    def __init__(self) -> None:
        self._built: FloatArray = np.empty((0, 3))
        self._tree: Any = None  # before the first search

    def near(
        self, landmarks: FloatArray, points: FloatArray, radii_m: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Return pairs (q,), (q,) of a point and a landmark, by point.

        All pairs closer than the point's radius (m,) are among them, and some that aren't.
        Landmarks (n, 3), as they are now, and points (m, 3) are in one frame, metres.
        """
        shift_m = self._refresh(landmarks, np.min(radii_m, initial=np.inf))
        near = self._tree.query_ball_point(points, radii_m + shift_m, return_sorted=True)
        loose = np.arange(len(self._built), len(landmarks))
        rows = [np.append(np.array(point_rows, dtype=np.int64), loose) for point_rows in near]
        i = np.repeat(np.arange(len(points)), [len(point_rows) for point_rows in rows])
        return i, np.concatenate([np.empty(0, dtype=np.int64), *rows])

    def _refresh(self, landmarks: FloatArray, tolerance_m: float) -> float:
        """Build the tree again if it is too old; return the largest shift since it was built."""
        shift_m = self._shift_m(landmarks)
        if self._tree is not None and shift_m <= tolerance_m:
            return shift_m
        from scipy.spatial import cKDTree  # which only points without ids need

        self._built = landmarks.copy()
        self._tree = cKDTree(self._built)
        return 0.0

    def _shift_m(self, landmarks: FloatArray) -> float:
        built = len(self._built)
        if built == 0 or not built <= len(landmarks) <= built + MAX_LOOSE:
            return np.inf
        shifts = landmarks[:built] - self._built
        return float(np.sqrt(np.max(np.einsum('ij,ij->i', shifts, shifts))))
