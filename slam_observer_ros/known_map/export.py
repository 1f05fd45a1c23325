"""The present map, as it can be saved and loaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import diagonal_blocks, with_variances_above
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_correlations import MAX_CORRELATED
from slam_observer_ros.known_map.merging import joint_covariance
from slam_observer_ros.state.state import State

MOVING_SPEED = 0.1
"""Speed from which on a landmark is left out of a map, m/s; slower ones may be at rest."""


def map_of(state: State, loaded: LandmarkMap | None) -> LandmarkMap:
    """Return the confirmed landmarks at rest.

    ``loaded`` is the map in whose frame they are. In a frame of its own, None, a map has the
    covariances of its shape alone.
    """
    rows = state.confirmed
    rows = rows[np.linalg.norm(state.observer.u[rows], axis=1) < MOVING_SPEED]
    if state.is_fixed and loaded is not None:
        return _exact_map(state, rows, loaded)
    covariances, joint = _covariances_of(state, rows, loaded is None)
    orientations, sigmas = _orientations_of(state, rows)
    return LandmarkMap(
        state.landmarks.ids[rows],
        state.world_points[rows],
        covariances,
        state.landmarks.counts[rows],
        orientations=orientations,
        orientation_sigmas=sigmas,
        joint_covariance=joint,
    )


def _covariances_of(
    state: State, rows: IntArray, is_own_frame: bool
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return covariances (m, 3, 3) and, unless they are too many, the joint one (3 m, 3 m), m²."""
    are_many = len(rows) > MAX_CORRELATED
    if are_many and not is_own_frame:  # of those a map of any size could be loaded
        of_all = state.landmark_covariances()
        return None if of_all is None else with_variances_above(0.0, of_all[rows]), None
    joint = joint_covariance(state, rows, is_own_frame)
    if joint is None:
        return None, None
    return diagonal_blocks(joint, 3).copy(), None if are_many else joint


def _exact_map(state: State, rows: IntArray, loaded: LandmarkMap) -> LandmarkMap:
    """Return landmarks as the map has them that is taken to be exact."""
    order = np.argsort(loaded.ids)
    at = order[np.searchsorted(loaded.ids, state.landmarks.ids[rows], sorter=order)]
    return replace(loaded.select(at), counts=state.landmarks.counts[rows])


def _orientations_of(state: State, rows: IntArray) -> tuple[FloatArray | None, FloatArray | None]:
    """Return orientations (m, 3, 3) in the world, and standard deviations (m,), rad."""
    tags = state.filter.orientations
    if tags is None or not tags.are_known[rows].any():
        return None, None
    return state.observer.reference_pose[:3, :3] @ tags.B[rows], state.filter.orientation_sigmas(
        rows
    ) * tags.are_known[rows]
