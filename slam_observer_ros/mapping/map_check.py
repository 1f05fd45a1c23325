"""Where in a map one look at landmarks without ids says where the robot is."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.mapping.constellation import find_places
from slam_observer_ros.mapping.landmark_map import (
    LandmarkMap,
    MappedLandmarks,
    SAME_M,
    SAME_SHARE,
)
from slam_observer_ros.mapping.map_alignment import LEAST_SAME, LEAST_TURN_DEG, Likeness
from slam_observer_ros.mapping.places import Anywhere, Constellation

LEAST_TURN_RAD = math.radians(LEAST_TURN_DEG)
MAX_ALIKE = 64
MAX_LOOKS, MAX_SEEN = 600, 12
CELLS = 40
"""Along the longer side of a map, free places for one more landmark."""


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """What q looks around from places all over a map say."""

    poses: FloatArray  # (q, 4, 4)
    seen: IntArray  # (q,) landmarks in view
    fitting: IntArray  # (q,) places where these fit; 0 where they are too few
    error_probabilities: FloatArray  # (q,) that the most likely place is wrong
    is_found: BoolArray  # (q,) is it sure enough


def symmetries(known: LandmarkMap) -> list[Likeness]:
    """Return the turns about the vertical after which a map looks the same, the best first.

    Of turns that are as good the smallest is the first, as it makes the others.
    """
    found = turns_onto(known, known)
    turned = [each for each in found if each.turn_deg > LEAST_TURN_DEG]
    return sorted(turned, key=lambda each: (-int(each.is_same.sum()), round(each.turn_deg)))


def turns_onto(known: LandmarkMap, other: LandmarkMap) -> list[Likeness]:
    """Return the turns about the vertical after which a map looks as another, whatever its ids.

    Any of these takes the centre of the landmarks to the other centre, and the outermost landmark
    to one as far from there.
    """
    from scipy.spatial import cKDTree

    points, others = known.world_points, other.world_points
    sizes = sorted((len(points), len(others)))
    if sizes[0] < LEAST_SAME or sizes[0] < SAME_SHARE * sizes[1]:
        return []
    radii_m, angles = _from_centre(points)
    other_radii_m, other_angles = _from_centre(others)
    first, tree = int(np.argmax(radii_m)), cKDTree(others)
    tolerance_m = SAME_M + 2.0 * radii_m[first] * (1.0 - SAME_SHARE)
    off_m = np.abs(other_radii_m - radii_m[first])
    alike = np.argsort(off_m)[: min(MAX_ALIKE, int(np.count_nonzero(off_m < tolerance_m)))]
    found: list[Likeness] = []
    for angle in other_angles[alike] - angles[first]:
        likeness = _fitted(points, others, tree, angle)
        T = likeness.transform
        is_new = all(_turn_rad(T, each.transform) > LEAST_TURN_RAD for each in found)
        if is_new and likeness.is_same.mean() >= SAME_SHARE:
            found.append(likeness)
    return found


def _from_centre(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far points are from their centre, metres, and in which direction, rad."""
    offsets = points - points.mean(axis=0)
    return np.linalg.norm(offsets[:, :2], axis=1), np.arctan2(offsets[:, 1], offsets[:, 0])


def _turn_rad(T: FloatArray, other: FloatArray) -> float:
    return float(np.linalg.norm(so3.log(T[:3, :3] @ other[:3, :3].T)))


def _fitted(points: FloatArray, others: FloatArray, tree: Any, angle: float) -> Likeness:
    """Return the turn by about an angle that fits best, the nearest landmarks being the same."""
    centre, other_centre = points.mean(axis=0), others.mean(axis=0)
    R = so3.exp(np.array([0.0, 0.0, angle]))
    T = se3.pose(R, other_centre - R @ centre)
    flat = np.array([1.0, 1.0, 0.0])
    for tolerance_m in (10.0 * SAME_M, 3.0 * SAME_M, SAME_M):
        distances_m, near = tree.query(se3.transform(T, points))
        is_same = distances_m <= tolerance_m
        if is_same.mean() < SAME_SHARE:
            break
        z_m = (others[near[is_same]] - points[is_same])[:, 2].mean()
        T = rigid_alignment(points[is_same] * flat, others[near[is_same]] * flat)
        T[2, 3] = z_m
    return Likeness(T, np.asarray(is_same))


