"""Noise of observed points, for estimators that keep no account of what they saw when."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.lie.axes import SPATIAL
from slam_observer_ros.models import sensing
from slam_observer_ros.models.calibration import Calibration, without_calibration
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.models.point_noise import repetition_factors
from slam_observer_ros.settings.estimator_settings import Settings


class BaselineNoise:
    """The observer's noise of points, and by how much less those weigh whose errors last.

    Parameters
    ----------
    settings : Settings
        Noise figures.

    """

    def __init__(self, settings: Settings) -> None:
        self._noise, self._settings = ObservationNoise(settings), settings
        self._calibration = Calibration(
            FilterArrays(np.eye(4)), without_calibration(settings), SPATIAL
        )
        self._last_seen_ns: dict[int, int] = {}

    def corrected(self, event: ObservationEvent) -> ObservationEvent:
        """Return an observation as the settings state its sensor: its range's scale, or depth."""
        if not self._calibration.corrects_points:
            return event
        if event.sensor_frame not in self._calibration.sensors:
            self._calibration.add(event.sensor_frame)
        return sensing.calibrated(self._calibration, self._settings, event)

    def add(self, event: ObservationEvent) -> tuple[FloatArray, FloatArray]:
        """Take in an observation; call it once for each, in the order of the stamps.

        All points count as seen, also those that an estimator rejects later.

        Returns
        -------
        covariances : FloatArray
            (m, 3, 3) of its points alone, body frame, m².
        factors : FloatArray
            (m,) by which they are larger where landmarks were seen a short time ago.

        """
        ids = event.ids.tolist()
        before_ns = [self._last_seen_ns.get(landmark_id) for landmark_id in ids]
        self._last_seen_ns.update(dict.fromkeys(ids, event.stamp_ns))
        dt_s = np.array(
            [np.inf if last is None else to_s(event.stamp_ns - last) for last in before_ns]
        )
        return self._noise.covariances(event), repetition_factors(dt_s, self._noise.error_time_s)
