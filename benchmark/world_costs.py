"""What whole runs cost: the benchmark's worlds, and long courses past many landmarks.

The CPU time is that of the estimator's own calls, as in docs/benchmark.md, of one run.
"""

from __future__ import annotations

import math
import time

from cost_tables import Table, Tables
from estimators import EKF, ISAM2, ISAM2_DEFAULT
from step_costs import make
import worlds
from worlds import Loop, World

from slam_observer_ros.events import ObservationEvent

PASSED = (800, 2000)
LONGEST_S = 60.0  # of CPU for one run, which is then given up
CLOSED = 1.05  # laps: enough to see the first landmarks again


def measure_worlds() -> Tables:
    """Return the CPU time over that of iSAM2, and of iSAM2 with its defaults, on each world."""
    rows: dict[str, list[float | None]] = {}
    totals: dict[str, list[float]] = {}
    for name in worlds.names():
        world = worlds.load(name)
        costs_s = [run_s(each, world) for each in ('riccati', ISAM2, ISAM2_DEFAULT, EKF)]
        group = 'MRCLAM 6, mean' if 'MRCLAM' in name else name
        totals[group] = [a + b for a, b in zip(totals.get(group, [0.0] * 4), costs_s, strict=True)]
    for group, (riccati_s, *others_s) in totals.items():
        rows[group] = [riccati_s / other_s for other_s in others_s]
    rows['highest'] = [max(row[i] or 0.0 for row in rows.values()) for i in range(3)]
    columns = [f'over {ISAM2}', f'over {ISAM2_DEFAULT}', f'over the {EKF}']
    return {'worlds': Table(columns=columns, rows=rows)}


def measure_passing() -> Tables:
    """Return the CPU time over that of iSAM2 with its defaults on courses past many landmarks."""
    rows: dict[str, list[float | None]] = {
        name: [] for name in ('scheduled', 'riccati', EKF, ISAM2_DEFAULT)
    }
    for passed in PASSED:
        world = course(passed)
        unit_s = run_s(ISAM2_DEFAULT, world)
        for name, row in rows.items():
            cost_s = run_s(name, world, LONGEST_S)
            row.append(None if cost_s > LONGEST_S else cost_s / unit_s)
    return {'passing': Table(columns=[f'{n} landmarks' for n in PASSED], rows=rows)}


def course(landmarks: int) -> World:
    """Return a lap past landmarks half a metre apart, some three of them seen a second."""
    loop = Loop('stereo_inertial', landmarks, CLOSED * landmarks, landmarks, 6.0, 1)
    return worlds.drive(loop, worlds.simulated_settings(loop.config), seed=0)


def run_s(name: str, world: World, longest_s: float = math.inf) -> float:
    """Return the CPU time of an estimator on a world, seconds; after ``longest_s`` it ends."""
    estimator = make(name, world.settings)
    start_s = time.process_time()
    for event in world.events:
        estimator.add(event)
        if isinstance(event, ObservationEvent) and time.process_time() - start_s > longest_s:
            break
    return time.process_time() - start_s
