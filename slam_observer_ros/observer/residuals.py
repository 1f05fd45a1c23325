"""What an observation says against the state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes


@dataclass(frozen=True, slots=True)
class Residuals:
    """What an observation of m known landmarks says against the state, in the reference frame."""

    rows: IntArray  # (m,) which landmarks are seen
    e: FloatArray  # (m, 3) errors (29), metres
    r: FloatArray  # (m, 3) residuals e_i − y_i°, metres
    a: FloatArray  # (m, 3) â_i, metres
    covariances: FloatArray  # (m, 3, 3) of the points seen, m²
    dt_s: FloatArray  # (m,) seconds since each was seen before, in this run; else infinite
    # (m, 3, c) how points change with the calibration, reference frame; None where they don't
    D: FloatArray | None = None

    @property
    def landmarks(self) -> FloatArray:
        """(m, 3) estimated landmarks y_i° + â_i, metres, reference frame."""
        return self.e - self.r + self.a

    def on(self, axes: EstimatedAxes) -> tuple[FloatArray, FloatArray]:
        """Return r (m, k), metres, and the covariances (m, k, k), m², on estimated axes."""
        k = axes.point
        return self.r[:, :k], self.covariances[:, :k, :k]

    def changed(self, change: FloatArray) -> Residuals:
        """Return it with residuals that have changed by (m, k), for the same landmarks."""
        e, r = self.e.copy(), self.r.copy()
        e[:, : change.shape[1]] += change
        r[:, : change.shape[1]] += change
        return replace(self, e=e, r=r)

    def select(self, mask: BoolArray | slice) -> Residuals:
        """Return the part of it that ``mask`` (m,), or a slice, picks."""
        if isinstance(mask, np.ndarray) and np.count_nonzero(mask) == len(mask):
            return self
        return replace(
            self,
            rows=self.rows[mask],
            e=self.e[mask],
            r=self.r[mask],
            a=self.a[mask],
            covariances=self.covariances[mask],
            dt_s=self.dt_s[mask],
            D=None if self.D is None else self.D[mask],
        )
