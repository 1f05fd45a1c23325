"""What it costs to reject what is seen, to believe it, or to take the robot for slipped.

All costs are −2 ln of a likelihood, as in :mod:`.joint_compatibility`.
"""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.association.joint_compatibility import (
    huber_loss,
    joint_cost,
    unpaired_cost,
)
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.geometry.matrices import mahalanobis, with_blocks
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.observer.robust import gated
from slam_observer_ros.state.matching import MatchedObservation, rejected_before
from slam_observer_ros.state.state import State

SLIP_COST = 20.0
"""What it costs to take a robot for slipped, at odds of e¹⁰, beside what it sees then."""

SAME_CAUSE_COST = 3.0
"""What it costs to reject another point for the reason for which one was rejected already."""

MAX_OF_ONE_CAUSE = 3
"""Points that cost this, at most: one garbled message is one, however many points it has."""


def outlier_cost(state: State) -> float:
    """Return what it costs that a point is of no known landmark."""
    return unpaired_cost(state.settings.rejection_threshold)


def pairing_cost(state: State, m: int, residuals: Residuals) -> float:
    """Return what it costs to take some of m points for the landmarks whose ids they have."""
    r, noise = residuals.on(state.axes)
    passed, predicted = gated(
        r, state.filter.predicted(residuals)[1], noise, state.settings.rejection_threshold
    )
    paired_cost = joint_cost(r[passed], with_blocks(predicted, noise[passed]), noise[passed])
    return paired_cost + (m - int(np.sum(passed))) * outlier_cost(state)


def rejection_cost(
    state: State, matched: MatchedObservation, rejected: BoolArray
) -> tuple[float, bool]:
    """Return what it costs to reject landmarks, and whether there is a new cause for it.

    The first time one cause is enough: the observation is garbled. The next time it is not, and
    each landmark has moved for a cause of its own. From then on only how well it is seen at its
    old position costs anything: landmarks that have moved must not throw the pose, however often
    they are seen.
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
    """Return which landmarks (m,) were rejected where they are seen now, and what that costs (m,).

    The last rejected position is known as well as the sensor measures: compared with the first
    one, a landmark that goes on moving would pay for the same shift each time. No landmark costs
    more than another outlier.
    """
    k, known = state.axes.point, matched.known
    noise = 2.0 * state.observer.turned(state.observation_noise.covariances(known))
    again, shifts = rejected_before(state, matched)
    costs = huber_loss(mahalanobis(shifts[:, :k], noise[:, :k, :k])) + k * math.log(2.0)
    return again, np.minimum(costs, outlier_cost(state))
