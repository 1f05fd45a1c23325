"""Landmarks without ids that turn out to be one: side by side, at the end of a loop, anywhere.

After a loop the pose may be so uncertain that points pass for new landmarks. Which of all are one
is asked of all pairs together, by the joint covariance: they share the errors of the poses from
which they were seen, so where one pair is one, the others are known far better.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.filter.landmark_table import LandmarkTable, SURE
from slam_observer_ros.filter.robust import accepted
from slam_observer_ros.lie.matrices import diagonal_blocks, mahalanobis
from slam_observer_ros.tracking.hypothesis import id_pairs, IdPairs, Twins
from slam_observer_ros.tracking.joint_compatibility import (
    columns_of,
    JointSearch,
    Pairs,
    PRUNING_COST_OF_IDS,
)
from slam_observer_ros.tracking.state import State

PERIOD_NS = 5_000_000_000  # time between two searches, nanoseconds
MAX_CANDIDATES = 10  # landmarks that another one may be: the likeliest, if there are more

# Standard deviation of how far apart they may be though exactly known, metres: no two views of a
# thing have quite the same centre.
LEAST_M = 0.01
LATEST = 64  # landmarks, those seen last, of which it is asked: time grows with their cube
# What odometry states of its standard deviation, then twice as much, and twice that, …
WIDTHS = (1.0, 2.0, 4.0)
FEW = 8  # of these that lie to each other as they were seen, however odometry was off
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
        points = state.observer.points[rows]
        lengths_m = np.linalg.norm(points[:, None] - points, axis=2)
        i, j = np.nonzero(np.triu(lengths_m < self._near_m, 1))
        self._apart.update(id_pairs(landmarks.ids, rows[i], rows[j]))

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
        old, own = absent[at], added[new]
        B, a, b = _blocks(state, old, own)
        distances = mahalanobis(points[old] - points[own], _of_differences(B, a, b, a, b))
        differ = ~accepted(distances, state.settings.rejection_threshold)
        doubled = {*id_pairs(landmarks.ids, old[differ], own[differ])} - self._doubled
        state.counts['doubled_landmark'] += len(doubled)
        self._doubled |= doubled

    def twins(self, state: State, asked: Set[IdPairs]) -> list[Twins]:
        """Return which landmarks may be one: each likely answer, the likeliest first.

        That none are is an answer, too; others that were ``asked`` before are left out. It is
        asked of the landmarks seen last.
        """
        rows, landmarks, k = state.confirmed, state.landmarks, state.axes.point
        own = rows[is_automatic(landmarks.ids[rows])]
        own = own[np.lexsort((landmarks.ids[own], landmarks.born_ns[own]))]
        if len(own) <= 2:
            return []
        points, gate = state.observer.points[own, :k], state.settings.rejection_threshold
        latest = np.argsort(-landmarks.last_seen_ns[own], kind='stable')
        last, few = np.sort(latest[:LATEST]), latest[:FEW]
        lengths_m = np.linalg.norm(points[last][:, None] - points, axis=2)
        # How many there are about each, but for a twin.
        nearest_m = np.sort(lengths_m, axis=1)[:, 1:]
        m = min(NEIGHBOURS, len(own) - 2)
        self._near_m = float(np.median(nearest_m[:, 0]))
        log_densities = math.log(m / (math.pi if k == 2 else 4.0 / 3.0 * math.pi))
        log_densities = log_densities - k * np.log(np.maximum(nearest_m[:, m], LEAST_M))
        # Pairs that may be one, and how they were seen.
        at, others, S = _pairs_near(state, own, last, lengths_m)
        if not len(at):
            return []
        pairs = id_pairs(landmarks.ids, own[last[at]], own[others])
        beside = np.array([self._apart[pair] for pair in pairs], dtype=np.int64)
        are_new = np.array([frozenset([pair]) not in asked for pair in pairs], dtype=np.bool_)
        evidence = _evidence(landmarks, own[others], own[last[at]], beside)
        # How the last few lie turned and shifted, as a whole, to others that were not seen since:
        # odometry alone lies between.
        older, newer = own[np.sort(np.stack([last[at], others]), axis=0)]
        are_far = np.isin(last[at], few) != np.isin(others, few)
        are_far &= landmarks.born_ns[newer] > landmarks.last_seen_ns[older]
        whole = _as_a_whole(state, own[last[at]], are_far, S)
        turn = float(np.max(np.diagonal(state.known_errors.pose_covariance())[:3]))
        r, none = points[others] - points[last[at]], Twins(own[:0], own[:0], 0.0, np.empty(0))
        found = [none]
        for width in WIDTHS:
            wide = S + (width**2 - 1.0) * whole
            may_be = accepted(mahalanobis(r, diagonal_blocks(wide, k)), gate)
            used = np.flatnonzero(may_be & (are_new if width == 1.0 else are_far))
            columns, unit = columns_of(used.tolist(), k), np.eye(k) / (2.0 * math.pi)
            wide, noise = wide[np.ix_(columns, columns)], np.tile(unit, (len(used), 1, 1))
            # Of second order, as those seen last lie turned to the others.
            of_used = points[last[at[used]]]
            off_m = np.linalg.norm(of_used - of_used.sum(axis=0) / max(len(used), 1), axis=1)
            wide += np.diag(np.repeat(0.75 * (width**2 * turn * off_m) ** 2, k))
            search = JointSearch(
                Pairs(at[used], others[used], r[used], wide, noise),
                np.zeros(len(used), dtype=np.bool_),
                -2.0 * log_densities[at[used]],
                PRUNING_COST_OF_IDS,
                pair_costs=-2.0 * evidence[used],
            )
            points_used = np.unique(at[used])
            # Over none, of a factor of the variance as likely as MotionFactors have it at first.
            extra = (2.0 * math.log(width)) ** 2 + 2.0 * float(log_densities[points_used].sum())
            for each in search.pairings():
                one, q = used[each.chosen], len(each.chosen)
                # Some turn and shift fits so few pairs in any case.
                if not q or (width > 1.0 and k * q <= state.axes.p):
                    continue
                # Back on old ground all are known, on new ground none: any number is as likely.
                cost = each.cost + extra + 2.0 * math.log(math.comb(len(points_used), q))
                first, second = np.sort(np.stack([last[at[one]], others[one]]), axis=0)
                seen_costs = search.seen_costs(each)
                found.append(Twins(own[first], own[second], cost, seen_costs, width))
            found.sort(key=lambda one: one.cost)
            if found[0].cost < -2.0 * SURE:
                break
        least = found[0].cost
        return [
            replace(one, cost=one.cost - least)
            for one in found
            if one.cost <= least + 2.0 * SURE and one.pairs(landmarks.ids) not in asked
        ]


def _pairs_near(
    state: State, own: IntArray, last: IntArray, lengths_m: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return pairs (q,), (q,) of one of ``last`` (l,) with one of ``own`` (n,) that may be it.

    And the joint covariance (q k, q k) of how far apart they are, by odometry as it states its
    noise. ``lengths_m`` (l, n) is how far apart they are, metres.
    """
    k, gate = state.axes.point, WIDTHS[-1] * state.settings.rejection_threshold
    points, of_each = state.observer.points[own, :k], state.known_errors.landmark_covariances()
    # By their own covariances at first: a difference has at most twice their sum.
    of_each = of_each[own][:, :k, :k] + LEAST_M**2 * np.eye(k)
    spread_m = np.sqrt(np.trace(of_each, axis1=1, axis2=2))
    is_near = lengths_m <= gate * np.add.outer(spread_m[last], spread_m)
    is_near[:, last] &= np.tri(len(last), k=-1, dtype=np.bool_)  # once, and none with itself
    at, others = np.nonzero(is_near)
    S = 2.0 * (of_each[last[at]] + of_each[others])
    distances = mahalanobis(points[last[at]] - points[others], S)
    near = _nearest(at, distances, 3 * MAX_CANDIDATES, gate)
    at, others = at[near], others[near]
    # Then by their joint one.
    B, a, b = _blocks(state, own[last[at]], own[others])
    distances = mahalanobis(points[last[at]] - points[others], _of_differences(B, a, b, a, b))
    near = _nearest(at, distances, MAX_CANDIDATES, gate)
    a, b = a[near], b[near]
    S = _of_differences(B, a[:, None], b[:, None], a, b).swapaxes(1, 2)
    return at[near], others[near], S.reshape((k * len(near),) * 2)


