"""What speaks for a delay of velocities, and for ranges that are depths along the sensor's axis.

The delay τ follows from how velocities change from observation to observation, f = Σ W_i V_i with
the weights W_i of their means around the two, in the noise of the motion between them. Noise n_i
of V_i is in f, too: it adds to what seems to be known of τ; and it is in the motion, so that the
estimate follows it. Per second of motion, with densities q stated and q_n ≤ q in the velocities,

    information  Σ f²/q,   of which is noise  Σ (q_n/q) Σ W_i²/T,   pull  Σ (q_n/q) Σ W_i t_i/T

for velocities that came every T, each in force for t_i of the motion. Where a share ρ of the
information is noise, the estimate goes only the part 1 − ρ of the way that the filter takes it to
go: of an error at the start the share (σ²/σ_0²)^(1 − ρ) is left when σ_0 has become σ. All of it
is known from the velocities and the stated noise alone.

A camera that judges distance by apparent size measures r cos b at the angle b off its axis, so
that ln(range measured / range estimated) = a + q ln cos b with q = 1; a laser has q = 0. The
standard deviation of q is that by which it scatters over parts of the run, as errors of ranges
last.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, RangePower, Update
from slam_observer_ros.events import flatten, ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.sensing import cosines, LEAST_COSINE
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory

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
        if len(stamps) < 3 or stamps[0] == stamps[-1] or duration_s <= 0.0:
            return
        axes = calibration.axes.pose
        V = V[:, axes]
        W = _weights(stamps, centres_ns[1], reach_ns, end_ns)
        W -= _weights(stamps, centres_ns[0], reach_ns, start_ns)
        in_force_s = _overlaps(stamps, *centres_ns) / NANOSECONDS_PER_SECOND
        period_s = (stamps[-1] - stamps[0]) / (len(stamps) - 1) / NANOSECONDS_PER_SECOND
        # How much noise there is: as stated, or less where velocities differ less.
        steps = np.sort(np.abs(V[1:] - V[:-1]), axis=0)[(len(V) - 1) // 2]
        self._used += 1
        self._steps[axes] += (steps - self._steps[axes]) / self._used
        found = 0.5 * (_PER_MEDIAN * self._steps[axes]) ** 2 * period_s
        stated = variances[axes] / duration_s
        is_noisy = stated > 0.0
        stated = stated[is_noisy]
        share = float(np.minimum(found[is_noisy] / stated, 1.0).sum()) / period_s
        self._information += float((W.dot(V)[is_noisy] ** 2 / stated).sum()) / duration_s
        self._noise += share * float(W.dot(W)) / duration_s
        self._pull += share * float(W.dot(in_force_s)) / duration_s

    def corrected(self, delay: CalibrationEstimate, initial_s: float) -> CalibrationEstimate:
        """Return the estimate, ± ``initial_s`` at the start, without what the noise adds to it."""
        if not (self._information > 0.0 and delay.deviation > 0.0):
            return delay
        prior, posterior = initial_s**-2, delay.deviation**-2
        learnt = max(posterior - prior, 0.0)
        true_share = max(1.0 - self._noise / self._information, 0.0)
        pull = self._pull / self._information * learnt / posterior
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


MAX_WAITING = 100
"""Observations that are remembered until they are used."""

MAX_OBSERVATIONS = 20_000
"""Observations that are looked at, from the start of the run."""

MOST_UNCOMPARED = 64
"""Observations whose ranges are compared at once."""

MIN_POINTS, PARTS = 200, 20
"""Least number of points that says something, and the parts of them that scatter."""

MIN_SPREAD = 0.02
"""Standard deviation of ln cos b from which it does: half a field of view of some 25°."""

MAX_BEHIND = 0.1
"""Share of the points beside or behind the sensor beyond which it sees all around."""

MAX_ERROR = 1.0
"""Error of ln range beyond which a point is no measurement of its landmark."""


class RangeErrors:
    """Compares the ranges of observations with where their landmarks are then known to be."""

    def __init__(self, two_d_mode: bool) -> None:
        self._is_planar = two_d_mode
        self._waiting: deque[ObservationEvent] = deque(maxlen=MAX_WAITING)
        self._errors: list[FloatArray] = []
        self._log_cosines: list[FloatArray] = []
        # Of each observation: points as shown and as estimated (m, 3), from the sensor, and cos b.
        self._uncompared: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._count = self._points = self._behind = 0

    def note_event(self, event: ObservationEvent) -> None:
        """Take in an observation that is going to be used."""
        if self._count < MAX_OBSERVATIONS:
            self._waiting.append(flatten(event) if self._is_planar else event)

    def note_update(self, update: Update, known: IntArray, world_points: FloatArray) -> None:
        """Take in what an observation was found to be, and where landmarks ``known`` (n,) are."""
        event = next((each for each in self._waiting if each.stamp_ns == update.stamp_ns), None)
        if event is None:
            return
        self._waiting.remove(event)
        if not len(known) or not len(event.ids):
            return
        (seen, were_seen), (at, are_known) = _find(update.ids, event.ids), _find(update.ids, known)
        is_used = were_seen & are_known
        if not np.count_nonzero(is_used):
            return
        seen, at = seen[is_used], at[is_used]
        points = se3.transform(se3.inverse(update.pose), world_points[at])
        shown = event.lines_of_sight[seen]
        arms = points if event.sensor is None else points - event.sensor[seen]
        self._uncompared.append((shown, arms, cosines(arms, event.sensor_axis)))
        self._count += 1
        if len(self._uncompared) == MOST_UNCOMPARED:
            self._compare()

    def _compare(self) -> None:
        """Take the ranges of several observations at once: one by one costs more."""
        none = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
        columns = zip(none, *self._uncompared, strict=True)
        shown, arms, cosine = (np.concatenate(parts) for parts in columns)
        self._uncompared.clear()
        is_behind = cosine <= LEAST_COSINE
        self._points += len(cosine)
        self._behind += int(np.count_nonzero(is_behind))
        ranges = np.linalg.norm(arms, axis=1)
        with np.errstate(divide='ignore'):
            errors = np.log(np.linalg.norm(shown, axis=1) / np.maximum(ranges, 1e-9))
        is_good = (np.abs(errors) < MAX_ERROR) & ~is_behind
        self._errors.append(errors[is_good])
        self._log_cosines.append(np.log(cosine[is_good]))

    @property
    def power(self) -> RangePower | None:
        """q; None where the sensor sees all around, or not far enough off its axis."""
        self._compare()
        none = np.empty(0)
        errors = np.concatenate([none, *self._errors])
        x = np.concatenate([none, *self._log_cosines])
        if (
            self._behind > MAX_BEHIND * self._points
            or len(x) < MIN_POINTS
            or np.std(x) < MIN_SPREAD
        ):
            return None
        x, errors = x - x.mean(), errors - errors.mean()
        information = float(x.dot(x))
        value = float(x.dot(errors)) / information
        scores = [part.sum() for part in np.array_split(x * (errors - value * x), PARTS)]
        return RangePower(value, math.sqrt(float(np.dot(scores, scores))) / information)


def _find(wanted: IntArray, ids: IntArray) -> tuple[IntArray, BoolArray]:
    """Return at which rows of ``ids`` (n,), n > 0, wanted ones (m,) are, and whether they are."""
    order = np.argsort(ids)
    rows = order.take(ids[order].searchsorted(wanted), mode='clip')
    return rows, ids[rows] == wanted
