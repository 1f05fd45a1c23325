"""Matching of an observation with a state: residuals of known landmarks, and their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.observer.filter import FrameObservation, Residuals
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.sensor_models.observation_noise import ObservationNoise, RESOLUTION_M
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state.landmark_table import LandmarkTable

SAME_PLACE = 4.0
"""Rejections within this many standard deviations of each other are at one place."""


@dataclass(frozen=True, slots=True)
class MatchedObservation:
    """An observation, with the landmarks of a state that its points are of.

    Attributes
    ----------
    event : ObservationEvent
        The observation; where nothing is added to the map, without what is not in it.
    rows : IntArray
        (m,) row of the landmark that each of them is, −1 where it is new.
    covariances : FloatArray
        (m, 3, 3) their covariances, body frame, m².
    known : ObservationEvent
        The part of ``event`` that is of landmarks which are not new.
    residuals : Residuals
        Of this part.
    left_out : int
        How many points of the observation are not in ``event``.

    """

    event: ObservationEvent
    rows: IntArray
    covariances: FloatArray
    known: ObservationEvent
    residuals: Residuals
    left_out: int


class MeasurementModel:
    """Predicts where landmarks should be seen, and forms the residuals.

    Rows are those of the landmarks, −1 where one is new.

    Parameters
    ----------
    observer, landmarks : Observer, LandmarkTable
        The state.
    noise : ObservationNoise
        Noise of observations.
    settings : Settings
        ``confirmations`` and ``max_rejections``.

    """

    def __init__(
        self,
        observer: Observer,
        landmarks: LandmarkTable,
        noise: ObservationNoise,
        settings: Settings,
    ) -> None:
        self._observer, self._landmarks, self._noise = observer, landmarks, noise
        self._settings = settings

    def match(self, event: ObservationEvent, rows: IntArray, left_out: int) -> MatchedObservation:
        """Compare the points of ``event`` with where landmarks ``rows`` (m,) should be seen."""
        is_known, covariances = rows >= 0, self.covariances(event, rows)
        known = event.select(is_known)
        residuals = self.residuals(known, rows[is_known], covariances[is_known])
        return MatchedObservation(event, rows, covariances, known, residuals, left_out)

    def residuals(
        self, event: ObservationEvent, rows: IntArray, covariances: FloatArray
    ) -> Residuals:
        """Return what landmarks ``rows`` (m,) tell that were seen with ``covariances``, m²."""
        observer = self._observer
        e, r = observer.errors(rows, event.points)
        return Residuals(
            rows=rows,
            e=e,
            r=r,
            a=observer.a[rows],
            covariances=observer.turned(covariances),
            dt_s=self._landmarks.unseen_s(rows, event.stamp_ns),
        )

    def frame_observation(self, event: ObservationEvent, rows: IntArray) -> FrameObservation:
        """Return what there is to look back at later, after the correction."""
        lines_of_sight = self._lines_of_sight(event, rows)
        is_stated = event.covariances is not None
        stated = self._noise.covariances(event, lines_of_sight) if is_stated else None
        dt_s = self._landmarks.unseen_s(rows, event.stamp_ns)
        return FrameObservation(event.stamp_ns, rows, event.points, lines_of_sight, stated, dt_s)

    def places(self, event: ObservationEvent) -> tuple[FloatArray, FloatArray]:
        """Return where points seem to be (m, 3), and within what they are at one place, metres.

        In the reference frame, by their noise there: that of where a landmark should be may be
        much less.
        """
        spread_m = np.sqrt(np.trace(self._noise.covariances(event), axis1=1, axis2=2))
        return se3.transform(self._observer.A, event.points), SAME_PLACE * spread_m

    def covariances(self, event: ObservationEvent, rows: IntArray) -> FloatArray:
        """Return what observed points may be off by: (m, 3, 3), body frame, m².

        The noise model is told how far off a landmark should be, not how far it was measured:
        one measured too near would be believed more than one measured too far, and all would be
        drawn towards the robot. In which direction, the sensor knows better than a state does
        whose heading is yet to be corrected.
        """
        measured, expected = event.lines_of_sight, self._lines_of_sight(event, rows)
        measured_m = np.maximum(np.linalg.norm(measured, axis=1), RESOLUTION_M)
        shares = np.linalg.norm(expected, axis=1) / measured_m
        return self._noise.covariances(event, shares[:, None] * measured)

    def _lines_of_sight(self, event: ObservationEvent, rows: IntArray) -> FloatArray:
        """Return where points should be (m, 3), from the sensor, metres, body frame.

        Of a landmark that is new, that is in doubt, or that was seen so seldom that it may itself
        be an outlier, this is where it was measured.
        """
        landmarks = self._landmarks
        if not len(landmarks):
            return event.lines_of_sight
        is_confirmed = landmarks.counts[rows] >= self._settings.confirmations
        in_doubt = landmarks.in_doubt(rows, self._settings.max_rejections)
        is_sure = (rows >= 0) & is_confirmed & ~in_doubt
        points = np.where(is_sure[:, None], self._observer.body_points(rows), event.points)
        return points if event.sensor is None else points - event.sensor
