"""What systematic errors of a sensor cost: in simulated loops, and in MRCLAM 6.

``python benchmark/studies/calibration.py`` drives small loops with each error alone and with all,
whose figures the settings state; then what ``slam-observer calibrate`` finds in a surveyed map,
with all of them, in twice as many drives; then robots of MRCLAM 6 with the shipped settings,
beside iSAM2 on the same points, corrected as the settings state. Ratios are to the runs without an
error.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
import logging
from pathlib import Path
import sys
from typing import Any

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from threadpoolctl import threadpool_limits
import worlds
from worlds import drive, Loop, simulated_settings, World

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.trajectory import interpolate, LandmarkTruth, Trajectory, Truth
from slam_observer_ros.runs.calibration import CalibrationFinder, Material
from slam_observer_ros.runs.metrics import anchored_average_nees, ConfigurationError

LOOPS = {
    'plane': Loop('wheeled_bearing_range', 60.0, 150.0, 20, 6.0, 5),
    'space': Loop('stereo_inertial', 60.0, 150.0, 20, 6.0, 5),
}

ANGLE, SHIFT_M, LONGER, LATE_S = np.radians(2.0), 0.03, 1.02, 0.05

MOUNT_RAD = 0.035
"""How far a bracket is stated to be turned."""

JUDGED_EVERY_S = 5.0
"""Seconds from one comparison of errors with covariances to the next."""

ROBOTS = 5

SURVEYED_M = 0.005
"""Standard deviation of each coordinate of a surveyed map."""

EIGHTS = Loop('wheeled_robot', 20.0, 180.0, 20, 8.0, 5)
"""Eights, as docs/calibrate_a_sensor.md has them driven; a lap is one of them."""

TO_BE_FOUND = {
    'sensor_rotation_z': ANGLE,
    'sensor_translation_x': SHIFT_M,
    'sensor_translation_y': -SHIFT_M,
    'range_scale': LONGER,
    'velocity_delay': 0.2,
}
"""How the sensor and the clock of :func:`surveyed_drive` err."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A systematic error, and the settings that state how large it may be."""

    turned: float = 0.0  # rad, about each axis that is estimated
    shifted: float = 0.0  # metres, along each
    longer: float = 1.0  # what ranges have to be multiplied by
    late_s: float = 0.0  # by how much too early observations are stamped

    def stated(self, planar: bool) -> dict[str, Any]:
        """Return what settings have to say of it."""
        turn = (0.0, 0.0, 1.0) if planar else (1.0, 1.0, 1.0)
        shift = (1.0, 1.0, 0.0) if planar else (1.0, 1.0, 1.0)
        rotation = tuple(MOUNT_RAD * bool(self.turned) * axis for axis in turn)
        settings: dict[str, Any] = {
            'sensor_translation_stddev': tuple(self.shifted * axis for axis in shift),
            'range_scale_stddev': abs(self.longer - 1.0),
            'velocity_delay_stddev': 0.2,
        }
        return settings | ({'sensor_rotation_stddev': rotation} if self.turned else {})

    def put_in(self, world: World) -> World:
        """Return a run whose sensor has the error."""
        planar = world.settings.two_d_mode
        turn = self.turned * np.array([0.0, 0.0, 1.0] if planar else [0.6, -0.5, 0.6])
        shift = self.shifted * np.array([1.0, -1.0, 0.0] if planar else [1.0, -1.0, 1.0])
        R, late_ns = so3.exp(turn), round(self.late_s * 1e9)

        def shown(event: ObservationEvent) -> ObservationEvent:
            points = (event.points - shift) @ R / self.longer
            stamp_ns = max(event.stamp_ns - late_ns, 0)
            return replace(event, stamp_ns=stamp_ns, points=points, covariances=None)

        events = [
            shown(event) if isinstance(event, ObservationEvent) else event
            for event in world.events
        ]
        events.sort(key=lambda event: (event.stamp_ns, isinstance(event, ObservationEvent)))
        return replace(world, events=events)


