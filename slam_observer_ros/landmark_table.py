"""Which landmarks are known: ids, counts and stamps as a struct of arrays."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.types import BoolArray, IntArray


class LandmarkTable:
    """Book-keeping of n landmarks; row i belongs to the observer's landmark i.

    Attributes
    ----------
    ids : IntArray
        (n,) landmark ids, in the order in which they were first seen.
    counts : IntArray
        (n,) in how many observations each was seen and accepted.
    rejections : IntArray
        (n,) how many observations in a row were rejected, up to now.
    last_seen_ns : IntArray
        (n,) stamp of the latest observation of each, nanoseconds.

    """

    def __init__(self) -> None:
        self.ids: IntArray = np.empty(0, dtype=np.int64)
        self.counts: IntArray = np.empty(0, dtype=np.int64)
        self.rejections: IntArray = np.empty(0, dtype=np.int64)
        self.last_seen_ns: IntArray = np.empty(0, dtype=np.int64)
        self._order: IntArray = np.empty(0, dtype=np.int64)

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.ids)

    def indices_of(self, ids: IntArray) -> IntArray:
        """Return the row of each id (m,), −1 where it is unknown."""
        if not len(self.ids):
            return np.full(len(ids), -1)
        place = np.searchsorted(self.ids, ids, sorter=self._order)
        rows = self._order[np.minimum(place, len(self.ids) - 1)]
        return np.where(self.ids[rows] == ids, rows, -1)

    def add(self, ids: IntArray, stamp_ns: int) -> None:
        """Append landmarks (m,) that are seen for the first time."""
        self.ids = np.concatenate([self.ids, ids])
        self.counts = np.concatenate([self.counts, np.ones(len(ids), dtype=np.int64)])
        self.rejections = np.concatenate([self.rejections, np.zeros(len(ids), dtype=np.int64)])
        self.last_seen_ns = np.concatenate([self.last_seen_ns, np.full(len(ids), stamp_ns)])
        self._order = np.argsort(self.ids)

    def see(self, indices: IntArray, accepted: BoolArray, stamp_ns: int) -> None:
        """Count one more observation of the rows ``indices`` (m,), accepted or rejected."""
        self.counts[indices] += accepted
        self.rejections[indices] = np.where(accepted, 0, self.rejections[indices] + 1)
        self.last_seen_ns[indices] = np.maximum(self.last_seen_ns[indices], stamp_ns)

    def remove(self, indices: IntArray) -> None:
        """Delete rows; those behind move up."""
        self.ids = np.delete(self.ids, indices)
        self.counts = np.delete(self.counts, indices)
        self.rejections = np.delete(self.rejections, indices)
        self.last_seen_ns = np.delete(self.last_seen_ns, indices)
        self._order = np.argsort(self.ids)
