"""A motion of the robot, as a filter is given it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import symmetric
from slam_observer_ros.sensor_models.calibration import Calibration


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
