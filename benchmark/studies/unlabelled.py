"""What it costs to map without ids: configuration error, consistency and CPU time over those with.

``python benchmark/studies/unlabelled.py`` prints a row a run, and the means over runs of one kind:
of landmarks with ids, without, and without but with 5 % false points. ``--random N`` draws a hall
a seed instead (:mod:`halls`), and prints how the ratios are distributed: work on ``--half work``
of the seeds, and report the other half.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import logging
import math
import os
import sys
import time

import _above  # noqa: F401 (finds the modules of the folder above)
import halls
import numpy as np
import outliers
from threadpoolctl import threadpool_limits
import worlds
from worlds import World

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.event_warnings import UNEXPECTED_POSES
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import interpolate, LandmarkTruth
from slam_observer_ros.runs.health import of_estimate, of_map_without_ids, of_rejections
from slam_observer_ros.runs.metrics import ConfigurationError

NEES_EVERY = 10
"""Observations from one covariance of the configuration to the next: these cost O(n³)."""

MRCLAM_S = 600.0
"""How much of each MRCLAM run is taken by default, seconds."""


HALVES = {'work': (0,), 'report': (1,), 'both': (0, 1)}
"""Remainders, by two, of the seeds of a half."""

WELL_SEEN = 10
"""Sightings with ids from which on a landmark is too few where the map without has it not."""

WRONG_ANEES, WRONG_COUNT = 3.0, 2
"""From where on a map is wrong: so many times the ANEES with ids (or 1, if that is less), or so
many landmarks too many.
"""

SAYS_SO = ('ambiguous_map', 'unconfirmed_map', 'unexpected_place', 'doubled_landmark')
"""Findings that say that a map without ids may be wrong."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one run."""

    rmse_m: float  # of the configuration
    anees: float
    cpu_s: float
    landmarks: int
    stands_for: tuple[int, ...]  # the true landmark that each of them is
    well_seen: frozenset[int]  # true landmarks seen often
    findings: frozenset[str]


@dataclass(frozen=True, slots=True)
class Compared:
    """A hall without ids, over the same with ids."""

    hall: halls.Hall
    ratio: float  # of the configuration error
    anees: float
    anees_with_ids: float
    too_many: int  # landmarks that stand for one that another stands for, too, or for none
    too_few: int  # well seen ones that none stands for
    cpu: float
    findings: frozenset[str]

    @property
    def is_wrong(self) -> bool:
        """Whether the map or what is stated of it is wrong, and not so with ids, too."""
        limit = WRONG_ANEES * max(self.anees_with_ids, 1.0)
        return not self.anees <= limit or self.too_many >= WRONG_COUNT

    @property
    def says_so(self) -> bool:
        """Whether a finding says that the map may be wrong."""
        return not self.findings.isdisjoint(SAYS_SO)

    def __str__(self) -> str:
        return (
            f'{self.ratio:5.2f} ×  ANEES {self.anees:6.2f} ({self.anees_with_ids:.2f} with ids)  '
            f'+{self.too_many} −{self.too_few}  {self.cpu:4.1f} × CPU  '
            f'{"WRONG" if self.is_wrong else "right"}  {self.hall}; '
            f'{", ".join(sorted(self.findings)) or "no finding"}'
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='NAME', help='runs whose name has NAME')
    parser.add_argument('--seeds', type=int, default=5, help='loops, and draws of false points')
    parser.add_argument('--mrclam-s', type=float, default=MRCLAM_S, help='of each MRCLAM run')
    parser.add_argument('--random', type=int, metavar='N', help='random halls, of seeds up to N')
    parser.add_argument('--half', choices=HALVES, default='work', help='of these seeds')
    parser.add_argument('--jobs', type=int, default=os.cpu_count(), help='processes')
    args = parser.parse_args()
    if args.random:
        compare_random([i for i in range(args.random) if i % 2 in HALVES[args.half]], args.jobs)
        return
    _prepare()
    sys.stdout.write(
        '| run | landmarks | error with ids, m | without | + false | ANEES with ids '
        '| without | + false | CPU with ids, s | without | + false |\n' + '| --- ' * 11 + '|\n'
    )
    kinds: dict[str, list[list[float]]] = {}
    for kind, name, world, draws in runs(args.seeds, args.mrclam_s):
        if args.only.lower() in name.lower():
            figures = measured(name, world, draws)
            kinds.setdefault(kind, []).append(figures)
    for kind, rows in kinds.items():
        means = np.mean(rows, axis=0)
        sys.stdout.write(
            f'{kind}, mean of {len(rows)}: error {means[0]:.2f} ×, with false points '
            f'{means[1]:.2f} ×; ANEES {means[2]:.2f}, {means[3]:.2f}; CPU {means[4]:.1f} ×, '
            f'{means[5]:.1f} ×\n'
        )


