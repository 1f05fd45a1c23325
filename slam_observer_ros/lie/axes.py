"""The coordinates that a filter estimates: all of 3D, or planar motion."""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import so3


class EstimatedAxes:
    """Coordinates of the pose error and of each landmark error that are estimated."""

    def __init__(self, pose: slice, point: int) -> None:
        self.pose = pose  # of the pose error ε = (Ω, v), …
        self.p: int = pose.stop - pose.start  # … so many
        self.point = point  # leading axes of a point, 2 or 3
        self.is_planar = point == 2
        self.turn: int = 3 - pose.start  # how many turns of a landmark, 1 or 3, …
        self.turned: IntArray = np.arange(pose.start, 3)  # … and which: about z, or about all
        self._turned = slice(pose.start, 3)
        self._shape = (-1, point, self.p)
        turns = np.concatenate([-so3.hat(np.eye(3)), np.zeros((3, 3, 3))], axis=2)
        self._turns = turns[:, :point, pose].reshape(3, -1)
        self._shift = np.eye(3, 6, 3)[:point, pose].ravel()

    def of_points(self) -> EstimatedAxes:
        """Return the same where landmarks have no orientations: ``turn`` is 0."""
        other = copy(self)
        other.turn, other.turned, other._turned = 0, self.turned[:0], slice(0)
        return other

    def output_matrix(self, lever_arms: FloatArray) -> FloatArray:
        """Return (m, point, p) blocks [−[y]×, I]: how a pose error ε moves points y (m, 3)."""
        # One product for all blocks costs a third of filling them in piece by piece.
        C: FloatArray = lever_arms.dot(self._turns) + self._shift
        return C.reshape(self._shape)

    def turn_matrix(self, lever_arms: FloatArray) -> FloatArray:
        """Return (m, point, p) blocks [−[y]×, 0]: how a pose error ε turns vectors y (m, 3)."""
        C: FloatArray = lever_arms.dot(self._turns)
        return C.reshape(self._shape)

    def full_pose(self, error: FloatArray) -> FloatArray:
        """Return ε (6,) with zeros on the axes that are not estimated."""
        full = np.zeros(6)
        full[self.pose] = error
        return full

    def full_pose_covariance(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance (…, 6, 6) of ε with zeros on the axes that are not estimated."""
        full = np.zeros((*covariance.shape[:-2], 6, 6))
        full[..., self.pose, self.pose] = covariance
        return full

    def turns(self, vectors: FloatArray) -> FloatArray:
        """Return what of rotation vectors (m, 3) is estimated (m, turn)."""
        return vectors[:, self._turned]

    def turn_covariances(self, covariances: FloatArray) -> FloatArray:
        """Return what of covariances (m, 3, 3) of rotation vectors is (m, turn, turn)."""
        return covariances[:, self._turned, self._turned]

    def full_turns(self, turns: FloatArray) -> FloatArray:
        """Return rotation vectors (m, 3) with zeros about the axes that are not estimated."""
        full = np.zeros((len(turns), 3))
        full[:, self._turned] = turns
        return full

    def full_points(self, errors: FloatArray) -> FloatArray:
        """Return (m, 3) points from (m · point,) coordinates, with zeros elsewhere."""
        full = np.zeros((errors.size // self.point, 3))
        full[:, : self.point] = errors.reshape(-1, self.point)
        return full


SPATIAL = EstimatedAxes(slice(0, 6), 3)
PLANAR = EstimatedAxes(slice(2, 5), 2)


def axes_of(two_d_mode: bool) -> EstimatedAxes:
    """Return the axes that are estimated with the setting ``two_d_mode``."""
    return PLANAR if two_d_mode else SPATIAL
