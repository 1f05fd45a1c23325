"""What is recorded of a run, to be shown and to be compared with: the estimate, and the truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate


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


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """The estimate at one stamp; covariances are None where the gains know none."""

    stamp_ns: int
    pose: FloatArray  # (4, 4) body to world
    pose_covariance: FloatArray | None  # (6, 6) rotation vector, position; world, rad² and m²
    ids: IntArray  # (n,)
    world_points: FloatArray  # (n, 3) metres
    landmark_covariances: FloatArray | None  # (n, 3, 3) world, m²
    calibration: tuple[CalibrationEstimate, ...]
    dropped: Counter[str]  # messages so far, by reason


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """All residuals of a run, one row each, and its u observations of known landmarks.

    ``distances`` are in standard deviations; ``weights`` are 0 for what was gated and below 1 for
    what was taken with caution; ``moved`` is what was taken to be somewhere else from then on.
    """

    stamps_ns: IntArray  # (m,)
    ids: IntArray  # (m,)
    distances: FloatArray  # (m,)
    residuals: FloatArray  # (m, 3) metres, world
    weights: FloatArray  # (m,)
    moved: BoolArray  # (m,)
    update_stamps_ns: IntArray  # (u,)
    nis: FloatArray  # (u,) NaN where no joint covariance is known, or nothing was used
    degrees_of_freedom: IntArray  # (u,)
    lyapunov: FloatArray  # (u,)

    @property
    def residuals_m(self) -> FloatArray:
        """(m,) lengths of the residuals, metres."""
        lengths: FloatArray = np.linalg.norm(self.residuals, axis=1)
        return lengths

    @property
    def mean_nis(self) -> float | None:
        """NIS per degree of freedom over the run, 1 is consistent; None if none is known."""
        total = int(self.degrees_of_freedom.sum())
        return float(np.nansum(self.nis) / total) if total else None
