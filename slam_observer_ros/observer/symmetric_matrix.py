"""A symmetric matrix that grows with the map, and is changed in place by products of few rows.

BLAS changes one triangle, at half the cost of a product of whole matrices and without a temporary
one; then the other is its mirror image, to the bit.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.linalg.blas import dsyr2k, dsyrk

from slam_observer_ros.common.types import FloatArray, IntArray

GROWTH = 1.125
"""How many times as large the storage becomes once it is full."""

_BLOCK = 128
_LOWER = np.tril(np.ones((_BLOCK, _BLOCK), dtype=np.bool_), -1)


class SymmetricMatrix:
    """Values (N, N), and room for some more rows and columns, which is zero."""

    def __init__(self, values: FloatArray) -> None:
        self.set(values)

    def set(self, values: FloatArray) -> None:
        """Become ``values`` (N, N), of any size."""
        self._storage: FloatArray = np.array(values, order='C')
        self._size = len(values)

    def copy(self) -> SymmetricMatrix:
        """Return an independent copy."""
        other = copy(self)
        other._storage = self._storage.copy()
        return other

    @property
    def values(self) -> FloatArray:
        """(N, N) the matrix, as a view that may be written to, symmetrically."""
        return self._storage[: self._size, : self._size]

    def rows(self, numbers: IntArray) -> FloatArray:
        """Return the rows (q, N) with these ``numbers`` (q,); transposed they are columns."""
        # Of the storage, which is contiguous: of a view NumPy would copy all first.
        return self._storage.take(numbers, axis=0)[:, : self._size]

    def append_zeros(self, count: int) -> None:
        """Append rows and columns."""
        size = self._size + count
        if size > len(self._storage):
            roomy = np.zeros((max(size, int(GROWTH * self._size)),) * 2)
            roomy[: self._size, : self._size] = self.values
            self._storage = roomy
        self._size = size

    def insert_zeros(self, at: int, count: int) -> None:
        """Insert rows and columns before number ``at``."""
        before, end = self.values, self._size + count
        self._storage, self._size = np.zeros((end, end)), end
        for rows, to_rows in ((slice(at), slice(at)), (slice(at, None), slice(at + count, end))):
            self._storage[to_rows, :at] = before[rows, :at]
            self._storage[to_rows, at + count :] = before[rows, at:]

    def among(self, numbers: IntArray) -> FloatArray:
        """Return the entries (q, q) of the ``numbers`` (q,) of rows and columns."""
        return self._storage.take(numbers, axis=0).take(numbers, axis=1)

    def subtract_square(self, W: FloatArray) -> None:
        """Subtract Wᵀ W for W (q, N)."""
        subtract_square(self._storage, self._size, self._widened(W))

    def add_symmetric_product(self, A: FloatArray, B: FloatArray) -> None:
        """Add Aᵀ B + Bᵀ A for A and B (q, N)."""
        add_symmetric_product(self._storage, self._size, self._widened(A), self._widened(B))

    def _widened(self, rows: FloatArray) -> FloatArray:
        """Return rows (q, N) with zeros for the room that is left."""
        if len(self._storage) == self._size:
            return np.ascontiguousarray(rows)
        wide = np.zeros((len(rows), len(self._storage)))
        wide[:, : self._size] = rows
        return wide


def subtract_square(M: FloatArray, size: int, W: FloatArray) -> None:
    """Subtract Wᵀ W, W (q, room) zero from ``size`` on, from the symmetric M (room, room)."""
    dsyrk(-1.0, W.T, beta=1.0, c=M.T, lower=1, overwrite_c=1)
    _mirror(M, size)


def add_symmetric_product(M: FloatArray, size: int, A: FloatArray, B: FloatArray) -> None:
    """Add Aᵀ B + Bᵀ A likewise, for A and B (q, room)."""
    dsyr2k(1.0, A.T, B.T, beta=1.0, c=M.T, lower=1, overwrite_c=1)
    _mirror(M, size)


def _mirror(M: FloatArray, size: int) -> None:
    """Copy the upper triangle, the one that BLAS takes for a lower one, to the lower one."""
    for begin in range(0, size, _BLOCK):
        end = min(begin + _BLOCK, size)
        M[end:size, begin:end] = M[begin:end, end:size].T
        block = M[begin:end, begin:end]
        np.copyto(block, block.T, where=_LOWER[: end - begin, : end - begin])
