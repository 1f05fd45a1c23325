"""Riccati gains in a map that is taken to be exact: O(m) for m landmarks seen, however large.

What :mod:`slam_observer_ros.gains.riccati` is for pose, calibration and landmarks, for pose and
calibration alone: the landmarks' errors ã_i are zero, so r_i ≈ [ −[y]×  I ] ε.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.gains.base import Residuals
from slam_observer_ros.gains.prediction import predict
from slam_observer_ros.gains.riccati import RiccatiGains
from slam_observer_ros.geometry import so3
from slam_observer_ros.motion.motion import Motion
from slam_observer_ros.observer import Correction, Observer
from slam_observer_ros.types import FloatArray, IntArray


class FixedMapGains(RiccatiGains):
    """Gains that know pose and calibration as well as ``before``, and never move a landmark.

    Parameters
    ----------
    before : RiccatiGains
        Gains until now.
    landmark_covariances : FloatArray
        (n, 3, 3) what the map says of its landmarks, reference frame, m². It is only passed on.

    """

    def __init__(self, before: RiccatiGains, landmark_covariances: FloatArray) -> None:
        super().__init__(before._settings)
        self.calibration = before.calibration
        first = self._joint.first
        self._joint.P = before._joint.P[:first, :first].copy()
        self._landmark_covariances = landmark_covariances

    @property
    def landmark_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmarks, as the map has them."""
        return self._landmark_covariances

    def predict(self, observer: Observer, motion: Motion) -> None:
        """Add the motion's noise to the pose's covariance."""
        predict(self._joint.P, self._axes, self.calibration, motion)

    def remove_landmarks(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        self._landmark_covariances = np.delete(self._landmark_covariances, rows, axis=0)

    def settle(self, observer: Observer) -> None:
        """Do nothing: the landmarks of an exact map do not move."""

    @property
    def looks_back(self) -> bool:
        """False: in an exact map there is no drift to undo."""
        return False

    def restart(self, observer: Observer, since: str) -> None:
        """Do nothing: nothing is kept of the past."""

    def _project(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return C P and C P Cᵀ."""
        C = self._pose_output(residuals)
        CP = C @ self._joint.P[: self._p]
        return CP, CP[:, : self._p] @ C.T

    def _output_covariances(
        self, C: FloatArray, columns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of C ε with ε (…, p, j), and of its own (…, j, j)."""
        PC = self._joint.pose @ so3.transpose(C)
        return PC, C @ PC

    def _as_correction(self, x: FloatArray) -> Correction:
        """Return the group element exp(x); it moves no landmark."""
        D = super()._as_correction(x).D
        return Correction(D, np.empty(0, dtype=np.int64), np.empty((0, 3)))
