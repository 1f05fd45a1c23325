"""Velocities that cover an interval of time, each held until the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray

LEAD_S = 0.5  # either side of it, a mean shows how fast the robot is in the middle
LEAD_NS = to_ns(LEAD_S)


class Velocities(NamedTuple):
    """Velocities, in force from their stamp to the next; two columns: angular and linear."""

    stamps_ns: IntArray  # (r,)
    body_velocities: FloatArray  # (r, 6)
    since_ns: IntArray  # (r, 2) stamps of the messages that they are of
    is_stated: BoolArray  # (r, 2) whether a message stated its covariance
    covariances: FloatArray  # (r, 6, 6) as stated, zero where unknown
    usual_angular_s: float  # how long one is held as a rule
    usual_linear_s: float
    timeout_ns: int  # how long one is held at most


@dataclass(frozen=True, slots=True)
class HeldVelocities:
    """k velocities that cover an interval of time. Columns of two: angular and linear part."""

    body_velocities: FloatArray  # (k, 6)
    covariances: FloatArray  # (k, 6, 6), zero where unknown
    is_stated: BoolArray  # (k, 2) whether the covariance is known
    dt_s: FloatArray  # (k,) how long each was held
    gap_s: FloatArray  # (k,) with dt_s zero: how long none was known, as it had timed out
    before_s: FloatArray  # (k, 2) how long each had been held for before
    lead_s: FloatArray  # (b,) how long the velocities were held that lead to these …
    lead_velocities: FloatArray  # … (b, 6)
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
            lead_s=np.empty(0),
            lead_velocities=np.empty((0, 6)),
            usual_s=np.full(2, np.inf),
        )


def held(velocities: Velocities, start_ns: int, end_ns: int) -> HeldVelocities:
    """Return velocities in force between stamps; gaps, where they time out, are pieces, too."""
    first = int(velocities.stamps_ns.searchsorted(start_ns, 'right')) - 1
    last = max(int(velocities.stamps_ns.searchsorted(end_ns, 'left')), first + 1)
    bounds_ns = np.append(velocities.stamps_ns[first:last], end_ns)
    bounds_ns[0], since_ns = start_ns, velocities.since_ns[first:last]
    rows: slice | IntArray = slice(first, last)
    dt_ns, before_s = np.diff(bounds_ns), to_s(bounds_ns[:-1, None] - since_ns)
    timed_out_ns = np.maximum(since_ns[:, 1] + velocities.timeout_ns, bounds_ns[:-1])
    gap_ns = bounds_ns[1:] - np.minimum(timed_out_ns, bounds_ns[1:])
    if np.count_nonzero(gap_ns):  # seldom
        piece = np.repeat(np.arange(last - first), 1 + ((gap_ns > 0) & (gap_ns < dt_ns)))
        is_gap = np.append(False, piece[1:] == piece[:-1]) | (gap_ns == dt_ns)[piece]
        rows, before_s = first + piece, before_s[piece]
        dt_ns = np.where(is_gap, 0, (dt_ns - gap_ns)[piece])
        gap_ns = np.where(is_gap, gap_ns[piece], 0)
    lead_s, lead_velocities = lead(velocities, first, start_ns)
    return HeldVelocities(
        body_velocities=velocities.body_velocities[rows],
        covariances=velocities.covariances[rows],
        is_stated=velocities.is_stated[rows],
        dt_s=to_s(dt_ns),
        gap_s=to_s(gap_ns),
        before_s=before_s,
        lead_s=lead_s,
        lead_velocities=lead_velocities,
        usual_s=np.array([velocities.usual_angular_s, velocities.usual_linear_s]),
    )


def lead(velocities: Velocities, row: int, end_ns: int) -> tuple[FloatArray, FloatArray]:
    """Return what was in force just before a stamp in a row: seconds (b,), velocities (b, 6)."""
    begin_ns, stamps_ns = end_ns - LEAD_NS, velocities.stamps_ns
    oldest = max(int(stamps_ns.searchsorted(begin_ns, 'right')) - 1, 1)  # row 0 is unknown
    bounds_ns = np.append(stamps_ns[oldest : row + 1], end_ns)
    bounds_ns[0] = max(bounds_ns[0], begin_ns)
    return to_s(np.diff(bounds_ns)), velocities.body_velocities[oldest : row + 1]


def squared_speeds(motion: HeldVelocities) -> FloatArray:
    """Return squares (k, 6) of how fast the robot is in each of k pieces.

    One factor is the mean velocity over a window around the middle of the piece, as far as it is
    in the motion; the other one is the mean until the window's end over half a second at least,
    of which the noise in the first one is a small part.
    """
    dt_s, b = np.append(motion.lead_s, motion.dt_s), len(motion.lead_s)
    times_s = np.append(0.0, np.cumsum(dt_s))
    motions = np.zeros((len(times_s), 6))
    V = np.concatenate([motion.lead_velocities, motion.body_velocities])
    np.cumsum(dt_s[:, None] * V, axis=0, out=motions[1:])
    middles_s = 0.5 * (times_s[b:-1] + times_s[b + 1 :])
    numbers = np.arange(b, len(dt_s))
    starts = times_s.searchsorted(middles_s - LEAD_S)
    starts = np.minimum(np.maximum(starts, b), numbers)
    ends = times_s.searchsorted(middles_s + LEAD_S, side='right') - 1
    ends = np.maximum(ends, numbers + 1)
    since = np.minimum(times_s.searchsorted(times_s[ends] - LEAD_S), starts)

    def mean(begins: IntArray) -> FloatArray:
        lengths_s = np.maximum(times_s[ends] - times_s[begins], np.finfo(np.float64).tiny)
        return np.asarray((motions[ends] - motions[begins]) / lengths_s[:, None])

    return np.abs(mean(starts) * mean(since))
