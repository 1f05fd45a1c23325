"""A map of landmarks known before anything is seen, and which of them have given distances."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.known_landmarks import KnownLandmarks, part_of_joint, tags_among
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import (
    COVARIANCE_ROUNDING,
    diagonal_blocks,
    in_own_deviations,
    LEAST_DEVIATION,
    limited,
    MAX_DEVIATION,
)
from slam_observer_ros.models.point_noise import RESOLUTION_M

SAME_M = 0.2  # how far landmarks may be apart that look the same from places that look the same
SAME_SHARE = 0.9  # of landmarks that are where others are, in a map that looks the same moved
ROUNDED_M = 1e-3  # by how much positions differ that somebody wrote down in millimetres
MAX_CORRELATED = 1000  # landmarks of a map up to which correlations are saved, in 46 MB then
MAX_NUMBER = 1e12  # metres; nothing larger is meant seriously, and its square still has all digits


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """n landmarks in one frame, of independent errors but for a ``joint_covariance``."""

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

    def rows_of(self, ids: IntArray) -> IntArray:
        """Return the rows (m,) of landmarks by their ids (m,), −1 for ids that are not there."""
        order = np.argsort(self.ids)
        rows = order[np.searchsorted(self.ids, ids, sorter=order) % len(self.ids)]
        return np.where(self.ids[rows] == ids, rows, -1)

    @property
    def tags(self) -> IntArray:
        """(t,) rows of landmarks with an orientation."""
        return tags_among(self.orientations)

    @property
    def is_planar(self) -> bool:
        """Whether all heights are zero and exact, as in a map made with ``two_d_mode``."""
        if self.covariances is None or not len(self.ids):
            return False
        return not (self.world_points[:, 2].any() or self.covariances[:, 2].any())

    def flattened(self) -> LandmarkMap:
        """Return the map with all landmarks in the plane z = 0."""
        return replace(self, world_points=self.world_points * np.array([1.0, 1.0, 0.0]))

    def covariances_or(self, sigma_m: float) -> FloatArray:
        """Return covariances (n, 3, 3), up to MAX_DEVIATION, of ``sigma_m`` where unknown."""
        if self.covariances is not None:
            return limited(self.covariances, np.full(3, MAX_DEVIATION))
        return np.tile(sigma_m**2 * np.eye(3), (len(self.ids), 1, 1))

    def says_the_same(self, other: LandmarkMap) -> bool:
        """Return whether a map has the same landmarks within 3 deviations, and SAME_M at most."""
        if self.frame_id != other.frame_id or len(self.ids) != len(other.ids):
            return False
        others = other.rows_of(self.ids)
        if (others < 0).any():
            return False
        other = other.select(others)
        variances = self.covariances_or(ROUNDED_M) + other.covariances_or(ROUNDED_M)
        deviations = np.sqrt(np.diagonal(variances, axis1=1, axis2=2)) + ROUNDED_M
        off_m = np.abs(self.world_points - other.world_points)
        if (off_m > np.minimum(3.0 * deviations, SAME_M)).any():
            return False
        # Tags are turned alike, within their sigmas.
        if self.orientations is None or other.orientations is None:
            return self.orientations is other.orientations
        # Points, whose matrix is zero, only differ from tags.
        off_rad = np.sqrt(0.5 * np.square(self.orientations - other.orientations).sum(axis=(1, 2)))
        known = [each.orientation_sigmas for each in (self, other)]
        squares = sum(sigmas**2 for sigmas in known if sigmas is not None)
        return bool((off_rad <= 3.0 * np.sqrt(squares) + ROUNDED_M).all())

    def landmarks_in(self, T: FloatArray, sigma_m: float) -> KnownLandmarks:
        """Return landmarks with :meth:`covariances_or` in the frame that T (4, 4) leads into."""
        covariances, joint = self.covariances_or(sigma_m), self.joint_covariance
        if joint is not None:
            # A map's shape says nothing of a motion of everything: that is all but exact, and as
            # it concerns all landmarks information about it would drown all other in rounding.
            joint = limited(joint, np.full(len(joint), MAX_DEVIATION))
            joint += RESOLUTION_M**2 * np.eye(len(joint))
        return KnownLandmarks(
            self.world_points, covariances, joint, self.orientations, self.orientation_sigmas
        ).moved(T)


MAX_PAIRS = 2_000_000  # pairs that are kept: all of 2000 landmarks, in larger maps the close ones
MAX_TRIPLES = 1_000_000  # triangles that are looked at for one of three given sides

# Which of three landmarks are 0, 1 and 2, found in this order: both ends of one side, that first
# which another side shares, and the other end of that.
_CORNERS = np.zeros((3, 3, 3), dtype=np.int64)
for _first, _second in permutations(range(3), 2):
    _ends, _others = ((0, 1), (0, 2), (1, 2))[_first], ((0, 1), (0, 2), (1, 2))[_second]
    (_shared,) = set(_ends) & set(_others)
    _found = [_shared, *(set(_ends) - {_shared}), *(set(_others) - {_shared})]
    _CORNERS[_first, _second] = np.argsort(_found)


class MappedLandmarks:
    """n landmarks of a map, and the distances between any that can be in view together."""

    def __init__(self, points: FloatArray, covariances: FloatArray, axes: EstimatedAxes) -> None:
        from scipy.spatial import cKDTree  # which only points without ids need

        self.axes, k = axes, axes.point
        self.points = points  # (n, 3) metres
        self.covariances = np.ascontiguousarray(covariances[:, :k, :k])  # (n, k, k) m²
        # (k, k) covariance of the landmark known worst: none is gated more tightly
        spreads = np.trace(self.covariances, axis1=1, axis2=2)
        self.largest_covariance = self.covariances[np.argmax(spreads)]
        self.tree: Any = cKDTree(points[:, :k])
        self.reach_m = 0.0  # up to which distance all pairs are known
        self._most_m = np.inf  # up to which they can be

    def __len__(self) -> int:
        return len(self.points)

    def reach(self, distance_m: float) -> float:
        """Get ready for distances of up to so many metres; return up to how many it can be."""
        if self.reach_m < distance_m and self.reach_m < self._most_m:
            self.reach_m = min(1.2 * distance_m, self._most_m)
            while self.tree.count_neighbors(self.tree, self.reach_m) > 2 * MAX_PAIRS:
                self.reach_m = self._most_m = 0.8 * self.reach_m
            # All pairs up to the reach, by distance, and by their first landmark as well
            pairs = self.tree.query_pairs(self.reach_m, output_type='ndarray').astype(np.int32)
            lines = self.points[pairs[:, 0]] - self.points[pairs[:, 1]]
            distances = np.sqrt(np.einsum('ij,ij->i', lines, lines))
            order = np.argsort(distances)
            self._pairs: IntArray = pairs[order]
            self._distances: FloatArray = distances[order]
            if not self.axes.is_planar:
                keys = self._key(pairs.T, distances).ravel()
                by_first = np.argsort(keys)
                self._keys: FloatArray = keys[by_first]
                self._partners: IntArray = pairs.T[::-1].ravel()[by_first]
        return self.reach_m

    def within_reach(self, points: FloatArray) -> IntArray:
        """Return which points (m, 3) are so near the first one that all pairs are in reach."""
        from_first_m = np.linalg.norm(points - points[0], axis=1)
        return np.flatnonzero(from_first_m <= 0.4 * self.reach(2.5 * float(from_first_m.max())))

    def pairs(self, distance_m: float, tolerance_m: float) -> IntArray:
        """Return landmarks (h, 2) that are about so far from each other, in either order."""
        limits = [distance_m - tolerance_m, distance_m + tolerance_m]
        first, last = np.searchsorted(self._distances, limits)
        pairs = self._pairs[first:last]
        return np.concatenate([pairs, pairs[:, ::-1]])

    def triangles(self, sides_m: FloatArray, tolerances_m: FloatArray) -> IntArray | None:
        """Return landmarks (h, 3) of sides 0–1, 0–2, 1–2 (3,); None if there are too many."""
        # Two of them by the shortest side, which the fewest have, in an order that …
        turns = np.argsort(sides_m)
        corners = _CORNERS[turns[0], turns[1]]
        sides_m, tolerances_m = sides_m[turns], tolerances_m[turns]
        pairs = self.pairs(sides_m[0], tolerances_m[0])
        pairs = pairs[np.argsort(pairs[:, 0])]
        # … lets the third one be found soon, by the second side.
        key = self._key(pairs[:, 0], sides_m[1])
        first = np.searchsorted(self._keys, key - tolerances_m[1])
        counts = np.searchsorted(self._keys, key + tolerances_m[1]) - first
        if counts.sum() > MAX_TRIPLES:
            return None
        pairs = np.repeat(pairs, counts, axis=0)
        before = np.cumsum(counts) - counts
        third = self._partners[np.arange(int(counts.sum())) + np.repeat(first - before, counts)]
        lines = self.points[pairs[:, 1]] - self.points[third]
        off_m = np.sqrt(np.einsum('ij,ij->i', lines, lines)) - sides_m[2]
        fits: BoolArray = (np.abs(off_m) <= tolerances_m[2]) & (third != pairs[:, 1])
        found: IntArray = np.column_stack([pairs[fits], third[fits]])
        return found[:, corners]

    def _key(self, first: IntArray, distances_m: FloatArray | float) -> FloatArray:
        """Return numbers that sort pairs by their first landmark, then by distance."""
        return np.asarray(first * (2.0 * self.reach_m + 1.0) + distances_m)


def heights_of(maps: Iterable[LandmarkMap]) -> dict[int, float]:
    """Return how high landmarks of maps in space are, metres, by id."""
    return {
        landmark_id: height_m
        for known in maps
        if not known.is_planar
        for landmark_id, height_m in zip(
            known.ids.tolist(), known.world_points[:, 2].tolist(), strict=True
        )
    }


def check_joint(joint: FloatArray, covariances: FloatArray) -> None:
    """Raise a :exc:`MapError` unless a joint covariance fits the landmarks' own (n, 3, 3)."""
    joint = np.asarray(joint, dtype=np.float64)
    blocks, scaled = diagonal_blocks(joint, 3)[: len(covariances)], in_own_deviations(joint)
    deviations = np.sqrt(np.maximum(np.diagonal(blocks, axis1=1, axis2=2), LEAST_DEVIATION**2))
    differences = np.abs(blocks - covariances) / (deviations[:, :, None] * deviations[:, None, :])
    if differences.max(initial=0.0) > COVARIANCE_ROUNDING:
        raise MapError('a landmark has another covariance there')
    if np.abs(scaled - scaled.T).max() > COVARIANCE_ROUNDING:
        raise MapError('they are not symmetric')
    scaled[np.diag_indices(len(scaled))] += COVARIANCE_ROUNDING
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError as error:
        raise MapError('they are negative in some direction') from error
