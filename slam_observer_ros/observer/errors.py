"""What is known of the errors of X̂: what their joint covariance P says of an estimate.

Covariances are those of errors in the reference frame, m² and rad². Gains that know no joint
covariance have none of this.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import mahalanobis, with_blocks
from slam_observer_ros.observer.joint_covariance import JointCovariance
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.sensor_models.motion import Motion, Passage


class Errors:
    """What ``joint``, P, says of the estimates of an ``observer``."""

    def __init__(self, observer: Observer, joint: JointCovariance, axes: EstimatedAxes) -> None:
        self.observer, self.joint, self.axes = observer, joint, axes

    def copy(self, observer: Observer) -> Errors:
        """Return an independent copy for a copy of the observer."""
        return Errors(observer, self.joint.copy(observer), self.axes)

    def pose_covariance(self, motion: Motion | Passage | None = None) -> FloatArray:
        """Return the covariance (6, 6) of ε in Â = exp(ε) A, maybe after a motion yet to come.

        (s, 6, 6) at the s instants of a passage. Zero on axes that are not estimated.
        """
        if motion is None:
            return self.axes.full_pose_covariance(self.joint.pose)
        return self.axes.full_pose_covariance(motion.pose_covariance(self.joint.of_robot))

    def landmark_covariances(self, duration_s: float = 0.0) -> FloatArray:
        """Return those (n, 3, 3) of ã_i, when landmarks have moved on for ``duration_s``."""
        points = self.observer.points + duration_s * self.observer.u
        return self.joint.landmarks(points, duration_s)

    def joint_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i; None in an exact map."""
        return self.joint.with_pose(rows, self.observer.points[rows])

    def orientation_matrices(self, rows: IntArray) -> FloatArray:
        """Return B̂_i (m, 3, 3) of landmarks, zero for those that have none."""
        return self.joint.turned(rows, self.observer.orientations.B[rows])

    def orientation_sigmas(self, rows: IntArray) -> FloatArray:
        """Return standard deviations (m,) of orientations about the axis of the largest, rad."""
        if self.observer.is_exact:
            sigmas: FloatArray = self.observer.orientations.map_sigmas[rows]
            return sigmas
        largest = np.linalg.eigvalsh(self.joint.own_turns(rows))[:, -1]
        return np.asarray(np.sqrt(np.maximum(largest, 0.0)))

    def distances(self, residuals: Residuals) -> FloatArray:
        """Return the Mahalanobis distance (m,) of each residual."""
        r, R = residuals.on(self.axes)
        C = self.joint.output_matrix(residuals, chord=0.5)
        _, predicted = self.joint.output(C, residuals.rows)
        return mahalanobis(r, predicted + R)

    def innovation_covariance(self, residuals: Residuals) -> FloatArray:
        """Return the joint covariance (m k, m k) of residuals, noise included."""
        return with_blocks(self.predicted(residuals)[1], residuals.on(self.axes)[1])

    def predicted(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return what P predicts of m residuals: with ε (p, m k), and their own (m k, m k)."""
        C = self.joint.output_matrix(residuals, chord=0.5)
        return self.joint.outputs(C, residuals.rows)
