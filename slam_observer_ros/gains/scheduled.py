"""Variance-scheduled gains: the paper's k_i and l_i, set by what is known, at O(m) for m seen.

Kept are a covariance P of the pose error ε (with the velocity's calibration) and a covariance L_i
of each landmark by itself; how they are correlated is not kept. Landmark errors are those of
p̂_i itself, so that landmarks out of view have none to correct. With C_i = [−[e_i + â_i]×, I] and
the noise R_i of the observation, the gains of (30) and (31) become matrices

    k_i = (L_i + R_i)⁻¹,                 Δ = −P⁺ Σ C_iᵀ k_i r_i
    l_i / k_i · dt = L_i (L_i + R_i)⁻¹,  δ_i = L_i k_i (r_i + C_i Δ)

where P⁺ = (P⁻¹ + Σ C_iᵀ k_i C_i)⁻¹. Since correlations are ignored, P and L_i come out too small:
they set gains, and are not published as covariances.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.axes import Axes, PLANAR, SPATIAL
from slam_observer_ros.gains.base import Innovation, Motion, Seen
from slam_observer_ros.gains.calibration import Calibration
from slam_observer_ros.gains.gauge import anchor
from slam_observer_ros.gains.prediction import initial_covariance, predict
from slam_observer_ros.gains.robust import block_diagonal, huber_weights, mahalanobis
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.observer import Correction, Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import FloatArray, IntArray

REWEIGHTINGS = 3
"""Rounds of reweighted least squares."""

NOISE_INFLATION = 3.0
"""Factor on the observations' standard deviations.

