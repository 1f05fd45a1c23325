"""Landmarks that a map knows, and how far it may be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import block_diagonal, turned


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoints:
    """Positions of n landmarks of a map in one frame, and the covariances of their errors."""

    points: FloatArray  # (n, 3) metres
    covariances: FloatArray  # (n, 3, 3) of each, m²
    joint: FloatArray | None = None  # (3 n, 3 n) of all; None if errors are independent

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: IntArray | BoolArray) -> KnownPoints:
        """Return those at ``rows``."""
        joint = None if self.joint is None else blocks_at(self.joint, rows)
        return KnownPoints(self.points[rows], self.covariances[rows], joint)

    def moved(self, T: FloatArray) -> KnownPoints:
        """Return the same in another frame, into which ``T`` (4, 4) leads."""
        R = T[:3, :3]
        covariances: FloatArray = R @ self.covariances @ R.T
        joint = None if self.joint is None else turned(self.joint, R)
        return KnownPoints(se3.transform(T, self.points), covariances, joint)

    def covariance_on(self, axes: EstimatedAxes) -> FloatArray:
        """Return the covariance (n k, n k) of all on the axes that are estimated."""
        n, k = len(self), axes.point
        if self.joint is None:
            return block_diagonal(self.covariances[:, :k, :k])
        return self.joint.reshape(n, 3, n, 3)[:, :k, :, :k].reshape(n * k, n * k)


def blocks_at(joint: FloatArray, rows: IntArray | BoolArray) -> FloatArray:
    """Return the rows and columns (3 m, 3 m) of landmarks, of a covariance (3 n, 3 n)."""
    numbers = np.arange(len(joint) // 3)[rows]
    columns = (3 * numbers[:, None] + np.arange(3)).ravel()
    part: FloatArray = joint[np.ix_(columns, columns)]
    return part
