"""How an estimate and a map that is known in advance become one, and the map that this gives.

Where the start is unknown the robot maps in a frame of its own at first. Once enough landmarks of
the known map are among its own, well enough spread, the whole estimate is moved into the known
frame and both maps become one. So it does not matter whether these landmarks are seen at once or
one after another, nor whether the map is known from the start or is loaded later.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.linalg import orth, solve_triangular

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.filter.known_landmarks import JITTER_M2, KnownLandmarks
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import block_diagonal, diagonal_blocks, with_variances_above
from slam_observer_ros.mapping.landmark_map import LandmarkMap, MAX_CORRELATED
from slam_observer_ros.mapping.map_alignment import find_transform
from slam_observer_ros.tracking.state import State

ROUNDING = 1e-14  # least variance distinguished from zero, as a share of the sum of all
RANK_TOLERANCE = 1e-8  # share of G's largest singular value: few landmarks leave turns open


def start_in_map(state: State, known: LandmarkMap, pose_covariance: FloatArray | None) -> None:
    """Add a map to a state at its start, of a pose there, exact or of rad² and m² (6, 6)."""
    state.set_pose(state.observer.pose, pose_covariance)
    if state.settings.localization_mode != 'fixed':
        state.gains.add_known(_in_reference_frame(state, known))
    _complete(state, known, known)


def enter_map(
    state: State, known: LandmarkMap, pairs: tuple[IntArray, IntArray] | None = None
) -> bool:
    """Move an estimate into the frame of a map, if enough of its landmarks have been seen.

    ``pairs`` are landmarks (q,) of the estimate, and which of the map's (q,) they are; by default
    landmarks with the same ids. Return whether it is in that frame now. Pairs are merged. A pair
    that contradicts the others is taken as the map has it, and landmarks that only the estimate
    has are kept where mapping goes on.
    """
    if pairs is None:
        own = state.landmarks.rows_of(known.ids)
        shared = np.flatnonzero((own >= 0) & ~is_automatic(known.ids))
        pairs = own[shared], shared
    rows, shared = pairs
    # The transform, by the landmarks that both have.
    covariance = state.gains.joint_covariance(rows)
    if covariance is None:
        covariance = _of_constant_gains(state, rows)
    target = known.select(shared).landmarks_in(np.eye(4), state.settings.map_noise)
    found = find_transform(state.observer.points[rows], covariance, target, state.axes)
    if found is None:
        return False
    transform, agree = found
    state.observer.set_reference_pose(transform)
    named = np.flatnonzero(
        np.isin(state.landmarks.ids, known.ids) & ~is_automatic(state.landmarks.ids)
    )
    wrong = np.setdiff1d(np.append(rows, named), rows[agree])
    _renumber(state, known, rows[agree], known.ids[shared[agree]])
    # Landmarks that agree are merged, others removed, or all where the map does not grow, …
    if state.settings.localization_mode == 'off':
        state.remove(wrong)
    else:
        state.remove(np.setdiff1d(np.arange(len(state.landmarks)), rows[agree]))
    # … and landmarks that only the map has are added.
    rows = state.landmarks.rows_of(known.ids)
    merged, others = np.flatnonzero(rows >= 0), np.flatnonzero(rows < 0)
    is_exact = state.settings.localization_mode == 'fixed'
    taken = merged if is_exact else np.append(merged, others)
    state.gains.enter_map(rows[merged], _in_reference_frame(state, known.select(taken)))
    state.landmarks.counts[rows[merged]] += _counts(known.select(merged), state)
    _complete(state, known, known.select(others))
    return True


def joint_covariance(
    state: State, rows: IntArray, tags: IntArray, is_own_frame: bool
) -> FloatArray | None:
    """Return the covariance (3 (m + t), …) of landmarks ``rows`` (m,) together, world axes.

    Of their positions, m², and of the rotation vectors of ``tags`` (t,) among them. A frame of
    one's own starts where the robot did, and all landmarks share the error of how they lie to that
    pose. Who loads the map knows it by its landmarks alone: what remains is the error of its
    shape, P − G (Gᵀ P⁻¹ G)⁻¹ Gᵀ, with G as in :mod:`slam_observer_ros.filter.known_landmarks`.
    None where the gains know no joint covariance.
    """
    m, axes, points = len(rows), state.axes, state.observer.points[rows]
    P = state.gains.landmark_covariance(rows, tags)
    if P is None or m == 0:
        return P
    # As the square of a root, so that rounding makes no variance negative, however small it is.
    L = _lower_root(P)
    if is_own_frame:
        G = axes.output_matrix(points - points.mean(axis=0)).reshape(-1, axes.p)
        G = np.vstack([G, np.tile(np.eye(axes.turn, axes.p), (len(tags), 1))])
        Q = orth(solve_triangular(L, G, lower=True, check_finite=False), RANK_TOLERANCE)
        L = L - (L @ Q) @ Q.T
    of_points, of_turns = np.split(L, [m * axes.point])
    root = np.zeros((m + len(tags), 3, len(L)))
    root[:m, : axes.point] = of_points.reshape(m, axes.point, len(L))
    root[m:, axes.turned] = of_turns.reshape(len(tags), axes.turn, len(L))
    world_root = (state.observer.reference_pose[:3, :3] @ root).reshape(-1, len(L))
    world: FloatArray = world_root @ world_root.T
    return world


def _lower_root(P: FloatArray) -> FloatArray:
    """Return L with L Lᵀ = P + δ I, and δ no larger than rounding in P makes necessary."""
    least_m2 = JITTER_M2 + ROUNDING * np.trace(P)
    for growth in 100.0 ** np.arange(8):  # with the last one δ is the trace, which always does
        with suppress(np.linalg.LinAlgError):
            return np.linalg.cholesky(P + growth * least_m2 * np.eye(len(P)))
    raise MapError('the covariance of the landmarks is not finite')


def _of_constant_gains(state: State, rows: IntArray) -> FloatArray:
    """Return a covariance (p + m k, p + m k) of ε and m landmarks for gains that know none."""
    # The pose is exact, and each landmark as uncertain as if it was seen from here once.
    p, k = state.axes.p, state.axes.point
    noise = state.observation_noise.at(state.observer.body_points(rows))
    covariance = np.zeros((p + k * len(rows),) * 2)
    covariance[p:, p:] = block_diagonal(state.observer.turned(noise)[:, :k, :k])
    return covariance


def _counts(known: LandmarkMap, state: State) -> IntArray:
    """Return how often landmarks of a map count as seen: a surveyed one is confirmed at once."""
    return np.asarray(np.maximum(known.counts, state.settings.confirmations))


def _renumber(state: State, known: LandmarkMap, rows: IntArray, known_ids: IntArray) -> None:
    """Give ``rows`` a map's ids, and new numbers to others that no sensor named like these."""
    ids = state.landmarks.ids
    own = np.flatnonzero(is_automatic(ids) & np.isin(ids, known.ids))
    taken = np.append(ids[is_automatic(ids)], known.ids[is_automatic(known.ids)])
    state.landmarks.renumber(own, np.max(taken, initial=0) + 1 + np.arange(len(own)))
    state.landmarks.renumber(rows, known_ids)
    state.landmarks.evidence[rows] = np.inf


