"""Velocities that cover an interval of time, each held until the next one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

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

    @property
    def piece_counts(self) -> IntArray:
        """(k,) 2 for pieces that have a gap beside time with a velocity, 1 for others."""
        return 1 + ((self.gap_s > 0.0) & (self.dt_s > 0.0))

    def with_gaps_apart(self) -> HeldVelocities:
        """Return the same with each gap as a piece of its own."""
        rows = np.repeat(np.arange(len(self.dt_s)), self.piece_counts)
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

    def as_usual(self, usual_s: FloatArray) -> HeldVelocities:
        """Return the same, as when velocities were held for ``usual_s`` (2,) as a rule."""
        return replace(self, usual_s=usual_s)


@dataclass(frozen=True, slots=True)
class HeldUntil:
    """Velocities that are held from one instant to each of s others, as they were known then.

    Until each of these there are the first of k pieces, and a last one that it ends in.
    """

    whole: HeldVelocities  # (k)
    last: HeldVelocities  # (s)
    counts: IntArray  # (s,) how many of the whole pieces there are before the last one
    usual_s: FloatArray  # (s, 2) how long velocities were held as a rule, as known then

    @property
    def has_gaps(self) -> bool:
        """Whether there is time in which no velocity is known."""
        return bool(self.whole.gap_s.any() or self.last.gap_s.any())

    def until(self, row: int) -> HeldVelocities:
        """Return all pieces until one of the instants."""
        count = self.counts[row]
        joined = {
            field.name: np.append(
                getattr(self.whole, field.name)[:count],
                getattr(self.last, field.name)[row : row + 1],
                axis=0,
            )
            for field in fields(HeldVelocities)
            if field.name != 'usual_s'
        }
        return HeldVelocities(**joined, usual_s=self.usual_s[row])


def averaged(body_velocities: FloatArray, dt_s: FloatArray, window_s: float) -> FloatArray:
    """Return the mean velocities (k, 6) over windows around the middle of each of k pieces.

    As far as they are held here; one that was held for longer than the window is its own mean.
    """
    times_s = np.append(0.0, np.cumsum(dt_s))
    motions = np.zeros((len(times_s), 6))
    np.cumsum(dt_s[:, None] * body_velocities, axis=0, out=motions[1:])
    middles_s = 0.5 * (times_s[:-1] + times_s[1:])
    numbers = np.arange(len(middles_s))
    starts = np.minimum(times_s.searchsorted(middles_s - 0.5 * window_s), numbers)
    ends = times_s.searchsorted(middles_s + 0.5 * window_s, side='right') - 1
    ends = np.maximum(ends, numbers + 1)
    lengths_s = np.maximum(times_s[ends] - times_s[starts], np.finfo(np.float64).tiny)
    means: FloatArray = (motions[ends] - motions[starts]) / lengths_s[:, None]
    return means