FAULTS = {
    'mount 2°': Fault(turned=ANGLE),
    'offset 3 cm': Fault(shifted=SHIFT_M),
    'range 2 %': Fault(longer=LONGER),
    'stamps 50 ms': Fault(late_s=LATE_S),
    'all of it': Fault(ANGLE, SHIFT_M, LONGER, LATE_S),
}


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Configuration error, metres, and ANEES per degree of freedom of configuration and pose."""

    error_m: float
    configuration: float
    pose: float


def judged(world: World) -> Accuracy:
    """Run the observer, and compare its estimates and covariances with the truth."""
    estimator, error = Estimator(world.settings), ConfigurationError()
    seen = [event.stamp_ns for event in world.events if isinstance(event, ObservationEvent)]
    truth, are_known = interpolate(world.truth, np.array(seen))
    stamps: list[int] = []
    poses: list[FloatArray] = []
    covariances: list[FloatArray] = []
    number, next_ns = 0, 0
    for event in world.events:
        estimator.add(event)
        if not isinstance(event, ObservationEvent):
            continue
        stamp_ns, covariance = event.stamp_ns, estimator.pose_covariance
        if are_known[number] and covariance is not None:
            is_due = stamp_ns >= next_ns
            if len(estimator.landmark_ids):
                error.add(
                    stamp_ns,
                    estimator.pose,
                    estimator.landmark_ids,
                    estimator.world_points,
                    truth[number],
                    world.landmarks_at(stamp_ns),
                    estimator.configuration_covariance if is_due else None,
                )
            if is_due:
                next_ns = stamp_ns + round(JUDGED_EVERY_S * 1e9)
            stamps.append(stamp_ns)
            poses.append(estimator.pose.copy())
            covariances.append(covariance)
        number += 1
    trajectory = Trajectory(np.array(stamps), np.array(poses))
    try:
        pose_anees = anchored_average_nees(trajectory, np.array(covariances), world.truth)
    except EvaluationError:  # truth that begins later than the run
        pose_anees = None
    found = (error.rmse_m, error.anees, pose_anees)
    return Accuracy(*(np.nan if figure is None else figure for figure in found))


def means(make: Callable[[int], World], seeds: int) -> Accuracy:
    """Return the mean of each figure over runs."""
    every = [judged(make(seed)) for seed in range(seeds)]
    return Accuracy(*(float(np.mean([getattr(one, name) for one in every])) for name in FIGURES))


FIGURES = ('error_m', 'configuration', 'pose')


def write(name: str, found: Accuracy, error_m: float) -> None:
    """Write a line of the table."""
    figures = (found.error_m, found.error_m / error_m, found.configuration, found.pose)
    sys.stdout.write(f'{name:44}' + ''.join(f'{figure:8.3f}' for figure in figures) + '\n')
    sys.stdout.flush()


def compare_loops(name: str, seeds: int) -> None:
    """Write what each error costs, with and without estimating it."""
    loop = LOOPS[name]
    shipped = simulated_settings(loop.config)
    exact = replace(shipped, sensor_rotation_stddev=(0.0, 0.0, 0.0))
    yaw = MOUNT_RAD if shipped.two_d_mode else 0.0
    usual = replace(shipped, sensor_rotation_stddev=(0.0, 0.0, yaw))

    def make(settings: Any, fault: Fault) -> Callable[[int], World]:
        plain = partial_drive(loop, shipped)
        return lambda seed: replace(fault.put_in(plain(seed)), settings=settings)

    least = means(make(exact, Fault()), seeds)
    write(f'{name}, none, none estimated', least, least.error_m)
    write(f'{name}, none, yaw estimated', means(make(usual, Fault()), seeds), least.error_m)
    for label, fault in FAULTS.items():
        write(f'{name}, {label}, ignored', means(make(exact, fault), seeds), least.error_m)
        stated = replace(usual, **fault.stated(shipped.two_d_mode))
        without = means(make(stated, Fault()), seeds)
        write(f'{name}, none, prepared for {label}', without, least.error_m)
        write(f'{name}, {label}, estimated', means(make(stated, fault), seeds), least.error_m)


def partial_drive(loop: Loop, settings: Any) -> Callable[[int], World]:
    """Return what drives a loop, given a seed."""
    return lambda seed: drive(loop, settings, seed)


def compare_recordings() -> None:
    """Write errors in MRCLAM 6, with iSAM2's on the same corrected points."""
    from estimators import run_online  # which needs GTSAM, as no loop does
    from gtsam_baselines import accurate_isam2
    from scores import score

    errors, baseline = [], []
    for robot in range(1, ROBOTS + 1):
        world = worlds.load(f'MRCLAM 6, robot {robot}')
        found = judged(world)
        isam2 = score(run_online(accurate_isam2(world.settings), world.events), world)
        errors.append(found.error_m)
        baseline.append(isam2.configuration_rmse_m)
        write(f'MRCLAM 6, robot {robot} (to iSAM2)', found, isam2.configuration_rmse_m)
    sys.stdout.write(
        f'mean {np.mean(errors):.4f} m, iSAM2 {np.mean(baseline):.4f} m on the same points, '
        f'ratio {np.mean(errors) / np.mean(baseline):.2f}\n'
    )


