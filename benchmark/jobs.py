"""Units of work for the benchmark's worker processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
import logging

import estimators
from estimators import BATCH, ISAM2, Run
from gtsam_baselines import IndeterminateError
import monte_carlo
import outliers
from scores import FAILED, mean_scores, score, Scores
import variants
import worlds
from worlds import World

from slam_observer_ros.types import FloatArray

DRAWS = 4
"""Sets of outliers, over which scores are averaged."""

GTSAM_JOB = 'GTSAM'
"""iSAM2 and batch in one job, since one starts from the other."""

TIMED_RUNS = 3
"""Runs of which the least CPU time counts: whatever else the machine does only ever adds."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Job:
    """One estimator on one world.

    Attributes
    ----------
    variant : str
        The table that the scores go to.
    world, column : str
        Names of the world and of the estimator.
    first_s : float or None
        Only so many seconds of the world.

    """

    variant: str
    world: str
    column: str
    first_s: float | None


@dataclass(frozen=True, slots=True)
class SeedJob:
    """One Monte Carlo run of an estimator."""

    loop: str
    estimator: str
    seed: int


def run_job(job: Job) -> dict[str, Scores]:
    """Return the scores by column."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    world = _load(job.world) if job.first_s is None else _load(job.world).first(job.first_s)
    if job.variant == variants.NO_IDS:
        return {job.column: _score_without_ids(outliers.without_ids(world))}
    if job.variant == variants.FALSE_POINTS:
        return {job.column: _score_without_ids(outliers.with_false_points(world, seed=1))}
    if job.variant == variants.OUTLIERS:
        return _score_draws(job, world, outliers.with_outliers)
    if job.variant == variants.LEFT_OUT:
        return _score_draws(job, world, outliers.without_outliers)
    try:
        runs = _with_least_cpu_time(job.column, world)
    except IndeterminateError as error:
        logger.warning('%s: %s failed %s', job.world, job.column, error)
        failed = (ISAM2, BATCH) if job.column == GTSAM_JOB else (job.column,)
        return dict.fromkeys(failed, FAILED)
    return {column: score(run, world) for column, run in runs.items()}


def run_seed(job: SeedJob) -> FloatArray:
    """Return what :func:`monte_carlo.run_once` does."""
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    return monte_carlo.run_once(job.loop, job.estimator, job.seed)


def _run(column: str, world: World) -> dict[str, Run]:
    if column == GTSAM_JOB:
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


def _with_least_cpu_time(column: str, world: World) -> dict[str, Run]:
    """Return runs with the CPU time of the fastest of all :data:`TIMED_RUNS`."""
    runs = [_run(column, world) for _ in range(TIMED_RUNS)]
    return {
        name: replace(run, cpu_s=min(one[name].cpu_s for one in runs))
        for name, run in runs[0].items()
    }


def _score_without_ids(world: World) -> Scores:
    estimator = estimators.observer('riccati')(world.settings)
    run = estimators.run_online(estimator, world.events)
    if not len(estimator.landmark_ids):
        return FAILED
    return score(run, world, has_ids=False)


@cache
def _load(name: str) -> World:
    return worlds.load(name)
