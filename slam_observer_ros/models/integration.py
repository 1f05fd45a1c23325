"""The motion between two stamps: velocities as the calibration has them, with their noise.

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

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate
from slam_observer_ros.lie import se3
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion import Motion, Passage
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.velocity_history import VelocityHistory


def transition(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> FloatArray:
    """Return exp(V_1 dt_1) … exp(V_k dt_k) (4, 4), how the body moves from stamp to stamp."""
    held = _held(velocities, calibration, start_ns, end_ns)
    end: FloatArray = _path(np.eye(4), held, calibration)[-1]
    return end


def transition_covariance(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    start_ns: int,
    end_ns: int,
) -> FloatArray:
    """Return the covariance (6, 6) of w in exp(w) Φ, Φ the `transition`, axes of the start."""
    held = _held(velocities, calibration, start_ns, end_ns)
    Ad = se3.adjoint(_path(np.eye(4), held, calibration))
    return se3.summed_noise(Ad, noise.covariances(held))


def integrate(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    A: FloatArray,
    start_ns: int,
    end_ns: int,
    at_start: FloatArray | None,
) -> Motion:
    """Return how Â, ``A`` (4, 4) at ``start_ns``, moves on to ``end_ns``.

    ``at_start`` (6,) is the mean velocity with which the motion before ended, or None. As each
    begins like the last one ended, the delay's error shows in their two ends alone.
    """
    held = _held(velocities, calibration, start_ns, end_ns)
    at_ends = None
    if calibration.delay_error_ns:
        at_start = _around(velocities, calibration, start_ns) if at_start is None else at_start
        at_ends = np.array([at_start, _around(velocities, calibration, end_ns)])
    return Motion(
        path=_path(A, held, calibration),
        measured_velocities=held.body_velocities,
        dt_s=held.dt_s,
        covariances=noise.covariances(held),
        duration_s=to_s(end_ns - start_ns),
        at_ends=at_ends,
        calibration=calibration,
    )


def integrate_until(
    velocities: VelocityHistory,
    calibration: Calibration,
    noise: MotionNoise,
    A: FloatArray,
    start_ns: int,
    stamps_ns: IntArray,
    at_start: FloatArray | None,
    with_covariances: bool,
) -> Passage:
    """Return how Â, ``A`` (4, 4) at ``start_ns``, moves on to each of s stamps of velocities.

    As :func:`integrate` would have had it at each stamp, maybe without what covariances take.
    """
    held = velocities.held_until(start_ns, stamps_ns, calibration.delay_ns)
    if calibration.delay_ns < 0:
        held = replace(held, usual_s=held.usual_s + to_s(-calibration.delay_ns))
    path, last = _path(A, held.whole, calibration), held.last
    at_ends = None
    if with_covariances and (reach_ns := calibration.delay_error_ns):
        at_ends = np.zeros((2, len(stamps_ns), 6))
        starts_ns = np.full(len(stamps_ns), start_ns)
        for of_each, instants_ns in zip(at_ends, (starts_ns, stamps_ns), strict=True):
            centres_ns = instants_ns - calibration.delay_ns
            of_each[:] = velocities.means_until(centres_ns, reach_ns, stamps_ns)
        if at_start is not None:
            at_ends[0] = at_start
    return Passage(
        path=path,
        poses=path[held.counts]
        @ se3.exp(calibration.apply(last.body_velocities) * last.dt_s[:, None]),
        held=held,
        at_ends=at_ends,
        calibration=calibration,
        motion_noise=noise,
    )


def _held(
    velocities: VelocityHistory, calibration: Calibration, start_ns: int, end_ns: int
) -> HeldVelocities:
    delay_ns = calibration.delay_ns
    held = velocities.held(start_ns - delay_ns, end_ns - delay_ns)
    if delay_ns >= 0:
        return held
    # The velocities of that time are yet to come: it is no sign that one was lost.
    return replace(held, usual_s=held.usual_s + to_s(-delay_ns))


def _path(start: FloatArray, held: HeldVelocities, calibration: Calibration) -> FloatArray:
    """Return the poses (k + 1, 4, 4) that velocities lead to, from ``start`` (4, 4) on."""
    return se3.path(start, calibration.apply(held.body_velocities) * held.dt_s[:, None])


def _around(velocities: VelocityHistory, calibration: Calibration, stamp_ns: int) -> FloatArray:
    """Return the mean velocity (6,) around a stamp, as far as its delay may reach.

    At the very stamp a velocity's own noise would pass for a change to read the time from; a mean
    has less noise. The latest velocity stands for those that are yet to come.
    """
    reach_ns, centre_ns = calibration.delay_error_ns, stamp_ns - calibration.delay_ns
    return velocities.mean(centre_ns - reach_ns, centre_ns + reach_ns)


_PER_MEDIAN = 1.4826
"""Standard deviation over the median of the absolute value, of normal distributions."""


SAMPLED = 3
"""One of so many motions is looked at: only ratios of sums count, and time."""


class DelayEvidence:
    """Sums over motions between observations."""

    def __init__(self) -> None:
        self._information = self._noise = self._pull = 0.0
        # (6,) mean of how velocities usually differ from the one before, of how many motions.
        self._steps, self._used, self._seen = np.zeros(6), 0, 0

    def add(
        self,
        velocities: VelocityHistory,
        calibration: Calibration,
        variances: FloatArray,
        start_ns: int,
        end_ns: int,
    ) -> None:
        """Take in a motion between two stamps, of a state that estimates the delay.

        It was off by ``variances`` (6,) by axis, rad² and m².
        """
        self._seen += 1
        if self._seen % SAMPLED:
            return
        delay_ns, reach_ns = calibration.delay_ns, calibration.delay_error_ns
        duration_s = to_s(end_ns - start_ns)
        centres_ns = start_ns - delay_ns, end_ns - delay_ns
        stamps, V = velocities.between(centres_ns[0] - reach_ns, end_ns)
        if len(stamps) < 2 or stamps[0] == stamps[-1] or duration_s <= 0.0:
            return
        axes = calibration.axes.pose
        V = V[:, axes]
        W = _weights(stamps, centres_ns[1], reach_ns, end_ns)
        W -= _weights(stamps, centres_ns[0], reach_ns, start_ns)
        stated = variances[axes] / duration_s
        is_noisy = stated > 0.0
        stated = stated[is_noisy]
        self._information += float((W.dot(V)[is_noisy] ** 2 / stated).sum()) / duration_s
        if len(stamps) < 3:  # a single step may be a change, as of commands by key press
            return
        in_force_s = _overlaps(stamps, *centres_ns) / NANOSECONDS_PER_SECOND
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


def _weights(stamps: IntArray, centre_ns: int, reach_ns: int, known_ns: int) -> FloatArray:
    """Return the weights (m,) of velocities in :meth:`.VelocityHistory.mean`, asked at a stamp."""
    known = int(stamps.searchsorted(known_ns, 'right'))
    weights = np.zeros(len(stamps))
    weights[:known] = _overlaps(stamps[:known], centre_ns - reach_ns, centre_ns + reach_ns)
    total = weights.sum()
    return weights / total if total else weights


def _overlaps(stamps: IntArray, start_ns: int, end_ns: int) -> IntArray:
    """Return for how long (m,) each velocity was in force between two stamps, nanoseconds."""
    # A fifth of what np.append, np.clip and np.diff cost, of so few.
    bounds = np.empty(len(stamps) + 1, dtype=np.int64)
    bounds[:-1], bounds[-1] = stamps, end_ns
    bounds = np.minimum(np.maximum(bounds, start_ns), end_ns)
    overlaps: IntArray = bounds[1:] - bounds[:-1]
    return overlaps
