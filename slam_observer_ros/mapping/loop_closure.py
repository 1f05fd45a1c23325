"""Landmarks without ids that turn out to be one: side by side, at the end of a loop, anywhere.

After a loop the pose may be so uncertain that points pass for new landmarks. Which of all are one
is asked of all pairs together, by the joint covariance: they share the errors of the poses from
which they were seen, so where one pair is one, the others are known far better.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.filter.landmark_table import LandmarkTable, SURE
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.lie.matrices import mahalanobis
from slam_observer_ros.tracking.hypothesis import Twins
from slam_observer_ros.tracking.joint_compatibility import JointSearch, Pairs, PRUNING_COST_OF_IDS
from slam_observer_ros.tracking.state import State

PERIOD_NS = 5_000_000_000  # time between two searches, nanoseconds
MAX_CANDIDATES = 10  # landmarks that another one may be: the likeliest, if there are more

# Standard deviation of how far apart they may be though exactly known, metres: no two views of a
# thing have quite the same centre.
LEAST_M = 0.01
NEIGHBOURS = 4  # landmarks next to one that say how many there are about it


class LoopClosure:
    """Finds landmarks of one map that are one."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
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

    def count_doubled(self, state: State) -> None:
        """Count landmarks added where known ones, which they can't be, should be seen."""
        landmarks, known = state.landmarks, state.confirmed
        missed = landmarks.missed[known]
        absent = known[missed * landmarks.rate > SURE]
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
        B = _blocks(state, np.concatenate([absent, added]))
        r, new_at = points[absent[at]] - points[added[new]], len(absent) + new
        differ = ~accepted(
            mahalanobis(r, _of_differences(B, at, new_at, at, new_at)),
            state.settings.rejection_threshold,
        )
        pairs = np.column_stack([landmarks.ids[absent[at]], landmarks.ids[added[new]]])[differ]
        doubled = {(int(old), int(own)) for old, own in pairs} - self._doubled
        state.counts['doubled_landmark'] += len(doubled)
        self._doubled |= doubled

    def twins(self, state: State, apart: Set[tuple[int, int]]) -> list[Twins]:
        """Return which landmarks may be one: each likely answer, the likeliest first.

        That none are is an answer, too. Ids ``apart`` are two landmarks.
        """
        rows, landmarks, k = state.confirmed, state.landmarks, state.axes.point
        own = rows[is_automatic(landmarks.ids[rows])]
        own = own[np.lexsort((landmarks.ids[own], landmarks.born_ns[own]))]
        if len(own) <= 2:
            return []
        points, gate = state.observer.points[own, :k], state.settings.rejection_threshold
        lengths_m = np.linalg.norm(points[:, None] - points, axis=2)
        # How many there are about each, but for a twin.
        some = min(NEIGHBOURS, len(own) - 1)
        radii_m = np.partition(lengths_m, some, axis=1)[:, some]
        self._near_m = float(np.median(radii_m))
        unit = math.pi if k == 2 else 4.0 / 3.0 * math.pi
        log_densities = np.log(some / (unit * np.maximum(radii_m, LEAST_M) ** k))
        # Pairs of an older and a later one that may be so near each other, …
        B = _blocks(state, own)
        shared = np.trace(B, axis1=2, axis2=3)
        spread = np.add.outer(shared.diagonal(), shared.diagonal()) - 2.0 * shared
        reach_m = gate * np.sqrt(np.maximum(spread, 0.0) + k * LEAST_M**2)
        first, second = np.nonzero(np.triu(lengths_m <= reach_m, 1))
        S = _of_differences(B, first, second, first, second)
        distances = mahalanobis(points[first] - points[second], S)
        order = np.lexsort((distances, second))
        rank = np.arange(len(order)) - np.searchsorted(second[order], second[order])
        near = np.sort(order[(rank < MAX_CANDIDATES) & accepted(distances[order], gate)])
        first, second = first[near], second[near]
        # … by how they were seen.
        ids = np.sort(landmarks.ids[own][np.column_stack([first, second])], axis=1)
        pairs = [(a, b) for a, b in ids.tolist()]
        beside = np.array([self._apart[pair] for pair in pairs], dtype=np.int64)
        evidence = _evidence(landmarks, own[first], own[second], beside)
        may_be = np.array([pair not in apart for pair in pairs], dtype=np.bool_)
        if not may_be.any():
            return []
        first, second, evidence = first[may_be], second[may_be], evidence[may_be]
        a, b = first[:, None], second[:, None]
        S = _of_differences(B, a, b, first, second).swapaxes(1, 2).reshape((k * len(first),) * 2)
        # Of second order, as the later ones lie turned to the others.
        turn = float(np.max(np.diagonal(state.known_errors.pose_covariance())[:3]))
        off_m = np.linalg.norm(points[second] - points[second].mean(axis=0), axis=1)
        S += np.diag(np.repeat(0.75 * (turn * off_m) ** 2, k))
        r, unit_noise = points[first] - points[second], np.eye(k) / (2.0 * math.pi)
        search = JointSearch(
            Pairs(second, first, r, S, np.tile(unit_noise, (len(first), 1, 1))),
            np.zeros(len(first), dtype=np.bool_),
            -2.0 * log_densities[second],
            PRUNING_COST_OF_IDS,
            pair_costs=-2.0 * evidence,
        )
        found, m = search.pairings(), len(np.unique(second))
        # Back on old ground all are known ones, on new ground none: any number is as likely.
        costs = [each.cost + 2.0 * math.log(math.comb(m, len(each.chosen))) for each in found]
        return [
            Twins(
                own[first[found[i].chosen]],
                own[second[found[i].chosen]],
                costs[i] - min(costs),
                search.seen_costs(found[i]),
            )
            for i in np.argsort(costs, kind='stable')
            if costs[i] <= min(costs) + 2.0 * SURE
        ]


def _evidence(
    landmarks: LandmarkTable, rows: IntArray, others: IntArray, beside: IntArray
) -> FloatArray:
    """Return how much likelier (q,) landmarks are one than two, by how they were seen.

    They were seen ``beside`` (q,) each other so often. Of two, the one that is missed each time
    that the other is seen is hidden, as in :meth:`.LandmarkTable.hidden`; beside one alone there
    are false points.
    """
    counts, q = landmarks.counts, landmarks.rate
    misses = np.maximum(landmarks.in_view - counts, 0)
    alone = np.minimum(counts[rows] - beside, misses[others])
    alone = np.maximum(alone + np.minimum(counts[others] - beside, misses[rows]), 0)
    expected = landmarks.false_share * np.maximum(alone + beside, 1)
    return np.asarray(np.log1p(q * alone) - beside * np.log1p(1.0 / expected))


def _blocks(state: State, rows: IntArray) -> FloatArray:
    """Return the joint covariance of landmarks (n,) in blocks (n, n, k, k)."""
    P, k = state.gains.joint_covariance(rows), state.axes.point
    if P is None:
        raise TypeError('a filter without a joint covariance has no twins')
    p, n = state.axes.p, len(rows)
    return np.asarray(P[p:, p:].reshape(n, k, n, k).swapaxes(1, 2))


def _of_differences(
    B: FloatArray, a: IntArray, b: IntArray, c: IntArray, d: IntArray
) -> FloatArray:
    """Return the covariance (…, k, k) of how far a is from b with how far c is from d."""
    S = B[a, c] - B[a, d] - B[b, c] + B[b, d]
    is_own = (np.equal(a, c) & np.equal(b, d))[..., None, None]
    return np.asarray(S + is_own * LEAST_M**2 * np.eye(B.shape[2]))
