"""Landmarks without ids that turn out to be one: near each other, or at the end of a loop.

After a loop the pose may be so uncertain that points pass for new landmarks. Where these lie to
each other as old ones do, in one way only, they are those.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
import logging
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.filter.landmark_table import MIN_LOOP
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.lie.matrices import cholesky, mahalanobis
from slam_observer_ros.mapping.merging import without_frame
from slam_observer_ros.settings.estimator_settings import ERROR_PROBABILITY
from slam_observer_ros.tracking.hypothesis import Twins
from slam_observer_ros.tracking.state import State

logger = logging.getLogger(__name__)

PERIOD_NS = 5_000_000_000  # time between two searches, nanoseconds
MAX_SOUGHT = 12  # new landmarks that are looked for among old ones, those seen last
MAX_OLD = 400  # old landmarks among which they are looked for: the nearest ones
REACH = 4.0  # standard deviations of the pose within which a loop may close
MOST = 4.0  # normalised square, per axis, of how far landmarks may be apart that are one

# Standard deviation of how far apart they may be though exactly known, metres: no two views of a
# thing have quite the same centre.
LEAST_M = 0.01

# Landmarks next to one to which distances say how well it is known where it lies there.
NEIGHBOURS = 3


HALF = 0.5  # share of how often two would be seen side by side from which on they are two

# −ln of the probability below which it is no chance that a landmark in view is not seen.
SHOULD_BE_SEEN = 3.0


class LoopClosure:
    """Merges landmarks of one map that are one."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._searched: tuple[bytes, int] | None = None
        self._apart: Counter[tuple[int, int]] = Counter()  # ids seen at once, side by side
        self._near_m = math.inf  # how far side by side is
        self._doubled: set[tuple[int, int]] = set()  # ids that were counted as such

    def note(self, state: State, stamp_ns: int) -> None:
        """Count which landmarks an observation, already used, has shown side by side."""
        landmarks = state.landmarks
        rows = np.flatnonzero(landmarks.last_seen_ns == stamp_ns)
        if len(rows) < 2:
            return
        points, ids = state.observer.points[rows], landmarks.ids[rows].tolist()
        lengths_m = np.linalg.norm(points[:, None] - points, axis=2)
        for i, j in zip(*np.nonzero(np.triu(lengths_m < self._near_m, 1)), strict=True):
            self._apart[min(ids[i], ids[j]), max(ids[i], ids[j])] += 1

    def is_due(self, state: State, stamp_ns: int) -> bool:
        """Return whether it is time to look for landmarks that are one."""
        if not state.is_mapping:
            return False
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < PERIOD_NS:
            return False
        self._last_ns = stamp_ns
        return True

    def close(self, state: State, stamp_ns: int) -> bool:
        """Merge new landmarks with old ones if they lie alike; return whether they do."""
        landmarks, own = state.landmarks, _own(state)
        new = own[landmarks.are_new(own, stamp_ns)]
        old = own[landmarks.are_old(own, stamp_ns)]
        if len(new) < MIN_LOOP or len(old) < MIN_LOOP:
            return False
        seen_ns = landmarks.last_seen_ns
        new = np.sort(new[np.argsort(-seen_ns[new], kind='stable')][:MAX_SOUGHT])
        old = _within_reach(state, new, old)
        searched = (landmarks.ids[new].tobytes(), len(old))
        if len(old) < MIN_LOOP or searched == self._searched:
            return False
        self._searched = searched
        pairs = _pairs(state, new, old)
        has_closed = pairs is not None and state.merge(*pairs, MOST) <= MOST
        if pairs is not None and has_closed:
            logger.info(
                'A loop has closed: %d landmarks without ids were seen before.', len(pairs[0])
            )
        return has_closed

    def count_doubled(self, state: State) -> None:
        """Count landmarks that were added where known ones should be seen, and are not.

        By their joint covariance they can't be these, or they would be merged.
        """
        landmarks, known = state.landmarks, state.confirmed
        missed = landmarks.missed[known]
        absent = known[-missed * math.log1p(-landmarks.likely_share) > SHOULD_BE_SEEN]
        added = known[is_automatic(landmarks.ids[known]) & (missed == 0)]
        if not len(absent) or not len(added):
            return
        points = state.observer.points[:, : state.axes.point]
        off_m = np.linalg.norm(points[absent][:, None] - points[added], axis=2)
        is_since = landmarks.born_ns[added] > landmarks.last_seen_ns[absent][:, None]
        # Nearer to a known one than half as far as this is from the robot, or from a third one.
        others = np.setdiff1d(known, added)
        to_others_m = np.linalg.norm(points[absent][:, None] - points[others], axis=2)
        to_others_m[absent[:, None] == others] = np.inf
        ranges_m = np.linalg.norm(points[absent] - state.observer.A[: state.axes.point, 3], axis=1)
        reach_m = 0.5 * np.minimum(ranges_m, to_others_m.min(axis=1))
        at, new = np.nonzero(is_since & (off_m < reach_m[:, None]))
        if not len(at):
            return
        r, S = _differences(state, absent[at], added[new])
        differ = ~accepted(mahalanobis(r, S), state.settings.rejection_threshold)
        pairs = np.column_stack([landmarks.ids[absent[at]], landmarks.ids[added[new]]])[differ]
        doubled = {(int(old), int(own)) for old, own in pairs} - self._doubled
        state.counts['doubled_landmark'] += len(doubled)
        self._doubled |= doubled

    def twins(self, state: State, apart: Set[tuple[int, int]]) -> Twins | None:
        """Return two landmarks that are likelier one than two, but for ids ``apart``."""
        own = _own(state)
        if len(own) <= 2:
            return None
        from scipy.spatial import cKDTree  # which only points without ids need

        landmarks, k = state.landmarks, state.axes.point
        points = state.observer.points[own, :k]
        tree = cKDTree(points)
        # How many there are about each, but for a twin.
        some = min(NEIGHBOURS + 2, len(own))
        radii_m = tree.query(points, k=some)[0][:, -1]
        unit = math.pi if k == 2 else 4.0 / 3.0 * math.pi
        densities = (some - 1) / (unit * np.maximum(radii_m, LEAST_M) ** k)
        self._near_m = float(np.median(radii_m))
        at = tree.query_pairs(self._near_m, output_type='ndarray')
        first = np.minimum(own[at[:, 0]], own[at[:, 1]])
        second = np.maximum(own[at[:, 0]], own[at[:, 1]])
        ids = np.sort(np.column_stack([landmarks.ids[first], landmarks.ids[second]]), axis=1)
        # Two are seen side by side whenever they are seen, but for what the sensor misses; one is
        # where a false point is beside it.
        p, beside = landmarks.likely_share, np.array([self._apart[a, b] for a, b in ids.tolist()])
        alone = np.minimum(landmarks.counts[first], landmarks.counts[second]) - beside
        may_be = beside < HALF * p * (alone + beside)
        may_be &= landmarks.last_seen_ns[first] != landmarks.last_seen_ns[second]
        may_be &= [(a, b) not in apart for a, b in ids.tolist()]
        if not may_be.any():
            return None
        at, first, second, alone = at[may_be], first[may_be], second[may_be], alone[may_be]
        # How much likelier it is that they are one, there and not seen side by side.
        r, S = _differences(state, first, second)
        distances = mahalanobis(r, S)
        may_be_one = accepted(distances, state.settings.rejection_threshold)
        log_density = np.log(np.maximum(densities[at[:, 0]], densities[at[:, 1]]))
        odds = -0.5 * (distances**2 + np.linalg.slogdet(2.0 * math.pi * S)[1]) - log_density
        # Seen alone so often as one that was missed in a row: :meth:`.LandmarkTable.hidden`.
        odds += np.log1p(p * np.maximum(alone, 0))
        best = int(np.argmax(np.where(may_be_one, odds, -np.inf)))
        if not may_be_one[best] or odds[best] <= 0.0:
            return None
        return Twins(first[[best]], second[[best]], float(odds[best]))


