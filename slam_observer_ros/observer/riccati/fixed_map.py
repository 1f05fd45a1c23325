"""Riccati gains in a map that is taken to be exact: O(m) for m landmarks seen, however large.

The landmarks' errors ã_i are zero, so r_i ≈ [ −[y]×  I ] ε, and P is that of ε and c alone.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.filter import InHindsight, Residuals
from slam_observer_ros.observer.observer import Correction, Observer
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.observer.riccati.riccati import RiccatiGains
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.settings.estimator_settings import Settings


class FixedMapGains(RiccatiGains):
    """Gains that never move a landmark.

    Parameters
    ----------
    settings : Settings
        Robustness and ``two_d_mode``.
    calibration, joint : Calibration, JointCovariance
        What is known of pose and calibration so far.
    covariances : FloatArray
        (n, 3, 3) what the map says of its landmarks, reference frame, m². It is only passed on.

    """

    def __init__(
        self,
        settings: Settings,
        calibration: Calibration,
        joint: JointCovariance,
        covariances: FloatArray,
    ) -> None:
        super().__init__(settings, calibration, joint.without_landmarks())
        self._covariances = covariances

    @property
    def landmark_error_covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of the landmarks, as the map has them."""
        return self._covariances

    def remove_landmarks(self, rows: IntArray) -> None:
        """Forget the landmarks at ``rows``."""
        self._covariances = np.delete(self._covariances, rows, axis=0)

    def smooth(self, observer: Observer) -> InHindsight:
        """Refuse: in an exact map there is no drift to undo, and nothing is kept of the past."""
        raise ParameterError("there is nothing to smooth with 'localization_mode: fixed'")

    def _project(self, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
        """Return C P and C P Cᵀ."""
        C = self._pose_output(residuals)
        CP = C @ self._joint.P[: self._p]
        return CP, CP[:, : self._p] @ C.T

    def _output_covariances(
        self, C: FloatArray, columns: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the covariances of C ε with ε (…, p, j), and of its own (…, j, j)."""
        PC = self._joint.pose @ transpose(C)
        return PC, C @ PC

    def _as_correction(self, x: FloatArray) -> Correction:
        """Return the group element exp(x); it moves no landmark."""
        self.calibration.shift(x[self._p :])
        D = se3.exp(self._axes.full_pose(x[: self._p]))
        return Correction(D, np.empty(0, dtype=np.int64), np.empty((0, 3)))