def surveyed_drive(seed: int) -> Material:
    """Drive eights, and turn on the spot, among surveyed landmarks, with all errors at once."""
    settings = replace(simulated_settings(EIGHTS.config), localization_mode='uncertain')
    t_s = np.arange(round(EIGHTS.duration_s * worlds.VELOCITY_RATE_HZ)) / worlds.VELOCITY_RATE_HZ
    V = np.zeros((len(t_s), 6))
    on_the_spot = t_s % 30.0 > 24.0
    V[:, 2] = 0.8 * np.sign(np.sin(2.0 * np.pi * t_s / EIGHTS.lap_s))
    V[:, 3] = 0.5 + 0.2 * np.sin(2.0 * np.pi * t_s / 7.0)
    V[on_the_spot, 2] = np.where(t_s[on_the_spot] % 60.0 < 30.0, 1.0, -1.0)
    V[on_the_spot, 3] = 0.0
    poses = se3.path(np.eye(4), V / worlds.VELOCITY_RATE_HZ)
    rng = np.random.default_rng(seed)
    n = EIGHTS.landmarks
    points = rng.uniform([-6.0, -6.0, 0.0], [6.0, 6.0, 0.0], (n, 3))
    plain = worlds.recorded_on(
        poses, LandmarkTruth(np.arange(n), points), np.zeros((n, 3)), EIGHTS, settings, rng
    )
    events = Fault(ANGLE, SHIFT_M, LONGER, -TO_BE_FOUND['velocity_delay']).put_in(plain).events
    surveyed = points + SURVEYED_M * rng.standard_normal((n, 3)) * np.array([1.0, 1.0, 0.0])
    covariances = np.tile(SURVEYED_M**2 * np.eye(3), (n, 1, 1))
    known = LandmarkMap(np.arange(n), surveyed, covariances, np.full(n, 10))
    none = Truth(np.empty(0, np.int64), np.empty((0, 4, 4)), None)
    end_ns = events[-1].stamp_ns + 1
    return Material(Path(f'seed {seed}'), '', events, none, EIGHTS.max_range_m, end_ns, known)


def calibrate_drives(seeds: int) -> None:
    """Write how far what `slam-observer calibrate` finds is off, in standard deviations."""
    settings = replace(simulated_settings(EIGHTS.config), localization_mode='uncertain')
    off: dict[str, list[float]] = {}
    share: dict[str, list[float]] = {}
    for seed in range(seeds):
        found = CalibrationFinder(surveyed_drive(seed), settings, (), lambda: None).find(True)
        for part in found.parts:
            true = TO_BE_FOUND.get(part.name, part.nominal)
            off.setdefault(part.name, []).append((part.value - true) / part.deviation)
            share.setdefault(part.name, []).append(part.deviation / abs(true - part.nominal or 1))
    sys.stdout.write(f'{"":32} mean z   rms z   max z  σ/error (scales, biases: σ)\n')
    for name, z in off.items():
        figures = (np.mean(z), np.sqrt(np.mean(np.square(z))), np.abs(z).max(), max(share[name]))
        sys.stdout.write(f'{name:30}' + ''.join(f'{figure:8.3f}' for figure in figures) + '\n')


def main() -> None:
    """Run everything and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--only', choices=('plane', 'space', 'drives', 'recordings'))
    args = parser.parse_args()
    threadpool_limits(1)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    sys.stdout.write(f'{"":44} error m   ratio   ANEES    pose\n')
    for name in LOOPS:
        if args.only in (None, name):
            compare_loops(name, args.seeds)
    if args.only in (None, 'drives'):
        calibrate_drives(2 * args.seeds)
    if args.only in (None, 'recordings'):
        compare_recordings()


if __name__ == '__main__':
    main()
