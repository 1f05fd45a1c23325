"""A robot that goes on slipping: wheels turn, and it stands, or gets on more slowly than they do.

What is in view then moves less in the robot's frame than odometry says, time after time, and each
time by too little to be rejected: the pose would be dragged along, and landmarks with it. So how
much of the motion since the last observation has not been made, s of its turn and of its way, is
tested at each one. With S and B = C J the residuals r are likelier with s ~ N(0, I) by

    gᵀ (I + H)⁻¹ g − ln |I + H|,    g = Bᵀ S⁻¹ r,  H = Bᵀ S⁻¹ B

which adds up from one observation to the next (E. S. Page, *Continuous inspection schemes*,
1954). Once it is clear, odometry is no longer believed, until it explains what is seen again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.association.costs import SLIP_COST
from slam_observer_ros.association.slip import strayed
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.common.units import to_s
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import mahalanobis, with_blocks
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.observer.robust import distances
from slam_observer_ros.state.matching import MatchedObservation
from slam_observer_ros.state.state import State

MOST_AT_ONCE = 0.5 * SLIP_COST
"""What a single observation may speak for a slip: one that is garbled shows none."""

LEAST_SEEN = 2
"""Landmarks that must agree: one alone may move."""

LEAST_SHARE = 0.1
"""Share of a motion that must be missing; less than that is a matter of its scale."""

CLEAR = 2.0
"""Mean of squared standard deviations of the sensor's noise, up to which nothing is tested."""

MARGIN = 0.5
"""What such a share may be off by: it is 0 to 1, or what the robot has slipped before."""

MEMORY_S = 1.0
"""Time for which a filter that follows odometry may lag behind what is seen."""


@dataclass(slots=True)
class Slipping:
    """Whether a robot slips, by what its observations say together."""

    is_on: bool = False
    _evidence: float = 0.0
    _lost: FloatArray = field(default_factory=lambda: np.zeros(6))  # motion since it may slip
    _recent: FloatArray = field(default_factory=lambda: np.zeros(2))  # turn and way, rad and m
    _stamp_ns: int = 0

    def note(self, state: State, matched: MatchedObservation) -> None:
        """Judge an observation that is yet to be used; disbelieve the motion to it if need be."""
        motion = se3.log(state.reckoned)
        state.reckoned = np.eye(4)
        if not motion.any():
            return
        self._evidence = min(self._evidence, SLIP_COST) + min(
            self._gain(state, matched, motion), MOST_AT_ONCE
        )
        if self._evidence <= 0.0:
            self.is_on, self._evidence, self._lost = False, 0.0, np.zeros(6)
            return
        self._lost = motion if self.is_on else self._lost + motion
        if self.is_on or self._evidence >= SLIP_COST:
            state.counts['slip'] += not self.is_on
            self.is_on = True
            A, turn, way = state.observer.A, self._lost[:3], self._lost[3:]
            noise = block_diag(np.outer(turn, turn), np.outer(way, way))
            state.propagate(strayed(state, np.array([A, A]), noise[None]))

    def _gain(self, state: State, matched: MatchedObservation, motion: FloatArray) -> float:
        """Return how much more likely the observation is if the robot slips."""
        done = np.linalg.norm(motion.reshape(2, 3), axis=1)
        elapsed_s = to_s(matched.event.stamp_ns - self._stamp_ns)
        self._stamp_ns = matched.event.stamp_ns
        self._recent = done + math.exp(-max(elapsed_s, 0.0) / MEMORY_S) * self._recent
        r, noise = matched.residuals.on(state.axes)
        # Nearly always what is seen is off by no more than by the sensor's noise.
        if not self._evidence and np.sum(mahalanobis(r, noise) ** 2) <= CLEAR * r.size:
            return 0.0
        most = 1.0 + MARGIN + self._recent / np.maximum(done, np.finfo(np.float64).tiny)
        return _gain(state, matched.residuals, motion, most) if len(r) else 0.0


def _gain(state: State, residuals: Residuals, motion: FloatArray, most: FloatArray) -> float:
    """Return how much likelier residuals are if a part of the motion (6,) has not been made.

    Of turn and way at ``most`` (2,) times as much as there was.
    """
    seen = len(residuals.rows)
    # How the part of the turn and that of the way move what is seen.
    parts = np.zeros((6, 2))
    parts[:3, 0], parts[3:, 1] = motion[:3], motion[3:]
    J = se3.adjoint(state.observer.A)[state.axes.pose] @ parts
    B = state.axes.output_matrix(residuals.e + residuals.a) @ J
    r, noise = residuals.on(state.axes)
    predicted = state.filter.predicted(residuals)[1]
    gain, s = _likelihood_ratio(r, B, predicted, noise)
    # Most must fit; what does not may have moved.
    explained = distances(r - B @ s, predicted, noise) <= state.settings.rejection_threshold
    fitting = int(np.count_nonzero(explained))
    if fitting < max(LEAST_SEEN, 0.5 * seen):
        return min(gain, 0.0)
    if fitting < seen:
        columns = np.flatnonzero(np.repeat(explained, r.shape[1]))
        part = predicted[np.ix_(columns, columns)]
        gain, s = _likelihood_ratio(r[explained], B[explained], part, noise[explained])
    is_plausible = s.min() >= -MARGIN and s.max() >= LEAST_SHARE and (s <= most).all()
    return gain if is_plausible else min(gain, 0.0)


def _likelihood_ratio(
    r: FloatArray, B: FloatArray, predicted: FloatArray, noise: FloatArray
) -> tuple[float, FloatArray]:
    """Return 2 ln of how much likelier residuals (m, k) are with B s, and s (2,)."""
    B = B.reshape(-1, B.shape[-1])
    solved = np.linalg.solve(with_blocks(predicted, noise), np.column_stack([r.ravel(), B]))
    g, H = B.T @ solved[:, 0], np.eye(B.shape[1]) + B.T @ solved[:, 1:]
    s = np.linalg.solve(H, g)
    return float(g @ s - np.linalg.slogdet(H)[1]), s