def _prepare() -> None:
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)


def compare_random(seeds: Sequence[int], jobs: int) -> None:
    """Compare a hall a seed, print each, and how they are distributed."""
    rows: list[Compared] = []
    with ProcessPoolExecutor(jobs, initializer=_prepare) as pool:
        for row in pool.map(compared, seeds):
            sys.stdout.write(f'{row}\n')
            sys.stdout.flush()
            rows.append(row)
    sys.stdout.write(
        '\n| halls | number | median | 90 % | worst | above 1.5 | too many | too few | ANEES > 3 '
        '| wrong | of these unsaid | said of right ones | CPU |\n' + '| --- ' * 13 + '|\n'
    )
    for kind in sorted({row.hall.kind for row in rows}):
        _print_kind(kind, [row for row in rows if row.hall.kind == kind])
    _print_kind('all', rows)
    kinds = sorted({kind for row in rows for kind in row.findings})
    for kind in kinds:
        named = [row.is_wrong for row in rows if kind in row.findings]
        sys.stdout.write(f'{kind}: in {sum(named)} wrong ones and {named.count(False)} right\n')


def _print_kind(kind: str, rows: Sequence[Compared]) -> None:
    ratios = np.array([row.ratio for row in rows])
    wrong, right = [r for r in rows if r.is_wrong], [r for r in rows if not r.is_wrong]
    sys.stdout.write(
        f'| {kind} | {len(rows)} | {np.median(ratios):.2f} | '
        f'{np.percentile(ratios, 90, method="higher"):.2f} | '
        f'{ratios.max():.2f} | {np.mean(ratios > 1.5):.0%} | {sum(r.too_many for r in rows)} | '
        f'{sum(r.too_few for r in rows)} | {sum(not r.anees <= WRONG_ANEES for r in rows)} | '
        f'{len(wrong)} | {sum(not r.says_so for r in wrong)} | '
        f'{sum(r.says_so for r in right)} of {len(right)} | '
        f'{np.mean([r.cpu for r in rows]):.1f} × |\n'
    )


def compared(seed: int) -> Compared:
    """Run the hall of a seed with ids and without."""
    hall = halls.draw(seed)
    measured = halls.world(hall)
    with_ids, without = run(measured), run(halls.without_ids(hall, measured))
    true = set(without.stands_for) & set(measured.landmarks.ids.tolist())
    return Compared(
        hall,
        without.rmse_m / with_ids.rmse_m,
        without.anees,
        with_ids.anees,
        len(without.stands_for) - len(true),
        len(with_ids.well_seen - true),
        without.cpu_s / with_ids.cpu_s,
        without.findings,
    )


def runs(seeds: int, mrclam_s: float) -> Iterator[tuple[str, str, World, range]]:
    """Yield the kind of each run, its name, the run, and its draws of false points."""
    loop = worlds.WHEELED_LOOP
    for seed in range(seeds):
        world = worlds.drive(loop, worlds.simulated_settings(loop.config), seed)
        yield 'loops', f'loop, seed {seed}', world, range(seed, seed + 1)
    if worlds.data_folder().is_dir():
        yield 'Starry Night', 'Starry Night', worlds.load('Starry Night'), range(1)
        for robot in range(1, 6):
            world = worlds.load(f'MRCLAM 6, robot {robot}').part(0.0, mrclam_s)
            yield 'MRCLAM 6', f'MRCLAM 6, robot {robot}', world, range(min(seeds, 4))


