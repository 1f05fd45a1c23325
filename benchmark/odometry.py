"""Velocities between two observations made one motion: the common input of the baselines."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.models.motion_noise import MotionNoise
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import Settings

Event: TypeAlias = VelocityEvent | ObservationEvent
"""What the worlds consist of: each velocity is one sensor's."""


class Odometry:
    """Integrates velocities as the estimator does: each held until the next, same noise figures.

    Parameters
    ----------
    settings : Settings
        Noise figures and ``velocity_timeout``.

    """

    def __init__(self, settings: Settings) -> None:
        self._velocities = VelocityHistory(round(settings.velocity_timeout * 1e9))
        self._noise = MotionNoise(settings)
        self._stamp_ns: int | None = None

    def add(self, event: VelocityEvent) -> None:
        """Take in a velocity; stamps must not decrease."""
        self._velocities.append(event)
        if self._stamp_ns is None:
            self._stamp_ns = event.stamp_ns

    def motion_to(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the motion since the call before this one.

        Returns
        -------
        motion : FloatArray
            (4, 4) pose at ``stamp_ns`` in the body frame of the last call.
        covariance : FloatArray
            (6, 6) covariance of η in ``motion`` · exp(η), (Ω, v) order, rad² and m².

        """
        start_ns = stamp_ns if self._stamp_ns is None else self._stamp_ns
        held = self._velocities.held(start_ns, stamp_ns)
        path = se3.path(np.eye(4), held.body_velocities * held.dt_s[:, None])
        Ad = se3.adjoint(se3.inverse(path[-1]) @ path)
        # ∫ Ad Q Adᵀ by the trapezoidal rule
        shares = se3.at_poses(self._noise.covariances(held))
        covariance: FloatArray = (Ad @ shares @ Ad.swapaxes(1, 2)).sum(axis=0)
        self._velocities.forget_before(stamp_ns)
        self._stamp_ns = stamp_ns
        return path[-1], covariance
