"""What sensors show, by the calibration of the one that showed it; whether that is depths.

A camera that judges distance by apparent size measures r cos b at the angle b off its axis, so
that ln(range measured / range estimated) = a + q ln cos b with q = 1; a laser has q = 0. The
standard deviation of q is by how much it scatters over parts of the run: errors of ranges last.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import RangePower, Update
from slam_observer_ros.events import flatten, ObservationEvent, POINT
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.sensor_mounting import Sensed, sensitivity, turning, without_bias
from slam_observer_ros.models.calibration import Calibration, EACH
from slam_observer_ros.settings.estimator_settings import Settings

LEAST_COSINE = 0.2  # cosine of the angle off its axis, 78°, beyond which no sensor sees depth
_ALONG_X = np.array([1.0, 0.0, 0.0])
_TINY = np.finfo(np.float64).tiny


def calibrated(
    calibration: Calibration,
    settings: Settings,
    event: ObservationEvent,
    anchors: IntArray | None = None,
) -> ObservationEvent:
    """Return an observation as it is by the calibration of its sensor; keep what that showed.

    ``anchors`` (m,) are the landmarks of ranges that have a bias, −1 for other points.

    Points of a depth that is taken for a range are as much further off as 1/cos b makes them, at
    the angle b off the sensor's axis.
    """
    frame = event.sensor_frame
    values, number = calibration.sensor(frame), calibration.sensors.index(frame)
    origins = np.zeros_like(event.points) if event.sensor is None else event.sensor
    arms = event.points - origins
    if settings.range_is_depth:
        arms = arms / cosines(arms, event.sensor_axis)[:, None]
    if anchors is None:
        anchors = np.full(len(arms), -1)
    sensed = Sensed(np.full(len(arms), number), origins, arms, anchors, event.orientations)
    covariances, velocities, R = event.covariances, event.velocities, so3.exp(values[:3])
    directions = event.directions
    if covariances is not None:
        squared = np.einsum('ij,ij->i', arms, arms)
        shown = np.einsum('ij,ij->i', event.lines_of_sight, event.lines_of_sight)
        longer = math.exp(2.0 * values[6]) * squared / np.maximum(shown, _TINY)
        covariances = longer[:, None, None] * (R @ covariances @ R.T)
    if velocities is not None:
        velocities = velocities @ R.T
    if directions is not None:
        directions = directions @ R.T
    event = replace(
        event, covariances=covariances, directions=directions, velocities=velocities, sensed=sensed
    )
    return calibrated_again(calibration, event)


def calibrated_again(calibration: Calibration, event: ObservationEvent) -> ObservationEvent:
    """Return a calibrated observation as it is by the calibration now."""
    sensed, Z = event.sensed, event.orientations
    if sensed is None:
        return event
    values = calibration.sensor(event.sensor_frame)
    R, scale = so3.exp(values[:3]), math.exp(values[6])
    sensor, arms = sensed.origins + values[3:6], sensed.arms
    if calibration.range_bias_m:
        arms = without_bias(arms, calibration.biases(sensed.anchors)[0]) * arms
    points = arms.dot(scale * R.T) + sensor
    if calibration.axes.is_planar:  # the line of sight keeps its height
        sensor[:, 2] -= points[:, 2]
        points[:, 2] = 0.0
    if sensed.orientations is not None:
        Z = R @ sensed.orientations
    return replace(event, points=points, sensor=sensor, orientations=Z)


def point_sensitivity(
    calibration: Calibration, event: ObservationEvent, points: FloatArray
) -> FloatArray | None:
    """Return D (m, 3, c) at ``points`` (m, 3) of a calibrated observation, body frame; or None."""
    if event.sensed is None or event.sensor is None or not calibration.calibrates_sensors:
        return None
    frame, D = event.sensor_frame, np.zeros((len(points), 3, calibration.count))
    of_sensor = sensitivity(calibration.sensor(frame), points - event.sensor)
    D[:, :, calibration.columns(frame)] = of_sensor[:, :, calibration.of_sensor]
    if calibration.range_bias_m:
        _, columns = calibration.biases(event.sensed.anchors)
        at = np.flatnonzero(columns >= 0)
        D[at, :, columns[at]] = of_sensor[at, :, EACH]
    return D


def turn_sensitivity(calibration: Calibration, event: ObservationEvent) -> FloatArray | None:
    """Return (3, c), how orientations seen turn with the calibration, body frame; or None."""
    if event.sensed is None or not calibration.calibrates_sensors:
        return None
    frame, D = event.sensor_frame, np.zeros((3, calibration.count))
    of_sensor = turning(calibration.sensor(frame))
    D[:, calibration.columns(frame)] = of_sensor[:, calibration.of_sensor]
    return D


def cosines(arms: FloatArray, axis: FloatArray | None) -> FloatArray:
    """Return cos b (m,) of lines of sight (m, 3) off the sensor's axis (3,), x by default."""
    lengths = np.sqrt(np.einsum('ij,ij->i', arms, arms))
    along = arms.dot(_ALONG_X if axis is None else axis)
    return np.asarray(np.maximum(along / np.maximum(lengths, _TINY), LEAST_COSINE))


MAX_WAITING = 100  # observations that are remembered until they are used
MAX_OBSERVATIONS = 20_000  # observations that are looked at, from the start of the run
MOST_UNCOMPARED = 64  # observations whose ranges are compared at once

# Least number of points that says something, and the parts of them that scatter.
MIN_POINTS, PARTS = 200, 20
MIN_SPREAD = 0.02  # least standard deviation of ln cos b: half a field of view of some 25°
MAX_BEHIND = 0.1  # share of the points beside or behind the sensor beyond which it sees all around
MAX_ERROR = 1.0  # error of ln range beyond which a point is no measurement of its landmark


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
        if event.kinds is not None:  # half points have no range, or none off an axis
            event = event.select(event.kinds == POINT)
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
