"""Orientations of those landmarks that have one, as tags do, and what is seen of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, LandmarkColumns

UNKNOWN_RAD = 100.0
"""Standard deviation about each axis of an orientation of which nothing is known."""

FLIP_EVIDENCE = 9.0
"""By how much less, as −2 ln of likelihood, what is seen must cost than its flipped twin."""

FLIP_DISTANCE = 3.0
"""Standard deviations of the sensor's noise within which a flip does no harm."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenOrientations:
    """How the tags of m landmarks are turned that were seen at one instant, body frame."""

    rows: IntArray  # (m,) which landmarks
    Z: FloatArray  # (m, 3, 3) from the tag's own axes
    flipped: FloatArray  # (m, 3, 3) the other orientation that looks nearly the same
    covariances: FloatArray  # (m, 3, 3) of rotation vectors along the body's axes, rad²
    dt_s: FloatArray  # (m,) seconds since each was seen before, in this run; else infinite
    # (3, c) how they turn with the calibration, reference frame; None where they don't
    D: FloatArray | None = None

    def select(self, mask: BoolArray) -> SeenOrientations:
        """Return the part of it that ``mask`` (m,) picks."""
        return SeenOrientations(
            self.rows[mask],
            self.Z[mask],
            self.flipped[mask],
            self.covariances[mask],
            self.dt_s[mask],
            self.D,
        )


class LandmarkOrientations(LandmarkColumns):
    """B̂_i of n landmarks in the frame of P°, all zero for those that have none (yet)."""

    COLUMNS: ClassVar = {
        'B': (np.float64, (3, 3)),
        'counts': (np.int64, ()),
        'rejections': (np.int64, ()),
        'map_sigmas': (np.float64, ()),
    }
    B: FloatArray  # (n, 3, 3)
    # (n,) how often each was seen and accepted, and rejections in a row up to now
    counts: IntArray
    rejections: IntArray
    map_sigmas: FloatArray  # (n,) standard deviations, rad, of those that are known by a map

    @property
    def are_known(self) -> BoolArray:
        """(n,) which landmarks have an orientation."""
        return np.asarray(self.B.any(axis=(1, 2)))

    def put(self, rows: IntArray, B: FloatArray) -> None:
        """Let landmarks have orientations (m, 3, 3), seen once."""
        self.B[rows], self.counts[rows], self.rejections[rows] = B, 1, 0

    def put_known(self, rows: IntArray, B: FloatArray, sigmas: FloatArray, seen: int) -> None:
        """Let landmarks have orientations (m, 3, 3) of a map, which count as ``seen`` so often."""
        self.put(rows, B)
        self.counts[rows], self.map_sigmas[rows] = seen, sigmas

    def clear(self, rows: IntArray) -> None:
        """Let landmarks have no orientation."""
        self.B[rows] = 0.0

    def reset(self) -> None:
        """Let no landmark have an orientation, and none ever seen."""
        for name in self.COLUMNS:
            getattr(self, name)[...] = 0

    def turn(self, rows: IntArray | slice, turns: FloatArray) -> None:
        """Let those of landmarks (m,) become R_i B̂_i of ``turns`` R_i (m, 3, 3)."""
        self.B[rows] = turns @ self.B[rows]

    def count(self, rows: IntArray, accepted: BoolArray) -> None:
        """Count which orientations (m,) were accepted; all others were rejected."""
        self.counts[rows] += accepted
        self.rejections[rows] = np.where(accepted, 0, self.rejections[rows] + 1)

    def in_doubt(self, rows: IntArray, max_rejections: int) -> BoolArray:
        """Return which of the rows (m,) are rejected so often that the first one was wrong."""
        needed = np.minimum(self.counts[rows] + 1, max_rejections)
        return np.asarray(self.rejections[rows] >= needed)


def flip_verdicts(evidence: FloatArray, apart: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return which orientations (m,) are less likely than their twins, and which hardly likelier.

    ``evidence`` (m,) is by how much less they cost, as −2 ln of likelihood, ``apart`` (m,) how far
    the twins are from them by the sensor's noise. An orientation as good as its twin is neither.
    """
    differ = apart > FLIP_DISTANCE
    are_flipped = differ & (evidence < 0.0)
    return are_flipped, differ & ~are_flipped & (evidence < FLIP_EVIDENCE)
