"""What is postponed of large maps: corrections of landmarks out of view, and products of low rank.

Landmarks out of view do not move, and only x shows anything of their errors η. Let X = cov(η, x)
at the instant from which on corrections are postponed. After a correction of x by the residual r
of H x, with the covariance S,

    cov(η, x) = X Φᵀ,    Φ ← Φ − K H Φ
    cov(η)    = B − X Ψ Xᵀ,    Ψ ← Ψ + (H Φ)ᵀ S⁻¹ H Φ
    η̂         moved by  −X g,    g = (H Φ)ᵀ S⁻¹ r,

for any η, and however many there are. Where some η_i become part of x, X has the columns
cov(η, η_i) of B, too, and Φ and Ψ grow by these. With K = P Hᵀ S⁻¹ the matrix [P Φ; Φᵀ −Ψ] is
corrected as P is, by an H that is zero in the new columns, where K r is g. So Φ and Ψ are kept as
columns of P, and the rest here. On the group, X̂ ← exp(−K r) · X̂, the shift a of a
landmark from its reference becomes D a − J X_i g, with D = exp(ε_Ω) and its left Jacobian J;
over many corrections D₁ a + T X_i, with a tensor T. A tag's orientation turns by exp(−X_i g) each
time. See docs/theory.md, Large maps.

cov(η) is large, and such products of low rank are added to it a little at a time: it is a
:class:`PanelMatrix` M = B + U diag(w) Uᵀ, with a B of its own. Its rows are in panels. B is kept
up to its diagonal, in square tiles: so it grows without a copy, and takes half the memory.
Adding U diag(w) Uᵀ to B costs O(N²) for N rows, and is done panel by panel
(:meth:`PanelMatrix.fold`). U grows panel by panel, too: columns that are *begun* have been given
to some panels, and M is what it was before in the others. No array is changed in place: copies
share them.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from itertools import pairwise

import numpy as np
from scipy.linalg.lapack import dpstrf

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import so3
from slam_observer_ros.lie.axes import EstimatedAxes


class PostponedCorrection:
    """D (k, k) and T (k, k, q₀) since x had q₀ entries, with these ``variances``."""

    def __init__(self, variances: FloatArray, point: int, have_turns: bool = False) -> None:
        # g of each correction, which turns the orientations of tags; as long as x was then
        self.gains: list[FloatArray] | None = [] if have_turns else None
        self.turn: FloatArray = np.eye(point)
        self.shift: FloatArray = np.zeros((point, point, len(variances)))
        self.has_moved = False
        self._deviations = np.sqrt(np.maximum(variances, 0.0))

    def copy(self) -> PostponedCorrection:
        """Return an independent copy."""
        other = copy(self)
        other.shift = self.shift.copy()
        other.gains = None if self.gains is None else self.gains.copy()
        return other

    def move(self, turn: FloatArray, minus_g: FloatArray) -> None:
        """Take in a correction with −g (q₀,) which turned the state by ``turn`` (3,), rad."""
        k = len(self.turn)
        D, J = so3.exp(turn)[:k, :k], so3.left_jacobian(turn)[:k, :k]
        self.turn = D @ self.turn
        self.shift = (D @ self.shift.reshape(k, -1)).reshape(self.shift.shape)
        self.shift += J[:, :, None] * minus_g
        self.has_moved = True
        if self.gains is not None:
            self.gains.append(-minus_g)

    def shifted(self, a: FloatArray, X: FloatArray) -> FloatArray:
        """Return the shifts (n, k) now of landmarks with X (n, k, q₀) that had shifts a."""
        T = self.shift.reshape(len(self.turn), -1)
        moved: FloatArray = a @ self.turn.T + X.reshape(len(a), -1) @ T.T
        return moved

    def turns(self, X: FloatArray, since: int, axes: EstimatedAxes) -> FloatArray:
        """Return how tags with X (n, turn, q₀) have been turned (n, 3, 3) since a correction."""
        gains, (n, q) = (self.gains or [])[since:], X.shape[:2]
        if not gains:
            return np.tile(np.eye(3), (n, 1, 1))
        count = len(gains)
        G = np.zeros((count, X.shape[2]))
        for row, g in zip(G, gains, strict=True):
            row[: len(g)] = g
        omega = -(X.reshape(n * q, -1) @ G.T).reshape(n, q, count).swapaxes(1, 2)
        R = so3.exp(axes.full_turns(omega.reshape(-1, q))).reshape(n, count, 3, 3)
        # The product of all, by halves: first of each with its neighbour.
        while R.shape[1] > 1:
            last = R[:, R.shape[1] // 2 * 2 :]
            R = np.concatenate([R[:, 1::2] @ R[:, : R.shape[1] // 2 * 2 : 2], last], axis=1)
        turns: FloatArray = R[:, 0]
        return turns

    def take(self, variances: FloatArray) -> None:
        """Let X have m more columns, for entries with these variances."""
        self.shift = np.pad(self.shift, ((0, 0), (0, 0), (0, len(variances))))
        self._deviations = np.append(self._deviations, np.sqrt(np.maximum(variances, 0.0)))

    def root(self, Psi: FloatArray) -> FloatArray:
        """Return F (q₀, r) with F Fᵀ = Ψ up to rounding, r being the rank of Ψ."""
        if not len(Psi):
            return Psi
        # In standard deviations, as the units of angles and positions differ by far.
        scaled = self._deviations[:, None] * Psi * self._deviations
        L, order, rank, _ = dpstrf(scaled, lower=1)
        F = np.zeros((len(scaled), rank))
        F[order - 1] = np.tril(L)[:, :rank]
        used = self._deviations > 0.0
        F[used] /= self._deviations[used, None]
        return F


PANEL_ROWS = 96
"""Rows of a panel: landmarks do not straddle two, in space or in a plane, points or tags."""

FOLDED_RANK = 64  # columns of U that are added to B at a time


class PanelMatrix:
    """M (N, N) with N a multiple of ``PANEL_ROWS``; at first there is none."""

    def __init__(self) -> None:
        # Of each panel the tiles (PANEL_ROWS, PANEL_ROWS) of B, up to the one on the diagonal
        self._tiles: list[list[FloatArray]] = []
        self._zeros = np.zeros((PANEL_ROWS, PANEL_ROWS))
        self._folded: list[int] = []  # how many columns of U are already in each panel
        self._U: list[FloatArray] = []  # (PANEL_ROWS, …) rows of U
        self._w: FloatArray = np.zeros(0)
        self._rank = 0  # columns of U that all panels have
        self._next = self._target = 0  # the next panel to be folded, up to which column

    def __len__(self) -> int:
        """Return how many panels there are."""
        return len(self._tiles)

    def copy(self) -> PanelMatrix:
        """Return an independent copy."""
        other = copy(self)
        other._tiles = [tiles.copy() for tiles in self._tiles]
        other._folded, other._U = self._folded.copy(), self._U.copy()
        return other

    def append(self) -> None:
        """Append a panel of zeros."""
        self._tiles.append([self._zeros] * (len(self) + 1))
        self._folded.append(self._rank)
        self._U.append(np.zeros((PANEL_ROWS, len(self._w))))

    def columns(self, number: int, indices: IntArray, U: FloatArray | None = None) -> FloatArray:
        """Return the rows of a panel (PANEL_ROWS, m) at ascending ``indices`` (m,) of columns.

        ``U`` are to be its rows of U, by default those that it has.
        """
        found = np.empty((PANEL_ROWS, len(indices)))
        for part, other, local in _by_panel(indices):
            found[:, part] = self._pending(number, other, local, U)
            if other <= number:
                found[:, part] += self._tiles[number][other][:, local]
            else:
                found[:, part] += self._tiles[other][number][local].T
        return found

    def set_columns(self, number: int, indices: IntArray, values: FloatArray) -> None:
        """Replace these columns by ``values`` (PANEL_ROWS, m), and the same rows likewise."""
        for part, other, local in _by_panel(indices):
            new = values[:, part] - self._pending(number, other, local)
            tile = self._writable(max(number, other), min(number, other))
            if other <= number:
                tile[:, local] = new
            if other >= number:
                tile[local] = new.T

    def add_blocks(self, number: int, rows: IntArray, blocks: FloatArray) -> None:
        """Add blocks (m, k, k) on the diagonal, in rows (m, k) of a panel."""
        self._writable(number, number)[rows[:, :, None], rows[:, None, :]] += blocks

    def among(self, indices: IntArray, U: FloatArray) -> FloatArray:
        """Return M (m, m) at ascending ``indices`` (m,), which have the rows ``U`` of U."""
        found, w = np.empty((len(indices),) * 2), self._w
        for part, number, local in _by_panel(indices):
            f = self._folded[number]
            for left, other, of_left in _by_panel(indices[: part.stop]):
                block = self._tiles[number][other][np.ix_(local, of_left)]
                block += (U[part, f:] * w[f:]) @ U[left, f:].T
                found[part, left], found[left, part] = block, block.T
        return found

    @property
    def columns_of_U(self) -> int:  # noqa: N802 (as in the formula)
        """How many columns U has; some panels may not have the last ones yet."""
        return len(self._w)

    def rows_of_U(self, number: int) -> FloatArray:  # noqa: N802 (as in the formula)
        """Return the rows of U (PANEL_ROWS, …) of a panel."""
        return self._U[number]

    def begin(self, w: FloatArray) -> None:
        """Begin to add U diag(w) Uᵀ; :meth:`add` gives each panel its rows of U."""
        self._w = np.append(self._w, w)

    def add(self, number: int, U: FloatArray) -> None:
        """Give a panel its rows of U (PANEL_ROWS, r)."""
        self._U[number] = np.hstack([self._U[number], U])

    def end(self) -> None:
        """Note that all panels have their rows of U."""
        self._rank = len(self._w)

    def fold(self, work: float) -> None:
        """Go on adding U to panels: one, or as many as ``work`` multiplications allow."""
        # How much is done at a time may not depend on the clock: a replay has the same bits.
        if not self._target and self._rank < FOLDED_RANK:
            return
        self._target = FOLDED_RANK
        work *= max(self._rank / (4.0 * FOLDED_RANK), 1.0)
        while work > 0.0 and self._next < len(self):
            work -= self._fold_next()
        if self._next == len(self):
            self._drop_folded()

    def _fold_next(self) -> float:
        """Add columns up to the target to the next panel; return how many multiplications."""
        number, f, t = self._next, self._folded[self._next], self._target
        self._next += 1
        if f >= t:
            return 0.0
        tiles, U = self._tiles[number], self._U[number][:, f:t] * self._w[f:t]
        if U.any():
            for other, tile in enumerate(tiles):
                added = U @ self._U[other][:, f:t].T
                added += tile
                tiles[other] = added
        self._folded[number] = t
        return float(len(tiles) * PANEL_ROWS**2 * (t - f))

    def _drop_folded(self) -> None:
        """Drop the columns that all panels have in B."""
        t = self._target
        self._U, self._w = [U[:, t:].copy() for U in self._U], self._w[t:]
        self._folded, self._rank = [f - t for f in self._folded], self._rank - t
        self._next = self._target = 0

    def _pending(
        self, number: int, other: int, local: IntArray, U: FloatArray | None = None
    ) -> FloatArray:
        """Return what U has yet to add to rows of a panel at columns ``local`` of another."""
        U = self._U[number] if U is None else U
        f, until = self._folded[max(number, other)], min(U.shape[1], self._U[other].shape[1])
        right = self._U[other][local, f:until]
        pending: FloatArray = (U[:, f:until] * self._w[f:until]) @ right.T
        return pending

    def _writable(self, number: int, other: int) -> FloatArray:
        tile: FloatArray = self._tiles[number][other].copy()
        self._tiles[number][other] = tile
        return tile


def _by_panel(indices: IntArray) -> Iterator[tuple[slice, int, IntArray]]:
    """Yield parts of ascending ``indices``, the panel of each, and their rows in it."""
    numbers = indices // PANEL_ROWS
    bounds = np.flatnonzero(np.diff(numbers, prepend=-1, append=-1))
    for begin, end in pairwise(bounds):
        number = int(numbers[begin])
        yield slice(begin, end), number, indices[begin:end] - PANEL_ROWS * number
