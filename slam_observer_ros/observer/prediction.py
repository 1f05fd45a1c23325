"""What a motion does to the covariance of pose and calibration, in every filter that has one."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import symmetric
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion


def initial_covariance(axes: EstimatedAxes, calibration: Calibration) -> FloatArray:
    """Return (p + c, p + c): the pose is the reference, so known; the calibration is not."""
    return np.diag(np.append(np.zeros(axes.p), calibration.initial_variances))


def predict(P: FloatArray, motion: Motion) -> None:
    """Let ε become ε + F c̃ + w, w ~ N(0, noise), in the covariance P of (ε, c̃, …), in place."""
    p, c_count = motion.sensitivity.shape
    c = slice(p, p + c_count)
    if c_count:
        P[:p] += motion.sensitivity @ P[c]
        P[:p, :p] += P[:p, c] @ motion.sensitivity.T
        P[p:, :p] = P[:p, p:].T
        P[c, c] += motion.drift
    # No observation takes a skew part away again, so rounding must not add to it.
    P[:p, :p] = symmetric(P[:p, :p] + motion.noise)
