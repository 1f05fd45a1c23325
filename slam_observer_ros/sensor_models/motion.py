"""A motion of the robot, as a gain design is given it."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.common.types import FloatArray


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion from one instant of the state to the next, in k pieces of held velocity.

    Attributes
    ----------
    path : FloatArray
        (k + 1, 4, 4) Â before, between and after the pieces.
    measured_velocities : FloatArray
        (k, 6) velocities (Ω, v) as measured, rad/s and m/s.
    dt_s : FloatArray
        (k,) seconds that each velocity was held.
    covariances : FloatArray
        (k, 6, 6) covariance of each piece, in the body frame, rad² and m².
    duration_s : float
        Seconds in all, with those without a known velocity.
    at_ends : FloatArray or None
        (2, 6) measured velocities around the start and the end, rad/s and m/s; None where what
        moved does not depend on the delay of the velocities.

    """

    path: FloatArray
    measured_velocities: FloatArray
    dt_s: FloatArray
    covariances: FloatArray
    duration_s: float
    at_ends: FloatArray | None
