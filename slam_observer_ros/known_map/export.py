"""The present map, as it can be saved and loaded."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import with_variances_above
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.merging import shape_covariances
from slam_observer_ros.state.state import State

MOVING_SPEED = 0.1
"""Speed from which on a landmark is left out of a map, m/s; slower ones may be at rest."""


def map_of(state: State, is_own_frame: bool) -> LandmarkMap:
    """Return the confirmed landmarks at rest; in its own frame, with covariances of its shape."""
    rows = state.confirmed
    rows = rows[np.linalg.norm(state.observer.u[rows], axis=1) < MOVING_SPEED]
    if is_own_frame:
        covariances = shape_covariances(state, rows)
    elif (covariances := state.landmark_covariances()) is not None:
        covariances = covariances[rows]
    orientations, sigmas = _orientations_of(state, rows)
    return LandmarkMap(
        state.landmarks.ids[rows],
        state.world_points[rows],
        None if covariances is None else with_variances_above(0.0, covariances),
        state.landmarks.counts[rows],
        orientations=orientations,
        orientation_sigmas=sigmas,
    )


def _orientations_of(state: State, rows: IntArray) -> tuple[FloatArray | None, FloatArray | None]:
    """Return orientations (m, 3, 3) in the world, and standard deviations (m,), rad."""
    tags = state.filter.orientations
    if tags is None or not tags.are_known[rows].any():
        return None, None
    return state.observer.reference_pose[:3, :3] @ tags.B[rows], state.filter.orientation_sigmas(
        rows
    ) * tags.are_known[rows]
