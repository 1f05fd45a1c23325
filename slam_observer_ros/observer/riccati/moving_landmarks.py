"""The joint covariance where landmarks have unknown constant velocities, which are estimated.

The errors are x = (ε, c̃, (ξ_1, ũ_1) … ), with ũ_i = û_i − R_Ã u_i of the velocities in the
reference frame. While time passes ξ_i grows by ũ_i dt, and what turns the pose turns ũ_i, too.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.observer.riccati.symmetric_matrix import SymmetricMatrix
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion


class MovingLandmarksCovariance(JointCovariance):
    """P with columns for velocities, too, at first of ``velocity_error``, m/s."""

    def __init__(
        self,
        axes: EstimatedAxes,
        calibration: Calibration,
        matrix: SymmetricMatrix,
        velocity_error: float,
    ) -> None:
        super().__init__(axes, calibration, matrix)
        self._velocity_error = velocity_error
        self._stride = 2 * axes.point

    def landmarks(self, points: FloatArray, ahead_s: float = 0.0) -> FloatArray:
        """Return the covariances (n, 3, 3) of ã_i = ξ_i + t ũ_i − [ŷ_i]× ε_Ω, t from now."""
        # D of ã_i = D (ε, ξ_i, ũ_i), and the columns of these in P.
        n, k, p, rows = len(points), self._axes.point, self._p, np.arange(len(points))
        eye = np.tile(np.eye(k), (n, 1, 1))
        D = np.concatenate([-self._turning(points), eye, ahead_s * eye], axis=2)
        own = self._columns(rows).reshape(n, k)
        columns = np.concatenate([np.tile(np.arange(p), (n, 1)), own, own + k], axis=1)
        covariances = np.zeros((n, 3, 3))
        P = self.P[columns[:, :, None], columns[:, None, :]]
        covariances[:, :k, :k] = D @ P @ transpose(D)
        return covariances

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return ξ_i (n, 3) and ũ_i (n, 3) of x."""
        parts = x[self.first :].reshape(-1, 2, self._axes.point)
        return self._axes.full_points(parts[:, 0]), self._axes.full_points(parts[:, 1])

    def propagate(self, motion: Motion, points: FloatArray, u: FloatArray) -> None:
        """Let ξ_i grow by ũ_i dt, then the robot move."""
        rows, P = np.arange(len(points)), self.P
        columns = self._columns(rows)
        velocities = columns + self._axes.point
        P[columns] += motion.duration_s * P[velocities]
        P[:, columns] += motion.duration_s * P[:, velocities]
        J = np.stack([self._turning(points), self._turning(u)], axis=1)
        self._propagate(motion, J.reshape(-1, self._p))

    def _insert(self, rows: IntArray, C: FloatArray, noise: FloatArray) -> None:
        super()._insert(rows, C, noise)
        # Of their velocities nothing is known yet.
        columns = self._columns(rows) + self._axes.point
        self.P[columns] = self.P[:, columns] = 0.0
        self.P[columns, columns] = self._velocity_error**2

    def _all_turning(self, points: FloatArray) -> FloatArray:
        blocks = self._turning(points)
        return np.stack([blocks, np.zeros_like(blocks)], axis=1).reshape(-1, self._p)  # ũ_i: 0
