"""Whether a change is an improvement: whether it holds on what was held out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.runs.likelihood import Likelihood

BLOCKS = 20
"""Parts of a recording in time by which it is judged whether a gain may be chance."""

SURE = 2.0
"""Standard deviations by which the likelihood must grow."""

WORSE_ERROR = 1.05
WORSE_CONSISTENCY = 1.5
"""Factors by which the error, or how far the ANEES is from 1, may grow."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """How settings do on what was held out; errors are None where the truth is not known."""

    likelihood: Likelihood
    configuration_rmse_m: float | None
    configuration_anees: float | None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Figures of what was held out, before and after; the ``objection`` is '' if all is better.

    Log likelihoods are per observation; errors are root mean squares over the recordings, and
    ANEES means; None where the truth is not known.
    """

    log_likelihood: tuple[float, float]
    gain: float
    gain_deviation: float
    error_m: tuple[float, float] | None
    anees: tuple[float, float] | None
    objection: str


def judge(before: Sequence[Judged], after: Sequence[Judged]) -> Verdict:
    """Compare settings on the recordings that were held out, in the same order."""
    pairs = [(one.likelihood, other.likelihood) for one, other in zip(before, after, strict=True)]
    gains = np.concatenate([_block_gains(*pair) for pair in pairs])
    gain, deviation = float(gains.sum()), float(np.std(gains) * math.sqrt(len(gains)))
    error_m = _pair(
        _root_mean_square(judged.configuration_rmse_m for judged in one) for one in (before, after)
    )
    anees = _pair(_mean(judged.configuration_anees for judged in one) for one in (before, after))
    return Verdict(
        (_per_observation(pairs, 0), _per_observation(pairs, 1)),
        gain,
        deviation,
        error_m,
        anees,
        _objection(gain, deviation, error_m, anees),
    )


def _objection(
    gain: float,
    deviation: float,
    error_m: tuple[float, float] | None,
    anees: tuple[float, float] | None,
) -> str:
    if not gain > SURE * deviation:
        return f'the log likelihood changes by {gain:.1f} ± {deviation:.1f}, which may be chance'
    if error_m is not None and error_m[1] > WORSE_ERROR * error_m[0]:
        return f'the error grows from {error_m[0]:.3g} to {error_m[1]:.3g} m'
    if anees is not None:
        off = [abs(math.log(value)) for value in anees]
        if off[1] > off[0] + math.log(WORSE_CONSISTENCY):
            return f'the ANEES goes from {anees[0]:.2g} to {anees[1]:.2g}, away from 1'
    return ''


def _block_gains(before: Likelihood, after: Likelihood) -> FloatArray:
    """Return by how much the log likelihood grows in each of some parts of a recording."""
    stamps_ns = np.concatenate([before.stamps_ns, after.stamps_ns])
    edges = np.linspace(stamps_ns.min(), stamps_ns.max() + 1, BLOCKS + 1)
    totals = [
        np.histogram(one.stamps_ns, edges, weights=one.shares * one.log_densities)[0]
        for one in (before, after)
    ]
    return np.asarray(totals[1] - totals[0], dtype=np.float64)


def _per_observation(pairs: Sequence[tuple[Likelihood, Likelihood]], which: int) -> float:
    parts = [pair[which] for pair in pairs]
    return sum(part.total for part in parts) / sum(part.count for part in parts)


def _pair(values: Iterable[float | None]) -> tuple[float, float] | None:
    before, after = values
    return None if before is None or after is None else (before, after)


def _root_mean_square(values: Iterable[float | None]) -> float | None:
    mean = _mean(None if value is None else value**2 for value in values)
    return None if mean is None else math.sqrt(mean)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
