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
    if state.observer.is_exact and loaded is not None:
        return _exact_map(state, rows, loaded)
    landmark_map = LandmarkMap(
        state.landmarks.ids[rows],
        state.observer.world_points[rows],
        None,
        state.landmarks.counts[rows],
        orientations=_orientations_of(state, rows),
    )
    return _with_covariances(landmark_map, state, rows, loaded is None)


def _with_covariances(
    landmark_map: LandmarkMap, state: State, rows: IntArray, is_own_frame: bool
) -> LandmarkMap:
    """Return the map of landmarks ``rows`` with what is known of its errors.

    That is, unless there are too many, the joint covariance, too.
    """
    n, tags, sigmas = len(rows), landmark_map.tags, np.zeros(len(rows))
    if n > MAX_CORRELATED and not is_own_frame:  # of those a map of any size could be loaded
        joint, of_all = None, state.landmark_covariances()
        covariances = None if of_all is None else with_variances_above(0.0, of_all[rows])
    else:
        joint = joint_covariance(state, rows, rows[tags], is_own_frame)
        covariances = None if joint is None else diagonal_blocks(joint[: 3 * n, : 3 * n], 3).copy()
    if joint is not None:
        of_turns = diagonal_blocks(joint[3 * n :, 3 * n :], 3)
        sigmas[tags] = np.sqrt(np.maximum(np.linalg.eigvalsh(of_turns)[:, -1], 0.0))
    elif len(tags):
        sigmas[tags] = state.known_errors.orientation_sigmas(rows[tags])
    return replace(
        landmark_map,
        covariances=covariances,
        orientation_sigmas=sigmas if len(tags) else None,
        joint_covariance=None if n > MAX_CORRELATED else joint,
    )


def _exact_map(state: State, rows: IntArray, loaded: LandmarkMap) -> LandmarkMap:
    """Return landmarks as the map has them that is taken to be exact."""
    order = np.argsort(loaded.ids)
    at = order[np.searchsorted(loaded.ids, state.landmarks.ids[rows], sorter=order)]
    return replace(loaded.select(at), counts=state.landmarks.counts[rows])


def _orientations_of(state: State, rows: IntArray) -> FloatArray | None:
    """Return orientations (m, 3, 3) in the world."""
    tags = state.observer.orientations
    if not tags.are_known[rows].any():
        return None
    B = state.known_errors.orientation_matrices(rows)
    world: FloatArray = state.observer.reference_pose[:3, :3] @ B
    return world
