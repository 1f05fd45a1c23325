"""The covariance in a map that is taken to be exact: that of pose and calibration alone."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.joint_covariance import JointCovariance
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.sensor_models.motion import Motion


class ExactMapCovariance(JointCovariance):
    """P of (ε, c̃) alone, in a map that is taken to be exact: ã_i = 0, and ξ_i = [ŷ_i]× ε_Ω."""

    active = slice(0)
    is_dense = is_of_points = False

    def __init__(self, joint: JointCovariance, covariances: FloatArray) -> None:
        chart = joint.chart.with_postponed(0)
        super().__init__(chart, joint._matrix, joint.of_robot, joint._unknown)
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
        return self.chart.output(residuals.landmarks + chord * residuals.r, residuals.D)

    def change_of_residuals(self, residuals: Residuals, x: FloatArray) -> FloatArray:
        """Return H x (m, k)."""
        C = self.output_matrix(residuals)
        change: FloatArray = C @ x[: C.shape[2]]
        return change

    def _project(self, C: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        HP = C @ self.P[: C.shape[1]]
        return HP, HP[:, : C.shape[1]] @ C.T

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
