"""The core of scheduled gains: few errors that are estimated jointly, in a map of any size.

The core z = (ε, c, ã_1 … ã_K) has the errors of the pose, of the velocity's calibration, and of
the K landmarks seen last; P is their covariance. How other landmarks depend on them is in
:class:`.PostponedLandmarks`.

When the core becomes z' = Φ z + noise, because the robot moves or one landmark replaces another,
z = G z' + ζ with the regression G = P Φᵀ P'⁻¹, and ζ has the covariance V = P − G Φ P, here in
Joseph's form. The postponed landmarks, which depend on the core, follow both.

The error of a postponed landmark i is ã_i = F_i z + η_i, with η_i ~ N(0, N_i) independent of all
else. An observation of the core, or of other landmarks, changes neither F_i nor N_i. It moves the
estimate of z by x, and so the landmark by F_i x. When the core becomes another one, z = G z' + ζ
with ζ ~ N(0, V) independent of z', then F_i becomes F_i G, and N_i becomes N_i + F_i V F_iᵀ. A
sequence of such changes is one such change:

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
from slam_observer_ros.geometry.matrices import cholesky, kalman_update, symmetric, transpose
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion

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


CAPACITY = 8
"""K: three points fix a frame in space, and still do when half of eight have been exchanged."""

EMPTY = -1
"""Row of a slot of the core that has no landmark."""

NEVER = 1 << 62
"""Age, in observations, of an empty slot: older than any landmark's."""

ROUNDING = 1e-12
"""Share of its variances that is added to a covariance that may be singular to invert it."""


