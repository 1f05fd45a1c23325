"""The most likely noise figures: a factor for each kind of error.

Figures of one kind keep their proportions: how much of an error grows with the speed or with the
range, and along which axis it is, a recording seldom shows. One that is zero stays zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.runs.recorders import Likelihood
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_table import table, Value

_ROWS = {row.name: row for row in table(Settings)}


@dataclass(frozen=True, slots=True)
class NoiseKind:
    """A kind of error, and the parameters that say how large it is."""

    name: str
    parameters: tuple[str, ...]


_OF_MOTION = (
    NoiseKind('turning', ('angular_velocity_noise', 'angular_scale_noise')),
    NoiseKind('driving', ('linear_velocity_noise', 'linear_scale_noise')),
)
_OF_POINTS = {
    'range_bearing': (
        NoiseKind('range', ('range_noise', 'range_scale_noise')),
        NoiseKind('bearing', ('bearing_noise',)),
    ),
    'fiducial': (NoiseKind('pixels', ('pixel_noise',)),),
    'cartesian': (NoiseKind('points', ('point_noise',)),),
    'stereo': (
        NoiseKind('pixels', ('pixel_noise',)),
        NoiseKind('disparity', ('disparity_noise',)),
    ),
}


def kinds_of(settings: Settings) -> list[NoiseKind]:
    """Return the kinds of error that settings state, each with its figures that are not zero."""
    return [*of_motion(settings), *of_points(settings)]


def of_motion(settings: Settings) -> list[NoiseKind]:
    """Return the noise parameters of velocities."""
    return _stated(_OF_MOTION, settings)


def of_points(settings: Settings) -> list[NoiseKind]:
    """Return the noise parameters of points."""
    return _stated(_OF_POINTS[settings.observation_model], settings)


def _stated(possible: Sequence[NoiseKind], settings: Settings) -> list[NoiseKind]:
    kinds = [
        NoiseKind(
            kind.name, tuple(name for name in kind.parameters if np.any(getattr(settings, name)))
        )
        for kind in possible
    ]
    return [kind for kind in kinds if kind.parameters]


def scaled(
    settings: Settings, kinds: Sequence[NoiseKind], log_factors: Sequence[float]
) -> Settings:
    """Return settings whose figures of each kind have grown by a factor, given as its logarithm.

    None gets smaller or larger than its parameter may be.
    """
    values: dict[str, Any] = {}
    for kind, log_factor in zip(kinds, log_factors, strict=True):
        for name in kind.parameters:
            row, factor = _ROWS[name], math.exp(log_factor)
            within = np.clip(factor * np.array(getattr(settings, name)), row.minimum, row.maximum)
            values[name] = tuple(within.tolist()) if within.ndim else float(within)
    return replace(settings, **values)


LARGEST = math.log(32.0)
"""Logarithm of the factor by which a figure changes at most."""

FIRST_STEP = math.log(2.0)
CURVATURE_STEP = 0.2
"""Steps of the search at first, and by which the curvature is measured, as logarithms."""

EVALUATIONS = 12
"""How often the likelihood is computed at most in the search, for each factor."""

TOLERANCE = 0.03
"""How near the factors come to the most likely ones, as a share."""

NO_EFFECT = 1e-6
"""Change of the log likelihood below which a factor has none."""

DIGITS = 3
"""Significant digits of a noise figure; it is seldom known to so many."""

Objective = Callable[[FloatArray], float]


class LikelyFactors(NamedTuple):
    """Logarithms of the most likely factors, and their deviations.

    These are by the curvature of the log likelihood, where all others are unknown, too; infinite
    where it has no maximum there.
    """

    logs: FloatArray  # (n,)
    deviations: FloatArray  # (n,)


@dataclass(frozen=True, slots=True)
class NoiseFactor:
    """By which factor the noise of a kind is another than stated: its logarithm, ± so much."""

    kind: NoiseKind
    log: float
    deviation: float

    def __str__(self) -> str:
        """Return the factor and its interval of 95 % as text."""
        factor = math.exp(self.log)
        if not math.isfinite(self.deviation):
            return f'× {factor:.2g}, but the recording says little of it'
        low, high = (math.exp(self.log + sign * 2.0 * self.deviation) for sign in (-1, 1))
        return f'× {factor:.2g} ({low:.2g} to {high:.2g})'


def without_effect(objective: Objective, n: int) -> list[int]:
    """Return which of n factors change nothing."""
    nominal = objective(np.zeros(n))
    steps = FIRST_STEP * np.eye(n)
    return [i for i in range(n) if abs(objective(steps[i]) - nominal) < NO_EFFECT]


def most_likely(objective: Objective, n: int) -> LikelyFactors:
    """Return the maximum of a log likelihood over the logarithms of n factors, from 1 on."""
    if not n:
        return LikelyFactors(np.zeros(0), np.zeros(0))
    simplex = np.vstack([np.zeros(n), FIRST_STEP * np.eye(n)])
    result = optimize.minimize(
        lambda x: -objective(x),
        np.zeros(n),
        method='Nelder-Mead',
        bounds=[(-LARGEST, LARGEST)] * n,
        options={
            'initial_simplex': simplex,
            'maxfev': EVALUATIONS * n,
            'xatol': TOLERANCE,
            'fatol': 0.5 * TOLERANCE,
        },
    )
    x, h = np.asarray(result.x, dtype=np.float64), CURVATURE_STEP
    steps, middle = h * np.eye(n), objective(x)
    sides = np.array([[objective(x + step), objective(x - step)] for step in steps])
    H = np.diag(2.0 * middle - sides.sum(axis=1)) / h**2  # of minus the log likelihood
    for i in range(n):
        for j in range(i):
            both = objective(x + steps[i] + steps[j])
            H[i, j] = H[j, i] = (sides[i, 0] + sides[j, 0] - middle - both) / h**2
    # Where it has no maximum nothing is known.
    deviations = np.full(n, math.inf)
    curved = np.flatnonzero(np.diagonal(H) > 0.0)
    while len(curved):
        part = H[np.ix_(curved, curved)]
        values, vectors = np.linalg.eigh(part)
        if values[0] > 0.0:
            deviations[curved] = np.sqrt(np.diagonal(np.linalg.inv(part)))
            break
        curved = np.delete(curved, np.argmax(np.abs(vectors[:, 0])))
    return LikelyFactors(x, deviations)


def remembered(objective: Callable[[Sequence[float]], float]) -> Objective:
    """Return a function that computes nothing twice."""
    known: dict[tuple[float, ...], float] = {}

    def value(x: FloatArray) -> float:
        key = tuple(x.tolist())
        if key not in known:
            known[key] = objective(key)
        return known[key]

    return value


def search_noise(
    trained_on: Sequence[Callable[[Settings], Likelihood]],
    settings: Settings,
    kinds: Sequence[NoiseKind],
    advance: Callable[[], None],
) -> list[NoiseFactor]:
    """Return the most likely factors of the kinds of noise that have an effect.

    ``trained_on`` give the likelihood of each recording, and ``advance`` is called at each step.
    Raises a UsageError if nothing is seen twice.
    """
    counts = [likelihood(settings).count for likelihood in trained_on]
    if not all(counts):
        raise UsageError('nothing is seen twice in what is trained on')

    def log_likelihood(kinds: Sequence[NoiseKind], log_factors: Sequence[float]) -> float:
        advance()
        tried = scaled(settings, kinds, log_factors)
        likelihoods = [likelihood(tried) for likelihood in trained_on]
        return sum(one.mean * count for one, count in zip(likelihoods, counts, strict=True))

    idle = without_effect(remembered(lambda x: log_likelihood(kinds, x)), len(kinds))
    effective = [kind for number, kind in enumerate(kinds) if number not in idle]
    found = most_likely(remembered(lambda x: log_likelihood(effective, x)), len(effective))
    factors = zip(effective, found.logs.tolist(), found.deviations.tolist(), strict=True)
    return [NoiseFactor(*each) for each in factors]


def rounded(value: Value) -> Value:
    """Return a figure, or a vector of them, as it is written."""
    entries = [float(f'{entry:.{DIGITS}g}') for entry in np.ravel(value).tolist()]
    return tuple(entries) if isinstance(value, tuple) else entries[0]
