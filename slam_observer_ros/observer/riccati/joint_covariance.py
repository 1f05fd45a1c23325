"""The covariance of all errors that the Riccati filter knows of, in right-invariant coordinates.

The errors are x = (ε, c̃, ξ_1 … ξ_n): of the pose, Â = exp(ε) A, of the calibration, and of the
landmarks, ξ_i = ã_i + [ŷ_i]× ε_Ω with ã_i that of the estimate ŷ_i in the reference frame. The
p axes of ε and k of a point are those that are estimated. A point that moves with the pose has
ξ_i = ε_v, so residuals are r_i = ε_v − ξ_i whatever the map is (A. Barrau and
S. Bonnabel, *The invariant extended Kalman filter as a stable observer*, 2017).

Where the sensor is calibrated as well, r_i = ε_v − ξ_i + R̂ D_i c̃ (:mod:`.sensor_calibration`).
The blocks C_i of all methods are of ε (m, k, p), or of (ε, c̃), the first entries of x
(m, k, p + c).
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.blas import dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import (
    block_diagonal,
    kalman_update,
    transpose,
    with_blocks,
)
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.observer.riccati.symmetric_matrix import SymmetricMatrix
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion

if TYPE_CHECKING:
    from typing_extensions import Self


class JointCovariance:
    """P, kept in ``matrix``, and which of its columns are whose."""

    # Whether all landmarks are in P, and the rows of those that are, in its order: a correction
    # moves these. See :mod:`.compressed_covariance`.
    is_dense = True
    active: IntArray | slice = slice(None)

    def __init__(
        self, axes: EstimatedAxes, calibration: Calibration, matrix: SymmetricMatrix
    ) -> None:
        self._axes, self._p, self._matrix = axes, axes.p, matrix
        self.P = calibration.initial_covariance()
        self.first = len(self.P)  # p + c, the first column of the landmarks
        self._stride = axes.point  # columns of each landmark
        self._first_columns = self.first + np.arange(axes.point)

    @property
    def P(self) -> FloatArray:  # noqa: N802 (the field's name for it)
        """(p + c + k n, p + c + k n) covariance of x, as a view."""
        return self._matrix.values

    @P.setter
    def P(self, covariance: FloatArray) -> None:  # noqa: N802
        self._matrix.set(covariance)

    def copy(self, observer: Observer) -> Self:
        """Return an independent copy for a copy of the observer, which has one of P."""
        other = copy(self)
        other._matrix = observer.covariance
        return other

    @property
    def pose(self) -> FloatArray:
        """(p, p) covariance of ε."""
        return self.P[: self._p, : self._p]

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of the calibration."""
        variances: FloatArray = np.diagonal(self.P)[self._p : self.first]
        return variances

    def add_calibration(self, variances: FloatArray) -> None:
        """Append entries (c,) to c̃ that are independent of all else."""
        before, count = self.P, len(variances)
        at = np.append(np.arange(self.first), np.arange(self.first, len(before)) + count)
        P = np.zeros((len(before) + count,) * 2)
        P[np.ix_(at, at)] = before
        new = np.arange(self.first, self.first + count)
        P[new, new] = variances
        self.first += count
        self._first_columns = self._first_columns + count
        self.P = P

    def landmarks(self, points: FloatArray, ahead_s: float = 0.0) -> FloatArray:
        """Return the covariances (n, 3, 3) of ã_i for ``points`` (n, 3), ``ahead_s`` from now."""
        n, k = len(points), self._axes.point
        _, own = self.output(self._turning(points), np.arange(n))
        covariances = np.zeros((n, 3, 3))
        covariances[:, :k, :k] = own
        return covariances

    def with_pose(self, rows: IntArray, points: FloatArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i, for estimates (m, 3)."""
        columns = np.append(np.arange(self._p), self._columns(rows))
        P: FloatArray = self.P[np.ix_(columns, columns)]
        return sheared(P, self._p, -self._turning(points).reshape(-1, self._p))

    def of_landmarks(
        self, rows: IntArray, points: FloatArray, tags: IntArray
    ) -> FloatArray | None:
        """Return the covariance (m k + …) of ã_i of ``rows`` (m,), then of how ``tags`` turn."""
        with_pose = self.with_pose(rows, points)
        return None if with_pose is None else with_pose[self._p :, self._p :]

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return ξ_i (n, 3) of x, and the changes of velocities, None where there are none."""
        return self._axes.full_points(x[self.first :]), None

    def activate(self, rows: IntArray) -> None:
        """See to it that landmarks (m,), which are going to be observed, are in P."""

    def dense(self) -> JointCovariance:
        """Return the same with all landmarks in P."""
        return self

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far landmarks (m, 3) have yet to be moved, metres."""
        raise NotImplementedError

    # The step

    def propagate(self, motion: Motion, points: FloatArray, u: FloatArray) -> None:
        """Let the robot move, and landmarks of velocities ``u`` (n, 3), to ``points`` (n, 3)."""
        # Known velocities change no ξ_i.
        self._propagate(motion, self._turning(points).reshape(-1, self._p))

    def _propagate(self, motion: Motion, J_landmarks: FloatArray) -> None:
        """Let x become x + J (F c̃ + w), w the noise of a motion, with J's rows of landmarks."""
        P, p, c = self.P, self._p, slice(self._p, self.first)
        JT = np.zeros((p, len(P)))  # how a motion of the robot alone changes x, transposed
        JT[:, :p] = np.eye(p)
        JT[:, self.first :] = J_landmarks.T
        # P + J (F P_c + F P_c,c Fᵀ Jᵀ / 2 + noise Jᵀ / 2) + its transpose.
        if p == self.first:
            self._matrix.add_symmetric_product(JT, (0.5 * motion.noise).dot(JT))
            return
        F = motion.sensitivity
        noise = motion.noise + F.dot(P[c, c]).dot(F.T)
        self._matrix.add_symmetric_product(JT, F.dot(P[c]) + (0.5 * noise).dot(JT))
        P[c, c] += motion.drift

    def output_matrix(self, residuals: Residuals, chord: float = 0.0) -> FloatArray:
        """Return C_i of r_i = C_i (ε, c̃) − ξ_i, at ``chord`` from ŷ_i to the point seen."""
        # [0, I] at ŷ_i. Turning ŷ_i to the point seen, by however much, moves it at right angles
        # to the middle between them: judged by C at ŷ_i, a robot that has turned further than it
        # knows would reject what it sees.
        return self._with_sensor(self._axes.output_matrix(chord * residuals.r), residuals.D)

    def _with_sensor(self, C: FloatArray, D: FloatArray | None) -> FloatArray:
        """Return C_i (m, k, p + c) of C_i (m, k, p) and R̂ D_i (m, 3, c), if there is one."""
        return C if D is None else np.concatenate([C, D[:, : self._axes.point]], axis=2)

    def project(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return H P (m k, …) and H P Hᵀ (m k, m k) of H x = C_i (ε, c̃) − ξ_i."""
        q, columns = C.shape[2], self._columns(rows)
        C = C.reshape(-1, q)
        HP = C.dot(self.P[:q]) - self._matrix.rows(columns)
        return HP, HP[:, :q].dot(C.T) - HP.take(columns, axis=1)

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of C_i (ε, c̃) − ξ_i alone."""
        P, q = self.P, C.shape[2]
        columns = self._columns(rows).reshape(len(rows), self._axes.point)
        to_state, own = P[columns, :q], P[columns[..., :, None], columns[..., None, :]]
        PC = P[:q, :q] @ transpose(C) - transpose(to_state)
        return PC[:, : self._p], C @ PC - to_state @ transpose(C) + own

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of all together, (p, m k) and (m k, m k)."""
        q, columns = C.shape[2], self._columns(rows)
        C, seen = C.reshape(-1, q), self._matrix.rows(columns)
        to_state = seen[:, :q]
        PC = self.P[:q, :q].dot(C.T) - to_state.T
        return PC[: self._p], C.dot(PC) - to_state.dot(C.T) + seen.take(columns, axis=1)

    def change_of_residuals(self, residuals: Residuals, x: FloatArray) -> FloatArray:
        """Return H x (m, k), by which residuals change when the state is moved by exp(x)."""
        C, columns = self.output_matrix(residuals), self._columns(residuals.rows)
        change: FloatArray = C @ x[: C.shape[2]] - x[columns].reshape(len(C), -1)
        return change

    def correct(self, C: FloatArray, rows: IntArray, R: FloatArray, r: FloatArray) -> FloatArray:
        """Return −K r of residuals r (m, k) of noise R (m, k, k), K = P Hᵀ S⁻¹, and update P."""
        HP, HPH = self.project(C, rows)
        return -self.update(HP, with_blocks(HPH, R), r.ravel())

    def update(self, HP: FloatArray, S: FloatArray, r: FloatArray) -> FloatArray:
        """Update P by what :meth:`project` projected, which is used up; return K r.

        K = P Hᵀ S⁻¹ is the gain.
        """
        if not len(r):
            return np.zeros(len(self.P))
        L, is_indefinite = dpotrf(S, lower=1)
        if is_indefinite:  # by rounding, where all but nothing was known
            moved: FloatArray = kalman_update(self.P, HP, S).dot(r)
            return moved
        # P − Wᵀ W and Wᵀ z, W = L⁻¹ H P, z = L⁻¹ r, L Lᵀ = S.
        z = dtrsv(L, r, lower=1)
        W = dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
        self._matrix.subtract_square(W)
        Kr: FloatArray = z.dot(W)
        return Kr

    # Landmarks

    def add_seen(self, covariances: FloatArray, D: FloatArray | None = None) -> None:
        """Append landmarks (m,) seen for the first time, with covariances (m, 3, 3), R̂ D_i."""
        rows, noise = self._make_room(len(covariances)), self._noise(covariances)
        self._insert(rows, self._with_sensor(self._moving(rows), D), noise)

    def add_known(self, points: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks at ``points`` (m, 3) whose errors ã_i are independent of all else."""
        self._insert(self._make_room(len(points)), self._turning(points), self._noise(covariances))

    def add_correlated(self, known: KnownLandmarks) -> None:
        """Append landmarks of a map (m,) likewise, but with errors that are correlated."""
        rows, covariance = self._make_room(len(known)), known.covariance_on(self._axes)
        self._insert(rows, self._turning(known.points), covariance)

    def relocate(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take landmarks (m,) for newly seen ones, with covariances (m, 3, 3), R̂ D_i."""
        C = self._with_sensor(self._moving(covariances), D)
        self._insert(rows, C, self._noise(covariances))

    def remove(self, rows: IntArray) -> None:
        """Delete the rows and columns of landmarks."""
        columns = (self.first + self._stride * rows[:, None] + np.arange(self._stride)).ravel()
        self.P = np.delete(np.delete(self.P, columns, axis=0), columns, axis=1)

    def gauge(self, n: int) -> FloatArray:
        """Return G (…, p): how x changes when all, with n landmarks, is moved by exp(γ)."""
        rows = np.arange(n)
        G = np.zeros((len(self.P), self._p))
        G[: self._p] = np.eye(self._p)
        G[self._columns(rows)] = self._moving(rows).reshape(-1, self._p)
        return G

    def at_rest(self, rows: IntArray, points: FloatArray) -> FloatArray:
        """Return G (…, p) likewise if landmarks ``rows`` at ``points`` (m, 3) are not moved."""
        G = np.zeros((len(self.P), self._p))
        G[self._columns(rows)] = self._turning(points).reshape(-1, self._p)
        return G

    def difference(
        self, rows: IntArray, others: IntArray, points: FloatArray, other_points: FloatArray
    ) -> FloatArray:
        """Return H (m k, …) of the differences ã_i − ã_j of landmarks at two points (m, 3)."""
        H = np.zeros((len(rows) * self._axes.point, len(self.P)))
        each = np.arange(len(H))
        H[each, self._columns(rows)], H[each, self._columns(others)] = 1.0, -1.0
        H[:, : self._p] = self._turning(other_points - points).reshape(-1, self._p)
        return H

    # Other coordinates

    def of_positions(self, points: FloatArray) -> FloatArray:
        """Return the covariance of (ε, c̃, ã_1 … ã_n) for estimates ``points`` (n, 3)."""
        return sheared(self.P, self.first, -self._all_turning(points))

    def set_of_positions(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take over what :meth:`of_positions` returns."""
        self.P = sheared(covariance, self.first, self._all_turning(points))

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take ``covariance`` (p, p) for that of ε, independent of c̃ and of all ã_i."""
        P = self.of_positions(points)
        P[: self._p] = P[:, : self._p] = 0.0
        P[: self._p, : self._p] = covariance
        self.set_of_positions(P, points)

    def _noise(self, covariances: FloatArray) -> FloatArray:
        """Return the covariance (m k, m k) of independent points, given theirs (m, 3, 3)."""
        k = self._axes.point
        return block_diagonal(covariances[:, :k, :k])

    def _insert(self, rows: IntArray, C: FloatArray, noise: FloatArray) -> None:
        # ξ_i = C_i (ε, c̃) + noise of this covariance (m k, m k)
        q, columns = C.shape[2], self._columns(rows)
        C = C.reshape(-1, q)
        CP = C @ self.P[:q]
        self.P[columns], self.P[:, columns] = CP, CP.T
        own = CP[:, :q] @ C.T + noise
        self.P[np.ix_(columns, columns)] = 0.5 * (own + own.T)

    def _make_room(self, m: int) -> IntArray:
        """Append rows and columns for m landmarks; return which landmarks they are."""
        first_row = (len(self.P) - self.first) // self._stride
        self._matrix.append_zeros(m * self._stride)
        return np.arange(first_row, first_row + m)

    def _columns(self, rows: IntArray) -> IntArray:
        return (self._first_columns + self._stride * rows[:, None]).ravel()

    def _all_turning(self, points: FloatArray) -> FloatArray:
        return self._turning(points).reshape(-1, self._p)

    def _turning(self, points: FloatArray) -> FloatArray:
        """Return the blocks [[y_i]×, 0] (m, k, p): ξ_i of landmarks without an error ã_i."""
        return -self._axes.turn_matrix(points)

    def _moving(self, landmarks: FloatArray | IntArray) -> FloatArray:
        """Return the blocks [0, I] (m, k, p): ξ_i of m landmarks that move with the pose."""
        return self._axes.output_matrix(np.zeros((len(landmarks), 3)))


class ExactMapCovariance(JointCovariance):
    """P of (ε, c̃) alone, in a map that is taken to be exact: ã_i = 0, and ξ_i = [ŷ_i]× ε_Ω."""

    active = slice(0)

    def __init__(
        self, axes: EstimatedAxes, joint: JointCovariance, covariances: FloatArray
    ) -> None:
        self._axes, self._p, self.first = axes, axes.p, joint.first
        self._first_columns, self._matrix = joint._first_columns, joint._matrix
        self.P = joint.P[: self.first, : self.first]
        self._covariances = covariances  # (n, 3, 3) of the map, which are only passed on

    def landmarks(self, points: FloatArray, ahead_s: float = 0.0) -> FloatArray:
        """Return the covariances (n, 3, 3) of the landmarks, as the map has them."""
        return self._covariances

    def with_pose(self, rows: IntArray, points: FloatArray) -> FloatArray | None:
        """Return None: how far the map is off, nobody knows."""
        return None

    def propagate(self, motion: Motion, points: FloatArray, u: FloatArray) -> None:
        """Add a motion's noise to that of the pose."""
        motion.predict(self.P)

    def output_matrix(self, residuals: Residuals, chord: float = 0.0) -> FloatArray:
        """Return C_i of r_i = C_i (ε, c̃): [−[ŷ_i]×, I] of ε."""
        C = self._axes.output_matrix(residuals.landmarks + chord * residuals.r)
        return self._with_sensor(C, residuals.D)

    def change_of_residuals(self, residuals: Residuals, x: FloatArray) -> FloatArray:
        """Return H x (m, k)."""
        C = self.output_matrix(residuals)
        change: FloatArray = C @ x[: C.shape[2]]
        return change

    def project(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return H P and H P Hᵀ of H x = C_i (ε, c̃)."""
        q = C.shape[2]
        C = C.reshape(-1, q)
        HP = C @ self.P[:q]
        return HP, HP[:, :q] @ C.T

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of each C_i (ε, c̃) alone."""
        q = C.shape[-1]
        PC = self.P[:q, :q] @ transpose(C)
        return PC[..., : self._p, :], C @ PC

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of all together, (p, m k) and (m k, m k)."""
        return self.output(C.reshape(-1, C.shape[2]), rows)

    def remove(self, rows: IntArray) -> None:
        """Forget landmarks."""
        self._covariances = np.delete(self._covariances, rows, axis=0)

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take ``covariance`` (p, p) for that of ε, independent of c̃."""
        super().set_pose(covariance, np.empty((0, 3)))


def sheared(P: FloatArray, first: int, L: FloatArray) -> FloatArray:
    """Return the covariance of x whose entries from ``first`` on have grown by L ε, L (…, p)."""
    p = L.shape[1]
    result: FloatArray = P.copy()
    half = L @ P[:p]
    half[:, first:] += 0.5 * half[:, :p] @ L.T
    result[first:] += half
    result[:, first:] += half.T  # its mirror image, so that P stays symmetric
    return result
