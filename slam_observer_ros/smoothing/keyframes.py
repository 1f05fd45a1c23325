"""What is smoothed, as arrays: keyframes, the motions between them, and estimates of all."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import Sensed


@dataclass(frozen=True, slots=True)
class SeenTurns:
    """How the tags of M observed points are turned; zero for those that show no orientation."""

    Z: FloatArray  # (M, 3, 3) from the tag's own axes to the body's
    flipped: FloatArray  # (M, 3, 3) the other orientation that looks nearly the same
    information: FloatArray  # (M, q, q) inverse covariance of it, along the body's axes, 1/rad²

    def only(self, kept: BoolArray) -> SeenTurns:
        """Return those of some of the points (M,)."""
        return SeenTurns(self.Z[kept], self.flipped[kept], self.information[kept])

    def without(self, forgotten: BoolArray) -> SeenTurns:
        """Return what is left if some of the points (M,) show no orientation."""
        return replace(self, information=np.where(forgotten[:, None, None], 0.0, self.information))


@dataclass(frozen=True, slots=True)
class Keyframes:
    """S keyframes with M observed points since a prior."""

    motions: FloatArray  # (S, 4, 4) pose in the one before; the first in the prior's pose
    motion_covariances: FloatArray  # (S, d, d) of each motion as a right perturbation
    sensitivities: FloatArray  # (S, d, c) derivative of each motion by the calibration, so too
    calibrations: FloatArray  # (S, c) with which each motion was computed
    drift_covariances: FloatArray  # (S, c, c) of what the calibration drifted by meanwhile
    keyframes: IntArray  # (M,) in which keyframe each point was observed
    landmarks: IntArray  # (M,) which landmark it is
    points: FloatArray  # (M, 3) where it was seen, metres, body frame
    information: FloatArray  # (M, k, k) inverse covariance of it, body frame, 1/m²
    # (M,) how much of it counts: less than 1 where its error is partly that of a point before
    shares: FloatArray
    turns: SeenTurns | None = None  # where orientations of landmarks are estimated
    sensed: Sensed | None = None  # (M,) as the sensors showed them, where these are calibrated

    def only(self, kept: BoolArray) -> Keyframes:
        """Return the keyframes with only some of the points (M,)."""
        return replace(
            self,
            keyframes=self.keyframes[kept],
            landmarks=self.landmarks[kept],
            points=self.points[kept],
            information=self.information[kept],
            shares=self.shares[kept],
            turns=None if self.turns is None else self.turns.only(kept),
            sensed=None if self.sensed is None else self.sensed.select(kept),
        )

    def with_calibration(self, values: FloatArray) -> Keyframes:
        """Return the same with more of a calibration (c,), which was of no effect before."""
        S, d, c = self.sensitivities.shape
        more = len(values)
        drifts = np.zeros((S, c + more, c + more))
        drifts[:, :c, :c] = self.drift_covariances
        return replace(
            self,
            sensitivities=np.concatenate([self.sensitivities, np.zeros((S, d, more))], axis=2),
            calibrations=np.hstack([self.calibrations, np.tile(values, (S, 1))]),
            drift_covariances=drifts,
        )


@dataclass(frozen=True, slots=True)
class Solution:
    """Smoothed estimates."""

    poses: FloatArray  # (S + 1, 4, 4) of the prior, then of each keyframe
    calibrations: FloatArray  # (S + 1, c); all the same unless it drifts
    points: FloatArray  # (n, 3) landmarks, metres
    # (n, 3, 3) how they are turned, zero where that is not known; None if it is not estimated
    orientations: FloatArray | None = None


def joined(parts: list[Keyframes]) -> Keyframes:
    """Return the keyframes of one or more parts, one after the other."""
    optional = ('turns', 'sensed')
    names = [field.name for field in fields(Keyframes) if field.name not in optional]
    together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    turns = [part.turns for part in parts if part.turns is not None]
    sensed = [part.sensed for part in parts if part.sensed is not None]
    return replace(
        parts[0],
        **together,
        turns=joined_turns(turns) if turns else None,
        sensed=joined_sensed(sensed) if sensed else None,
    )


def no_keyframes(d: int, c: int, k: int, q: int = 0) -> Keyframes:
    """Return no keyframes; d, c and k as in :class:`.Smoother`, q if turns are estimated."""
    none = np.empty(0, dtype=np.int64)
    no_rotations = np.empty((0, 3, 3))
    return Keyframes(
        motions=np.empty((0, 4, 4)),
        motion_covariances=np.empty((0, d, d)),
        sensitivities=np.empty((0, d, c)),
        calibrations=np.empty((0, c)),
        drift_covariances=np.empty((0, c, c)),
        keyframes=none,
        landmarks=none,
        points=np.empty((0, 3)),
        information=np.empty((0, k, k)),
        shares=np.empty(0),
        turns=SeenTurns(no_rotations, no_rotations, np.empty((0, q, q))) if q else None,
    )


def joined_turns(parts: list[SeenTurns]) -> SeenTurns:
    """Return those of several parts, one after the other."""
    return SeenTurns(
        np.concatenate([part.Z for part in parts]),
        np.concatenate([part.flipped for part in parts]),
        np.concatenate([part.information for part in parts]),
    )


def joined_sensed(parts: list[Sensed]) -> Sensed:
    """Return what sensors showed in several parts, one after the other."""
    return Sensed(
        np.concatenate([part.sensors for part in parts]),
        np.concatenate([part.origins for part in parts]),
        np.concatenate([part.arms for part in parts]),
    )  # how tags are turned is in SeenTurns
