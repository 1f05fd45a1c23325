"""A large symmetric matrix to which products of low rank are added, a little at a time.

It is M = B + U diag(w) Uᵀ. Of B the rows up to the diagonal are kept, in panels of several rows;
so it grows without a copy, and takes half the memory. U has what is yet to be added to B, which
costs O(N²) for N rows: that is done panel by panel (:meth:`PanelMatrix.fold`). Copies share the
panels until they change them.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.observer.riccati.shared_array import SharedArray

PANEL_ROWS = 96
"""Rows of a panel: landmarks do not straddle two, in space or in a plane."""

FOLDED_RANK = 64
"""Columns of U from which on they are added to B."""

GROWTH = 1.5
"""By how much more room is made in U than is needed."""


class PanelMatrix:
    """M (N, N) with N a multiple of ``PANEL_ROWS``; at first there is none."""

    def __init__(self) -> None:
        self._panels: list[SharedArray] = []  # (PANEL_ROWS, rows up to its last) of B
        self._folded: list[int] = []  # how many columns of U are already in each panel
        self._U = SharedArray(np.zeros((0, 0)), self)  # with room for more rows and columns
        self._w: FloatArray = np.zeros(0)
        self._next = self._target = 0  # the next panel to be folded, up to which column

    def __len__(self) -> int:
        """Return N."""
        return len(self._panels) * PANEL_ROWS

    @property
    def nbytes(self) -> int:
        """Bytes of memory."""
        return sum(shared.array.nbytes for shared in (self._U, *self._panels))

    def copy(self) -> PanelMatrix:
        """Return an independent copy."""
        other = PanelMatrix()
        vars(other).update(vars(self))
        other._panels = [panel.share(other) for panel in self._panels]
        other._folded, other._U = self._folded.copy(), self._U.share(other)
        return other

    def extend(self, rows: int) -> None:
        """Append zeros, so that there are at least so many rows."""
        while len(self) < rows:
            panel = np.zeros((PANEL_ROWS, len(self) + PANEL_ROWS))
            self._panels.append(SharedArray(panel, self))
            self._folded.append(len(self._w))  # its rows of U are zero so far
        self._reserve(len(self._w))

    def columns(self, indices: IntArray) -> FloatArray:
        """Return columns (m,), in ascending order, of M: (N, m)."""
        found = np.empty((len(self), len(indices)))
        w, rank = self._w, len(self._w)
        U = self._U.array[:, :rank]
        of_indices = U[indices]
        for number, panel in enumerate(self._panels):
            start, end = PANEL_ROWS * number, PANEL_ROWS * (number + 1)
            before, until = np.searchsorted(indices, (start, end))
            f = self._folded[number]  # what is pending from there on
            # Left of the diagonal its rows; what is above the diagonal, by symmetry.
            left, own = of_indices[:until, f:], of_indices[before:until, f:] * w[f:]
            found[start:end, :until] = panel.array[:, indices[:until]]
            found[start:end, :until] += (U[start:end, f:] * w[f:]) @ left.T
            if before < until:
                found[:start, before:until] = panel.array[indices[before:until] - start, :start].T
                found[:start, before:until] += U[:start, f:] @ own.T
        return found

    def set_columns(self, indices: IntArray, values: FloatArray) -> None:
        """Replace columns (m,), in ascending order, and the same rows, by ``values`` (N, m)."""
        self._U = self._U.owned_by(self)
        self._U.array[indices] = 0.0
        for number in range(len(self._panels)):
            start, end = PANEL_ROWS * number, PANEL_ROWS * (number + 1)
            before, until = np.searchsorted(indices, (start, end))
            if until:
                panel = self._writable(number)
                panel[:, indices[:until]] = values[start:end, :until]
                panel[indices[before:until] - start] = values[:end, before:until].T

    def set_blocks(self, indices: IntArray, blocks: FloatArray) -> None:
        """Replace blocks (m, k, k) on the diagonal, of rows (m k,) that have no other entries."""
        k = blocks.shape[1]
        for rows, block in zip(indices.reshape(-1, k), blocks, strict=True):
            number = int(rows[0]) // PANEL_ROWS
            panel, start = self._writable(number), int(rows[0])
            panel[start - PANEL_ROWS * number :][:k, start : start + k] = block

    def add(self, U: FloatArray, w: FloatArray) -> None:
        """Add U diag(w) Uᵀ, U (N, r)."""
        before, rank = len(self._w), len(self._w) + len(w)
        self._reserve(rank)
        self._U = self._U.owned_by(self)
        self._U.array[: len(U), before:rank] = U
        self._w = np.append(self._w, w)

    def fold(self, work: float) -> None:
        """Go on adding U to the panels, one or as many as ``work`` multiplications suffice for."""
        # How much is done at a time may not depend on the clock: a replay has the same bits.
        rank = len(self._w)
        if not self._target and rank < FOLDED_RANK:
            return
        self._target = self._target or rank
        work *= max(rank / (4.0 * FOLDED_RANK), 1.0)
        while work > 0.0 and self._next < len(self._panels):
            work -= self._fold_next()
        if self._next == len(self._panels):
            self._drop_folded()

    def _fold_next(self) -> float:
        """Add columns up to the target to the next panel; return how many multiplications."""
        number, f, t = self._next, self._folded[self._next], self._target
        self._next += 1
        if f >= t:
            return 0.0
        panel, start, U = self._writable(number), PANEL_ROWS * number, self._U.array
        panel += (U[start : start + PANEL_ROWS, f:t] * self._w[f:t]) @ U[: panel.shape[1], f:t].T
        self._folded[number] = t
        return float(panel.size * (t - f))

    def _drop_folded(self) -> None:
        """Drop the columns that all panels have."""
        t = self._target
        U = np.zeros_like(self._U.array)
        left = len(self._w) - t
        U[:, :left] = self._U.array[:, t : t + left]
        self._U, self._w = SharedArray(U, self), self._w[t:]
        self._folded = [f - t for f in self._folded]
        self._next = self._target = 0

    def _writable(self, number: int) -> FloatArray:
        self._panels[number] = panel = self._panels[number].owned_by(self)
        return panel.array

    def _reserve(self, rank: int) -> None:
        """Make room in U for all rows and so many columns."""
        rows, columns = self._U.array.shape
        if rows >= len(self) and columns >= rank:
            return
        more_rows = rows if rows >= len(self) else int(GROWTH * len(self))
        more_columns = columns if columns >= rank else int(GROWTH * rank)
        U = np.zeros((more_rows, more_columns))
        U[:rows, :columns] = self._U.array
        self._U = SharedArray(U, self)
