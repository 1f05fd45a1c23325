"""Units of work for the benchmark's worker processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
import logging
from operator import attrgetter

import estimators
from estimators import Run
import features
from gtsam_baselines import IndeterminateError
import monte_carlo
import outliers
from scores import FAILED, mean_scores, score, Scores
import variants
import worlds
from worlds import World

from slam_observer_ros.common.types import FloatArray

DRAWS = 4
"""Sets of outliers, over which scores are averaged."""

ALL = 'all'
"""All columns in one job."""

GTSAM = 'GTSAM'
"""iSAM2 and batch in one run, since one starts from the other."""

TIMED_RUNS = 3
"""Runs of which the least CPU time counts: whatever else the machine does only ever adds."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Job:
    """One estimator, or all, on one world.

    Attributes
    ----------
    variant : str
        The table that the scores go to.
    world, column : str
        Names of the world and of the estimator, or :data:`ALL`.
    from_s, to_s : float
        The part of the world, seconds since its start.

    """

    variant: str
    world: str
    column: str
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class SeedJob:
    """One Monte Carlo run of an estimator."""

    loop: str
    estimator: str
    seed: int


@dataclass(frozen=True, slots=True)
class FeatureJob:
    """A draw of a case of :mod:`features`, the part of it between two times, seconds."""

    case: str
    draw: int
    from_s: float
    to_s: float


def run_job(job: Job) -> dict[str, Scores]:
    """Return the scores by column."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    world = _load(job.world).part(job.from_s, job.to_s)
    if not world.events:
        logger.warning('%s lasts less than %g s', job.world, job.from_s)
        return dict.fromkeys(_columns(job), FAILED)
    if job.variant == variants.NO_IDS:
        return {job.column: _score_without_ids(outliers.without_ids(world))}
    if job.variant == variants.FALSE_POINTS:
        return {job.column: _score_without_ids(outliers.with_false_points(world, seed=1))}
    if job.variant == variants.OUTLIERS:
        return _score_draws(job, world, outliers.with_outliers)
    if job.variant == variants.LEFT_OUT:
        return _score_draws(job, world, outliers.without_outliers)
    return _score_all(job.world, world)


def run_seed(job: SeedJob) -> FloatArray:
    """Return what :func:`monte_carlo.run_once` does."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    return monte_carlo.run_once(job.loop, job.estimator, job.seed)


def run_feature(job: FeatureJob) -> tuple[Scores, Scores]:
    """Return the scores with the feature and without it."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    return features.with_and_without(job.case, job.draw, job.from_s, job.to_s)


def _columns(job: Job) -> tuple[str, ...]:
    """Return what a job has scores of."""
    if job.column == ALL:
        return estimators.COLUMNS
    draws = job.variant in (variants.OUTLIERS, variants.LEFT_OUT)
    return (job.column, job.column + variants.WORST) if draws else (job.column,)


def _run(column: str, world: World) -> dict[str, Run]:
    if column == GTSAM:
        return estimators.run_gtsam(world.settings, world.events)
    if column == estimators.SMOOTHED:
        return {column: estimators.run_smoothed(world.settings, world.events)}
    estimator = estimators.ONLINE[column](world.settings)
    return {column: estimators.run_online(estimator, world.events)}


def _score_draws(
    job: Job, world: World, change: Callable[[World, int], World]
) -> dict[str, Scores]:
    """Return the mean and the worst scores over all sets of outliers."""
    try:
        scores = [
            score(_run(job.column, worse)[job.column], worse)
            for worse in (change(world, seed) for seed in range(1, DRAWS + 1))
        ]
    except IndeterminateError as error:
        logger.warning('%s: %s failed with outliers %s', job.world, job.column, error)
        scores = [FAILED]
    worst = max(scores, key=lambda one: one.configuration_rmse_m)
    return {job.column: mean_scores(scores), job.column + variants.WORST: worst}


def _score_all(name: str, world: World) -> dict[str, Scores]:
    """Return the scores of all columns, with the CPU time of the fastest run of each.

    They take turns: whatever slows the machine for a while then slows no column's every run.
    """
    runs = _run_all(name, world)
    for _ in range(TIMED_RUNS - 1):
        again = _run_all(name, world)
        runs = {
            column: min(run, again[column], key=attrgetter('cpu_s'))
            for column, run in runs.items()
        }
    scores = {column: score(run, world) for column, run in runs.items()}
    return dict.fromkeys(estimators.COLUMNS, FAILED) | scores


def _run_all(name: str, world: World) -> dict[str, Run]:
    """Run each estimator once; those that give up are left out."""
    runs: dict[str, Run] = {}
    for column in (*estimators.ONLINE, estimators.SMOOTHED, GTSAM):
        try:
            runs |= _run(column, world)
        except IndeterminateError as error:
            logger.warning('%s: %s failed %s', name, column, error)
    return runs


def _score_without_ids(world: World) -> Scores:
    estimator = estimators.observer('riccati')(world.settings)
    run = estimators.run_online(estimator, world.events)
    if not len(estimator.landmark_ids):
        return FAILED
    return score(run, world, has_ids=False)


@cache
def _load(name: str) -> World:
    return worlds.load(name)
