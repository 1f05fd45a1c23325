"""Which points are which landmarks, judged together: branch and bound on joint compatibility.

After Neira and Tardós, *Data association in stochastic mapping using the joint compatibility
test*, 2001. All points of an observation share the error of the pose, so pairs that each pass a
gate alone may contradict each other, and a pair that is sure tells which of the others are right.
A pairing takes each point for one landmark, or for none that is known. It costs

    Σ over its pairs  d² + ln(|S| / |R|)    and    gate² for each point without a landmark,

with the joint residual's Mahalanobis distance d, its covariance S and the sensor's R: the less the
state foretells where a landmark is seen, the less it says that something is seen there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.types import BoolArray, FloatArray, IntArray

MAX_NODES = 1000
"""Partial pairings that are looked at, the most likely first, before the search ends."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Pairs of a point and a landmark that may be one.

    Attributes
    ----------
    points, landmarks : IntArray
        (q,) what may be what.
    residuals : FloatArray
        (q, k) residual of each, metres.
    covariances : FloatArray
        (q k, q k) joint covariance S of the residuals, m².
    noise : FloatArray
        (q, k, k) what of it is the sensor's noise R, m².

    """

    points: IntArray
    landmarks: IntArray
    residuals: FloatArray
    covariances: FloatArray
    noise: FloatArray


@dataclass(frozen=True, slots=True)
class Pairing:
    """Some of the pairs, none with a point or landmark of another.

    Attributes
    ----------
    cost : float
        What it costs; see the module's text.
    chosen : list of int
        Which pairs.

    """

    cost: float
    chosen: list[int]


class JointSearch:
    """All pairings that cost little more than the cheapest.

    Parameters
    ----------
    pairs : Pairs
        The pairs to choose from.
    certain : BoolArray
        (q,) pairs whose point is of a known landmark in any case, if not of this then of another.
    gate : float
        Mahalanobis distance at which a point is as likely to be of no known landmark.
    margin : float
        How much more than the cheapest a pairing may cost.

    """

    def __init__(self, pairs: Pairs, certain: BoolArray, gate: float, margin: float) -> None:
        self._pairs = pairs
        self._certain = certain
        self._unpaired_cost = gate**2
        self._margin = margin
        points, counts = np.unique(pairs.points, return_counts=True)
        # Points with the fewest options first: they are the surest, and the others follow them.
        order = points[np.argsort(counts, kind='stable')]
        self._options = [np.flatnonzero(pairs.points == point) for point in order]
        self._noise_log_dets = np.linalg.slogdet(pairs.noise)[1]
        self._nodes = 0
        self._least = np.inf
        self._found: list[Pairing] = []

    def pairings(self) -> list[Pairing]:
        """Return the pairings, the cheapest first; what no pair belongs to is left out of it."""
        self._visit([], np.empty((0, 0)), np.empty(0), 0.0)
        worst = self._least + self._margin
        return sorted(
            (pairing for pairing in self._found if pairing.cost <= worst),
            key=lambda pairing: pairing.cost,
        )

    def _visit(
        self, chosen: list[int], L: FloatArray, z: FloatArray, cost: float, level: int = 0
    ) -> None:
        """Go on from the pairs ``chosen``: L is the inverse Cholesky factor of S, z = L r."""
        self._nodes += 1
        if cost > self._least + self._margin or (self._found and self._nodes > MAX_NODES):
            return
        if level == len(self._options):
            self._least = min(self._least, cost)
            self._found.append(Pairing(cost, chosen))
            return
        taken = self._pairs.landmarks[chosen]
        branches = []
        for pair in self._options[level]:
            if self._pairs.landmarks[pair] not in taken:
                grown, whitened, rise = self._grow(chosen, L, z, int(pair))
                branches.append((cost + rise, [*chosen, int(pair)], grown, whitened))
        if not branches or not self._certain[self._options[level]].all():
            branches.append((cost + self._unpaired_cost, chosen, L, z))
        for next_cost, pairs, grown, whitened in sorted(branches, key=lambda branch: branch[0]):
            self._visit(pairs, grown, whitened, next_cost, level + 1)

    def _grow(
        self, chosen: list[int], L: FloatArray, z: FloatArray, pair: int
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return L, z and the rise in cost with one more pair."""
        S, r, k = self._pairs.covariances, self._pairs.residuals, self._pairs.residuals.shape[1]
        own, n = slice(k * pair, k * pair + k), len(z)
        W = L @ S[columns_of(chosen, k), own]
        corner = np.linalg.inv(np.linalg.cholesky(S[own, own] - W.T @ W))
        tail = corner @ (r[pair] - W.T @ z)
        grown = np.zeros((n + k, n + k))
        grown[:n, :n], grown[n:, :n], grown[n:, n:] = L, -corner @ W.T @ L, corner
        log_det = -2.0 * np.sum(np.log(np.diag(corner))) - self._noise_log_dets[pair]
        return grown, np.append(z, tail), float(tail @ tail + log_det)


def columns_of(pairs: list[int], k: int) -> IntArray:
    """Return the columns (q k,) that belong to ``pairs`` (q,) in a joint covariance."""
    columns: IntArray = (k * np.array(pairs, dtype=np.int64)[:, None] + np.arange(k)).ravel()
    return columns
