"""How fast the Lyapunov function decreases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray


@dataclass(frozen=True, slots=True)
class Decay:
    """A straight line in log10 L: its slope, decades per second, and its value at time zero."""

    slope_per_s: float
    log10_at_zero: float

    def log10_at(self, times_s: FloatArray) -> FloatArray:
        """Return log10 L on the line at times (k,), seconds."""
        return self.log10_at_zero + self.slope_per_s * times_s


def fit_decay(times_s: FloatArray, lyapunov: FloatArray, floor: float) -> Decay | None:
    """Fit a line to log10 L over time, after the transient and before rounding is felt.

    L (k,) at ``times_s`` (k,) counts until it first falls below ``floor``, where rounding is felt;
    the transient is taken to be over at half of that time. None if there are fewer than two
    values to fit.
    """
    below = np.flatnonzero(lyapunov <= floor)
    end = int(below[0]) if len(below) else len(lyapunov)
    if end - end // 2 < 2:
        return None
    fitted = slice(end // 2, end)
    slope_per_s, log10_at_zero = np.polyfit(times_s[fitted], np.log10(lyapunov[fitted]), 1)
    return Decay(float(slope_per_s), float(log10_at_zero))