def _own(state: State) -> IntArray:
    """Return the rows of the landmarks in the map that have no id."""
    rows = state.confirmed
    return rows[is_automatic(state.landmarks.ids[rows])]


def _within_reach(state: State, new: IntArray, old: IntArray) -> IntArray:
    """Return the old landmarks (n,) that new ones (m,) may be."""
    points = state.observer.points
    centre = points[new].mean(axis=0)
    radius_m = np.linalg.norm(points[new] - centre, axis=1).max()
    off_m = np.linalg.norm(points[old] - centre, axis=1)
    nearest = np.argsort(off_m, kind='stable')[:MAX_OLD]
    old, off_m = old[nearest], off_m[nearest]
    # Old landmarks that may lie among them, by how well it is known where these are to each other.
    S = _differences(state, np.full(len(old), new[0]), old)[1]
    spread_m = np.sqrt(np.trace(S, axis1=1, axis2=2))
    return np.sort(old[off_m <= 2.0 * radius_m + REACH * spread_m])


def _pairs(state: State, new: IntArray, old: IntArray) -> tuple[IntArray, IntArray] | None:
    """Return which old landmarks (q,) are certainly which new ones (q,), if that is so."""
    from slam_observer_ros.mapping.constellation import find_places  # which few runs need
    from slam_observer_ros.mapping.landmark_map import MappedLandmarks
    from slam_observer_ros.mapping.places import Anywhere, Constellation, Near

    P = state.gains.joint_covariance(np.append(new, old))
    if P is None:
        return None
    axes, points, p = state.axes, state.observer.points, state.axes.p
    m, k = len(new), axes.point
    blocks = P[p:, p:].reshape(m + len(old), k, -1, k).swapaxes(1, 2)
    known = MappedLandmarks(points[old], _local_covariances(points[old], blocks[m:, m:]), axes)
    # How the new ones lie to each other: where they are is not known.
    G = axes.output_matrix(points[new] - points[new].mean(axis=0)).reshape(-1, axes.p)
    of_new = P[p : p + m * k, p : p + m * k] + LEAST_M**2 * np.eye(m * k)
    root = without_frame(cholesky(of_new), G)
    shape = root @ root.T + LEAST_M**2 * np.eye(m * k)
    seen = Constellation(points[new], shape, np.full(m, -1))
    of_pose = state.known_errors.pose_covariance()
    prior = Anywhere(known) if of_pose is None else Near(np.eye(4), of_pose, axes)
    places = find_places(known, seen, prior, ERROR_PROBABILITY)
    place = places.decided(ERROR_PROBABILITY)
    if place is None or place.matches < MIN_LOOP:
        return None
    matched = place.rows >= 0
    return old[place.rows[matched]], new[matched]


