"""The cost of each way to interpret an observation: lower is likelier.

A cost is −2 ln of a likelihood, as in :mod:`.joint_compatibility`. Costs of points add up, and the
interpretation with the lowest sum is the likeliest one.
"""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.filter.robust import accepted, distances, huber_loss
from slam_observer_ros.lie.matrices import mahalanobis, with_blocks
from slam_observer_ros.tracking.joint_compatibility import joint_cost, NewCosts, unpaired_cost
from slam_observer_ros.tracking.matching import MatchedObservation, rejected_before
from slam_observer_ros.tracking.state import State

SLIP_COST = 20.0
"""Cost of a slip of the robot, at odds of e¹⁰; what it sees afterwards costs extra."""

SAME_CAUSE_COST = 3.0  # cost of each further point that is rejected for the cause of the first one

MAX_OF_ONE_CAUSE = 3
"""Most points that are charged so: a garbled message is one, however many points it has."""


def outlier_cost(state: State) -> float:
    """Return the cost of a point that belongs to no known landmark."""
    return unpaired_cost(state.settings.rejection_threshold)


def pairing_cost(state: State, m: int, residuals: Residuals) -> float:
    """Return the cost of believing the ids of m points; what the gate rejects is an outlier."""
    r, noise = residuals.on(state.axes)
    predicted = state.known_errors.predicted(residuals)[1]
    passed = accepted(distances(r, predicted, noise), state.settings.rejection_threshold)
    used = np.flatnonzero(np.repeat(passed, r.shape[1]))
    predicted = predicted[used][:, used]
    paired_cost = joint_cost(r[passed], with_blocks(predicted, noise[passed]), noise[passed])
    return paired_cost + (m - int(np.sum(passed))) * outlier_cost(state)


def rejection_cost(
    state: State, matched: MatchedObservation, rejected: BoolArray
) -> tuple[float, bool]:
    """Return the cost of rejecting landmarks, and whether a new cause is needed for that.

    All landmarks of a first rejected observation share one cause: the message is garbled. In the
    next rejected observation each landmark needs a cause of its own: it has moved. A landmark that
    is rejected again at the same place costs only what :func:`cost_of_staying` says: landmarks
    that have moved must not throw the pose, however often they are seen.
    """
    # Which were rejected before at this position, and which have a new cause.
    again, staying = cost_of_staying(state, matched)
    again &= rejected
    is_second = again & (state.landmarks.rejections[matched.residuals.rows] == 1)
    new = int(np.sum(rejected & ~again))
    causes = new if state.was_contradicted else min(new, 1)
    same_cause = min(new - causes, MAX_OF_ONE_CAUSE) * SAME_CAUSE_COST
    # One of these may be of a garbled message once more: the one that is surest to have stayed.
    moved = np.sort(staying[is_second])[1:]
    causes += len(moved)
    stayed = float(staying[again].sum() - moved.sum())
    return causes * outlier_cost(state) + same_cause + stayed, causes > 0


def cost_of_staying(state: State, matched: MatchedObservation) -> tuple[BoolArray, FloatArray]:
    """Return which landmarks (m,) were rejected before where they are now, and their costs (m,).

    The cost grows with the distance from the position at which the landmark was last rejected,
    both being measured by the sensor. The last position counts, as with the first one a landmark
    that goes on moving would pay for the same shift each time. A landmark costs no more than an
    outlier.
    """
    k, known = state.axes.point, matched.known
    noise = 2.0 * state.observer.turned(state.observation_noise.covariances(known))
    again, shifts = rejected_before(state, matched)
    costs = huber_loss(mahalanobis(shifts[:, :k], noise[:, :k, :k])) + k * math.log(2.0)
    return again, np.minimum(costs, outlier_cost(state))


MEMORY_S = 60.0  # time, seconds, after which what was seen counts for a third

SHARE_AT_FIRST, POINTS_AT_FIRST = 0.05, 10.0
"""The share as it is taken to be before anything was seen, and how many points that counts for."""

LEAST_COST = 6.0
"""What a point of no known landmark costs at least: else many a true pair, at 2.5 σ, would cost
more.
"""


class NewLandmarks:
    """What it costs to take a point for a new landmark or a false point; −2 ln of a likelihood.

    Such points are anywhere in the volume in which the sensor sees. Where all is known a point
    that could only just be of a known landmark hardly ever is another. On new ground they are
    many: where one point is new others are, too.
    """

    def __init__(self) -> None:
        self._observations = self._points = self._new = 0.0  # of late
        self._stamp_ns: int | None = None

    def costs(self, noise: FloatArray, volume: float, most: float) -> NewCosts:
        """Return the costs of points (m,), which have ``noise`` (m, k, k), m².

        Of each it is −2 ln λ √|2π R|, λ being how many there are in an observation and a unit of
        ``volume``, m^k, of what the sensor sees; and ``most`` where that is not known. With s the
        share of points that are new, u of m are with a likelihood of sᵘ (1 − s)ᵐ⁻ᵘ where they come
        one by one. With a probability of s the robot has come to new ground, where any share of
        them may be: 1 / ((m + 1) (m over u)).
        """
        m = len(noise)
        if not volume:
            return NewCosts(np.full(m, most), np.zeros(m))
        share = (self._new + SHARE_AT_FIRST * POINTS_AT_FIRST) / (self._points + POINTS_AT_FIRST)
        density = share * max(self._points / max(self._observations, 1.0), 1.0) / volume
        costs = -2.0 * math.log(density) - np.linalg.slogdet(2.0 * math.pi * noise)[1]
        s, u = min(share, 0.5), np.arange(m + 1)
        one_by_one = math.log1p(-s) + u * math.log(s) + (m - u) * math.log1p(-s)
        ln_choices = np.append(0.0, np.cumsum(np.log((m - u[:-1]) / (u[:-1] + 1.0))))
        on_new_ground = math.log(s / (m + 1)) - ln_choices
        steps = -2.0 * (np.diff(np.logaddexp(one_by_one, on_new_ground)) - math.log(s))
        each = np.clip(costs, min(LEAST_COST, most), most)
        return NewCosts(each, np.minimum(steps, 0.0))

    def note(self, event: ObservationEvent, new: int) -> None:
        """Count an observation, and how many landmarks turned out to be ``new``, or false."""
        if self._stamp_ns is not None:
            decay = math.exp(-max(to_s(event.stamp_ns - self._stamp_ns), 0.0) / MEMORY_S)
            self._observations *= decay
            self._points *= decay
            self._new *= decay
        self._stamp_ns = event.stamp_ns
        self._observations += 1.0
        self._points += len(event.ids)
        self._new += new
