"""Which points are which landmarks, judged together: a beam search on joint compatibility.

After Neira and Tardós, *Data association in stochastic mapping using the joint compatibility
test*, 2001. All points of an observation share the error of the pose, so pairs that each pass a
gate alone may contradict each other, and a pair that is sure tells which of the others are right.
A pairing takes each point for one landmark, or for none that is known. It costs

    Σ over its pairs  ρ(d) + ln(|S| / |R|)    and    ρ(gate) for each point without a landmark,

where a pair's d is the Mahalanobis distance of its residual as the pairs before it foretell it,
S its covariance and R the sensor's: the less the state foretells where a landmark is seen, the
less it says that something is seen there. ρ is Huber's loss: where wheels slip a true pair may be
at 6 σ, and by d² it would outweigh much that speaks for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.geometry import so3
from slam_observer_ros.types import BoolArray, FloatArray, IntArray

MAX_PARTIAL = 16
"""Pairings of the points so far, the cheapest, that are gone on with at the next point.

A search in depth would spend its time below the first pair, and never see that it is wrong.
"""

HEAVY_TAIL = 2.0
"""Standard deviations from which on the cost of a pair grows in proportion to its distance."""


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


@dataclass(frozen=True, slots=True)
class _Partial(Pairing):
    """A pairing of some points: L is the inverse Cholesky factor of S, z = L r."""

    L: FloatArray
    z: FloatArray


class JointSearch:
    """The pairings that cost little more than the cheapest.

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

    Attributes
    ----------
    unpaired_cost : float
        What each point costs that is taken for no known landmark.

    """

    def __init__(self, pairs: Pairs, certain: BoolArray, gate: float, margin: float) -> None:
        self._pairs = pairs
        self._certain = certain
        self.unpaired_cost = float(huber_loss(gate))
        self._margin = margin
        points, counts = np.unique(pairs.points, return_counts=True)
        # Points with the fewest options first: they are the surest, and the others follow them.
        order = points[np.argsort(counts, kind='stable')]
        self._options = [np.flatnonzero(pairs.points == point) for point in order]
        self._noise_log_dets = np.linalg.slogdet(pairs.noise)[1]

    def pairings(self) -> list[Pairing]:
        """Return the pairings, the cheapest first; what no pair belongs to is left out of it."""
        partial = [_Partial(0.0, [], np.empty((0, 0)), np.empty(0))]
        for options in self._options:
            longer = [more for one in partial for more in self._continued(one, options)]
            longer.sort(key=lambda one: one.cost)
            worst = longer[0].cost + self._margin
            partial = [one for one in longer[:MAX_PARTIAL] if one.cost <= worst]
        return list(partial)

    def _continued(self, one: _Partial, options: IntArray) -> list[_Partial]:
        """Return a pairing with each of the pairs ``options``, all of one point, and without."""
        taken = self._pairs.landmarks[one.chosen]
        free = options[~(self._pairs.landmarks[options][:, None] == taken).any(axis=1)]
        longer = self._with_each(one, free) if len(free) else []
        if not longer or not self._certain[options].all():
            longer.append(_Partial(one.cost + self.unpaired_cost, one.chosen, one.L, one.z))
        return longer

    def _with_each(self, one: _Partial, free: IntArray) -> list[_Partial]:
        """Return a pairing with one more of the pairs ``free`` (o,), for each of them."""
        S, r = self._pairs.covariances, self._pairs.residuals
        n, k = len(one.z), r.shape[1]
        own = k * free[:, None] + np.arange(k)
        W = one.L @ S[columns_of(one.chosen, k)[:, None], own[:, None, :]]  # (o, n, k)
        left = S[own[:, :, None], own[:, None, :]] - so3.transpose(W) @ W
        corners = np.linalg.inv(np.linalg.cholesky(left))
        tails = (corners @ (r[free] - one.z @ W)[:, :, None])[:, :, 0]
        log_dets = np.log(np.diagonal(corners, axis1=1, axis2=2)).sum(axis=1)
        rises = huber_loss(np.sqrt((tails * tails).sum(axis=1))) - 2.0 * log_dets
        costs = one.cost + rises - self._noise_log_dets[free]
        L = np.zeros((len(free), n + k, n + k))
        L[:, :n, :n], L[:, n:, n:] = one.L, corners
        L[:, n:, :n] = -corners @ so3.transpose(W) @ one.L
        return [
            _Partial(float(costs[i]), [*one.chosen, int(pair)], L[i], np.append(one.z, tails[i]))
            for i, pair in enumerate(free)
        ]


def joint_cost(r: FloatArray, covariance: FloatArray, noise: FloatArray) -> float:
    """Return what a pairing costs, of residuals r (m, k) with S (m k, m k) and R (m, k, k)."""
    L = np.linalg.cholesky(covariance)
    z = np.linalg.solve(L, r.ravel()).reshape(r.shape)
    log_det = 2.0 * np.log(np.diagonal(L)).sum() - np.linalg.slogdet(noise)[1].sum()
    return float(huber_loss(np.sqrt((z * z).sum(axis=1))).sum() + log_det)


def huber_loss(distances: FloatArray | float) -> FloatArray:
    """Return ρ(d): d² near zero, and from ``HEAVY_TAIL`` on a line."""
    near = np.minimum(distances, HEAVY_TAIL)
    loss: FloatArray = near * (2.0 * distances - near)
    return loss


def columns_of(pairs: list[int], k: int) -> IntArray:
    """Return the columns (q k,) that belong to ``pairs`` (q,) in a joint covariance."""
    columns: IntArray = (k * np.array(pairs, dtype=np.int64)[:, None] + np.arange(k)).ravel()
    return columns
