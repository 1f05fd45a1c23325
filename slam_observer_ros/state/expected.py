"""What a filter expects residuals to be, and how far off they are by that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.geometry.matrices import diagonal_blocks, mahalanobis, solve
from slam_observer_ros.observer.filter import Filter
from slam_observer_ros.observer.residuals import Residuals


@dataclass(frozen=True, slots=True)
class Expected:
    """Residuals r (m, k), metres, as they are before a correction, and their covariance."""

    r: FloatArray
    distances: FloatArray  # (m,) Mahalanobis distance of each
    S: FloatArray | None  # (m k, m k) joint covariance, m²; None if unknown

    @classmethod
    def of(cls, filter_: Filter, residuals: Residuals) -> Expected:
        """Ask the filter, before it corrects itself."""
        r, _ = residuals.on(filter_.axes)
        S = filter_.innovation_covariance(residuals) if len(r) else None
        if S is not None:
            return cls(r, mahalanobis(r, diagonal_blocks(S, r.shape[1])), S)
        return cls(r, filter_.distances(residuals) if len(r) else np.empty(0), None)

    def judge(self, weights: FloatArray) -> NormalisedInnovation:
        """Return how far off the residuals are, given the weights (m,) of the correction."""
        used = np.flatnonzero(np.repeat(weights > 0.0, self.r.shape[1]))
        nis = None
        if self.S is not None and len(used):
            r = self.r.ravel()[used]
            nis = float(r @ solve(self.S[np.ix_(used, used)], r))
        return NormalisedInnovation(self.distances, weights, nis, 0 if nis is None else len(used))
