"""The benchmark of accuracy and consistency: ``make benchmark-accuracy``.

Every estimator gets the same events and the same noise figures, from config/*.yaml.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Iterator
from concurrent.futures import as_completed, Future, ProcessPoolExecutor
import json
import logging
import math
import multiprocessing
import os
from pathlib import Path
import sys
from typing import TypeVar

import features
from jobs import ALL, FeatureJob, Job, run_feature, run_job, run_seed, SeedJob
import monte_carlo
import numpy as np
import report
from rich.console import Console
from rich.progress import track
import variants
import worlds

from slam_observer_ros.common.types import FloatArray

DOCS = worlds.CHECKOUT / 'docs'
QUICK_S = 60.0
QUICK_RUNS = 4
RUNS = 4 * monte_carlo.BATCH

ResultT = TypeVar('ResultT')


def main() -> None:
    """Run the benchmark and print its tables."""
    args = parse_arguments()
    logging.basicConfig(format='benchmark: %(message)s')
    # Worker processes, side by side, would slow each other down with threads of their own.
    os.environ['OMP_NUM_THREADS'] = os.environ['OPENBLAS_NUM_THREADS'] = '1'
    if not worlds.data_folder().is_dir():
        logging.warning(
            'no recordings in %s (SLAM_OBSERVER_DATA names their folder): simulation only',
            worlds.data_folder(),
        )
    chosen = chosen_worlds(args.only)
    loops = [] if args.only or args.skip else list(monte_carlo.LOOPS)
    seeds = range(args.seed, args.seed + (QUICK_RUNS if args.quick else RUNS))
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn')) as pool:
        until_s = args.skip + QUICK_S if args.quick else math.inf
        tables = run_jobs(pool, list(list_jobs(chosen, args.skip, until_s)))
        worth = run_features(pool, chosen_cases(args.only), args.skip, until_s)
        consistency = run_monte_carlo(pool, loops, seeds)
    results = report.Results(tables, worth, consistency, len(seeds))
    sys.stdout.write(report.tables(results))
    if args.json:
        args.json.write_text(json.dumps(report.to_json(results), indent=1) + '\n')
    if args.write_docs:
        (DOCS / 'images').mkdir(parents=True, exist_ok=True)
        page = DOCS / 'benchmark.md'
        text = report.rewritten(page.read_text(encoding='utf-8'), results)
        page.write_text(text, encoding='utf-8')
        report.draw(results, DOCS / 'images' / 'benchmark.png')


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all numbers to FILE')
    parser.add_argument(
        '--only', default='', metavar='NAME', help='only what has NAME in its name'
    )
    parser.add_argument(
        '--quick', action='store_true', help='only the first minute and few Monte Carlo runs'
    )
    parser.add_argument(
        '--skip',
        type=float,
        default=0.0,
        metavar='S',
        help='begin S seconds later, as if these were other recordings',
    )
    parser.add_argument(
        '--seed', type=int, default=0, metavar='N', help='seed of the first Monte Carlo run'
    )
    parser.add_argument(
        '--write-docs', action='store_true', help='rewrite docs/benchmark.md and its figure'
    )
    args = parser.parse_args()
    if args.write_docs and (args.only or args.quick or args.skip):
        parser.error('--write-docs takes the whole benchmark, without --only, --quick or --skip')
    if not chosen_worlds(args.only) + chosen_cases(args.only):
        known = ', '.join(worlds.names() + features.names())
        parser.error(f"--only '{args.only}' fits none of: {known}")
    return args


def chosen_worlds(part: str) -> list[str]:
    """Return the names of the data sets that contain ``part``."""
    return [name for name in worlds.names() if part.lower() in name.lower()]


def chosen_cases(part: str) -> list[str]:
    """Return the names of the features on data that contain ``part``."""
    return [name for name in features.names() if part.lower() in name.lower()]


def list_jobs(names: list[str], from_s: float, to_s: float) -> Iterator[Job]:
    """Yield all jobs on this part of the worlds of these names, the longest first."""
    for name in names:
        yield Job(variants.CLEAN, name, ALL, from_s, to_s)
        yield Job(variants.FALSE_POINTS, name, 'riccati', from_s, to_s)
        yield Job(variants.NO_IDS, name, 'riccati', from_s, to_s)
    for name in names:
        for column in variants.OUTLIER_COLUMNS:
            yield Job(variants.OUTLIERS, name, column, from_s, to_s)
        yield Job(variants.LEFT_OUT, name, 'riccati', from_s, to_s)


def run_jobs(pool: ProcessPoolExecutor, jobs: list[Job]) -> report.Tables:
    """Run jobs side by side; return table → world → column → scores."""
    tables: report.Tables = {
        variant: {job.world: {} for job in jobs if job.variant == variant}
        for variant in variants.VARIANTS
    }
    futures = {pool.submit(run_job, job): job for job in jobs}
    for future in show_progress('data sets', futures):
        job = futures[future]
        tables[job.variant][job.world].update(future.result())
    return tables


def run_features(
    pool: ProcessPoolExecutor, cases: list[str], from_s: float, to_s: float
) -> report.Worth:
    """Return case → scores with the feature and without it, of each draw."""
    jobs = [
        FeatureJob(case, draw, from_s, to_s) for case in cases for draw in range(features.DRAWS)
    ]
    futures = {pool.submit(run_feature, job): job for job in jobs}
    worth: report.Worth = {case: [] for case in cases}
    for future in show_progress('features', futures):
        worth[futures[future].case].append(future.result())
    return worth


def run_monte_carlo(
    pool: ProcessPoolExecutor, loops: list[str], seeds: range
) -> dict[str, dict[str, monte_carlo.Consistency]]:
    """Return loop → estimator → consistency."""
    jobs = [
        SeedJob(loop, estimator, seed)
        for seed in seeds
        for loop in loops
        for estimator in monte_carlo.ESTIMATORS
    ]
    futures = {pool.submit(run_seed, job): job for job in jobs}
    nees: dict[tuple[str, str], list[FloatArray]] = {}
    for future in show_progress('Monte Carlo', futures):
        job = futures[future]
        nees.setdefault((job.loop, job.estimator), []).append(future.result())
    return {
        loop: {
            estimator: monte_carlo.summarise(loop, np.array(nees[loop, estimator]))
            for estimator in monte_carlo.ESTIMATORS
        }
        for loop in loops
    }


def show_progress(title: str, futures: Collection[Future[ResultT]]) -> Iterator[Future[ResultT]]:
    """Yield futures as they finish, with a progress bar on standard error."""
    console = Console(stderr=True)
    yield from track(
        as_completed(futures),
        title,
        total=len(futures),
        console=console,
        disable=not console.is_terminal,
    )


if __name__ == '__main__':
    main()
