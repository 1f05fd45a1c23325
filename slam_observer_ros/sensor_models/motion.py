"""A motion of the robot, as a filter is given it, and what is known at instants on its way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import symmetric, transpose
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.held_velocities import HeldVelocities
from slam_observer_ros.sensor_models.motion_noise import MotionNoise


@dataclass(frozen=True)
class Motion:
    """Motion from one instant of the state to the next, in k pieces of held velocity."""

    path: FloatArray  # (k + 1, 4, 4) Â before, between and after the pieces
    measured_velocities: FloatArray  # (k, 6)
    dt_s: FloatArray  # (k,) how long each was held
    covariances: FloatArray  # (k, 6, 6) of each piece, rad² and m²
    duration_s: float  # in all, with the time without a known velocity
    # (2, 6) measured velocities around the start and the end; None where what moved does not
    # depend on the delay of the velocities.
    at_ends: FloatArray | None
    calibration: Calibration  # which led along the path
    is_slip: bool = False  # whether odometry has not seen it, so that it may not have been

    @cached_property
    def noise(self) -> FloatArray:
        """(p, p) Σ Ad_Â Q Ad_Âᵀ, what the motion adds to the covariance of ε."""
        return se3.summed_noise(self._adjoints, self.covariances)

    @cached_property
    def sensitivity(self) -> FloatArray:
        """(p, c) F, how ε grows with the errors of the calibration."""
        return self.calibration.sensitivity(
            self._adjoints, self.measured_velocities, self.dt_s, self.at_ends
        )

    @cached_property
    def drift(self) -> FloatArray:
        """(c, c) what the motion's time adds to the covariance of the calibration."""
        return self.calibration.drift_covariance * self.duration_s

    def pose_covariance(self, P: FloatArray) -> FloatArray:
        """Return the covariance (p, p) of ε after the motion, from P (p + c, p + c) before it."""
        return _pose_covariance(P, self.sensitivity, self.noise)

    def predict(self, P: FloatArray) -> None:
        """Let ε become ε + F c̃ + w, w ~ N(0, noise), in P, the covariance of (ε, c̃, …)."""
        F = self.sensitivity
        p, c = len(F), slice(len(F), sum(F.shape))
        if F.shape[1]:
            P[:p] += F @ P[c]
            P[:p, :p] += P[:p, c] @ F.T
            P[p:, :p] = P[:p, p:].T
            P[c, c] += self.drift
        # No observation takes a skew part away again, so rounding must not add to it.
        P[:p, :p] = symmetric(P[:p, :p] + self.noise)

    @cached_property
    def _adjoints(self) -> FloatArray:
        """(k + 1, p, 6) the estimated rows of Ad_Â along the path."""
        return se3.adjoint(self.path)[:, self.calibration.axes.pose]


@dataclass(frozen=True)
class Passage:
    """Motion from one instant of the state through s others, in k pieces of held velocity.

    What is known at each of these is what :class:`.Motion` has of a motion that ends there.
    """

    path: FloatArray  # (k + 1, 4, 4) Â before, between and after the pieces
    held: HeldVelocities  # the pieces
    counts: IntArray  # (s,) how many pieces there are until each instant
    usual_s: FloatArray  # (s, 2) how long velocities were held as a rule, as known then
    calibration: Calibration  # which led along the path
    motion_noise: MotionNoise

    @property
    def poses(self) -> FloatArray:
        """(s, 4, 4) Â at each instant."""
        return self.path[self.counts]

    def pose_covariance(self, P: FloatArray) -> FloatArray:
        """Return the covariances (s, p, p) of ε then, from P (p + c, p + c) before the motion."""
        return _pose_covariance(P, self._sensitivity, self._noise)

    @property
    def _noise(self) -> FloatArray:
        """(s, p, p) Σ Ad_Â Q Ad_Âᵀ until each instant."""
        held, noise, Ad = self.held, self.motion_noise, self._adjoints
        if noise.is_summed(held, self.usual_s.min(axis=0)):
            return se3.summed_noise_until(Ad, noise.covariances(held))[self.counts]
        return np.array(
            [
                se3.summed_noise(Ad[: count + 1], noise.covariances(held.first(count, usual_s)))
                for count, usual_s in zip(self.counts.tolist(), self.usual_s, strict=True)
            ]
        )

    @property
    def _sensitivity(self) -> FloatArray:
        """(s, p, c) F until each instant."""
        held, calibration = self.held, self.calibration
        until_all = calibration.sensitivity_until(self._adjoints, held.body_velocities, held.dt_s)
        return until_all[self.counts]

    @cached_property
    def _adjoints(self) -> FloatArray:
        """(k + 1, p, 6) the estimated rows of Ad_Â along the path."""
        return se3.adjoint(self.path)[:, self.calibration.axes.pose]


def _pose_covariance(P: FloatArray, F: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance (…, p, p) of ε + F c̃ + w, w ~ N(0, noise), from P of (ε, c̃).

    P is (p + c, p + c), F (…, p, c) and the noise (…, p, p).
    """
    p = F.shape[-2]
    of_calibration = F @ P[p:, :p] + 0.5 * F @ P[p:, p:] @ transpose(F)
    return symmetric(P[:p, :p] + of_calibration + transpose(of_calibration) + noise)
