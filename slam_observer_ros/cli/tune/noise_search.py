"""The most likely noise on recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from slam_observer_ros.cli.tune.noise_kinds import NoiseKind, scaled
from slam_observer_ros.cli.tune.search import Found, most_likely, remembered, without_effect
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.runs.likelihood import Likelihood
from slam_observer_ros.settings.estimator_settings import Settings


def search_noise(
    trained_on: Sequence[Callable[[Settings], Likelihood]],
    settings: Settings,
    kinds: Sequence[NoiseKind],
    advance: Callable[[], None],
) -> tuple[list[NoiseKind], Found]:
    """Return the kinds of noise that have an effect, and their most likely factors.

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
    return effective, most_likely(
        remembered(lambda x: log_likelihood(effective, x)), len(effective)
    )
