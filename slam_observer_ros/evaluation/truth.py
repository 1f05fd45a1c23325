"""What an estimate is compared with."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.common.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PoseTruth:
    """True pose (4, 4) of the robot, base frame to world, at a time."""

    stamp_ns: int
    pose: FloatArray


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """True positions (n, 3) of landmarks, in the world, metres, and their ids (n,)."""

    ids: IntArray
    world_points: FloatArray