A landmark seen again and again tells less and less about the pose, as their errors have become
the same; a design that does not know this must believe each observation less.
"""


class ScheduledGains:
    """Gains from a pose covariance and a covariance per landmark.

    Parameters
    ----------
    settings : Settings
        Noise, calibration, robustness and ``two_d_mode``.

    """

    pose_covariance = None
    landmark_covariances = None

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._axes: Axes = PLANAR if settings.two_d_mode else SPATIAL
        self._calibration = Calibration(settings, self._axes)
        self._P = initial_covariance(self._axes, self._calibration)
        self._L: FloatArray = np.empty((0, self._axes.point, self._axes.point))

    def change_settings(self, settings: Settings) -> None:
        """Take over the robustness."""
        self._settings = settings

    def calibrated(self, body_velocities: FloatArray) -> FloatArray:
        """Return velocities (k, 6) with the estimated scale and bias put right."""
        return self._calibration.apply(body_velocities)

    def predict(self, motion: Motion) -> None:
        """Add the motion's noise to the pose's covariance."""
        predict(self._P, self._axes, self._calibration, motion)

    def add_landmarks(self, y_ref: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks (m, 3): as uncertain as the pose and the observation together."""
        self._L = np.concatenate([self._L, self._first_variances(y_ref, covariances)])

    def relocate_landmarks(
        self, indices: IntArray, y_ref: FloatArray, covariances: FloatArray
    ) -> None:
        """Take landmarks for new ones."""
        self._L[indices] = self._first_variances(y_ref, covariances)

    def add_known_landmarks(self, covariances: FloatArray) -> None:
        """Append landmarks (m,) as certain as the map has them, or exact in a fixed map."""
        self._L = np.concatenate([self._L, self._map_variances(covariances)])

    def pose_covariance_after(self, motion: Motion) -> None:
        """Return None: the covariance that sets the gains is too small to be published."""

    def set_pose_covariance(self, covariance: FloatArray) -> None:
        """Take over the covariance (6, 6) of ε."""
        p, pose = len(self._axes.pose), self._axes.pose
        self._P[:p] = self._P[:, :p] = 0.0
        self._P[:p, :p] = covariance[np.ix_(pose, pose)]

    def joint_covariance(self, indices: IntArray) -> FloatArray:
        """Return the covariance (p + m k, p + m k) of ε and m landmarks, without correlations."""
        p = len(self._axes.pose)
        return np.asarray(block_diag(self._P[:p, :p], block_diagonal(self._L[indices])))

    def anchor(
        self, observer: Observer, indices: IntArray, r: FloatArray, covariances: FloatArray
    ) -> Correction:
        """Return the correction that puts pose and known landmarks where these are known to be."""
        points = observer.y_ref + observer.a
        first, p, m, k = len(self._P), len(self._axes.pose), len(r), self._axes.point
        P = block_diag(self._P, block_diagonal(self._L[indices]))
        G = np.zeros((len(P), p))
        G[:p] = np.eye(p)
        G[first:] = self._axes.output_matrix(points[indices]).reshape(-1, p)
        R = block_diagonal(self._map_variances(covariances))
        x, P = anchor(P, G, np.arange(first, len(P)), R, r[:, :k].ravel())
        self._P = P[:first, :first]
        own = P[first:, first:].reshape(m, k, m, k)[np.arange(m), :, np.arange(m)]
        self._L[indices] = own * (self._settings.localization_mode != 'fixed')
        shifts = self._axes.output_matrix(points) @ x[:p]
        shifts[indices] = x[first:].reshape(m, k)
        everything = np.arange(len(points))
        return self._as_correction(everything, -x[:first], -shifts.ravel(), observer.a)

    def restart(self, observer: Observer) -> None:
        """Do nothing: these gains keep no history."""

    def remove_landmarks(self, indices: IntArray) -> None:
        """Forget the landmarks at ``indices``."""
        self._L = np.delete(self._L, indices, axis=0)

    def correct(self, innovation: Innovation) -> tuple[Correction, FloatArray]:
        """Return the innovation and the weight that each observation was given."""
        passed = self.distances(innovation) <= self._settings.rejection_distance
        k, rows = self._axes.point, innovation.indices[passed]
        r, a = innovation.r[passed][:, :k, None], innovation.a[passed]
        C, L = self._output_matrix(innovation.e[passed] + a), self._L[rows]
        R = self._noise(innovation.covariances[passed])
        weights = np.ones(len(r))
        for _ in range(REWEIGHTINGS):
            gain_k = np.asarray(np.linalg.inv(L + R / weights[:, None, None]))
            P_new, x = self._pose_step(C, gain_k, r)
            pull = gain_k @ (r + C @ x)
            weights = huber_weights(pull[:, :, 0], R, weights, self._settings.huber_threshold)
        spread = gain_k - gain_k @ C @ P_new @ so3.transpose(C) @ gain_k
        self._P, self._L[rows] = P_new, L - L @ spread @ L
        correction = self._as_correction(rows, x[:, 0], (L @ pull)[:, :, 0], a)
        all_weights = np.zeros(len(passed))
        all_weights[passed] = weights
        return correction, all_weights

    def distances(self, innovation: Innovation) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        C = self._output_matrix(innovation.e + innovation.a)
        L, R = self._L[innovation.indices], self._noise(innovation.covariances)
        S = C @ self._P @ so3.transpose(C) + L + R
        return mahalanobis(innovation.r[:, : self._axes.point], S)

    def settle(self, observer: Observer) -> None:
        """Do nothing: these gains measure landmarks in the world, whatever the reference."""

    def look_back(self, observer: Observer, seen: Seen, in_doubt: bool) -> None:
        """Do nothing: these gains keep no history."""

    def _pose_step(
        self, C: FloatArray, gain_k: FloatArray, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return P⁺ (p + c, p + c) and the step (p + c, 1) of pose and calibration."""
        pull = so3.transpose(C) @ gain_k
        G = np.sum(pull @ C, axis=0)
        P_new = np.linalg.solve(np.eye(len(G)) + self._P @ G, self._P)
        P_new = 0.5 * (P_new + P_new.T)
        return P_new, -P_new @ np.sum(pull @ r, axis=0)

    def _output_matrix(self, lever_arms: FloatArray) -> FloatArray:
        """Return C_i (m, k, p + c), with zeros for the calibration."""
        C = self._axes.output_matrix(lever_arms)
        return np.concatenate([C, np.zeros((*C.shape[:2], self._calibration.count))], axis=2)

    def _first_variances(self, y_ref: FloatArray, covariances: FloatArray) -> FloatArray:
        J = self._output_matrix(y_ref)
        return J @ self._P @ so3.transpose(J) + self._noise(covariances)

    def _map_variances(self, covariances: FloatArray) -> FloatArray:
        k = self._axes.point
        return covariances[:, :k, :k] * (self._settings.localization_mode != 'fixed')

    def _noise(self, covariances: FloatArray) -> FloatArray:
        k = self._axes.point
        return NOISE_INFLATION**2 * covariances[:, :k, :k]

    def _as_correction(
        self, rows: IntArray, x: FloatArray, shifts: FloatArray, a: FloatArray
    ) -> Correction:
        """Return the element that moves the pose by x and â_i (m, 3) by ``shifts`` alone."""
        p = len(self._axes.pose)
        self._calibration.shift(x[p:])
        D = se3.exp(self._axes.full_pose(x[:p]))
        return Correction(D, rows, self._axes.full_points(shifts) + a - se3.rotate(D, a))
