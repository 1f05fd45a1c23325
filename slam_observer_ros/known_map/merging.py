"""Moves an estimate into the frame of a map that is known in advance.

Where the start is unknown the robot maps in a frame of its own at first. Once enough landmarks of
the known map are among its own, well enough spread, the whole estimate is moved into the known
frame and both maps become one. So it does not matter whether these landmarks are seen at once or
one after another, nor whether the map is known from the start or is loaded later.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from scipy.linalg import solve_triangular

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import is_automatic
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import (
    block_diagonal,
    diagonal_blocks,
    transpose,
)
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_alignment import find_transform
from slam_observer_ros.observer.gauge import JITTER_M2
from slam_observer_ros.state.state import State

ROUNDING = 1e-14
"""Least variance that is distinguished from zero, as a share of the sum of all variances."""


def start_in_map(state: State, known: LandmarkMap, pose_covariance: FloatArray | None) -> None:
    """Add a map to a state at its start, whose pose is given in the map's frame.

    ``pose_covariance`` (6, 6) is that of rotation vector and position along the map's axes, rad²
    and m²; None for an exact pose.
    """
    state.set_pose(state.observer.pose, pose_covariance)
    _complete(state, known)


def enter_map(state: State, known: LandmarkMap) -> bool:
    """Move an estimate into the frame of a map, if enough of its landmarks have been seen.

    Return whether it is in that frame now. Landmarks that both have are merged. Those that
    contradict the others are taken as the map has them, and those that only the estimate has are
    kept where mapping goes on.
    """
    # The transform, by the landmarks that both have.
    rows = state.landmarks.rows_of(known.ids)
    shared = np.flatnonzero((rows >= 0) & ~is_automatic(known.ids))
    found = _find_frame(state, rows[shared], known.select(shared))
    if found is None:
        return False
    state.observer.reference_pose, agree = found
    # Landmarks that agree are merged, …
    merged = shared[agree]
    _merge(state, rows[merged], known.select(merged))
    # … others removed, as are all that the map does not have where it does not grow, …
    if state.settings.localization_mode == 'off':
        state.remove(rows[shared[~agree]])
    else:
        state.remove(np.setdiff1d(np.arange(len(state.landmarks)), rows[merged]))
    # … and those that only the map has are added.
    _renumber(state, known)
    _complete(state, known)
    return True


def shape_covariances(state: State, rows: IntArray) -> FloatArray | None:
    """Return covariances (m, 3, 3) of landmarks ``rows`` in a frame of their own, world axes, m².

    A map's frame starts where the robot did, and all landmarks share the error of how they lie to
    that pose. Who loads the map knows it by its landmarks alone: what remains is the error of
    its shape, P − G (Gᵀ P⁻¹ G)⁻¹ Gᵀ, with G as in :mod:`slam_observer_ros.observer.gauge`. None
    where the gains know no covariances.
    """
    m, axes = len(rows), state.axes
    k, R = axes.point, state.observer.reference_pose[:3, :3]
    joint, points = state.filter.joint, state.filter.points[rows]
    with_pose = None if joint is None or m == 0 else joint.with_pose(rows, points)
    if with_pose is None:
        of_all = state.landmark_covariances()
        return None if of_all is None else of_all[rows]
    P = with_pose[axes.p :, axes.p :]
    G = axes.output_matrix(points - points.mean(axis=0)).reshape(m * k, -1)
    whitened = solve_triangular(_lower_root(P), G, lower=True, check_finite=False)
    information = whitened.T @ whitened
    G_each = G.reshape(m, k, -1)
    common = G_each @ np.linalg.pinv(information, hermitian=True) @ transpose(G_each)
    own = np.zeros((m, 3, 3))
    own[:, :k, :k] = diagonal_blocks(P, k) - common
    world: FloatArray = R @ own @ R.T
    return world


def _lower_root(P: FloatArray) -> FloatArray:
    """Return L with L Lᵀ = P + δ I, and δ no larger than rounding in P makes necessary."""
    least_m2 = JITTER_M2 + ROUNDING * np.trace(P)
    for growth in 100.0 ** np.arange(8):  # with the last one δ is the trace, which always does
        with suppress(np.linalg.LinAlgError):
            return np.linalg.cholesky(P + growth * least_m2 * np.eye(len(P)))
    raise MapError('the covariance of the landmarks is not finite')


def _find_frame(
    state: State, rows: IntArray, known: LandmarkMap
) -> tuple[FloatArray, BoolArray] | None:
    """Return P° (4, 4) in the frame of a map, of whose landmarks the estimate has ``rows``."""
    axes = state.axes
    covariance = state.filter.joint_covariance(rows)
    if covariance is None:
        covariance = _of_constant_gains(state, rows)
    covariances = known.covariances_or(state.settings.map_noise)
    points = state.filter.points[rows]
    return find_transform(points, covariance, known.world_points, covariances, axes)


def _of_constant_gains(state: State, rows: IntArray) -> FloatArray:
    """Return a covariance (p + m k, p + m k) of ε and m landmarks for gains that know none."""
    # The pose is exact, and each landmark as uncertain as if it was seen from here once.
    p, k = state.axes.p, state.axes.point
    noise = state.observation_noise.at(state.observer.body_points(rows))
    covariance = np.zeros((p + k * len(rows),) * 2)
    covariance[p:, p:] = block_diagonal(state.observer.turned(noise)[:, :k, :k])
    return covariance


def _merge(state: State, rows: IntArray, known: LandmarkMap) -> None:
    """Correct the estimate by what a map knows of the landmarks at ``rows``."""
    targets, covariances = _in_reference_frame(state, known)
    r = state.filter.points[rows] - targets
    state.filter.anchor(rows, r, covariances)
    state.landmarks.counts[rows] += _counts(known, state)


def _counts(known: LandmarkMap, state: State) -> IntArray:
    """Return how often landmarks of a map count as seen: a surveyed one is confirmed at once."""
    return np.asarray(np.maximum(known.counts, state.settings.confirmations))


def _renumber(state: State, known: LandmarkMap) -> None:
    """Give landmarks new numbers where the map's have the same, though no sensor gave these."""
    ids = state.landmarks.ids
    own = np.flatnonzero(is_automatic(ids) & np.isin(ids, known.ids))
    taken = np.append(ids[is_automatic(ids)], known.ids[is_automatic(known.ids)])
    state.landmarks.renumber(own, np.max(taken, initial=0) + 1 + np.arange(len(own)))