def _local_covariances(points: FloatArray, blocks: FloatArray) -> FloatArray:
    """Return how well it is known (n, 3, 3) where landmarks lie to those next to them.

    ``blocks`` (n, n, k, k) is their joint covariance.
    """
    n, k = blocks.shape[0], blocks.shape[2]
    lines = points[:, None, :k] - points[None, :, :k]
    lengths_m = np.linalg.norm(lines, axis=2)
    np.fill_diagonal(lengths_m, np.inf)
    near = np.argsort(lengths_m, axis=1)[:, :NEIGHBOURS]
    a, b = np.repeat(np.arange(n), near.shape[1]), near.ravel()
    u = lines[a, b] / np.maximum(lengths_m[a, b], LEAST_M)[:, None]
    joint = blocks[a, a] + blocks[b, b] - blocks[a, b] - blocks[b, a]
    variances = 0.5 * np.einsum('ai,aij,aj->a', u, joint, u).reshape(n, -1).mean(axis=1)
    return np.asarray(np.maximum(variances, LEAST_M**2)[:, None, None] * np.eye(3))


def _differences(state: State, rows: IntArray, others: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return how far landmarks (q,) are from others (q,): (q, k), and its covariances."""
    k, p, q = state.axes.point, state.axes.p, len(rows)
    both, at = np.unique(np.append(rows, others), return_inverse=True)
    P = state.gains.joint_covariance(both)
    if P is None:
        raise TypeError('a filter without a joint covariance has no twins')
    blocks = P[p:, p:].reshape(len(both), k, len(both), k).swapaxes(1, 2)
    a, b = at[:q], at[q:]
    S = blocks[a, a] + blocks[b, b] - blocks[a, b] - blocks[b, a] + LEAST_M**2 * np.eye(k)
    return (state.observer.points[rows] - state.observer.points[others])[:, :k], S
