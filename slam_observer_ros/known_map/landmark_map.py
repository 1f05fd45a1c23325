"""A map of landmarks known before anything is seen: saved by an earlier run, or surveyed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """n landmarks in one frame; their errors are taken to be independent of each other."""

    ids: IntArray  # (n,) landmark ids, each one once
    world_points: FloatArray  # (n, 3) positions, metres, in frame_id
    covariances: FloatArray | None  # (n, 3, 3) of the positions, m²; None if unknown
    counts: IntArray  # (n,) in how many observations each was seen; zero for surveyed ones
    frame_id: str = 'map'
    # (n, 3, 3) of tags, from their own axes, all zero for points; None if all are points
    orientations: FloatArray | None = None
    orientation_sigmas: FloatArray | None = None  # (n,) of rotation vectors, rad, each axis

    def select(self, rows: IntArray | BoolArray) -> LandmarkMap:
        """Return the map of the landmarks at ``rows``."""

        def part(array: FloatArray | None) -> FloatArray | None:
            return None if array is None else array[rows]

        return LandmarkMap(
            self.ids[rows],
            self.world_points[rows],
            part(self.covariances),
            self.counts[rows],
            self.frame_id,
            part(self.orientations),
            part(self.orientation_sigmas),
        )

    @property
    def is_planar(self) -> bool:
        """Whether all heights are zero and exact, as those of a map made with ``two_d_mode``."""
        if self.covariances is None or not len(self.ids):
            return False
        return not (self.world_points[:, 2].any() or self.covariances[:, 2].any())

    def flattened(self) -> LandmarkMap:
        """Return the map with all landmarks in the plane z = 0."""
        return replace(self, world_points=self.world_points * np.array([1.0, 1.0, 0.0]))

    def covariances_or(self, sigma_m: float) -> FloatArray:
        """Return (n, 3, 3) covariances, those of ``sigma_m`` in each coordinate if unknown."""
        if self.covariances is not None:
            return self.covariances
        return np.tile(sigma_m**2 * np.eye(3), (len(self.ids), 1, 1))
