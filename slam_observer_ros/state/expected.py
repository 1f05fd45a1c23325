"""What a filter expects residuals to be, and how far off they are by that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import NormalisedInnovation
from slam_observer_ros.geometry.matrices import cholesky, diagonal_blocks, mahalanobis
from slam_observer_ros.observer.gains import Gains
from slam_observer_ros.observer.residuals import Residuals
from slam_observer_ros.observer.step import LOG_ROOT_2_PI


@dataclass(frozen=True, slots=True)
class Expected:
    """Residuals of m points before a correction, metres, and what was expected of them."""

    r: FloatArray  # (m, k)
    distances: FloatArray  # (m,) Mahalanobis distance of each
    R: FloatArray  # (m, k, k) what of their covariance is that of the points, m²
    S: FloatArray  # (m k, m k) their joint covariance, m²; empty if it is not known

    @classmethod
    def of(cls, gains: Gains, residuals: Residuals) -> Expected:
        """Ask gains, before they correct the state."""
        r, R = residuals.on(gains.axes)
        if not len(r):
            return cls(r, np.empty(0), R, np.empty((0, 0)))
        if len(S := gains.innovation_covariance(residuals)):
            return cls(r, mahalanobis(r, diagonal_blocks(S, r.shape[1])), R, S)
        return cls(r, gains.distances(residuals), R, S)

    def judge(self, weights: FloatArray, shares: FloatArray) -> NormalisedInnovation:
        """Return how far off the residuals are, given the weights (m,) of the correction.

        ``shares`` (m,) is what each is worth of an observation with new errors.
        """
        (m, k), used = self.r.shape, weights > 0.0
        nis, log_densities = None, np.full(m, -np.inf)
        if len(self.S) and used.any():
            rows = np.flatnonzero(np.repeat(used, k))
            L = cholesky(self.S[np.ix_(rows, rows)])
            # One after the other, each as those before it have it: the product is that of all.
            white = np.linalg.solve(L, self.r.ravel()[rows])
            nis = float(white @ white)
            each = 0.5 * white**2 + np.log(np.diagonal(L)) + LOG_ROOT_2_PI
            log_densities[used] = -each.reshape(-1, k).sum(axis=1)
        return NormalisedInnovation(
            self.distances,
            weights,
            nis,
            0 if nis is None else k * int(np.count_nonzero(used)),
            log_densities,
            shares,
        )
