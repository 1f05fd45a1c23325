"""What one update costs, against the size n of the map and the number m of landmarks seen.

Times are given as ratios to the cheapest, so that they mean something on any machine. Looking
back, which Riccati gains do now and then, is left out: ``make benchmark-accuracy`` has the cost of
whole recordings.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
from threadpoolctl import threadpool_limits

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.observer.designs import DESIGNS
from slam_observer_ros.settings.estimator_settings import Settings

MAP_SIZES = (10, 30, 100, 300, 1000)
SEEN = (1, 3, 10)
STEP_NS = 20_000_000
REPEATS = 12


def main() -> None:
    """Measure all designs and print one table a design."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    threadpool_limits(1)  # as the nodes do
    measured = {
        (design, n, m): update_s(design, n, m)
        for design in DESIGNS
        for n in MAP_SIZES
        for m in SEEN
    }
    unit_s = measured['constant', MAP_SIZES[0], SEEN[0]]
    lines = [f'One unit: constant gains, n = {MAP_SIZES[0]}, m = {SEEN[0]}.', '']
    for design in DESIGNS:
        lines += [f'| {design} | ' + ' | '.join(f'n = {n}' for n in MAP_SIZES) + ' |']
        lines += ['|---' * (len(MAP_SIZES) + 1) + '|']
        for m in SEEN:
            ratios = (f'{measured[design, n, m] / unit_s:.1f}' for n in MAP_SIZES)
            lines += [f'| m = {m} | ' + ' | '.join(ratios) + ' |']
        lines += ['']
    sys.stdout.write('\n'.join(lines))


def update_s(design: str, map_size: int, seen: int) -> float:
    """Return the least time of a velocity and an observation of ``seen`` known landmarks."""
    rng = np.random.default_rng(0)
    settings = Settings(gains=design, reorder_window=0.0, relinearization_interval=0)
    estimator = Estimator(settings)
    points = rng.uniform(-20.0, 20.0, (map_size, 3))
    estimator.add(VelocityEvent(0, np.zeros(6)))
    estimator.add(ObservationEvent(0, np.arange(map_size), points))
    times_s = []
    for step in range(1, REPEATS + 1):
        ids = rng.choice(map_size, seen, replace=False)
        noisy = points[ids] + 0.01 * rng.standard_normal((seen, 3))
        start_s = time.perf_counter()
        estimator.add(VelocityEvent(step * STEP_NS, np.zeros(6)))
        estimator.add(ObservationEvent(step * STEP_NS, ids, noisy))
        times_s.append(time.perf_counter() - start_s)
    return min(times_s)


if __name__ == '__main__':
    main()