def _as_a_whole(state: State, rows: IntArray, are_far: BoolArray, S: FloatArray) -> FloatArray:
    """Return the part of S (q k, q k) in which landmarks (q,) lie turned and shifted together.

    It is of pairs that ``are_far`` (q,), and zero elsewhere.
    """
    arms = state.observer.points[rows]
    C = state.axes.output_matrix(arms - arms.mean(axis=0)).reshape(-1, state.axes.p)
    C[np.repeat(~are_far, state.axes.point)] = 0.0
    fit = np.linalg.pinv(C)
    return np.asarray(C @ (fit @ S @ fit.T) @ C.T)


def _nearest(at: IntArray, distances: FloatArray, most: int, gate: float) -> IntArray:
    """Return which pairs (q,) of points ``at`` pass a gate, of each point the ``most`` nearest."""
    order = np.lexsort((distances, at))
    rank = np.arange(len(order)) - np.searchsorted(at[order], at[order])
    return np.sort(order[(rank < most) & accepted(distances[order], gate)])


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


def _blocks(
    state: State, rows: IntArray, others: IntArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the joint covariance in blocks (m, m, k, k) of landmarks and others (q,).

    And which of these m each landmark is, and each other one.
    """
    concerned, places = np.unique(np.append(rows, others), return_inverse=True)
    P, k = state.gains.joint_covariance(concerned), state.axes.point
    if P is None:
        raise TypeError('a filter without a joint covariance has no twins')
    p, m = state.axes.p, len(concerned)
    a, b = np.split(places, 2)
    return np.asarray(P[p:, p:].reshape(m, k, m, k).swapaxes(1, 2)), a, b


def _of_differences(
    B: FloatArray, a: IntArray, b: IntArray, c: IntArray, d: IntArray
) -> FloatArray:
    """Return the covariance (…, k, k) of how far a is from b with how far c is from d."""
    S = B[a, c] - B[a, d] - B[b, c] + B[b, d]
    is_own = (np.equal(a, c) & np.equal(b, d))[..., None, None]
    return np.asarray(S + is_own * LEAST_M**2 * np.eye(B.shape[2]))