def measured(name: str, world: World, draws: range) -> list[float]:
    """Run a world with ids and without, print its row, and return what it is over that with."""
    with_ids = run(world)
    without = run(outliers.without_ids(world))
    false = [run(outliers.with_false_points(world, draw)) for draw in draws]
    error_m, anees, cpu_s = np.mean([(one.rmse_m, one.anees, one.cpu_s) for one in false], axis=0)
    counts = [with_ids.landmarks, without.landmarks, *(one.landmarks for one in false)]
    sys.stdout.write(
        f'| {name} | {", ".join(map(str, counts))} | {with_ids.rmse_m:.3f} | '
        f'{without.rmse_m / with_ids.rmse_m:.2f} × | {error_m / with_ids.rmse_m:.2f} × | '
        f'{with_ids.anees:.2f} | {without.anees:.2f} | {anees:.2f} | {with_ids.cpu_s:.1f} | '
        f'{without.cpu_s / with_ids.cpu_s:.1f} × | {cpu_s / with_ids.cpu_s:.1f} × |\n'
    )
    sys.stdout.flush()
    return [
        without.rmse_m / with_ids.rmse_m,
        error_m / with_ids.rmse_m,
        without.anees,
        anees,
        without.cpu_s / with_ids.cpu_s,
        cpu_s / with_ids.cpu_s,
    ]


class HypothesesError(ConfigurationError):
    """The error of a map which is another one when another hypothesis becomes the likeliest.

    A landmark stands for the true one that it was nearest to most often when it was seen, as the
    hypothesis that is shown now has it: what it was seen as in another one is no mistake of this.
    """

    def note(self, estimator: Estimator, true_pose: FloatArray, truth: LandmarkTruth) -> None:
        """Count what an observation shows landmarks without ids to be, in each hypothesis."""
        there = se3.transform(se3.inverse(true_pose), truth.world_points)
        for state in estimator._hypotheses.states:
            rows = np.flatnonzero(state.landmarks.last_seen_ns == estimator.stamp_ns)
            rows = rows[is_automatic(state.landmarks.ids[rows])]
            points, ids = state.observer.body_points(rows), state.landmarks.ids[rows].tolist()
            # Copies of a state share what it was given: that is replaced, and never changed.
            seen_as = dict(getattr(state, 'seen_as', {}))
            for point, i in zip(points, ids, strict=True):
                nearest = int(truth.ids[np.argmin(np.linalg.norm(there - point, axis=1))])
                seen_as[i] = seen_as.get(i, Counter()) + Counter([nearest])
            setattr(state, 'seen_as', seen_as)  # noqa: B010 (a state has no such field)
        self._shown: dict[int, Counter[int]] = getattr(estimator._hypotheses.best, 'seen_as')  # noqa: B009

    def true_ids(self, ids: IntArray) -> IntArray:
        """Return the true landmark (n,) that each stands for; its own id where it had one."""
        most = {i: seen.most_common(1)[0][0] for i, seen in self._shown.items()}
        return np.array([most.get(i, i) for i in ids.tolist()], dtype=np.int64)


def run(world: World) -> Outcome:
    """Feed a world to the estimator, and compare each state with the truth."""
    estimator = Estimator(replace(world.settings, gains='riccati'))
    error, cpu_s, start_s, count = HypothesesError(), 0.0, time.process_time(), 0
    for event in world.events:
        estimator.add(event)
        if not isinstance(event, ObservationEvent):
            continue
        cpu_s += time.process_time() - start_s
        true_pose, is_covered = interpolate(world.truth, np.array([event.stamp_ns]))
        update = estimator.last_update
        if is_covered[0] and update is not None:
            count += 1
            truth = world.landmarks_at(event.stamp_ns)
            error.note(estimator, true_pose[0], truth)
            error.add(
                event.stamp_ns,
                estimator.pose,
                estimator.landmark_ids,
                estimator.world_points,
                true_pose[0],
                truth,
                None if error.nees and count % NEES_EVERY else estimator.configuration_covariance,
                update.ids[~update.rejected],
            )
        start_s = time.process_time()
    ids = estimator.landmark_ids
    true_ids = error.true_ids(ids)
    return Outcome(
        error.rmse_m or math.inf,
        error.anees or math.inf,
        cpu_s,
        len(ids),
        tuple(true_ids.tolist()),
        frozenset(true_ids[estimator.landmark_counts >= WELL_SEEN].tolist()),
        frozenset(finding.kind for finding in _findings(estimator)),
    )


def _findings(estimator: Estimator) -> Iterator[Finding]:
    """Yield what node and replay say of an estimate."""
    yield from of_estimate(estimator)
    yield from of_rejections(estimator.counts)
    yield from of_map_without_ids(estimator, estimator.longest_ambiguity)
    yield from (found(kind) for kind in UNEXPECTED_POSES if estimator.counts[kind])


if __name__ == '__main__':
    main()
