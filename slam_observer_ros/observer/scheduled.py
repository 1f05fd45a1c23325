"""Variance-scheduled gains: the paper's k_i and l_i, set by variances, at O(m) for m points seen.

Landmarks share little beyond the errors of the robot and of the landmarks near it. So a full
covariance P is kept of the errors of a small *core* z = (ε, c, ã_1 … ã_K) alone: pose, calibration
of the velocity, and the K landmarks seen last. The error of any other landmark depends on that of
the core, and has a part of its own, taken to be independent of all others:

    ã_i = F_i z + η_i,  η_i ~ N(0, N_i);  when first seen, F_i = [−[y_i°]×, I, 0 …] and N_i = R_i.

The residual is r_i ≈ C_i ε − ã_i = H_i z − η_i with C_i = [−[p̂_i]×, I] and H_i = C_i − F_i. With
the noise R_i of the observation, the gains of (30) and (31) become matrices

    k_i = (N_i + R_i)⁻¹,                 Δ = −P⁺ Σ H_iᵀ k_i r_i,  P⁺ = (P⁻¹ + Σ H_iᵀ k_i H_i)⁻¹
    l_i / k_i · dt = N_i (N_i + R_i)⁻¹,  δ_i = F_i Δ + N_i k_i (r_i + H_i Δ)

where Δ is a step of all of z, and F_i ← F_i + N_i k_i H_i, N_i ← N_i − N_i k_i N_i. A landmark out
of view keeps F_i and N_i, and follows by F_i Δ later (:mod:`.scheduled_core`). Where the core
becomes another one (:class:`.Core`), what it no longer explains is added to each N_i as if it were
its own. So P is not that of an exact filter, and not published. See docs/theory.md, Gain designs,
which also has the origin: the compressed EKF and postponement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import (
    block_diagonal,
    diagonal_blocks,
    mahalanobis,
    symmetric,
    transpose,
)
from slam_observer_ros.observer.gains import Gains, OF_CONSTANT_GAINS, OF_JOINT_COVARIANCES
from slam_observer_ros.observer.known_landmarks import anchor, KnownLandmarks
from slam_observer_ros.observer.observer import Residuals
from slam_observer_ros.observer.robust import accepted, huber_weights, REWEIGHTINGS
from slam_observer_ros.observer.scheduled_core import Core, regression
from slam_observer_ros.sensor_models.calibration import without_sensor_calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.sensor_models.observation_noise import repetition_factors
from slam_observer_ros.settings.estimator_settings import Settings

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True, slots=True)
class _Step:
    """What m points ask for; a points have passed the gate. See the module's docstring."""

    Delta: FloatArray  # (q, 1) step Δ of the core
    gain_k: FloatArray  # (m, k, k) gains k_i, zero where the gate rejects a point
    k_left: FloatArray  # (m, k, 1) k_i (r_i + H_i Δ), with what the step leaves of the residual
    noise: FloatArray  # (a, k, k) R_i, over the weight and for errors that last
    weights: FloatArray  # (m,) Huber's weights, zero where the gate rejects a point


