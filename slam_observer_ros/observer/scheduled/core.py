"""The core of scheduled gains: few errors that are estimated jointly, in a map of any size.

The core z = (ε, c, ã_1 … ã_K) has the errors of the pose, of the velocity's calibration, and of
the K landmarks seen last; P is their covariance. How other landmarks depend on them is in
:mod:`.postponed_landmarks`.

When the core becomes z' = Φ z + noise, because the robot moves or one landmark replaces another,
z = G z' + ζ with the regression G = P Φᵀ P'⁻¹, and ζ has the covariance V = P − G Φ P, here in
Joseph's form. The postponed landmarks, which depend on the core, follow both.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import cholesky, kalman_update, symmetric, transpose
from slam_observer_ros.observer.scheduled.postponed_landmarks import PostponedLandmarks
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion

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
