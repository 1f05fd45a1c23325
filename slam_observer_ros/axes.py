"""Which coordinates a gain design estimates: all of 3D, or those of planar motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.geometry import so3
from slam_observer_ros.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Axes:
    """Coordinates of the pose error and of each landmark error that are estimated.

    Attributes
    ----------
    pose : IntArray
        (p,) axes of the pose error ε = (Ω, v).
    point : int
        Leading axes of a point, 2 or 3.

    """

    pose: IntArray
    point: int

    def output_matrix(self, lever_arms: FloatArray) -> FloatArray:
        """Return (m, point, p) blocks [−[y]×, I]: how a pose error ε moves points y (m, 3)."""
        C = np.empty((len(lever_arms), 3, 6))
        C[:, :, :3] = -so3.hat(lever_arms)
        C[:, :, 3:] = np.eye(3)
        return C[:, : self.point][:, :, self.pose]

    def turn_matrix(self, arms: FloatArray) -> FloatArray:
        """Return (m, point, p) blocks [−[d]×, 0]: what ``output_matrix`` gains when points move.

        ``arms`` (m, 3) are how far the points have moved, metres.
        """
        C = self.output_matrix(arms)
        C[:, :, self.pose >= 3] = 0.0
        return C

    def full_pose(self, error: FloatArray) -> FloatArray:
        """Return ε (6,) with zeros on the axes that are not estimated."""
        full = np.zeros(6)
        full[self.pose] = error
        return full

    def full_pose_covariance(self, covariance: FloatArray) -> FloatArray:
        """Return that of ε (6, 6) with zeros on the axes that are not estimated."""
        full = np.zeros((6, 6))
        full[np.ix_(self.pose, self.pose)] = covariance
        return full

    def full_points(self, errors: FloatArray) -> FloatArray:
        """Return (m, 3) points from (m · point,) coordinates, with zeros elsewhere."""
        full = np.zeros((errors.size // self.point, 3))
        full[:, : self.point] = errors.reshape(-1, self.point)
        return full


SPATIAL = Axes(np.arange(6), 3)
PLANAR = Axes(np.array([2, 3, 4]), 2)