class Core:
    """Covariance of the core, and which landmarks are in its K slots."""

    def __init__(self, axes: EstimatedAxes, calibration: Calibration) -> None:
        start = calibration.initial_covariance()
        self._axes, self._calibration = axes, calibration
        self._p = axes.p
        # (K, k) the entries of z that each slot has
        self._slots = len(start) + np.arange(CAPACITY * axes.point).reshape(CAPACITY, axes.point)
        self._unseen = np.full(CAPACITY, NEVER)
        self.rows: IntArray = np.full(CAPACITY, EMPTY)  # (K,) the landmarks in the slots
        # (q, q) covariance of z; the entries of an empty slot are zero
        self.P: FloatArray = np.zeros((len(start) + self._slots.size,) * 2)
        self.P[: len(start), : len(start)] = start
        self.postponed = PostponedLandmarks(axes, len(self.P))

    def copy(self, calibration: Calibration) -> Core:
        """Return an independent copy, whose calibration has been copied."""
        other = copy(self)
        other._calibration, other._unseen = calibration, self._unseen.copy()
        other.rows, other.P = self.rows.copy(), self.P.copy()
        other.postponed = self.postponed.copy()
        return other

    def predict(self, motion: Motion) -> None:
        """Add a motion's noise to the pose, and what the calibration's error adds."""
        before, Phi = self.P.copy(), np.eye(len(self.P))
        motion.predict(self.P)
        Phi[: self._p, self._p : self._p + self._calibration.count] = motion.sensitivity
        self._change_core(before, Phi)

    def set_pose_error_covariance(self, covariance: FloatArray) -> None:
        """Take over the covariance (p, p) of ε, independent of all else."""
        before, Phi = self.P.copy(), np.eye(len(self.P))
        Phi[: self._p] = self.P[: self._p] = self.P[:, : self._p] = 0.0
        self.P[: self._p, : self._p] = covariance
        self._change_core(before, Phi)

    def step(self, H: FloatArray, gain_k: FloatArray, r: FloatArray) -> FloatArray:
        """Return −P⁺ Σ H_iᵀ k_i r_i (q, 1), for H (m, k, q), k_i (m, k, k) and r (m, k, 1)."""
        HtK = transpose(H) @ gain_k
        information, gradient = np.sum(HtK @ H, axis=0), np.sum(HtK @ r, axis=0)
        eye = np.eye(len(self.P))
        x: FloatArray = -np.linalg.solve(eye + self.P @ information, self.P @ gradient)
        return x

    def measurement_update(self, H: FloatArray, gain_k: FloatArray) -> None:
        """Update P by m observations with H (m, k, q) and k_i (m, k, k)."""
        root = transpose(cholesky(gain_k)) @ H
        W = np.asarray(np.linalg.qr(root.reshape(-1, len(self.P)), mode='r'))  # WᵀW = Σ Hᵀ k H
        WP = W @ self.P
        kalman_update(self.P, WP, WP @ W.T + np.eye(len(W)))

    def turn(self, x: FloatArray) -> None:
        """Let a motion of everything remain one where the step x (q,) has put landmarks."""
        T = np.zeros_like(self.P)
        shifts = self._axes.full_points(x[self._slots].ravel())
        T[self._slots.ravel(), : self._p] = self._axes.turn_matrix(shifts).reshape(-1, self._p)
        eye = np.eye(len(T))
        self.P = _transformed(self.P, eye + T)
        # (I + T)⁻¹ = I − T: T turns landmarks by the pose, and not the pose.
        self.postponed.change_core(eye - T, np.zeros_like(T))

    def admit(self, rows: IntArray) -> None:
        """Put landmarks (m,) just seen into the core, in place of those unseen for longest."""
        # Which are new, and whose slots they get.
        seen = (self.rows[:, None] == rows).any(axis=1)
        self._unseen = np.where(seen, 0, self._unseen + 1)
        new = rows[~(rows[:, None] == self.rows).any(axis=1)][: np.sum(~seen)]
        if not len(new):
            return
        slots = np.argsort(-self._unseen, kind='stable')[: len(new)]
        replaced, columns = self.rows[slots], self._slots[slots]
        self.postponed.release(replaced[replaced != EMPTY])
        # z' has F_i z + η_i in these.
        F, N, _ = self.postponed.now(new)
        before, Phi = self.P, np.eye(len(self.P))
        Phi[columns] = F
        self.P = _transformed(before, Phi)
        self.P[columns[:, :, None], columns[:, None, :]] += N
        self._change_core(before, Phi)
        self.rows[slots], self._unseen[slots] = new, 0
        self.postponed.hold(new, np.eye(len(Phi))[columns])

    def dismiss(self, rows: IntArray) -> None:
        """Take landmarks (m,) out of the core, as far as they are in it."""
        slots = np.flatnonzero(np.isin(self.rows, rows) & (self.rows != EMPTY))
        if not len(slots):
            return
        self.postponed.release(self.rows[slots])
        self.rows[slots], self._unseen[slots] = EMPTY, NEVER
        before, Phi = self.P, np.eye(len(self.P))
        Phi[self._slots[slots].ravel()] = 0.0
        self.P = _transformed(before, Phi)
        self._change_core(before, Phi)

    def remove(self, rows: IntArray) -> None:
        """Forget landmarks (m,); those behind move up."""
        self.dismiss(rows)
        self.postponed.remove(rows)
        self.rows -= np.searchsorted(np.sort(rows), self.rows)  # by 0 for EMPTY

    def _change_core(self, before: FloatArray, Phi: FloatArray) -> None:
        """Let landmarks depend on z', whose covariance P is already; ``before`` is that of z."""
        after = Phi @ before
        G = _times_inverse(after.T, self.P)
        shared = G @ after
        self.postponed.change_core(G, before - shared - shared.T + G @ self.P @ G.T)


def regression(P: FloatArray, of: IntArray, on: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return B (a, b) and the covariance of ζ in x_of = B x_on + ζ, x of covariance P."""
    B = _times_inverse(P[np.ix_(of, on)], P[np.ix_(on, on)])
    return B, P[np.ix_(of, of)] - B @ P[np.ix_(on, of)]


def _times_inverse(cross: FloatArray, P: FloatArray) -> FloatArray:
    """Return cross P⁻¹ for a covariance P that may be singular."""
    rounding = ROUNDING * np.diagonal(P) + np.finfo(np.float64).tiny
    product: FloatArray = np.linalg.solve(P + np.diag(rounding), cross.T).T
    return product


def _transformed(P: FloatArray, Phi: FloatArray) -> FloatArray:
    return symmetric(Phi @ P @ Phi.T)
