"""What corrections of a local state have yet to do to errors that depend on it.

Errors η of landmarks out of view do not move, and are observed only through those of the local
state x. With X = cov(η, x) at the instant from which on corrections are postponed, a correction
of x, H x being observed with the covariance S and the residual r, leaves

    cov(η, x) = X Φᵀ,    Φ ← Φ − K H Φ
    cov(η)    = B − X Ψ Xᵀ,    Ψ ← Ψ + (H Φ)ᵀ S⁻¹ H Φ
    η̂         moved by  −X g,    g = (H Φ)ᵀ S⁻¹ r,

whatever η is and however many of them there are. Where some of the η become part of x, X has the
columns cov(η, η_i) of B, too: Φ and Ψ grow by these. On the group, X̂ ← exp(−K r) · X̂, the shift
a of a landmark since its reference becomes D a − J X_i g, with D = exp(ε_Ω) and its left
Jacobian J; over many corrections D₁ a + T X_i, with a tensor T. A tag's orientation turns by
exp(−X_i g) each time. See docs/theory.md, Large maps.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.linalg.lapack import dpstrf

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import so3
from slam_observer_ros.geometry.axes import EstimatedAxes


class PostponedCorrection:
    """Φ (q, q₀), Ψ (q₀, q₀), D (k, k) and T (k, k, q₀) since x had q₀ entries, of covariance P."""

    def __init__(self, P: FloatArray, point: int, have_turns: bool = False) -> None:
        size = len(P)
        # Of each correction g (q₀ of then,), by which the orientations of tags turn
        self.gains: list[FloatArray] | None = [] if have_turns else None
        self.Phi: FloatArray = np.eye(size)
        self.Psi: FloatArray = np.zeros((size, size))
        self.turn: FloatArray = np.eye(point)
        self.shift: FloatArray = np.zeros((point, point, size))
        self.has_moved = False
        self._deviations = np.sqrt(np.maximum(np.diagonal(P), 0.0))

    def copy(self) -> PostponedCorrection:
        """Return an independent copy."""
        other = copy(self)
        other.Phi, other.Psi = self.Phi.copy(), self.Psi.copy()
        other.shift = self.shift.copy()
        other.gains = None if self.gains is None else self.gains.copy()
        return other

    def correct(self, W: FloatArray, W_Phi: FloatArray, z: FloatArray, turn: FloatArray) -> None:
        """Take in a correction which turned the state by ``turn`` (3,), rad.

        With S = L Lᵀ it is given by L⁻¹ H P (m, q), L⁻¹ H Φ (m, q₀) and L⁻¹ r (m,).
        """
        self.Phi -= W.T @ W_Phi
        self.Psi += W_Phi.T @ W_Phi
        k, g = len(self.turn), W_Phi.T @ z
        D, J = so3.exp(turn)[:k, :k], so3.left_jacobian(turn)[:k, :k]
        self.turn = D @ self.turn
        self.shift = (D @ self.shift.reshape(k, -1)).reshape(self.shift.shape)
        self.shift -= J[:, :, None] * g
        self.has_moved = True
        if self.gains is not None:
            self.gains.append(g)

    def shifted(self, a: FloatArray, X: FloatArray) -> FloatArray:
        """Return what shifts a (n, k) have become, of landmarks with X (n, k, q₀)."""
        T = self.shift.reshape(len(self.turn), -1)
        moved: FloatArray = a @ self.turn.T + X.reshape(-1, T.shape[1]) @ T.T
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
        # One after the other: the product of all is that of the products of two neighbours.
        while R.shape[1] > 1:
            last = R[:, R.shape[1] // 2 * 2 :]
            R = np.concatenate([R[:, 1::2] @ R[:, : R.shape[1] // 2 * 2 : 2], last], axis=1)
        turns: FloatArray = R[:, 0]
        return turns

    def extend(self, count: int) -> None:
        """Append entries to x, which do not depend on η so far."""
        self.Phi = np.concatenate([self.Phi, np.zeros((count, self.Phi.shape[1]))])

    def take(self, Phi: FloatArray, variances: FloatArray) -> None:
        """Append entries to x that were η (m,): rows of Φ, and a column of X for each."""
        m = len(variances)
        self.Phi = np.block([[self.Phi, np.zeros((len(self.Phi), m))], [Phi, np.eye(m)]])
        self.Psi = np.pad(self.Psi, (0, m))
        self.shift = np.pad(self.shift, ((0, 0), (0, 0), (0, m)))
        self._deviations = np.append(self._deviations, np.sqrt(np.maximum(variances, 0.0)))

    def remove(self, entries: IntArray) -> None:
        """Remove entries of x."""
        self.Phi = np.delete(self.Phi, entries, axis=0)

    def root(self) -> FloatArray:
        """Return F (q₀, r) with F Fᵀ = Ψ up to rounding, r being the rank of Ψ."""
        # In units of standard deviations, as those of angles and positions differ by far.
        scaled = self._deviations[:, None] * self.Psi * self._deviations
        L, order, rank, _ = dpstrf(scaled, lower=1)
        F = np.zeros((len(scaled), rank))
        F[order - 1] = np.tril(L)[:, :rank]
        used = self._deviations > 0.0
        F[used] /= self._deviations[used, None]
        return F
