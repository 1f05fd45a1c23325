"""What one step costs, a velocity and an observation, against the size of map and observation.

The robot drives at 1 m/s through a grid of landmarks 2 m apart, all of which it has seen once, and
sees those nearest to it at 20 Hz. A step's cost is the mean CPU time over many, so that what an
estimator does only now and then is in it.
"""

from __future__ import annotations

from dataclasses import replace
import math
import time

from cost_tables import ratios, Table, Tables
from estimators import EKF, ISAM2, ISAM2_DEFAULT, observer, ONLINE, OnlineEstimator
from gtsam_baselines import accurate_isam2, qr_isam2
import numpy as np
from odometry import Event

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.placement import DESIGNS
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

KNOWN = (10, 30, 100, 300, 1000)
SEEN = (1, 3, 10, 30, 100)
MANY_KNOWN, FEW_SEEN = 300, 3  # of the table that does not vary them
CROWD = 200
LARGE_MAP, LARGE_SEEN = 5000, 20
MOST_POINTS = Settings().max_points

RATE_HZ = 20
SPEED_M_S = 1.0
SPACING_M = 2.0
POINT_NOISE_M = 0.05
STEPS = 60
LONGEST_S = 3.0  # of CPU for one cell, beyond which no further step is begun

ISAM2_QR = 'iSAM2, its defaults with QR'

ESTIMATORS = ('constant', 'riccati', EKF, ISAM2_DEFAULT, ISAM2)


def measure_steps() -> Tables:
    """Return costs of a step against landmarks known, and seen, in units of the cheapest."""
    by_known = {name: [step_s(name, known, FEW_SEEN) for known in KNOWN] for name in ESTIMATORS}
    by_seen = {name: [step_s(name, MANY_KNOWN, seen) for seen in SEEN] for name in ESTIMATORS}
    unit_s = min(values[0] for values in by_known.values())
    return {
        'known': ratios(by_known, [f'n = {known}' for known in KNOWN], unit_s),
        'seen': ratios(by_seen, [f'm = {seen}' for seen in SEEN], unit_s),
    }


def measure_large() -> Tables:
    """Return what an observation of 200 landmarks costs, and one in a map of 5000."""
    crowd_s = {name: step_s(name, CROWD, CROWD) for name in ESTIMATORS if name != 'constant'}
    rows: dict[str, list[float | None]] = {
        name: [1e3 * value_s, value_s / crowd_s[ISAM2_DEFAULT]]
        for name, value_s in crowd_s.items()
    }
    crowd = Table(columns=['ms', f'over {ISAM2_DEFAULT}'], rows=rows)
    large_s = {name: step_s(name, LARGE_MAP, LARGE_SEEN) for name in ('riccati', ISAM2_DEFAULT)}
    large: dict[str, list[float | None]] = {
        name: [RATE_HZ * value_s] for name, value_s in large_s.items()
    }
    return {'crowd': crowd, 'large': Table(columns=['share of one core'], rows=large)}


def step_s(name: str, known: int, seen: int) -> float:
    """Return the mean CPU time of a step, seconds."""
    settings = replace(settings_for(known), max_points=max(seen, MOST_POINTS))
    estimator = make(name, settings)
    start, steps = drive(known, seen)
    for event in start:
        estimator.add(event)
    total_s, done = 0.0, 0
    for step in steps:
        start_s = time.process_time()
        for event in step:
            estimator.add(event)
        total_s += time.process_time() - start_s
        done += 1
        if total_s > LONGEST_S:
            break
    return total_s / done


def settings_for(known: int) -> Settings:
    """Return settings for a map of so many landmarks, with the defaults for all else."""
    return Settings(reorder_window=0.0, max_landmarks=max(known, 2000))


def make(name: str, settings: Settings) -> OnlineEstimator:
    """Return an estimator by the name of its row."""
    makers = {
        **ONLINE,
        **{design: observer(design) for design in DESIGNS},
        ISAM2: accurate_isam2,
        ISAM2_QR: qr_isam2,
    }
    return makers[name](settings)


def drive(known: int, seen: int) -> tuple[list[Event], list[list[Event]]]:
    """Return the events by which all landmarks get known, and each step's."""
    rng = np.random.default_rng(0)
    side = math.ceil(math.sqrt(known))
    grid = SPACING_M * (np.stack(np.divmod(np.arange(known), side), axis=-1) - 0.5 * side)
    points = np.column_stack([grid + 0.3, rng.uniform(-1.0, 1.0, known)])
    velocity = np.array([0.0, 0.0, 0.0, SPEED_M_S, 0.0, 0.0])
    # The robot stands until it has seen all: of a message no more than ``max_points`` are used.
    start: list[Event] = []
    period_ns = 1_000_000_000 // RATE_HZ
    for ids in np.split(np.arange(known), range(MOST_POINTS, known, MOST_POINTS)):
        now_ns = len(start) // 2 * period_ns
        start.append(VelocityEvent(now_ns, velocity * (ids[-1] == known - 1)))
        start.append(ObservationEvent(now_ns, ids, _noisy(points[ids], rng)))
    steps: list[list[Event]] = []
    for step in range(1, STEPS + 1):
        stamp_ns = now_ns + step * period_ns
        pose = np.eye(4)
        pose[0, 3] = SPEED_M_S * step / RATE_HZ
        local = se3.transform(se3.inverse(pose), points)
        ids = np.sort(np.argsort(np.linalg.norm(local, axis=1))[:seen])
        observation = ObservationEvent(stamp_ns, ids, _noisy(local[ids], rng))
        steps.append([VelocityEvent(stamp_ns, velocity), observation])
    return start, steps


def _noisy(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    noisy: FloatArray = points + POINT_NOISE_M * rng.standard_normal(points.shape)
    return noisy
