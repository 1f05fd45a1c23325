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
from slam_observer_ros.sensor_models.observation_noise import repetition_factors


@dataclass(frozen=True, slots=True)
class Expected:
    """Residuals r (m, k), metres, as they are before a correction, and their covariance."""

    r: FloatArray
    distances: FloatArray  # (m,) Mahalanobis distance of each
    S: FloatArray | None  # (m k, m k) joint covariance, m²; None if unknown
    shares: FloatArray  # (m,) of an observation with new errors, that each is worth

    @classmethod
    def of(cls, gains: Gains, residuals: Residuals, error_time_s: float) -> Expected:
        """Ask gains, before they correct the state; errors last for ``error_time_s``."""
        r, _ = residuals.on(gains.axes)
        repeated = repetition_factors(residuals.dt_s, error_time_s)
        if gains.errors is not None and len(r):
            S = gains.errors.innovation_covariance(residuals)
            return cls(r, mahalanobis(r, diagonal_blocks(S, r.shape[1])), S, 1.0 / repeated)
        distances = gains.distances(residuals) if len(r) else np.empty(0)
        return cls(r, distances, None, 1.0 / repeated)

    def judge(self, weights: FloatArray) -> NormalisedInnovation:
        """Return how far off the residuals are, given the weights (m,) of the correction."""
        (m, k), used = self.r.shape, weights > 0.0
        nis, log_densities = None, np.full(m, -np.inf)
        if self.S is not None and used.any():
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
            self.shares,
        )
