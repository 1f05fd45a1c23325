"""Velocities that cover an interval of time, each held until the next one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class HeldVelocities:
    """k velocities that cover an interval of time. Columns of two: angular and linear part."""

    body_velocities: FloatArray  # (k, 6)
    covariances: FloatArray  # (k, 6, 6), zero where unknown
    is_stated: BoolArray  # (k, 2) whether the covariance is known
    dt_s: FloatArray  # (k,) how long each was held
    gap_s: FloatArray  # (k,) with dt_s zero: how long none was known, as it had timed out
    before_s: FloatArray  # (k, 2) how long each had been held for before
    usual_s: FloatArray  # (2,) how long they are held for as a rule; infinite if unknown

    @classmethod
    def unknown(cls, gap_s: FloatArray) -> HeldVelocities:
        """Return k = len(gap_s) pieces of time in which no velocity is known."""
        k = len(gap_s)
        return cls(
            body_velocities=np.zeros((k, 6)),
            covariances=np.zeros((k, 6, 6)),
            is_stated=np.zeros((k, 2), dtype=np.bool_),
            dt_s=np.zeros(k),
            gap_s=gap_s,
            before_s=np.zeros((k, 2)),
            usual_s=np.full(2, np.inf),
        )

    def with_gaps_apart(self) -> HeldVelocities:
        """Return the same with each gap as a piece of its own."""
        has_gap = (self.gap_s > 0.0) & (self.dt_s > 0.0)
        rows = np.repeat(np.arange(len(has_gap)), 1 + has_gap)
        is_gap = np.append(False, rows[1:] == rows[:-1]) | (self.dt_s[rows] == 0.0)
        return HeldVelocities(
            body_velocities=self.body_velocities[rows],
            covariances=self.covariances[rows],
            is_stated=self.is_stated[rows],
            dt_s=np.where(is_gap, 0.0, self.dt_s[rows]),
            gap_s=np.where(is_gap, self.gap_s[rows], 0.0),
            before_s=self.before_s[rows],
            usual_s=self.usual_s,
        )

    def counts_with_gaps_apart(self, counts: IntArray) -> IntArray:
        """Return how many pieces the first ``counts`` (s,) are :meth:`with_gaps_apart`."""
        has_gap = (self.gap_s > 0.0) & (self.dt_s > 0.0)
        more: IntArray = np.append(0, np.cumsum(has_gap))
        return counts + more[counts]

    def first(self, count: int, usual_s: FloatArray) -> HeldVelocities:
        """Return the first pieces, as when velocities were held for ``usual_s`` (2,) as a rule."""
        return HeldVelocities(
            body_velocities=self.body_velocities[:count],
            covariances=self.covariances[:count],
            is_stated=self.is_stated[:count],
            dt_s=self.dt_s[:count],
            gap_s=self.gap_s[:count],
            before_s=self.before_s[:count],
            usual_s=usual_s,
        )

    def averaged(self, window_s: float) -> FloatArray:
        """Return the mean velocities (k, 6) over windows around the middle of each one.

        As far as they are held here; one that was held for longer than the window is its own mean.
        """
        times_s = np.append(0.0, np.cumsum(self.dt_s))
        motions = np.zeros((len(times_s), 6))
        np.cumsum(self.dt_s[:, None] * self.body_velocities, axis=0, out=motions[1:])
        middles_s = 0.5 * (times_s[:-1] + times_s[1:])
        numbers = np.arange(len(middles_s))
        starts = np.minimum(np.searchsorted(times_s, middles_s - 0.5 * window_s), numbers)
        ends = np.searchsorted(times_s, middles_s + 0.5 * window_s, side='right') - 1
        ends = np.maximum(ends, numbers + 1)
        lengths_s = np.maximum(times_s[ends] - times_s[starts], np.finfo(np.float64).tiny)
        means: FloatArray = (motions[ends] - motions[starts]) / lengths_s[:, None]
        return means
