"""Corrections of a local state x whose effect on errors η of other landmarks is postponed.

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
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.linalg.lapack import dpstrf

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.axes import EstimatedAxes


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
