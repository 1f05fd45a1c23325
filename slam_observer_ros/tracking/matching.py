"""Matching an observation with a state: which landmarks it is of, residuals, their noise.

And what a filter expects residuals to be, and how far off they are by that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.lie import se3
from slam_observer_ros.models import sensing
from slam_observer_ros.models.point_noise import RESOLUTION_M
from slam_observer_ros.tracking.state import State

_NORMAL_TURNED = np.diag([1.0, 1.0, -1.0])

SAME_POSITION = 4.0
"""Rejections within this many standard deviations of each other are at one position."""


@dataclass(frozen=True, slots=True)
class MatchedObservation:
    """An observation, with the landmarks of a state that its points are of."""

    event: ObservationEvent  # where mapping is over, without points of unknown landmarks
    rows: IntArray  # (m,) row of each point's landmark, −1 where it is new
    covariances: FloatArray  # (m, 3, 3) of the points, body frame, m²
    known: ObservationEvent  # the points of known landmarks …
    residuals: Residuals  # … and theirs
    left_out: IntArray  # ids of the observation's points that are not in ``event``


def match(state: State, event: ObservationEvent) -> MatchedObservation:
    """Match an observation made at the state's instant with landmarks by their ids."""
    event = calibrated(state, event)
    rows, left_out = state.landmarks.rows_of(event.ids), event.ids[:0]
    if not state.is_mapping:
        left_out = event.ids[rows < 0]
        event, rows = mapped(state, event)
    is_known = rows >= 0
    state.gains.activate(rows[is_known])  # before anything is asked of them
    covariances = point_covariances(state, event, rows)
    if np.count_nonzero(is_known) == len(rows):  # as nearly always
        residuals = residuals_of(state, event, rows, covariances)
        return MatchedObservation(event, rows, covariances, event, residuals, left_out)
    known = event.select(is_known)
    residuals = residuals_of(state, known, rows[is_known], covariances[is_known])
    return MatchedObservation(event, rows, covariances, known, residuals, left_out)


def calibrated(
    state: State, event: ObservationEvent, anchors: IntArray | None = None
) -> ObservationEvent:
    """Return an observation by the calibration of its sensor, if it is not so yet.

    ``anchors`` (m,) are the landmarks whose ranges have a bias, −1 for other points.
    """
    calibration = state.calibration
    if not calibration.corrects_points or event.sensed is not None:
        return event
    if event.sensor_frame not in calibration.sensors:
        state.calibrate(event.sensor_frame)
    return sensing.calibrated(calibration, state.settings, event, anchors)


def calibrated_again(state: State, event: ObservationEvent) -> ObservationEvent:
    """Return an observation by the present calibration, which a correction has changed."""
    return sensing.calibrated_again(state.calibration, event)


def sensitivity(
    state: State, event: ObservationEvent, points: FloatArray | None = None
) -> FloatArray | None:
    """Return R̂ D_i (m, 3, c) at ``points`` (m, 3), body frame, or where an observation has them.

    None where nothing of a sensor is estimated.
    """
    points = event.points if points is None else points
    D = sensing.point_sensitivity(state.calibration, event, points)
    return None if D is None else state.observer.A[:3, :3] @ D


def mapped(state: State, event: ObservationEvent) -> tuple[ObservationEvent, IntArray]:
    """Return the points of known landmarks in an observation, and their rows."""
    rows = state.landmarks.rows_of(event.ids)
    is_known = rows >= 0
    return event.select(is_known), rows[is_known]


def residuals_of(
    state: State, event: ObservationEvent, rows: IntArray, covariances: FloatArray
) -> Residuals:
    """Return the residuals (29) of landmarks ``rows`` (m,) seen with ``covariances``, m²."""
    dt_s = state.landmarks.unseen_s(rows, event.stamp_ns)
    D = None
    if event.sensed is not None:
        D = sensitivity(state, event, state.observer.body_points(rows))
    repeated = state.observation_noise.repetitions(dt_s)
    return state.gains.residuals(rows, event.points, covariances, dt_s, repeated, D)


def positions(state: State, event: ObservationEvent) -> tuple[FloatArray, FloatArray]:
    """Return where points seem to be (m, 3), reference frame, and tolerances (m,), metres.

    By their own noise: a landmark's own uncertainty may be much less.
    """
    spread_m = np.sqrt(np.trace(state.observation_noise.covariances(event), axis1=1, axis2=2))
    return se3.transform(state.observer.A, event.points), SAME_POSITION * spread_m