class ScheduledGains(Gains):
    """Gains from the covariance of a small core and how each landmark depends on it."""

    ignores = (
        *OF_CONSTANT_GAINS,
        *OF_JOINT_COVARIANCES,
        'landmark_velocity_stddev',
        'use_tag_orientation',
        'orientation_noise',
    )

    def __init__(self, settings: Settings, reference_pose: FloatArray) -> None:
        super().__init__(settings, reference_pose)
        self._core = Core(self.axes, self.calibration)
        self._postponed = self.observer.postponed = self._core.postponed

    @staticmethod
    def estimated(settings: Settings) -> Settings:
        """Return the settings without calibrations of sensors, which are not estimated."""
        return without_sensor_calibration(settings)

    def copy(self) -> Self:
        """Return an independent copy."""
        other = super().copy()
        other._core = self._core.copy(other.calibration)
        other._postponed = other.observer.postponed = other._core.postponed
        return other

    def advance(self, motion: Motion) -> None:
        """Move pose and landmarks along a motion (27), and add its noise to the core's."""
        super().advance(motion)
        self._core.predict(motion)

    def prepare(self, rows: IntArray) -> None:
        """Bring landmarks (m,) up to date that are going to be observed; −1 for a new one."""
        rows = np.union1d(rows[rows >= 0], self._postponed.due())  # others, whose turn it is
        F, N, shifts = self._postponed.now(rows)
        self._postponed.update(rows, F, N)
        self.observer.a[rows] += shifts

    def observe(self, residuals: Residuals) -> FloatArray:
        """Move the state by the step of all points; return the weight that each was given."""
        # What the points that pass the gate ask for.
        rows = residuals.rows
        F, N, _ = self._postponed.now(rows)
        H = self._output_matrix(residuals.landmarks) - F
        gate = self._settings.rejection_threshold
        passed = accepted(self._distances(residuals, F, N), gate)
        step = self._reweighted_step(residuals, H, N, passed)
        # (31)  δ_i; F_i and N_i after it, where a motion of everything remains one.
        Delta, gain_k = step.Delta, step.gain_k
        delta = self.axes.full_points((F @ Delta + N @ step.k_left).ravel())
        F = F + N @ gain_k @ H
        F[:, :, : self.axes.p] += self.axes.turn_matrix(delta)
        N[passed] = symmetric(N[passed] @ gain_k[passed] @ step.noise)  # N − N k N, but positive
        # P⁺; other landmarks follow later.
        self._core.measurement_update(H[passed], gain_k[passed])
        self._postponed.shift(Delta[:, 0])
        self._postponed.update(rows, F, N)
        # The core takes in the landmarks just seen; X̂ ← (exp Δ, δ_i) · X̂.
        self._core.turn(Delta[:, 0])
        self._core.admit(rows[passed])
        self._move(rows, Delta[:, 0], delta)
        return step.weights

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        F, N, _ = self._postponed.now(residuals.rows)
        return self._distances(residuals, F, N)

    def add(
        self, points: FloatArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Append landmarks (m,): they have the errors of the pose and of the observation."""
        super().add(points, covariances)
        y_ref = self.observer.y_ref[-len(points) :]
        noise = self.observer.turned(covariances)
        self._postponed.add(self._output_matrix(y_ref), self._noise(noise))

    def add_known(self, known: KnownLandmarks) -> None:
        """Append landmarks (m,) as certain as the map has each of them."""
        super().add_known(known)
        N = self._noise(known.covariances)
        self._postponed.add(np.zeros((*N.shape[:2], len(self._core.P))), N)

    def relocate(
        self,
        rows: IntArray,
        points: FloatArray,
        covariances: FloatArray,
        D: FloatArray | None = None,
    ) -> None:
        """Take landmarks for new ones."""
        super().relocate(rows, points, covariances)
        y_ref, noise = self.observer.y_ref[rows], self.observer.turned(covariances)
        self._core.dismiss(rows)
        self._postponed.update(rows, self._output_matrix(y_ref), self._noise(noise))

    def remove(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        super().remove(rows)
        self._core.remove(rows)

    def fix_landmarks(self, known: KnownLandmarks) -> None:
        """Take all landmarks for exact."""
        super().fix_landmarks(known)
        count, k = len(known), self.axes.point
        self._core.remove(np.arange(len(self._postponed)))
        self._postponed.add(np.zeros((count, k, len(self._core.P))), np.zeros((count, k, k)))

    def set_pose(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Put the robot at Â = ``pose``; its correlation with the map is forgotten."""
        super().set_pose(pose, covariance)
        self._core.set_pose_error_covariance(covariance[self.axes.pose, self.axes.pose])

    def anchor(self, rows: IntArray, r: FloatArray, covariances: FloatArray) -> None:
        """Move pose and map to where known landmarks are, by γ, see :mod:`.known_landmarks`."""
        # All are up to date, and z is the pose (and calibration): ã_i = F_i (z − γ) + J_i γ + η_i.
        self._core.dismiss(self._core.rows)
        everything, p = np.arange(len(self._postponed)), self.axes.p
        self.prepare(everything)
        m, k, q = len(r), self.axes.point, len(self._core.P)
        F, N, _ = self._postponed.now(everything)
        J = self.axes.output_matrix(self.observer.points)
        # Joint covariance P of z, the known landmarks and γ; how γ moves them, G.
        z, known, gamma = np.split(np.arange(q + m * k + p), [q, q + m * k])
        P, G = np.zeros((gamma[-1] + 1,) * 2), np.zeros((gamma[-1] + 1, p))
        P[: gamma[0], : gamma[0]] = self._with_landmarks(F[rows], N[rows])
        G[:p] = G[gamma] = np.eye(p)
        G[known] = J[rows].reshape(-1, p)
        # All of these corrected by the known landmarks.
        S = P[np.ix_(known, known)] + block_diagonal(self._noise(covariances))
        x, P = anchor(P, G, P[:, known], S, G[known], r[:, :k].ravel())
        # γ = B z + ζ, so ã_i = F_i z + (J_i − F_i) γ + η_i depends on z by F_i + (J_i − F_i) B.
        self._core.P = P[:q, :q]
        J_gamma = J - F[:, :, :p]
        errors = F @ x[z] + J_gamma @ x[gamma]
        B, left = regression(P, gamma, z)
        F, N = F + J_gamma @ B, N + J_gamma @ left @ transpose(J_gamma)
        # Known landmarks were estimated themselves: they depend on z as P has it.
        errors[rows] = x[known].reshape(m, k)
        B, left = regression(P, known, z)
        F[rows] = B.reshape(m, k, q)
        N[rows] = symmetric(diagonal_blocks(left, k))
        # Landmarks move by their errors; a motion of everything remains one.
        shifts = -self.axes.full_points(errors.ravel())
        F[:, :, :p] += self.axes.turn_matrix(shifts)
        self._postponed.update(everything, F, N)
        self._move(everything, -x[z], shifts)

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of the calibration's estimates."""
        p = self.axes.p
        variances: FloatArray = np.diagonal(self._core.P)[p : p + self.calibration.count]
        return variances

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks; None in an exact map."""
        if self.observer.is_exact:
            return None
        F, N, _ = self._postponed.now(rows)
        p, q = self.axes.p, len(self._core.P)
        joint = self._with_landmarks(F, N)
        columns = np.append(np.arange(p), np.arange(q, len(joint)))
        return joint[np.ix_(columns, columns)]

    def _reweighted_step(
        self, residuals: Residuals, H: FloatArray, N: FloatArray, passed: BoolArray
    ) -> _Step:
        """Return the step Δ that the points which passed the gate ask for, by Huber's weights."""
        r, R = residuals.r[:, : self.axes.point, None], self._noise(residuals.covariances)
        repeated = repetition_factors(
            residuals.dt_s[passed], self._settings.observation_correlation_time
        )
        weights, gain_k = passed.astype(np.float64), np.zeros_like(N)
        for remaining in reversed(range(1 + REWEIGHTINGS)):
            shares = weights[passed] / repeated
            noise = R[passed] / shares[:, None, None]
            gain_k[passed] = np.linalg.inv(N[passed] + noise)
            Delta = self._core.step(H, gain_k, r)
            k_left = gain_k @ (r + H @ Delta)
            found = huber_weights(
                k_left[passed, :, 0], R[passed], shares, self._settings.huber_threshold
            )
            if not remaining or (found == weights[passed]).all():
                break
            weights[passed] = found
        return _Step(Delta, gain_k, k_left, noise, weights)

    def _distances(self, residuals: Residuals, F: FloatArray, N: FloatArray) -> FloatArray:
        # At the middle of the chord, for the reason that JointCovariance.output_matrix has.
        H = self._output_matrix(residuals.landmarks + 0.5 * residuals.r) - F
        S = H @ self._core.P @ transpose(H) + N + self._noise(residuals.covariances)
        return mahalanobis(residuals.r[:, : self.axes.point], S)

    def _with_landmarks(self, F: FloatArray, N: FloatArray) -> FloatArray:
        """Return the covariance (q + m k, q + m k) of z and m landmarks."""
        q = len(self._core.P)
        J = np.vstack([np.eye(q), F.reshape(-1, q)])
        joint: FloatArray = J @ self._core.P @ J.T
        joint[q:, q:] += block_diagonal(N)
        return joint

    def _output_matrix(self, lever_arms: FloatArray) -> FloatArray:
        """Return C_i (m, k, q), with zeros for all of z but ε."""
        C = self.axes.output_matrix(lever_arms)
        full = np.zeros((*C.shape[:2], len(self._core.P)))
        full[:, :, : C.shape[2]] = C
        return full

    def _noise(self, covariances: FloatArray) -> FloatArray:
        k = self.axes.point
        return covariances[:, :k, :k]

    def _move(self, rows: IntArray, x: FloatArray, shifts: FloatArray) -> None:
        p, a = self.axes.p, self.observer.a[rows]
        self.calibration.shift(x[p : p + self.calibration.count])
        D = se3.exp(self.axes.full_pose(x[:p]))
        self.observer.correct(D, rows, shifts + a - se3.rotate(D, a))
