"""Landmarks that depend on a small core z, and follow it when they are next needed.

The error of landmark i is ã_i = F_i z + η_i, with η_i ~ N(0, N_i) independent of all else. An
observation of the core, or of other landmarks, changes neither F_i nor N_i. It moves the estimate
of z by x, and so the landmark by F_i x. When the core becomes another one, z = G z' + ζ with
ζ ~ N(0, V) independent of z', then F_i becomes F_i G, and N_i becomes N_i + F_i V F_iᵀ. A sequence
of such changes is one such change:

    (G, V, x) then (G', V', x')   =   (G G',  V + G V' Gᵀ,  x + G x')

So nothing is done to a landmark out of view. Landmarks that were brought up to date together form
a group, and the changes since are composed once for the group: O(1) each. Groups are merged like
the digits of a binary counter, so each is more than twice as large as the next, there are at most
log₂ n of them, and a landmark takes part in O(log n) mergers until it is seen again.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import transpose

CORE = 0
"""The group of the landmarks that are in the core. F picks the entries of z that they are, and N
is zero: these never change. Only moves are postponed, until one is seen or is not in the core.
"""


class PostponedLandmarks:
    """F_i and N_i of all landmarks, and what each group has yet to follow."""

    def __init__(self, axes: EstimatedAxes, core_size: int) -> None:
        self._axes = axes
        self._F: FloatArray = np.empty((0, axes.point, core_size))
        self._N: FloatArray = np.empty((0, axes.point, axes.point))
        self._shifts: FloatArray = np.empty((0, 3))
        self._group: IntArray = np.empty(0, dtype=np.int64)
        self._members: list[IntArray] = [np.empty(0, dtype=np.int64)]  # and former ones
        self._sizes: IntArray = np.zeros(1, dtype=np.int64)
        self._G: FloatArray = np.eye(core_size)[None]
        self._V: FloatArray = np.zeros((1, core_size, core_size))
        self._x: FloatArray = np.zeros((1, core_size))

    def __len__(self) -> int:
        return len(self._F)

    def copy(self) -> PostponedLandmarks:
        """Return an independent copy."""
        other = copy(self)
        other._F, other._N, other._shifts = self._F.copy(), self._N.copy(), self._shifts.copy()
        other._group, other._sizes = self._group.copy(), self._sizes.copy()
        other._G, other._V, other._x = self._G.copy(), self._V.copy(), self._x.copy()
        return other  # lists of members are never changed in place

    def add(self, F: FloatArray, N: FloatArray) -> None:
        """Append landmarks (m,) with F (m, k, q) and N (m, k, k), m²."""
        rows = np.arange(len(self), len(self) + len(F))
        self._F, self._N = np.concatenate([self._F, F]), np.concatenate([self._N, N])
        self._shifts = np.concatenate([self._shifts, np.zeros((len(F), 3))])
        self._group = np.append(self._group, np.full(len(F), CORE))
        self._sizes[CORE] += len(F)
        self._form_group(rows)

    def remove(self, rows: IntArray) -> None:
        """Forget landmarks; those behind move up."""
        self._F, self._N = np.delete(self._F, rows, axis=0), np.delete(self._N, rows, axis=0)
        self._shifts = np.delete(self._shifts, rows, axis=0)
        self._group = np.delete(self._group, rows)
        self._members = [np.flatnonzero(self._group == g) for g in range(len(self._sizes))]
        self._sizes = np.array([len(members) for members in self._members], dtype=np.int64)

    def change_core(self, G: FloatArray, V: FloatArray) -> None:
        """Express the errors by another core z', with z = G z' + ζ and ζ ~ N(0, V), (q, q)."""
        before = self._G[1:]
        self._V[1:] += before @ V @ transpose(before)
        self._G[1:] = before @ G

    def shift(self, x: FloatArray) -> None:
        """Let the estimate of z be moved by x (q,)."""
        self._x += self._G @ x

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far landmarks (m, 3) have yet to be moved, metres."""
        return self._followed(self._F[rows], self._group[rows]) + self._shifts[rows]

    def now(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F (m, k, q), N (m, k, k) and the moves (m, 3) that landmarks have yet to make."""
        F, group = self._F[rows], self._group[rows]
        shifts = self._followed(F, group)
        # A motion of everything, by which a point p moves along [−[p]×, I], is to remain one when
        # the point has moved. In the core that is done when the core moves.
        turns = self._axes.turn_matrix(shifts)
        F[:, :, : self._axes.p] += turns * (group != CORE)[:, None, None]
        N = self._N[rows] + F @ self._V[group] @ transpose(F)
        return F @ self._G[group], N, shifts + self._shifts[rows]

    def _followed(self, F: FloatArray, group: IntArray) -> FloatArray:
        return self._axes.full_points((F @ self._x[group][:, :, None]).ravel())

    def update(self, rows: IntArray, F: FloatArray, N: FloatArray) -> None:
        """Set F (m, k, q) and N (m, k, k) of landmarks up to date; those in the core stay."""
        held = self._group[rows] == CORE
        if held.any():
            self.hold(rows[held], self._F[rows[held]])
            rows, F, N = rows[~held], F[~held], N[~held]
        self._F[rows], self._N[rows], self._shifts[rows] = F, N, 0.0
        self._form_group(rows)

    def hold(self, rows: IntArray, F: FloatArray) -> None:
        """Put landmarks that are up to date into the core, as its entries F z."""
        self._drop_from_groups(rows)
        self._sizes[CORE] += len(rows)
        self._group[rows] = CORE
        self._F[rows], self._N[rows], self._shifts[rows] = F, 0.0, 0.0
        self._x[CORE, F.any(axis=(0, 1))] = 0.0  # no move of their entries is postponed now

    def release(self, rows: IntArray) -> None:
        """Take landmarks out of the core; they depend on those entries of z which they were."""
        self._shifts[rows] = self.now(rows)[2]
        self._form_group(rows)

    def due(self) -> IntArray:
        """Return landmarks to be brought up to date so that groups stay few; some may be twice."""
        last = len(self._sizes) - 1
        first, size = last, self._sizes[last]
        while first > 1 and self._sizes[first - 1] <= 2 * size:
            first -= 1
            size += self._sizes[first]
        if first == last:
            return np.empty(0, dtype=np.int64)
        rows = np.concatenate(self._members[first:])
        return rows[self._group[rows] >= first]

    def _form_group(self, rows: IntArray) -> None:
        """Let landmarks (m,) follow as one what changes from now on."""
        if not len(rows):
            return
        self._drop_from_groups(rows)
        count = len(self._sizes)
        while count > 1 and not self._sizes[count - 1]:
            count -= 1
        self._group[rows] = count
        self._members = [*self._members[:count], rows]
        self._sizes = np.append(self._sizes[:count], len(rows))
        self._G = np.concatenate([self._G[:count], np.eye(self._G.shape[1])[None]])
        self._V = np.concatenate([self._V[:count], np.zeros_like(self._V[:1])])
        self._x = np.concatenate([self._x[:count], np.zeros_like(self._x[:1])])

    def _drop_from_groups(self, rows: IntArray) -> None:
        self._sizes -= np.bincount(self._group[rows], minlength=len(self._sizes))