def point_covariances(state: State, event: ObservationEvent, rows: IntArray) -> FloatArray:
    """Return the covariances (m, 3, 3) of points of landmarks ``rows``, −1 if new, body frame, m².

    The noise model is given the range at which a landmark should be, not the measured one: a range
    measured short would be trusted more than one measured long, and all would be drawn towards
    the robot. The bearing is the measured one: the sensor knows it better than a state whose
    heading is yet to be corrected.
    """
    measured, expected = event.lines_of_sight, _lines_of_sight(state, event, rows)
    expected_squared = np.einsum('ij,ij->i', expected, expected)
    measured_squared = np.einsum('ij,ij->i', measured, measured)
    shares = np.sqrt(expected_squared / np.maximum(measured_squared, RESOLUTION_M**2))
    return state.observation_noise.covariances(event, shares[:, None] * measured)


def rejected_before(state: State, matched: MatchedObservation) -> tuple[BoolArray, FloatArray]:
    """Return which known landmarks (m,) were rejected before where they are seen now.

    Return how far (m, 3) all of them are from where they were rejected last, too: metres,
    reference frame.
    """
    rows = matched.residuals.rows
    points, tolerances_m = positions(state, matched.known)
    again = state.landmarks.are_rejected_again(rows, points, tolerances_m)
    return again, points - state.landmarks.rejected_last[rows]


def is_contradiction(rejected: BoolArray) -> bool:
    """Return whether most of the known landmarks (m,) seen are rejected: the pose may be wrong."""
    return bool(2 * np.count_nonzero(rejected) > len(rejected))


def _lines_of_sight(state: State, event: ObservationEvent, rows: IntArray) -> FloatArray:
    """Return where points should be (m, 3), from the sensor, metres, body frame."""
    landmarks, settings = state.landmarks, state.settings
    if not len(landmarks):
        return event.lines_of_sight
    # A new or doubtful landmark, and one that may be an outlier, is where it was measured.
    is_confirmed = landmarks.counts.take(rows, mode='wrap') >= settings.confirmations
    in_doubt = landmarks.in_doubt(rows, settings.max_rejections)
    is_sure = (rows >= 0) & is_confirmed & ~in_doubt
    points = state.observer.body_points(rows)
    if np.count_nonzero(is_sure) < len(rows):
        points = np.where(is_sure[:, None], points, event.points)
    return points if event.sensor is None else points - event.sensor


def flipped(Z: FloatArray, lines_of_sight: FloatArray) -> FloatArray:
    """Return the other orientations (m, 3, 3) in which tags look nearly the same.

    Mirrored in depth, a plane's image is the same but for perspective; so they are hard to
    distinguish for tags that are small or nearly frontal. A tag is in its x-y plane.
    """
    squared = np.einsum('ij,ij->i', lines_of_sight, lines_of_sight)[:, None, None]
    outer = lines_of_sight[:, :, None] * lines_of_sight[:, None, :]
    mirror = np.eye(3) - 2.0 * outer / np.maximum(squared, np.finfo(np.float64).tiny)
    twins: FloatArray = mirror @ Z @ _NORMAL_TURNED
    return twins


def all_orientations(
    state: State, event: ObservationEvent, rows: IntArray, Z: FloatArray
) -> SeenOrientations:
    """Return the orientations ``Z`` (m, 3, 3) in an observation, with their noise."""
    noise = state.observation_noise.orientation_covariances(event, _expected(state, rows, Z))
    unseen_s = state.landmarks.unseen_s(rows, event.stamp_ns)
    repeated = state.observation_noise.repetitions(unseen_s)
    twins, D = flipped(Z, event.lines_of_sight), sensing.turn_sensitivity(state.calibration, event)
    if D is not None:
        D = state.observer.A[:3, :3] @ D
    return SeenOrientations(rows, Z, twins, noise, repeated, D)


def _expected(state: State, rows: IntArray, Z: FloatArray) -> FloatArray:
    """Return the orientations (m, 3, 3) expected of tags; of an unknown one, as it is seen.

    By the seen orientation, a tag that only seems to be tilted would be trusted too much.
    """
    tags = state.observer.orientations
    expected: FloatArray = state.observer.A[:3, :3].T @ tags.B[rows]
    return np.where(tags.are_known[rows][:, None, None], expected, Z)
