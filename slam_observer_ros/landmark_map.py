"""A map of landmarks known before anything is seen: saved by an earlier run, or surveyed."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """n landmarks in one frame; their errors are taken to be independent of each other.

    Attributes
    ----------
    ids : IntArray
        (n,) landmark ids, each one once.
    world_points : FloatArray
        (n, 3) positions, metres, in ``frame_id``.
    covariances : FloatArray or None
        (n, 3, 3) covariances of the positions, m²; None if unknown.
    counts : IntArray
        (n,) in how many observations each was seen; zero for surveyed ones.
    frame_id : str
        Frame of the positions.

    """

    ids: IntArray
    world_points: FloatArray
    covariances: FloatArray | None
    counts: IntArray
    frame_id: str = 'map'

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.ids)

    def select(self, rows: IntArray | BoolArray) -> LandmarkMap:
        """Return the map of the landmarks at ``rows``."""
        covariances = None if self.covariances is None else self.covariances[rows]
        return LandmarkMap(
            self.ids[rows], self.world_points[rows], covariances, self.counts[rows], self.frame_id
        )
