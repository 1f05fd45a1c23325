"""Which points are which landmarks, judged together: a beam search on joint compatibility.

After Neira and Tardós, *Data association in stochastic mapping using the joint compatibility
test*, 2001. All points of an observation share the error of the pose, so pairs that each pass a
gate alone may contradict each other, and a certain pair shows which of the others are right.
A pairing takes each point for one landmark, or for none that is known. It costs

    Σ over its pairs  h(d) + ln(|S| / |R|)    and    h(gate) for each point without a landmark,

where d is the Mahalanobis distance of a pair's residual as the pairs before it predict it, S its
covariance and R the sensor's: the less certain the prediction of a landmark, the less it says that
something is seen there. h is Huber's loss: where wheels slip a true pair may be at 6 σ, and by d²
it would outweigh much that speaks for it.

Here q pairs have points and landmarks (q,), residuals (q, k) in metres and covariances in m².
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import accumulate
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import UNKNOWN_ID
from slam_observer_ros.filter.robust import huber_loss
from slam_observer_ros.lie.matrices import cholesky, diagonal_blocks, mahalanobis, transpose

MAX_PARTIAL = 16
"""Pairings of the points so far, the cheapest, that are extended by the next point.

A search in depth would spend its time below the first pair, and never see that it is wrong.
"""

PRUNING_COST, PRUNING_COST_OF_IDS = 16.0, 35.0
"""How much more than the cheapest something may cost: at odds of e^8 it is given up. Where points
have ids, at odds of e^17.5: a slip costs what it is set to cost, and few points speak for it.
"""

RESOLUTION = 2.0  # standard deviations of the sensor within which two poses can't be distinguished


@dataclass(frozen=True, slots=True)
class Pairs:
    """Pairs of a point and a landmark that may be one."""

    points: IntArray
    landmarks: IntArray
    residuals: FloatArray
    covariances: FloatArray  # (q k, q k) joint covariance S of the residuals
    noise: FloatArray  # (q, k, k) the part R of it that is the sensor's noise


@dataclass(frozen=True, slots=True)
class NewCosts:
    """What it costs to take points of one observation for new landmarks or false points."""

    each: FloatArray  # (m,) of each, as if it were the only one
    steps: FloatArray  # (m,) what the first of them costs more for that, the second, … ≤ 0

    def of(self, is_new: BoolArray) -> float:
        """Return what some of the points cost together: ``is_new`` (m,) says which."""
        return float(self.each[is_new].sum() + self.steps[: np.count_nonzero(is_new)].sum())


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """Some of the pairs, none with a point or landmark of another."""

    cost: float  # see the module's docstring
    chosen: list[int]  # the q pairs
    L: FloatArray  # (q k, q k) inverse Cholesky factor of their S, 1/m
    z: FloatArray  # (q k,) L r, their residuals in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class _Extensions:
    """Pairings of one size, each with any of the o pairs of one more point, and without any."""

    pairings: list[Pairing]  # b of them
    options: IntArray  # (o,) the pairs
    costs: FloatArray  # (b, o + 1) the cost then, last without any; infinite where it can't be
    rows: FloatArray  # (b, o, k, q k + k) rows to append to L
    tails: FloatArray  # (b, o, k) entries to append to z

    def extended(self, i: int, j: int) -> Pairing:
        """Return pairing i with pair j, or without any."""
        pairing, cost = self.pairings[i], float(self.costs[i, j])
        if j == len(self.options):
            return replace(pairing, cost=cost)
        n = len(pairing.z)
        L = np.zeros((self.rows.shape[3],) * 2)
        L[:n, :n], L[n:] = pairing.L, self.rows[i, j]
        chosen = [*pairing.chosen, int(self.options[j])]
        return Pairing(cost, chosen, L, np.append(pairing.z, self.tails[i, j]))


class JointSearch:
    """The pairings that cost little more than the cheapest.

    ``certain`` (q,) are the pairs whose point is of some known landmark in any case,
    ``unpaired_costs`` (q,) what the pair's point costs if it is of none, and ``pair_costs`` (q,)
    what pairs cost more whose landmark may not exist. Of points that are of none the first, second
    … costs ``steps`` more. A pairing may cost ``margin`` more than the cheapest, and ``budget`` in
    all.
    """

    def __init__(
        self,
        pairs: Pairs,
        certain: BoolArray,
        unpaired_costs: FloatArray,
        margin: float,
        budget: float = math.inf,
        pair_costs: FloatArray | float = 0.0,
        steps: FloatArray | None = None,
    ) -> None:
        self._pairs = pairs
        self._certain = certain
        self._unpaired_costs = unpaired_costs
        self._margin, self._budget = margin, budget
        points, counts = np.unique(pairs.points, return_counts=True)
        # Points with the fewest options first: they are the surest, and the others follow them.
        order = points[np.argsort(counts, kind='stable')]
        self._options = [np.flatnonzero(pairs.points == point) for point in order]
        # What the first point of no landmark costs less for that, the second one, ….
        self._steps = np.zeros(len(points)) if steps is None else steps
        # (q,) what the rise of the cost with a pair is less by
        self._less = np.linalg.slogdet(pairs.noise)[1] - pair_costs

    def all_pairs(self) -> Pairing | None:
        """Return the pairing of all pairs; None if one of them is better left out.

        No two of them have a point or a landmark in common.
        """
        pairs = self._pairs
        q, k = pairs.residuals.shape
        L = np.asarray(np.linalg.inv(cholesky(pairs.covariances)), dtype=np.float64)
        z = L @ pairs.residuals.ravel()
        log_dets = np.log(np.diagonal(L)).reshape(q, k).sum(axis=1)
        rises = huber_loss(np.linalg.norm(z.reshape(q, k), axis=1)) - 2.0 * log_dets
        rises -= self._less
        cost = float(rises.sum())
        if (rises > self._unpaired_costs).any() or cost > self._budget:
            return None
        return Pairing(cost, list(range(q)), L, z)

    def pairings(self) -> list[Pairing]:
        """Return the pairings, the cheapest first; points without a landmark are in no pair."""
        partial = [Pairing(0.0, [], np.empty((0, 0)), np.empty(0))]
        for done, options in enumerate(self._options):  # the pairs of one more point
            # Pairings of one size are extended together.
            sizes = dict.fromkeys(len(pairing.chosen) for pairing in partial)
            groups = [
                [pairing for pairing in partial if len(pairing.chosen) == size] for size in sizes
            ]
            partial = self._cheapest([self._extensions(group, options, done) for group in groups])
        return partial

    def _cheapest(self, extensions: list[_Extensions]) -> list[Pairing]:
        """Return the cheapest pairings within margin and budget."""
        if not extensions:
            return []
        # No point makes a pairing cheaper, so one that costs too much can be given up at once.
        costs = np.concatenate([extension.costs.ravel() for extension in extensions])
        order = np.argsort(costs, kind='stable')[:MAX_PARTIAL]
        worst = min(self._budget, costs[order[0]] + self._margin)
        kept = order[np.isfinite(costs[order]) & (costs[order] <= worst)]
        # Back from positions in all costs to a group, its pairing i and option j.
        starts = list(accumulate((extension.costs.size for extension in extensions), initial=0))
        pairings = []
        for position in kept.tolist():
            group = bisect_right(starts, position) - 1
            i, j = divmod(position - starts[group], extensions[group].costs.shape[1])
            pairings.append(extensions[group].extended(i, j))
        return pairings

    def _extensions(self, pairings: list[Pairing], options: IntArray, done: int) -> _Extensions:
        """Return how pairings (b,) of one size may go on with the pairs ``options`` (o,).

        They are of the first ``done`` points.
        """
        S, r, k = self._pairs.covariances, self._pairs.residuals, self._pairs.residuals.shape[1]
        L = np.array([pairing.L for pairing in pairings])
        z = np.array([pairing.z for pairing in pairings])
        # The next rows of the inverse Cholesky factor, and the residuals they predict.
        columns = np.array([columns_of(pairing.chosen, k) for pairing in pairings])
        own = k * options[:, None] + np.arange(k)
        W = L[:, None] @ S[columns[:, None, :, None], own[:, None, :]]  # (b, o, q k, k)
        left = S[own[:, :, None], own[:, None, :]] - transpose(W) @ W
        corners = np.linalg.inv(cholesky(left))
        ahead = r[options] - (z[:, None, None] @ W)[:, :, 0]
        tails = (corners @ ahead[..., None])[..., 0]
        # By how much the cost rises with each option, and without any.
        log_dets = np.log(np.diagonal(corners, axis1=2, axis2=3)).sum(axis=2)
        rises = huber_loss(np.sqrt((tails * tails).sum(axis=2))) - 2.0 * log_dets
        rises[self._are_taken(pairings, options)] = np.inf
        rises -= self._less[options]
        is_certain = self._certain[options].all() & np.isfinite(rises).any(axis=1)
        unpaired = done - len(pairings[0].chosen)
        cost = self._unpaired_costs[options[0]] + self._steps[unpaired]
        without = np.where(is_certain, np.inf, cost)
        before = np.array([[pairing.cost] for pairing in pairings])
        costs = before + np.column_stack([rises, without])
        rows = np.concatenate([-corners @ transpose(W) @ L[:, None], corners], axis=3)
        return _Extensions(pairings, options, costs, rows, tails)

    def _are_taken(self, pairings: list[Pairing], options: IntArray) -> BoolArray:
        """Return (b, o) whether another point already has the landmark of a pair."""
        taken = np.array([self._pairs.landmarks[pairing.chosen] for pairing in pairings])
        same = self._pairs.landmarks[options][:, None] == taken[:, None]
        return np.asarray(same.any(axis=2))


def joint_cost(r: FloatArray, S: FloatArray, noise: FloatArray) -> float:
    """Return the cost of a pairing, of residuals r (m, k) with S (m k, m k) and R (m, k, k).

    Pairs are taken in the order of their distances, so that a wrong one is judged by the others,
    and not they by it.
    """
    order = np.argsort(mahalanobis(r, diagonal_blocks(S, r.shape[1])), kind='stable')
    columns = columns_of(order.tolist(), r.shape[1])
    L = cholesky(S[np.ix_(columns, columns)])
    z = np.linalg.solve(L, r[order].ravel()).reshape(r.shape)
    log_det = 2.0 * np.log(np.diagonal(L)).sum() - np.linalg.slogdet(noise)[1].sum()
    return float(huber_loss(np.sqrt((z * z).sum(axis=1))).sum() + log_det)


def pruning_cost(ids: IntArray) -> float:
    """Return how much more than the cheapest an interpretation of points (m,) may cost.

    More where some have an id, as slips are weighed then: what speaks for one comes later.
    """
    return PRUNING_COST if (ids == UNKNOWN_ID).all() else PRUNING_COST_OF_IDS


def unpaired_cost(gate: float) -> float:
    """Return the cost of a point of no known landmark: as likely as a pair at ``gate`` σ."""
    return float(huber_loss(gate))


def columns_of(pairs: list[int], k: int) -> IntArray:
    """Return the columns (q k,) that belong to ``pairs`` (q,) in a joint covariance."""
    columns: IntArray = (k * np.array(pairs, dtype=np.int64)[:, None] + np.arange(k)).ravel()
    return columns
