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

from collections import Counter
from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import UNKNOWN_ID
from slam_observer_ros.filter.robust import huber_loss
from slam_observer_ros.lie.matrices import (
    cholesky,
    diagonal_blocks,
    mahalanobis,
    squares_and_log_dets,
    transpose,
)

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
    with_pose: FloatArray | None = None  # (p, q k) covariance of the residuals with the pose


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
    chosen: list[int]  # the pairs
    move: FloatArray  # (p,) by how much they move the pose, if that is asked for


@dataclass(frozen=True, slots=True, eq=False)
class _Partial:
    """Pairings (b,) of some points; ``W`` is of the other points' pairs, the pose, and residuals.

    With S = L Lᵀ of a pairing W is L⁻¹ [S_others, C P, r]. Where one pairing has a pair more than
    another, that one has zeros.
    """

    costs: FloatArray
    chosen: list[list[int]]
    W: FloatArray  # (b, c, q k + p + 1)


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
        self._certain, self._unpaired_costs = certain, unpaired_costs
        self._margin, self._budget = margin, budget
        self._landmarks, self._k = pairs.landmarks.tolist(), pairs.residuals.shape[1]
        self._uses = Counter(self._landmarks)
        self._options: dict[int, list[int]] = {}  # the pairs of each point
        for i, point in enumerate(pairs.points.tolist()):
            self._options.setdefault(point, []).append(i)
        # What the first point of no landmark costs less for that, the second one, ….
        self._steps = np.zeros(len(self._options)) if steps is None else steps
        # (q,) what the rise of the cost with a pair is less by
        self._pair_costs = pair_costs + np.zeros(len(pairs.points))
        self._less = squares_and_log_dets(pairs.noise, pairs.residuals)[1] - self._pair_costs
        S, PC, r = pairs.covariances, pairs.with_pose, pairs.residuals.reshape(-1, 1)
        self._G = np.concatenate([S, r] if PC is None else [S, PC.T, r], axis=1)

    def all_pairs(self) -> Pairing | None:
        """Return the pairing of all pairs; None if one of them is better left out.

        No two of them have a point or a landmark in common.
        """
        chosen = list(range(len(self._landmarks)))
        rises, W = self._of_all(self._G, chosen)
        cost = float(rises.sum())
        if (rises > self._unpaired_costs).any() or cost > self._budget:
            return None
        return Pairing(cost, chosen, W[:, :-1].T @ W[:, -1])

    def seen_costs(self, pairing: Pairing) -> FloatArray:
        """Return what of the cost says where its pairs (q,) are seen, as shares of one sum."""
        chosen = set(pairing.chosen)
        left = [own[0] for own in self._options.values() if chosen.isdisjoint(own)]
        others = self._unpaired_costs[left].sum() + self._steps[: len(left)].sum()
        others += self._pair_costs[pairing.chosen].sum()
        return np.full(len(chosen), (pairing.cost - others) / max(len(chosen), 1))

    def pairings(self) -> list[Pairing]:
        """Return the pairings, the cheapest first; points without a landmark are in no pair."""
        # Points with the fewest options first: they are the surest, and the others follow them.
        ordered = [self._options[point] for point in sorted(self._options)]
        ordered.sort(key=len)
        # Those that are of one landmark, and no other is, in any case all at once.
        sure = [own[0] for own in ordered if len(own) == 1 and self._is_sure(own[0])]
        ordered = [own for own in ordered if len(own) > 1 or not self._is_sure(own[0])]
        columns = columns_of(sure + [i for own in ordered for i in own], self._k)
        G = self._G[columns]
        G = np.concatenate([G[:, columns], G[:, len(columns) :]], axis=1)
        cost, n = 0.0, self._k * len(sure)
        move = np.zeros(G.shape[1] - len(G) - 1)
        if sure:
            rises, W = self._of_all(G, sure)
            cost, of_pose = float(rises.sum()), slice(len(G) - n, -1)
            move = W[:, of_pose].T @ W[:, -1]
            G = G[n:, n:] - W[:, : len(G) - n].T @ W
        if cost > self._budget:
            return []
        partial = _Partial(np.array([cost]), [sure], np.empty((1, 0, G.shape[1])))
        for done, options in enumerate(ordered, len(sure)):  # the pairs of one more point
            partial = self._extended(partial, G, options, done)
            n = self._k * len(options)
            G = G[n:, n:]
        moves = move + (partial.W[:, :, -1, None] * partial.W[:, :, :-1]).sum(axis=1)
        return [
            Pairing(cost, *each)
            for cost, *each in zip(partial.costs.tolist(), partial.chosen, moves, strict=True)
        ]

    def _is_sure(self, pair: int) -> bool:
        return bool(self._certain[pair]) and self._uses[self._landmarks[pair]] == 1

    def _of_all(self, G: FloatArray, pairs: list[int]) -> tuple[FloatArray, FloatArray]:
        """Return by how much the cost rises with each of the first pairs (m,) in G, and their W.

        W (m k, …) is of all that follows them in G.
        """
        m, n = len(pairs), self._k * len(pairs)
        L = cholesky(G[:n, :n])
        W = np.asarray(np.linalg.solve(L, G[:n, n:]), dtype=np.float64)
        distances = np.sqrt(np.square(W[:, -1]).reshape(m, -1).sum(axis=1))
        log_dets = 2.0 * np.log(L.diagonal()).reshape(m, -1).sum(axis=1)
        return huber_loss(distances) + log_dets - self._less[pairs], W

    def _extended(
        self, partial: _Partial, G: FloatArray, options: list[int], done: int
    ) -> _Partial:
        """Return the cheapest within margin and budget of all that pairings may go on with.

        That is any of the pairs ``options`` (o,), which are the first ones in G, or none of them.
        Pairings are of the first ``done`` points.
        """
        W, o, k = partial.W, len(options), self._k
        b, c = W.shape[:2]
        # Residuals and their covariances as the pairs so far predict them.
        n, each = k * o, np.arange(o)
        own = W[:, :, :n].reshape(b, c, o, k).transpose(0, 2, 3, 1)
        left = G[:n, :n].reshape(o, k, o, k)[each, :, each] - own @ transpose(own)
        ahead = G[:n, -1].reshape(o, k) - (own @ W[:, None, :, -1:])[..., 0]
        # By how much the cost rises with each option, and without any.
        squares, log_dets = squares_and_log_dets(left, ahead)
        rises = np.empty((b, o + 1))
        rises[:, :o] = huber_loss(np.sqrt(squares)) + log_dets - self._less[options]
        rises[:, o] = self._unpaired_costs[options[0]]
        rises[:, o] += self._steps[[done - len(pairs) for pairs in partial.chosen]]
        landmarks = [self._landmarks[option] for option in options]
        if any(self._uses[landmark] > 1 for landmark in landmarks):
            for i, pairs in enumerate(partial.chosen):
                taken = {self._landmarks[pair] for pair in pairs}
                rises[i, [at for at in range(o) if landmarks[at] in taken]] = np.inf
        if self._certain[options].all():
            rises[np.isfinite(rises[:, :o]).any(axis=1), o] = np.inf
        costs = (partial.costs[:, None] + rises).ravel().tolist()
        # No point makes a pairing cheaper, so one that costs too much can be given up at once.
        order = sorted(range(len(costs)), key=costs.__getitem__)[:MAX_PARTIAL]
        worst = min(self._budget, costs[order[0]] + self._margin) if b else -math.inf
        kept = [divmod(at, o + 1) for at in order if costs[at] <= worst and costs[at] < math.inf]
        chosen = [
            [*partial.chosen[i], options[j]] if j < o else partial.chosen[i] for i, j in kept
        ]
        left_costs = np.array([costs[i * (o + 1) + j] for i, j in kept])
        W = W[[i for i, _ in kept], :, n:]
        if all(j == o for _, j in kept):
            return _Partial(left_costs, chosen, W)
        at = [i for i, _ in kept], [min(j, o - 1) for _, j in kept]
        rows = G[:n, n:].reshape(o, k, -1)[at[1]] - own[at] @ W
        more = np.linalg.solve(cholesky(left[at]), rows)
        more[[j == o for _, j in kept]] = 0.0
        return _Partial(left_costs, chosen, np.concatenate([W, more], axis=1))


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