def _complete(state: State, known: LandmarkMap, added: LandmarkMap) -> None:
    """Go on in a map, ``added`` the part of it that the state did not have."""
    mode = state.settings.localization_mode
    if mode == 'fixed':  # all are where the map has them, and are left there
        rows = known.rows_of(np.append(state.landmarks.ids, added.ids))
        state.fix_landmarks(_in_reference_frame(state, known.select(rows)))
    state.landmarks.add_known(added.ids, _counts(added, state))
    state.is_mapping = mode == 'off'
    state.forget_past('the pose in the loaded map was found')


def _in_reference_frame(state: State, known: LandmarkMap) -> KnownLandmarks:
    """Return what a map knows of positions in the frame of P°."""
    back = se3.inverse(state.observer.reference_pose)
    return known.landmarks_in(back, state.settings.map_noise)


MOVING_SPEED = 0.1  # m/s from which on a landmark is left out of a map; slower ones may be at rest


def map_of(state: State, loaded: LandmarkMap | None) -> LandmarkMap:
    """Return confirmed landmarks at rest, in ``loaded``'s frame or an own one, of its shape."""
    rows = state.confirmed
    rows = rows[np.linalg.norm(state.observer.u[rows], axis=1) < MOVING_SPEED]
    if state.observer.is_exact and loaded is not None:
        known = loaded.select(loaded.rows_of(state.landmarks.ids[rows]))
        return replace(known, counts=state.landmarks.counts[rows])
    R = None
    if state.observer.orientations.are_known[rows].any():
        B = state.known_errors.orientation_matrices(rows)
        R = state.observer.reference_pose[:3, :3] @ B
    landmark_map = LandmarkMap(
        state.landmarks.ids[rows],
        state.observer.world_points[rows],
        None,
        state.landmarks.counts[rows],
        orientations=R,
    )
    return _with_covariances(landmark_map, state, rows, loaded is None)


def _with_covariances(
    landmark_map: LandmarkMap, state: State, rows: IntArray, is_own_frame: bool
) -> LandmarkMap:
    """Return the map of landmarks ``rows`` with its errors, all together unless too many."""
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
