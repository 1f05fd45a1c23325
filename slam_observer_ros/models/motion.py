"""A motion of the robot as a filter is given it, and a passage through instants on its way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import symmetric, transpose
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.held_velocities import HeldUntil
from slam_observer_ros.models.motion_noise import MotionNoise


@dataclass(frozen=True)
class Motion:
    """Motion from one instant of the state to the next, in k pieces of held velocity."""

    path: FloatArray  # (k + 1, 4, 4) Â before, between and after the pieces
    measured_velocities: FloatArray  # (k, 6)
    dt_s: FloatArray  # (k,) how long each was held
    covariances: FloatArray  # (k, 6, 6) of each piece, rad² and m²
    duration_s: float  # in all, with the time without a known velocity
    # (2, 6) measured velocities around the start and the end; None where the motion does not
    # depend on the delay of the velocities.
    at_ends: FloatArray | None
    calibration: Calibration  # which led along the path
    is_slip: bool = False  # odometry has not seen it, and it may not have happened

    @cached_property
    def noise(self) -> FloatArray:
        """(p, p) Σ Ad_Â Q Ad_Âᵀ, which the motion adds to the covariance of ε."""
        return se3.summed_noise(self._adjoints, self.covariances)

    @property
    def noise_by_kind(self) -> FloatArray | None:
        """(2, p, p) parts of it by turning and driving; None if it stands or has gaps.

        A part is how fast the noise grows with the factor of either; a term that has errors of
        both is divided in halves.
        """
        stands = not np.count_nonzero(self.measured_velocities)
        if self.is_slip or stands or np.count_nonzero(self.dt_s) < len(self.dt_s):
            return None
        half = 0.5 * se3.summed_noise(self._adjoints, _of_angular_part(self.covariances))
        of_turning = half + half.T
        return np.array([of_turning, self.noise - of_turning])

    @cached_property
    def sensitivity(self) -> FloatArray:
        """(p, c) F, how ε grows with the errors of the calibration."""
        return self.calibration.sensitivity(
            self._adjoints, self.measured_velocities, self.dt_s, self.at_ends
        )

    @cached_property
    def drift(self) -> FloatArray:
        """(c, c) added to the covariance of the calibration in the motion's time."""
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


def _of_angular_part(covariances: FloatArray) -> FloatArray:
    """Return covariances (k, 6, 6) with the columns of the linear part zero."""
    part: FloatArray = covariances.copy()
    part[:, :, 3:] = 0.0
    return part


@dataclass(frozen=True)
class Passage:
    """Motion from one instant of the state to each of s others, in pieces of held velocity.

    At each of them it has what :class:`.Motion` has of a motion that ends there.
    """

    path: FloatArray  # (k + 1, 4, 4) Â before, between and after the whole pieces
    poses: FloatArray  # (s, 4, 4) Â at each instant
    held: HeldUntil  # the pieces
    # (2, s, 6) measured velocities around the start and each instant; None as in Motion
    at_ends: FloatArray | None
    calibration: Calibration  # which led along the path
    motion_noise: MotionNoise

    def pose_covariance(self, P: FloatArray) -> FloatArray:
        """Return the covariances (s, p, p) of ε then, from P (p + c, p + c) before the motion."""
        return _pose_covariance(P, self._sensitivity, self._noise)

    @property
    def _noise(self) -> FloatArray:
        """(s, p, p) Σ Ad_Â Q Ad_Âᵀ until each instant."""
        held, noise, least_s = self.held, self.motion_noise, self.held.usual_s.min(axis=0)
        whole, last = held.whole.as_usual(least_s), held.last.as_usual(least_s)
        if noise.is_summed(whole) and noise.is_summed(last) and not held.has_gaps:
            until = se3.summed_noise_until(self._adjoints, noise.covariances(whole))
            return until[held.counts] + self._of_last(noise.covariances(last))
        return np.array([self._noise_until(row) for row in range(len(held.counts))])

    def _of_last(self, covariances: FloatArray) -> FloatArray:
        """Return the noise (s, p, p) of the last pieces from theirs (s, 6, 6)."""
        before, after = self._adjoints[self.held.counts], self._adjoints_at_ends
        of_both = before @ covariances @ transpose(before) + after @ covariances @ transpose(after)
        noise: FloatArray = 0.5 * of_both
        return noise

    def _noise_until(self, row: int) -> FloatArray:
        held, count = self.held.until(row), self.held.counts[row]
        Ad = np.append(self._adjoints[: count + 1], self._adjoints_at_ends[row : row + 1], axis=0)
        # A gap is where the velocity before it has led.
        Ad = np.repeat(Ad, np.append(1, held.piece_counts), axis=0)
        return se3.summed_noise(Ad, self.motion_noise.covariances(held.with_gaps_apart()))

    @property
    def _sensitivity(self) -> FloatArray:
        """(s, p, c) F until each instant."""
        held, ends = self.held, (self._adjoints_at_ends, self.at_ends)
        return self.calibration.sensitivity_until(self._adjoints, held, *ends)

    @cached_property
    def _adjoints(self) -> FloatArray:
        """(k + 1, p, 6) the estimated rows of Ad_Â along the path."""
        return se3.adjoint(self.path)[:, self.calibration.axes.pose]

    @cached_property
    def _adjoints_at_ends(self) -> FloatArray:
        """(s, p, 6) those at the instants."""
        return se3.adjoint(self.poses)[:, self.calibration.axes.pose]


def _pose_covariance(P: FloatArray, F: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance (…, p, p) of ε + F c̃ + w, w ~ N(0, noise), from P of (ε, c̃).

    P is (p + c, p + c), F (…, p, c) and the noise (…, p, p).
    """
    p = F.shape[-2]
    of_calibration = F @ P[p:, :p] + 0.5 * F @ P[p:, p:] @ transpose(F)
    return symmetric(P[:p, :p] + of_calibration + transpose(of_calibration) + noise)
