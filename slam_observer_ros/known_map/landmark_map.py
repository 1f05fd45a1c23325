"""A map of landmarks known before anything is seen: saved by an earlier run, or surveyed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.observer.known_landmarks import KnownLandmarks, part_of_joint, tags_among
from slam_observer_ros.sensor_models.observation_noise import RESOLUTION_M

MAX_NUMBER = 1e12
"""Metres; nothing larger is meant seriously, and its square still has all digits."""


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """n landmarks in one frame.

    Their errors are taken to be independent of each other, unless ``joint_covariance`` is there.
    """

    ids: IntArray  # (n,) landmark ids, each one once
    world_points: FloatArray  # (n, 3) positions, metres, in frame_id
    covariances: FloatArray | None  # (n, 3, 3) of the positions, m²; None if unknown
    counts: IntArray  # (n,) in how many observations each was seen; zero for surveyed ones
    frame_id: str = 'map'
    # (n, 3, 3) of tags, from their own axes, all zero for points; None if all are points
    orientations: FloatArray | None = None
    orientation_sigmas: FloatArray | None = None  # (n,) of rotation vectors, rad, each axis
    # (3 (n + t), …) of all positions together, m², whose blocks on the diagonal are the
    # covariances, and then of the rotation vectors, map axes, of the t that have an orientation
    joint_covariance: FloatArray | None = None
    name: str = ''  # its file's, by which several maps are named

    def select(self, rows: IntArray | BoolArray) -> LandmarkMap:
        """Return the map of the landmarks at ``rows``."""

        def part(array: FloatArray | None) -> FloatArray | None:
            return None if array is None else array[rows]

        joint = self.joint_covariance

        return LandmarkMap(
            self.ids[rows],
            self.world_points[rows],
            part(self.covariances),
            self.counts[rows],
            self.frame_id,
            part(self.orientations),
            part(self.orientation_sigmas),
            None if joint is None else part_of_joint(joint, len(self.ids), self.tags, rows),
            self.name,
        )

    @property
    def tags(self) -> IntArray:
        """(t,) rows of landmarks with an orientation."""
        return tags_among(self.orientations)

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

    def landmarks_in(self, T: FloatArray, sigma_m: float) -> KnownLandmarks:
        """Return the landmarks with covariances, or :meth:`covariances_or`, in another frame.

        ``T`` (4, 4) leads into it.
        """
        covariances, joint = self.covariances_or(sigma_m), self.joint_covariance
        if joint is not None:
            # A map's shape says nothing of a motion of everything: that is all but exact, and as
            # it concerns all landmarks information about it would drown all other in rounding.
            joint = joint + RESOLUTION_M**2 * np.eye(len(joint))
        return KnownLandmarks(
            self.world_points, covariances, joint, self.orientations, self.orientation_sigmas
        ).moved(T)
