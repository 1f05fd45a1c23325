"""What an estimate is compared with."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.common.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PoseTruth:
    """True pose of the robot.

    Attributes
    ----------
    stamp_ns : int
        Time of validity, nanoseconds.
    pose : FloatArray
        (4, 4) transform from the base frame to the world.

    """

    stamp_ns: int
    pose: FloatArray


@dataclass(frozen=True, slots=True)
class LandmarkTruth:
    """True landmark positions.

    Attributes
    ----------
    ids : IntArray
        (n,) landmark ids.
    world_points : FloatArray
        (n, 3) positions in the world, metres.

    """

    ids: IntArray
    world_points: FloatArray
