"""The pose in a map by one tag whose position and orientation the map has."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_alignment import MAX_TURN_STD_RAD
from slam_observer_ros.state.state import State

SIGHTINGS = 2
"""Sightings of a tag that must agree: a single one may be flipped."""


@dataclass(frozen=True, slots=True, eq=False)
class TagPose:
    """What a tag says of where the robot is."""

    tag_id: int
    pose: FloatArray  # (4, 4) in the map
    covariance: FloatArray  # (6, 6) of rotation vector and position, rad² and m², map axes
    known: LandmarkMap  # the map


def pose_by_tag(state: State, known: LandmarkMap, refused: AbstractSet[int]) -> TagPose | None:
    """Return the pose in a map by the tag that says it best, but for ``refused`` ids; or None."""
    tags, R, sigmas = state.observer.orientations, known.orientations, known.orientation_sigmas
    if R is None or sigmas is None:
        return None
    # Tags that both have, and that were seen the same way each time.
    rows, landmarks = state.landmarks.rows_of(known.ids), state.landmarks
    shared = np.flatnonzero((rows >= 0) & R.any(axis=(1, 2)))
    shared = shared[~np.isin(known.ids[shared], list(refused))]
    own = rows[shared]
    is_sure = tags.are_known[own] & (tags.counts[own] >= SIGHTINGS) & (tags.rejections[own] == 0)
    is_sure &= landmarks.counts[own] >= SIGHTINGS
    shared, own = shared[is_sure], own[is_sure]
    if not len(own):
        return None
    turn_stds = np.hypot(state.known_errors.orientation_sigmas(own), sigmas[shared])
    best = int(np.argmin(turn_stds))
    if turn_stds[best] > MAX_TURN_STD_RAD:
        return None
    at, row, A = shared[best], own[best : best + 1], state.observer.A
    # From the frame of P° to the map: by how the tag is turned, and where it is.
    turn = R[at] @ state.known_errors.orientation_matrices(row)[0].T
    lever = turn @ (A[:3, 3] - state.observer.points[row[0]])
    pose = se3.pose(turn @ A[:3, :3], known.world_points[at] + lever)
    # An error of the tag's turn moves the robot about it.
    J = np.vstack([np.eye(3), -so3.hat(lever)])
    covariance = turn_stds[best] ** 2 * J @ J.T
    covariance[3:, 3:] += known.covariances_or(state.settings.map_noise)[at]
    seen, k = state.configuration_covariance(row), state.axes.point
    if seen is not None:
        relative = np.zeros((3, 3))
        relative[:k, :k] = seen
        covariance[3:, 3:] += pose[:3, :3] @ relative @ pose[:3, :3].T
    return TagPose(int(known.ids[at]), pose, covariance, known)
