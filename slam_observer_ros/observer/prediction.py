"""What a motion does to the covariance of pose and calibration, for every design that has one."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import paths, se3
from slam_observer_ros.geometry.axes import Axes
from slam_observer_ros.geometry.matrices import symmetric
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion


def initial_covariance(axes: Axes, calibration: Calibration) -> FloatArray:
    """Return (p + c, p + c): the pose is the reference, so known; the calibration is not."""
    return np.diag(np.append(np.zeros(axes.p), calibration.initial_variances))


def predict(
    P: FloatArray, axes: Axes, calibration: Calibration, motion: Motion
) -> tuple[FloatArray, FloatArray]:
    """Add a motion's noise Ad_Â Q Ad_Âᵀ to the pose block of P, in place.

    Parameters
    ----------
    P : FloatArray
        (p + c + …, p + c + …) covariance of pose error, calibration, and anything else.
    axes, calibration : Axes, Calibration
        Which p axes of the pose and c of the calibration are estimated.
    motion : Motion
        The motion since the last call.

    Returns
    -------
    noise : FloatArray
        (p, p) what was added to the pose block.
    F : FloatArray
        (p, c) how the pose error has grown with that of the calibration.

    """
    p = axes.p
    c = slice(p, p + calibration.count)
    Ad = se3.adjoint(motion.path)[:, axes.pose]
    F = calibration.sensitivity(Ad, motion)
    noise = paths.summed_noise(Ad, motion.covariances)
    if calibration.count:
        P[:p] += F @ P[c]
        P[:p, :p] += P[:p, c] @ F.T
        P[p:, :p] = P[:p, p:].T
        P[c, c] += calibration.drift_covariance * motion.duration_s
    # No observation takes a skew part away again, so rounding must not add to it.
    P[:p, :p] = symmetric(P[:p, :p] + noise)
    return noise, F
