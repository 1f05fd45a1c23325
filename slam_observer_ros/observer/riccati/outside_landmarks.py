"""Landmarks that are out of view, and how they depend on the local state x of those in view.

Each has the error η_i = ξ_i − [y_i°]× ε_Ω, that of its position with a reference y_i°: it does not
move while the robot does. Each is kept in a slot, k rows of all arrays, which it keeps while it is
in view, too; what is there is out of date then, and X is zero. Free slots have zeros.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import diagonal_blocks, transpose
from slam_observer_ros.observer.riccati.panel_matrix import PanelMatrix


class OutsideLandmarks:
    """B, the covariance of all η, and X = cov(η, x), both as of one instant."""

    def __init__(self, point: int, size: int) -> None:
        self._k = point
        self.matrix = PanelMatrix()  # B
        # Never changed in place: copies share them.
        self.X: FloatArray = np.zeros((0, size))  # (k slots, q₀)
        self.own: FloatArray = np.zeros((0, point, point))  # (slots, k, k) diagonal blocks of B
        self.references: FloatArray = np.zeros((0, 3))  # (slots, 3) y_i°, metres
        self._free: list[int] = []

    def copy(self) -> OutsideLandmarks:
        """Return an independent copy."""
        other = copy(self)
        other.matrix, other._free = self.matrix.copy(), self._free.copy()
        return other

    def rows(self, slots: IntArray) -> IntArray:
        """Return the rows (m k,) of landmarks in B and X."""
        return (self._k * slots[:, None] + np.arange(self._k)).ravel()

    def blocks(self, slots: IntArray) -> FloatArray:
        """Return the rows of X (m, k, q₀) of landmarks."""
        blocks: FloatArray = self.X.reshape(-1, self._k, self.X.shape[1])[slots]
        return blocks

    def new_slots(self, count: int) -> IntArray:
        """Return free slots for so many landmarks, ascending."""
        if len(self._free) < count:
            before = len(self.own)
            self.matrix.extend(self._k * (before + count - len(self._free)))
            after = len(self.matrix) // self._k
            room, k = after - before, self._k
            self.X = np.concatenate([self.X, np.zeros((k * room, self.X.shape[1]))])
            self.own = np.concatenate([self.own, np.zeros((room, k, k))])
            self.references = np.concatenate([self.references, np.zeros((room, 3))])
            self._free += range(before, after)
        self._free.sort()
        slots, self._free = self._free[:count], self._free[count:]
        return np.array(slots, dtype=np.int64)

    def remove(self, slots: IntArray) -> None:
        """Forget landmarks."""
        rows = self.rows(np.sort(slots))
        self.matrix.set_columns(rows, np.zeros((len(self.X), len(rows))))
        self.X = self.X.copy()
        self.X[rows] = 0.0
        self._free += slots.tolist()

    def add_independent(self, points: FloatArray, covariances: FloatArray) -> IntArray:
        """Add landmarks (m,) whose errors are independent of all else; return their slots."""
        slots = self.new_slots(len(points))
        self.matrix.set_blocks(self.rows(slots), covariances)
        self.own, self.references = self.own.copy(), self.references.copy()
        self.own[slots], self.references[slots] = covariances, points
        return slots

    def put(
        self,
        slots: IntArray,
        points: FloatArray,
        to_x: FloatArray,
        own: FloatArray,
        to_others: FloatArray,
    ) -> None:
        """Set all that is known of landmarks (m,), which refer to ``points``; slots ascend.

        Their covariances are those with x (m k, q₀), their own (m k, m k), and with all (…, m k).
        """
        rows = self.rows(slots)
        to_others[rows] = own
        self.matrix.set_columns(rows, to_others)
        self.X[rows] = to_x  # it has just been made
        self.own, self.references = self.own.copy(), self.references.copy()
        self.own[slots], self.references[slots] = diagonal_blocks(own, self._k), points

    def subtract(self, F: FloatArray) -> None:
        """Let B become B − X F Fᵀ Xᵀ."""
        U = self.X @ F
        self._add(U, -np.ones(U.shape[1]))

    def set_references(
        self, slots: IntArray, points: FloatArray, turns: FloatArray, P: FloatArray
    ) -> None:
        """Let landmarks refer to ``points`` (m, 3), by which η grows by ``turns`` (m k, s) ε_Ω.

        These s angles are the first entries of x, of the covariance P.
        """
        s = turns.shape[1]
        D = np.zeros((len(self.X), s))
        D[self.rows(slots)] = turns
        # D Zᵀ + Z Dᵀ, as the difference of two squares.
        Z = self.X[:, :s] + 0.5 * D @ P[:s, :s]
        self.X = self.X + D @ P[:s]
        self._add(np.hstack([D + Z, D - Z]), np.repeat([0.5, -0.5], s))
        self.references = self.references.copy()
        self.references[slots] = points

    def _add(self, U: FloatArray, w: FloatArray) -> None:
        blocks = U.reshape(len(self.own), self._k, len(w))
        self.own = self.own + (blocks * w) @ transpose(blocks)
        self.matrix.add(U, w)