def _complete(state: State, known: LandmarkMap) -> None:
    """Append what a map has beyond the estimate, now that both are in one frame."""
    observer, mode = state.observer, state.settings.localization_mode
    new = known.select(state.landmarks.rows_of(known.ids) < 0)
    observer.set_reference(observer.points)
    state.landmarks.add_known(new.ids, _counts(new, state))
    state.is_mapping = mode == 'off'
    if mode == 'fixed':
        _fix(state, known)
    else:
        state.filter.add_known(*_in_reference_frame(state, new))
    state.forget_past('the pose in the loaded map was found')


def _fix(state: State, known: LandmarkMap) -> None:
    """Put the landmarks exactly where the map has them, and leave them there."""
    order = np.argsort(known.ids)
    rows = order[np.searchsorted(known.ids, state.landmarks.ids, sorter=order)]
    y_ref, covariances = _in_reference_frame(state, known.select(rows))
    state.fix_landmarks(y_ref, covariances)


def _in_reference_frame(state: State, known: LandmarkMap) -> tuple[FloatArray, FloatArray]:
    """Return positions (m, 3) and covariances (m, 3, 3) of a map in the frame of P°."""
    back = se3.inverse(state.observer.reference_pose)
    R = back[:3, :3]
    covariances: FloatArray = R @ known.covariances_or(state.settings.map_noise) @ R.T
    return se3.transform(back, known.world_points), covariances
