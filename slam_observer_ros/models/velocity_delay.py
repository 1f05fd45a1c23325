"""What velocities say of their delay, apart from their noise.

An estimated delay has a share of noise of the velocities, too, which passes for their change. The
delay τ follows from how velocities change from one observation to the next, f = Σ W_i V_i with the
weights W_i of their means around the two, by the noise of the motion between them. Noise n_i of
V_i is in f, and seems to be information of τ; it is also in the motion, so that the estimate
follows it. Per second of motion, with densities q stated and q_n ≤ q in the velocities, there are

    information  Σ f²/q,   noise in it  Σ (q_n/q) Σ W_i²/T,   pull  Σ (q_n/q) Σ W_i t_i/T

for velocities that came every T, each in force for t_i of the motion. Where a share ρ of the
information is noise, the estimate goes only the part 1 − ρ of the way that the filter takes it to
go: of an error at the start the share (σ²/σ_0²)^(1 − ρ) is left when σ_0 has become σ. The
velocities and the stated noise alone show all of it.
"""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.held_velocities import Velocities

_PER_MEDIAN = 1.4826  # standard deviation over the median absolute value, of normal ones
SAMPLED = 3  # one of so many motions is looked at: only ratios of sums count, and time


class DelayEvidence:
    """Sums over motions between observations."""

    def __init__(self) -> None:
        self._information = self._noise = self._pull = 0.0
        # (6,) mean of how velocities usually differ from the one before, of how many motions.
        self._steps, self._used, self._seen = np.zeros(6), 0, 0

    def add(
        self,
        velocities: Velocities,
        calibration: Calibration,
        variances: FloatArray,
        start_ns: int,
        end_ns: int,
    ) -> None:
        """Take in a motion between two stamps, off by ``variances`` (6,) by axis, rad² and m²."""
        self._seen += 1
        if self._seen % SAMPLED:
            return
        delay_ns, reach_ns = calibration.delay_ns, calibration.delay_error_ns
        duration_s = (end_ns - start_ns) / NANOSECONDS_PER_SECOND
        centres_ns = start_ns - delay_ns, end_ns - delay_ns
        bounds_ns = centres_ns[0] - reach_ns, end_ns
        first, end = velocities.stamps_ns.searchsorted(bounds_ns, 'right').tolist()
        in_force = slice(max(first - 1, 1), end)
        stamps, V = velocities.stamps_ns[in_force], velocities.body_velocities[in_force]
        if len(stamps) < 2 or stamps[0] == stamps[-1] or duration_s <= 0.0:
            return
        axes = calibration.axes.pose
        V = V[:, axes]
        # For how long each was in force: in the means around end and start, by the velocities that
        # were known then, and in the motion.
        around = np.array([[-reach_ns, reach_ns]])
        spans_ns = np.concatenate([np.array(centres_ns)[::-1, None] + around, [centres_ns]])
        after, before, in_force_ns = _overlaps(stamps, spans_ns, [end_ns, start_ns, stamps[-1]])
        W = after / max(after.sum(), 1) - before / max(before.sum(), 1)
        stated = variances[axes] / duration_s
        is_noisy = stated > 0.0
        stated = stated[is_noisy]
        self._information += float((W.dot(V)[is_noisy] ** 2 / stated).sum()) / duration_s
        if len(stamps) < 3:  # a single step may be a change, as of commands by key press
            return
        in_force_s = in_force_ns / NANOSECONDS_PER_SECOND
        period_s = (stamps[-1] - stamps[0]) / (len(stamps) - 1) / NANOSECONDS_PER_SECOND
        # How much noise there is: as stated, or less where velocities differ less.
        steps = np.sort(np.abs(V[1:] - V[:-1]), axis=0)[(len(V) - 1) // 2]
        self._used += 1
        self._steps[axes] += (steps - self._steps[axes]) / self._used
        found = 0.5 * (_PER_MEDIAN * self._steps[axes]) ** 2 * period_s
        share = float(np.minimum(found[is_noisy] / stated, 1.0).sum()) / period_s
        self._noise += share * float(W.dot(W)) / duration_s
        self._pull += share * float(W.dot(in_force_s)) / duration_s

    def corrected(self, delay: CalibrationEstimate, initial_s: float) -> CalibrationEstimate:
        """Return the estimate, ± ``initial_s`` at the start, without what the noise adds to it."""
        if not (self._information > 0.0 and delay.deviation > 0.0):
            return delay
        prior, posterior = initial_s**-2, delay.deviation**-2
        learnt = max(posterior - prior, 0.0)
        information = max(self._information, self._noise)  # of which the noise is a share
        true_share = 1.0 - self._noise / information
        pull = self._pull / information * learnt / posterior
        left = initial_s * min(prior / posterior, 1.0) ** true_share
        variance = 1.0 / (prior + learnt * true_share) + (0.5 * pull) ** 2 + left**2
        deviation = min(math.sqrt(variance), initial_s)
        return replace(delay, value=delay.value - pull, deviation=deviation)


def _overlaps(stamps: IntArray, spans_ns: IntArray, known_ns: list[int]) -> IntArray:
    """Return for how long (k, m) each velocity was in force in spans (k, 2), nanoseconds.

    Of each span by the velocities that were known at a stamp.
    """
    start, end = spans_ns[:, :1], spans_ns[:, 1:]
    bounds = np.empty((len(spans_ns), len(stamps) + 1), dtype=np.int64)
    bounds[:, :-1] = np.where(stamps > np.array(known_ns)[:, None], end, stamps)
    bounds[:, -1:] = end
    bounds = np.minimum(np.maximum(bounds, start), end)
    return bounds[:, 1:] - bounds[:, :-1]
