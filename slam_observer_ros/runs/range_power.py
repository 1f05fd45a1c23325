"""Whether ranges look like depths along the sensor's axis, by how they err off that axis.

A camera that judges distance by apparent size measures r cos b at the angle b off its axis, so
that ln(range measured / range estimated) = a + q ln cos b with q = 1; a laser has q = 0. Its
standard deviation is that by which it scatters over parts of the run, as errors of ranges last.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import RangePower, Update
from slam_observer_ros.events import flatten, ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.sensor_models.sensing import cosines, LEAST_COSINE

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