def place_for_another(known: LandmarkMap, symmetry: Likeness) -> FloatArray:
    """Return where (3,) one more landmark shows best which way round the map is, metres.

    Among free places in the map, that which is furthest from all landmarks, from where these would
    be if the map was turned, and from where it would be itself.
    """
    from scipy.spatial import cKDTree

    points, T = known.world_points, symmetry.transform
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    step_m = max(float((high - low).max()) / CELLS, 1e-3)
    x, y = np.meshgrid(
        *(np.arange(a, b + 0.5 * step_m, step_m) for a, b in zip(low, high, strict=True))
    )
    free = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.median(points[:, 2]))])
    own = np.linalg.norm((free - se3.transform(T, free))[:, :2], axis=1)
    tree, turned = cKDTree(points[:, :2]), cKDTree(se3.transform(T, points)[:, :2])
    from_others = np.minimum(tree.query(free[:, :2])[0], turned.query(free[:, :2])[0])
    best: FloatArray = free[np.argmax(np.minimum(from_others, 0.5 * own))]
    return best


def look_around(
    known: LandmarkMap,
    axes: EstimatedAxes,
    view_m: float,
    fov_rad: float,
    sigma_m: float,
    map_sigma_m: float,
    error_probability: float,
) -> Looks:
    """Look around from places all over a map, by a sensor that sees ``view_m`` far.

    ``fov_rad`` is its field of view, and ``sigma_m`` the noise of each coordinate; ``map_sigma_m``
    is for landmarks whose file gives none.
    """
    covariances = known.covariances_or(map_sigma_m)
    mapped = MappedLandmarks(known.world_points, covariances, axes)
    mapped.reach(2.0 * view_m)
    poses = _poses(known.world_points, fov_rad)
    results = []
    for pose in poses:
        points = _seen(known.world_points, pose, view_m, fov_rad)
        covariance = sigma_m**2 * np.eye(axes.point * len(points))
        constellation = Constellation(points, covariance, np.full(len(points), -1))
        if len(points) <= axes.point:
            results.append((len(points), 0, 1.0, False))
            continue
        places = find_places(mapped, constellation, Anywhere(mapped), error_probability)
        fitting = sum(place.share > error_probability for place in places.all)
        is_found = places.decided(error_probability) is not None
        results.append((len(points), fitting, places.error_probability, is_found))
    return Looks(poses, *(np.array(column) for column in zip(*results, strict=True)))


def _poses(points: FloatArray, fov_rad: float) -> FloatArray:
    """Return poses (q, 4, 4) all over the area of the landmarks, some headings at each place."""
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    headings = 1 if fov_rad >= 2.0 * math.pi else 4
    sides_m = np.maximum(high - low, 1.0)
    step_m = math.sqrt(float(np.prod(sides_m)) * headings / MAX_LOOKS)
    x, y = np.meshgrid(
        *(np.arange(a + 0.5 * step_m, b, step_m) for a, b in zip(low, low + sides_m, strict=True))
    )
    at = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.median(points[:, 2]))])
    yaws = 2.0 * math.pi * np.arange(headings) / headings
    turns = so3.exp(np.column_stack([np.zeros((headings, 2)), yaws]))
    return np.array([se3.pose(R, position) for position in at for R in turns])


def _seen(points: FloatArray, pose: FloatArray, view_m: float, fov_rad: float) -> FloatArray:
    """Return the nearest points (m, 3) in view, body frame."""
    points = se3.transform(se3.inverse(pose), points)
    ranges_m = np.linalg.norm(points[:, :2], axis=1)
    bearings = np.abs(np.arctan2(points[:, 1], points[:, 0]))
    in_view = np.flatnonzero((ranges_m <= view_m) & (bearings <= 0.5 * fov_rad))
    nearest: FloatArray = points[in_view[np.argsort(ranges_m[in_view])][:MAX_SEEN]]
    return nearest
