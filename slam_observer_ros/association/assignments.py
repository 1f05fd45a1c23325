"""Which landmarks the points of an observation are, where the sensor gave no ids.

An *assignment* takes each such point for a landmark, or for a new one. What matters about it is
where it puts the robot: among those that agree on that, within what the sensor can tell, the most
likely one is taken. Those that don't agree are all returned, for later observations to decide
(:mod:`slam_observer_ros.association.hypotheses`).

A point whose id is new may be of a landmark that had none so far. Only where the state foretells
that landmark as well as the sensor can tell: an id that is new speaks for one that is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.association.joint_compatibility import (
    columns_of,
    JointSearch,
    MARGIN,
    Pairs,
    RESOLUTION,
    unpaired_cost,
)
from slam_observer_ros.events import is_automatic, UNKNOWN_ID
from slam_observer_ros.gains.base import Residuals
from slam_observer_ros.gains.riccati import RiccatiGains
from slam_observer_ros.gains.robust import mahalanobis, with_blocks
from slam_observer_ros.geometry.axes import axes_of, SPATIAL
from slam_observer_ros.observer import Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.slam.landmark_index import LandmarkIndex
from slam_observer_ros.slam.landmark_table import LandmarkTable
from slam_observer_ros.types import BoolArray, FloatArray, IntArray

MAX_CANDIDATES = 10
"""Landmarks that a point may be taken for; the nearest, if there are more."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """What the points of an observation are taken for.

    Attributes
    ----------
    rows : IntArray
        (m,) row of the landmark that each point is, −1 for a new one.
    cost : float
        −2 ln of its likelihood, up to what all assignments share.

    """

    rows: IntArray
    cost: float


def find_assignments(
    observer: Observer,
    gains: RiccatiGains,
    landmarks: LandmarkTable,
    index: LandmarkIndex,
    ids: IntArray,
    points: FloatArray,
    noise: FloatArray,
    settings: Settings,
    budget: float,
) -> list[Assignment]:
    """Return all assignments that put the robot at different places.

    Parameters
    ----------
    observer, gains : Observer, RiccatiGains
        State and its covariance.
    landmarks : LandmarkTable
        Their ids.
    index : LandmarkIndex
        Index over the observer's landmarks.
    ids : IntArray
        (m,) what the sensor says the points are, ``UNKNOWN_ID`` where it doesn't.
    points : FloatArray
        (m, 3) Â y_i, metres, reference frame.
    noise : FloatArray
        (m, 3, 3) their covariances, m².
    settings : Settings
        ``rejection_distance`` is how far a point may be from its landmark, in σ.
    budget : float
        What an assignment may cost at most.

    Returns
    -------
    list of Assignment
        The most likely first.

    """
    axes = axes_of(settings.two_d_mode)
    gate, m, k = settings.rejection_distance, len(points), axes.point
    known_rows = landmarks.rows_of(ids)
    is_new_id = (ids != UNKNOWN_ID) & (known_rows < 0)
    at, rows = _pairs_near(gate, observer, gains, index, points, noise)
    allowed = _may_be(known_rows, is_new_id, is_automatic(landmarks.ids), at, rows)
    at, rows = _pairs_within(gate, observer, gains, at[allowed], rows[allowed], points, noise)
    residuals = _as_residuals(observer, rows, points[at], noise[at])
    PC, CPC = gains.foretold(residuals)
    own_noise = residuals.covariances[:, :k, :k]
    S = with_blocks(CPC, own_noise)
    pairs = Pairs(at, rows, residuals.r[:, :k], S, own_noise)
    nearly = mahalanobis(pairs.residuals, pairs.noise) <= RESOLUTION
    certain = nearly & ~is_new_id[at]
    unpaired_costs = np.where(is_new_id, unpaired_cost(RESOLUTION), unpaired_cost(gate))
    # Beyond what is searched; a point of no landmark costs the same whatever it might have been.
    fixed_cost = m * unpaired_cost(gate) - float(unpaired_costs[np.unique(at)].sum())
    margin = 0.0 if certain.all() else MARGIN
    search = JointSearch(pairs, certain, unpaired_costs[at], margin, budget - fixed_cost)
    J = np.linalg.inv(np.linalg.cholesky(noise[:, :k, :k])) @ axes.output_matrix(points)
    assignments: list[Assignment] = []
    moves: list[FloatArray] = []
    for pairing in search.pairings():
        move = J @ PC[:, columns_of(pairing.chosen, k)] @ (pairing.L.T @ pairing.z)  # in σ
        if all(_largest(move - other) > RESOLUTION for other in moves):
            found = np.full(m, -1)
            found[at[pairing.chosen]] = rows[pairing.chosen]
            assignments.append(Assignment(found, pairing.cost + fixed_cost))
            moves.append(move)
    return assignments


def _pairs_near(
    gate: float,
    observer: Observer,
    gains: RiccatiGains,
    index: LandmarkIndex,
    points: FloatArray,
    noise: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Return pairs (q,), (q,) of a point and a landmark, all that may pass the gate among them."""
    C = SPATIAL.output_matrix(points)
    seen = C @ gains.pose_covariance @ C.swapaxes(1, 2) + noise
    spread_m = _spread_m(seen) + np.max(_spread_m(gains.landmark_covariances), initial=0.0)
    return index.near(observer.y_ref + observer.a, points, gate * spread_m)


def _may_be(
    known_rows: IntArray,
    is_new_id: BoolArray,
    is_nameless: BoolArray,
    at: IntArray,
    rows: IntArray,
) -> BoolArray:
    """Return which pairs (q,) of a point and a landmark the ids of the points (m,) allow.

    ``is_nameless`` (n,) says which landmarks have no id of their own.
    """
    others = ~np.isin(rows, known_rows) & (~is_new_id[at] | is_nameless[rows])
    return np.asarray(np.where(known_rows[at] >= 0, rows == known_rows[at], others))


def _pairs_within(
    gate: float,
    observer: Observer,
    gains: RiccatiGains,
    at: IntArray,
    rows: IntArray,
    points: FloatArray,
    noise: FloatArray,
) -> tuple[IntArray, IntArray]:
    """Return which of the pairs (q,), (q,) of a point and a landmark pass the gate alone."""
    distances = gains.distances(_as_residuals(observer, rows, points[at], noise[at]))
    order = np.lexsort((distances, at))
    rank = np.arange(len(at)) - np.searchsorted(at[order], at[order])
    near = order[(rank < MAX_CANDIDATES) & (distances[order] <= gate)]
    return at[near], rows[near]


def _as_residuals(
    observer: Observer, rows: IntArray, points: FloatArray, noise: FloatArray
) -> Residuals:
    """Return what it would be to see the landmarks ``rows`` (q,) at ``points`` (q, 3)."""
    a = observer.a[rows]
    e = points - a
    return Residuals(rows, e, e - observer.y_ref[rows], a, noise, np.zeros(len(rows)))


def _largest(vectors: FloatArray) -> float:
    """Return the largest norm of vectors (m, k)."""
    return float(np.sqrt((vectors * vectors).sum(axis=1).max()))


def _spread_m(covariances: FloatArray) -> FloatArray:
    """Return a bound on the standard deviation (m,) in any direction, of (m, 3, 3), metres."""
    return np.asarray(np.sqrt(np.trace(covariances, axis1=1, axis2=2)))
