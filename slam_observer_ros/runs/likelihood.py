"""How likely what was seen is by what the filter expected: a measure of its noise, without truth.

Each residual r of a known landmark, given those before it, is N(0, S) with the S that the filter
states, or else an outlier, anywhere in view. As both densities are normalised, no noise is good
for all: too large a one spreads them out (log det S), too small a one leaves r in their tails, and
what the filter rejects is paid for as an outlier.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Update

OUTLIERS = 0.02
"""Share of the points that are taken for outliers: sensors have some per cent of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Log densities of all residuals of a run, in natural logarithms.

    ``shares`` say how much of an observation each is: those whose errors last, as
    ``observation_correlation_time`` has it, are together one.
    """

    stamps_ns: IntArray  # (m,)
    log_densities: FloatArray  # (m,)
    shares: FloatArray  # (m,)

    def select(self, mask: BoolArray) -> Likelihood:
        """Return the part that ``mask`` (m,) picks."""
        return Likelihood(self.stamps_ns[mask], self.log_densities[mask], self.shares[mask])

    @property
    def total(self) -> float:
        """Log likelihood of them all."""
        return float(self.shares @ self.log_densities)

    @property
    def mean(self) -> float:
        """The same per observation with new errors; −∞ if there is none."""
        return self.total / self.count if self.count > 0.0 else -math.inf

    @property
    def count(self) -> float:
        """How many observations with new errors there are."""
        return float(self.shares.sum())


class LikelihoodRecorder:
    """Notes the likelihood of each observation of a run; ``dimension`` is that of a point."""

    def __init__(self, dimension: int, reach_m: float) -> None:
        ball = math.pi ** (dimension / 2) / math.gamma(dimension / 2 + 1) * reach_m**dimension
        self._log_outlier = math.log(OUTLIERS / ball)
        self.clear()

    def clear(self) -> None:
        """Forget all: the run has started again."""
        self._stamps_ns: list[int] = []
        self._log_densities: list[FloatArray] = []
        self._shares: list[FloatArray] = []

    def note_update(self, update: Update) -> None:
        """Take in an observation, whose innovation the estimator has judged."""
        innovation = update.innovation
        if innovation is None:
            return
        regular = math.log1p(-OUTLIERS) + innovation.log_densities
        self._log_densities.append(np.logaddexp(regular, self._log_outlier))
        self._shares.append(innovation.shares)
        self._stamps_ns += [update.stamp_ns] * len(regular)

    @property
    def likelihood(self) -> Likelihood:
        """What was noted so far."""
        none = np.empty(0)
        return Likelihood(
            np.array(self._stamps_ns, dtype=np.int64),
            np.concatenate([none, *self._log_densities]),
            np.concatenate([none, *self._shares]),
        )
