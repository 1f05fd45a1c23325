"""A motion of the robot, as a filter is given it."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.common.types import FloatArray


@dataclass(frozen=True, slots=True)
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
