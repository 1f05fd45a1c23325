"""Riccati gains: the equivariant filter on SLAM_n(3), from a covariance P.

The error E = X̂ X⁻¹ = (Ã, ã_i) (proof of Theorem 5.1) does not move while the robot does, so with
Ã = exp(ε) the state of the filter is x = (ε, c, ã_1 … ã_n), c being the errors of the velocity's
calibration. The residual is, by (33), r_i = Ã y_i° − ã_i − y_i° ≈ C_i x with

    C_i = [ −[y_i°]×  I  0 … −I … 0 ].

What no observation can tell, the choice of the world's frame, is exactly in its null space, so
the covariance stays honest. While â_i = 0, which :meth:`.FullMapGains.settle` sees to after each
correction and each motion (the reference ξ° is arbitrary), noise of the motion touches Ã alone:

    prediction   P ← P + Ad_Â Q Ad_Âᵀ in the pose block alone: O(1), however large the map;
                 with a calibration O(n), as what is known of it goes on into the pose
    update       K = P Cᵀ (C P Cᵀ + R)⁻¹,   X̂ ← exp(−K r) · X̂

at O(m n) for m landmarks seen plus O(m n²) to update the covariance of n known ones.

:mod:`slam_observer_ros.observer.riccati.full_map` has the landmarks in P,
:mod:`slam_observer_ros.observer.riccati.fixed_map` takes them for exact.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import axes_of
from slam_observer_ros.geometry.matrices import kalman_update, mahalanobis, with_blocks
from slam_observer_ros.observer.filter import GainDesign, OF_CONSTANT_GAINS, Residuals
from slam_observer_ros.observer.observer import Correction, Observer
from slam_observer_ros.observer.prediction import predict
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.observer.robust import observation_weights
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.sensor_models.observation_noise import repetition_factors
from slam_observer_ros.settings.estimator_settings import Settings


class RiccatiGains(GainDesign):
    """Gains K = P Cᵀ (C P Cᵀ + R)⁻¹, with a gate and robust weights before.

    Parameters
    ----------
    settings : Settings
        Robustness and ``two_d_mode``.
    calibration, joint : Calibration, JointCovariance
        What is known of the velocity's calibration, and the covariance P of everything.

    """

    ignores = OF_CONSTANT_GAINS

    def __init__(
        self, settings: Settings, calibration: Calibration, joint: JointCovariance
    ) -> None:
        self._settings = settings
        self._axes = axes_of(settings.two_d_mode)
        self._p = self._axes.p
        self.calibration = calibration
        self._joint = joint

    def change_settings(self, settings: Settings) -> None:
        """Take over the robustness."""
        self._settings = settings

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of what is estimated of the calibration."""
        variances: FloatArray = np.diagonal(self._joint.P)[self._p : self._joint.first]
        return variances

    @property
    def pose_error_covariance(self) -> FloatArray:
        """(6, 6) covariance of the pose error ε; zero on axes that are not estimated."""
        return self._axes.full_pose_covariance(self._joint.pose)

    @property
    def landmark_error_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmark errors ã_i, reference frame, m²."""
        raise NotImplementedError

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Add the motion's noise to the pose block, and what the calibration's error adds."""
        predict(self._joint.P, self._axes, self.calibration, motion)

    def pose_error_covariance_after(self, motion: Motion) -> FloatArray:
        """Return what the same (6, 6) will be after a motion that is yet to be predicted."""
        first = self._joint.first
        P = self._joint.P[:first, :first].copy()
        predict(P, self._axes, self.calibration, motion)
        return self._axes.full_pose_covariance(P[: self._p, : self._p])

    def set_pose_error_covariance(self, covariance: FloatArray) -> None:
        """Take over the covariance (6, 6) of ε, independent of all else."""
        pose = self._axes.pose
        self._joint.set_pose(covariance[pose, pose])

    def correct(self, residuals: Residuals) -> tuple[Correction, FloatArray]:
        """Return exp(−K r) and the weight that each point was given."""
        r, noise = residuals.on(self._axes)
        weights = observation_weights(r, self.predicted(residuals), noise, self._settings)
        passed = weights > 0.0
        used = residuals.select(passed)
        r, noise = used.on(self._axes)
        CP, CPC = self._project(used)
        share = weights[passed] / repetition_factors(
            used.dt_s, self._settings.observation_error_time
        )
        S = with_blocks(CPC, noise / share[:, None, None])
        K = kalman_update(self._joint.P, CP, S)
        return self._as_correction(K @ -r.ravel()), weights  # for (30) and (31)

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        r, noise = residuals.on(self._axes)
        columns = self._joint.columns(residuals.rows).reshape(r.shape)
        _, CPC = self._output_covariances(self._chord_output(residuals), columns)
        return mahalanobis(r, CPC + noise)

    def predicted(self, residuals: Residuals) -> FloatArray:
        """Return the covariance (m k, m k) of m residuals but for the noise of the points, m²."""
        return self.predicted_with_pose(residuals)[1]

    def predicted_with_pose(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what the state predicts of m residuals, as it is to judge them by.

        Returns
        -------
        PC : FloatArray
            (p, m k) their covariances with ε.
        CPC : FloatArray
            (m k, m k) their covariance, without the noise of the points, m².

        """
        C = self._chord_output(residuals).reshape(-1, self._p)
        return self._output_covariances(C, self._joint.columns(residuals.rows))

    def _project(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return C P and C P Cᵀ."""
        raise NotImplementedError

    def _output_covariances(
        self, C: FloatArray, columns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of C ε − ã with ε (…, p, j), and of its own (…, j, j).

        C is (…, j, p), and ``columns`` (…, j) are those of ã in P.
        """
        raise NotImplementedError

    def _as_correction(self, x: FloatArray) -> Correction:
        """Return the group element exp(x); the calibration moves by its own part of x."""
        raise NotImplementedError

    def _pose_output(self, residuals: Residuals) -> FloatArray:
        """Return the columns (m k, p) of C that belong to ε."""
        y_ref = residuals.e - residuals.r
        return self._axes.output_matrix(y_ref).reshape(-1, self._p)

    def _chord_output(self, residuals: Residuals) -> FloatArray:
        """Return C_i (m, k, p) at the middle of the chord from y_i° to e_i.

        Turning y_i° to e_i, by however much, moves it at right angles to (e_i + y_i°)/2; with C
        at y_i° a robot that has turned further than it knows would reject what it sees.
        """
        return self._axes.output_matrix(residuals.e - 0.5 * residuals.r)
