"""How far an observation is trusted: a Mahalanobis gate, then Huber's weight on what passes.

The step in C has both once more (filter/_core.c); in smoothing, a weight
that falls off takes the gate's place (smoothing/observations.py). Where the state is uncertain
the gate is wide, and outliers pass it.

Residuals r are (m, k), metres; ``predicted`` (m k, m k) is their covariance C P Cᵀ without the
``noise`` (m, k, k) of the observations, m².
"""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.filter.flat_arrays import Tuning
from slam_observer_ros.lie.matrices import (
    diagonal_blocks,
    mahalanobis,
    solve_definite,
    with_blocks,
)

AT_ONCE = 32
"""Points that are used at once. Of more, each block of so many is judged after the one before."""

REWEIGHTINGS = 2  # rounds of reweighted least squares; the weights hardly change after the second

HEAVY_TAIL = 2.0
"""Standard deviations from which on the cost of a residual grows in proportion to its distance."""

DETOURS = 0.2
"""Share of the ranges that came through a wall or by a reflection, where nothing is known of it:
one in five, as of points without ids that are of no landmark (mapping/places.py)."""


def accepted(distances: FloatArray, gate: float) -> BoolArray:
    """Return which residuals pass the gate (``rejection_threshold``), by Mahalanobis distances."""
    return distances <= gate


def accepted_points(r: FloatArray, S: FloatArray, gate: float) -> BoolArray:
    """Return which points pass the gate, by residuals (m, k) and their covariance S (m k, m k)."""
    # No residual is further out than all of them together are.
    if r.ravel().dot(solve_definite(S, r.ravel())) <= gate**2:
        return np.ones(len(r), dtype=np.bool_)
    return accepted(mahalanobis(r, diagonal_blocks(S, r.shape[1])), gate)


def distances(r: FloatArray, predicted: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the Mahalanobis distance (m,) of each residual."""
    return mahalanobis(r, diagonal_blocks(predicted, r.shape[1]) + noise)


def reweighted(
    r: FloatArray, predicted: FloatArray, noise: FloatArray, threshold: float
) -> FloatArray:
    """Return Huber's weights (m,), by reweighted least squares."""
    weights = np.ones(len(r))
    for _ in range(REWEIGHTINGS):
        S = with_blocks(predicted, noise / weights[:, None, None])
        S_inv_r = solve_definite(S, r.ravel()).reshape(r.shape)
        weights = huber_weights(S_inv_r, noise, weights, threshold)
        if np.count_nonzero(weights == 1.0) == len(r):
            break
    return weights


def gated_weights(
    r: FloatArray, predicted: FloatArray, noise: FloatArray, tuning: Tuning
) -> FloatArray:
    """Return the weight (m,) of each orientation of a tag, zero where the gate rejects it.

    The step has the same of points, a block at a time (filter/step.py).

    Other weights are Huber's. They judge R S⁻¹ r, the residual that the correction leaves, by the
    noise R as in an M-estimator: where the state is uncertain a large residual r is no outlier.
    """
    k = r.shape[1]
    passed = accepted_points(r, with_blocks(predicted, noise), tuning.rejection_threshold)
    used = np.flatnonzero(np.repeat(passed, k))
    weights = np.zeros(len(r))
    weights[passed] = reweighted(
        r[passed], predicted[np.ix_(used, used)], noise[passed], tuning.huber_threshold
    )
    return weights


def straight_odds(sigmas_m: FloatArray, ranges_m: FloatArray) -> FloatArray:
    """Return the density of straight ranges where they are right, over the density of all detours.

    A range through a wall or by a reflection is too long, never too short. A detour may add as
    much as the straight way is long, and anything up to that alike: its density is 1/ρ, of a
    straight one 1/(√(2π) σ). ``DETOURS`` is the share of ranges that have made one.
    """
    straight = (1.0 - DETOURS) / (math.sqrt(2.0 * math.pi) * sigmas_m)
    return np.asarray(straight * np.maximum(ranges_m, sigmas_m) / DETOURS)


def straight_share(off: FloatArray, odds: FloatArray) -> FloatArray:
    """Return the probability that ranges came straight, ``off`` standard deviations too long.

    ``odds`` are the :func:`straight_odds`. Of three standard deviations it is a half or so, of
    four next to nothing, and one for a range that is too short.
    """
    is_long = off > 0.0
    straight = odds * np.exp(-0.5 * np.square(np.where(is_long, off, 0.0)))
    return np.where(is_long, straight / (1.0 + straight), 1.0)


def huber_loss(distances: FloatArray | float) -> FloatArray:
    """Return h(d): d² near zero, and from ``HEAVY_TAIL`` on a line."""
    near = np.minimum(distances, HEAVY_TAIL)
    loss: FloatArray = near * (2.0 * distances - near)
    return loss


def huber_weights(
    S_inv_r: FloatArray, noise: FloatArray, weights: FloatArray, threshold: float
) -> FloatArray:
    """Return Huber's weights (m,) of the residuals after a correction; 1 for ``threshold`` 0.

    ``S_inv_r`` (m, k) is S⁻¹ r, where S has R = Σ/w by the old ``weights`` w and ``noise`` Σ.
    """
    if threshold == 0.0:
        return np.ones(len(S_inv_r))
    # R S⁻¹ r is left, by Σ at the distance √((S⁻¹ r)ᵀ Σ S⁻¹ r)/w from zero.
    left = np.sqrt(np.einsum('ij,ijk,ik->i', S_inv_r, noise, S_inv_r)) / weights
    return np.asarray(threshold / np.maximum(left, threshold))
