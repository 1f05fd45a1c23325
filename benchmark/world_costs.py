"""What whole runs cost: the benchmark's worlds, and long courses past many landmarks.

The CPU time is spent in the estimator's own calls, as in docs/benchmark.md, of one run.
"""

from __future__ import annotations

from dataclasses import replace
import math
import time

from cost_tables import Table, Tables
from estimators import EKF, ISAM2, ISAM2_DEFAULT
from gtsam_baselines import IndeterminateError
import numpy as np
from odometry import Event
from step_costs import ISAM2_QR, make, POINT_NOISE_M, settings_for
import worlds

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

PASSED = (800, 2000)
LONGEST_S = 60.0  # of CPU for one run, which is then given up
CLOSED = 1.05  # laps: enough to see the first landmarks again
SEEN, SPACING_M, VELOCITIES = 3, 1.0, 5  # velocities from one observation to the next
VELOCITY_NOISE = 0.01  # of rad/s and m/s
PLANE = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])


def measure_worlds() -> Tables:
    """Return the CPU time over iSAM2's, and over iSAM2's with its defaults, on each world."""
    rows: dict[str, list[float | None]] = {}
    totals: dict[str, list[float]] = {}
    for name in worlds.names():
        world = worlds.load(name)
        costs_s = [
            run_s(each, world.settings, world.events)
            for each in ('riccati', ISAM2, ISAM2_DEFAULT, EKF)
        ]
        group = 'MRCLAM 6, mean' if 'MRCLAM' in name else name
        totals[group] = [a + b for a, b in zip(totals.get(group, [0.0] * 4), costs_s, strict=True)]
    for group, (riccati_s, *others_s) in totals.items():
        rows[group] = [riccati_s / other_s for other_s in others_s]
    rows['highest'] = [max(row[i] or 0.0 for row in rows.values()) for i in range(3)]
    columns = [f'over {ISAM2}', f'over {ISAM2_DEFAULT}', f'over the {EKF}']
    return {'worlds': Table(columns=columns, rows=rows)}


def measure_passing() -> Tables:
    """Return the CPU time over iSAM2's with QR on courses past many landmarks."""
    compared = 'riccati', ISAM2_DEFAULT, ISAM2_QR
    rows: dict[str, list[float | None]] = {name: [] for name in compared}
    for passed in PASSED:
        settings, events = replace(settings_for(passed), two_d_mode=True), course(passed)
        costs_s = [_finished_s(name, settings, events) for name in compared]
        last_s = costs_s[-1]
        for name, cost_s in zip(compared, costs_s, strict=True):
            rows[name].append(None if cost_s is None or last_s is None else cost_s / last_s)
    return {'passing': Table(columns=[f'{n} landmarks' for n in PASSED], rows=rows)}


def _finished_s(name: str, settings: Settings, events: list[Event]) -> float | None:
    """Return what ``run_s`` does; None if it takes too long or the estimator gives up."""
    try:
        cost_s = run_s(name, settings, events, LONGEST_S)
    except IndeterminateError:
        return None
    return cost_s if cost_s <= LONGEST_S else None


def course(landmarks: int) -> list[Event]:
    """Return what a robot measures on a lap past landmarks a metre apart, and at its beginning.

    It drives at 1 m/s on a circle, in the plane, and sees the three nearest once a second.
    """
    rng = np.random.default_rng(0)
    angle = 2.0 * math.pi / landmarks
    radius_m = SPACING_M / angle
    bearings = angle * (np.arange(landmarks) + 0.5)
    radii = radius_m + rng.choice((-1.0, 1.0), landmarks) * rng.uniform(1.0, 3.0, landmarks)
    flat = [radii * np.sin(bearings), -radii * np.cos(bearings), np.zeros(landmarks)]
    points = np.column_stack(flat)
    velocity = np.array([0.0, 0.0, angle, SPACING_M, 0.0, 0.0])
    start = se3.pose(np.eye(3), np.array([0.0, -radius_m, 0.0]))
    events: list[Event] = []
    for step in range(round(CLOSED * landmarks)):
        for part in range(VELOCITIES):
            stamp_ns = (step * VELOCITIES + part) * 1_000_000_000 // VELOCITIES
            noisy = velocity + PLANE * VELOCITY_NOISE * rng.standard_normal(6)
            events.append(VelocityEvent(stamp_ns, noisy))
        local = se3.transform(se3.inverse(start @ se3.exp(step * velocity)), points)
        ids = np.sort(np.argsort(np.linalg.norm(local, axis=1))[:SEEN])
        seen = local[ids] + PLANE[3:] * POINT_NOISE_M * rng.standard_normal((SEEN, 3))
        events.append(ObservationEvent(step * 1_000_000_000, ids, seen))
    return sorted(events, key=lambda event: event.stamp_ns)


def run_s(
    name: str, settings: Settings, events: list[Event], longest_s: float = math.inf
) -> float:
    """Return the CPU time of an estimator on events, seconds; after ``longest_s`` it ends."""
    estimator = make(name, settings)
    start_s = time.process_time()
    for event in events:
        estimator.add(event)
        if isinstance(event, ObservationEvent) and time.process_time() - start_s > longest_s:
            break
    return time.process_time() - start_s
