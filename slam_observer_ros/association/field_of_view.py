"""Where a sensor sees, as far as that follows from what it has seen."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray

HULL_MARGIN = 0.01
"""How far outside, as a share of what it measures across, a point may be and still be inside.

Points are noisy, and without it each exact one at the sensor's full range would be a corner.
"""


class FieldOfView:
    """The convex hull, in the body frame, of the base and of all points that were ever seen.

    So no sensor has to be described. The hull is rather too large than too small: one wrong point
    behind a camera, and it sees all around. Until it has an inside, which it never has where all
    points lie in one plane with the base, everything counts as in view, and the latest points are
    kept. Of points, the first ``k`` coordinates matter: 2 in the plane, 3 in space.
    """

    def __init__(self, k: int) -> None:
        self.corners = np.zeros((1, k))  # (q, k) the base and points that span the hull, metres
        self._faces: FloatArray = np.empty((0, k + 1))
        self._margin_m = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the hull has an inside."""
        return len(self._faces) > 0

    def include(self, points: FloatArray) -> None:
        """Add points (m, 3) that were seen, metres, body frame."""
        from scipy.spatial import ConvexHull, QhullError  # which only points without ids need

        k = self.corners.shape[1]
        known = self.contains(points) & self.is_known
        if known.all():
            return
        corners = np.concatenate([self.corners, points[~known, :k]])
        try:
            hull = ConvexHull(corners)
        except QhullError:  # all of them in one point, on one line or in one plane
            self.corners = np.concatenate([np.zeros((1, k)), corners[1:][-2 * k :]])
            return
        self.corners, self._faces = corners[hull.vertices], hull.equations
        self._margin_m = HULL_MARGIN * float(np.ptp(self.corners, axis=0).max())

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which points (m, 3) lie where the sensor sees, metres, body frame."""
        k = self.corners.shape[1]
        heights_m = points[:, :k] @ self._faces[:, :k].T + self._faces[:, k]
        return np.asarray((heights_m <= self._margin_m).all(axis=1))
