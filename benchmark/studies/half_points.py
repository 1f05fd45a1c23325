"""Ranges alone: Plaza 1 and 2, in a survey of the anchors, without, and lost in it.

``python benchmark/studies/half_points.py`` prints errors against the truth by the shipped
``uwb.yaml``, and how many of 100 starts are found on Plaza and in random halls. By how much the
ranges, which are 7 % long, are so is not known. The data is not shipped: it is read from ``plaza``
in the folder that SLAM_OBSERVER_DATA names.

``--random 30`` drives through random halls whose landmarks are not known, by each kind, from the
seed ``--first`` on, where the ranges of each anchor are too long by ``--bias`` (σ, metres), which
is another one for each; ``--straight 50`` straight on past eight landmarks in each of so many.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import logging
import math
import os
from pathlib import Path
import sys
import time
from typing import TypeAlias

import numpy as np

from slam_observer_ros.cli.convert import surveyed
from slam_observer_ros.cli.doctor import shipped_settings
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AZIMUTH,
    AZIMUTH_RANGE,
    BEARING,
    Event,
    ObservationEvent,
    POINT,
    RANGE,
    VelocityEvent,
)
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.data_sets import load_plaza
from slam_observer_ros.recordings.trajectory import associate, Trajectory
from slam_observer_ros.runs.metrics import trajectory_errors
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.waiting_room import FEWEST_VIEWS

DATA = Path(os.environ.get('SLAM_OBSERVER_DATA', '../shared/data')) / 'plaza'
START_M, START_RAD = 0.05, 0.05
STARTS, MOST_M, WRONG_M = 100, 30.0, 2.0
STEP_S, SPEED = 0.1, 0.7

HALL = Settings(
    two_d_mode=True,
    localization_mode='uncertain',
    observation_model='range_bearing',
    range_noise=0.1,
    bearing_noise=0.02,
    range_scale_stddev=0.1,
    angular_velocity_noise=(0.01, 0.01, 0.01),
    linear_velocity_noise=(0.02, 0.01, 0.01),
    max_rejections=1_000_000,
)

WORLDS = {
    'ranges': (RANGE,),
    'bearings': (BEARING,),
    'mixed': (POINT, BEARING, AZIMUTH, RANGE, AZIMUTH_RANGE),
    'points': (POINT,),
}

Found: TypeAlias = tuple[float, float, bool]
"""Metres driven, error of the position there, metres, and whether the robot was found."""


def main() -> None:
    """Print a row for each run, in the surveyed map and without one; or of random worlds."""
    logging.getLogger('slam_observer_ros').setLevel(logging.CRITICAL)
    parser = argparse.ArgumentParser(description=__doc__)
    for name, help_ in (
        ('random', 'how many halls of each kind'),
        ('straight', 'how many straight drives of each kind'),
        ('worlds', 'how many surveyed worlds of each kind'),
        ('first', 'the first seed'),
    ):
        parser.add_argument(f'--{name}', type=int, default=0, help=help_)
    parser.add_argument('--bias', type=float, default=0.0, help='of ranges in halls, σ in metres')
    given = parser.parse_args()
    write_worlds(range(given.first, given.first + given.worlds))
    if given.random or given.straight or given.worlds:
        for kind in (RANGE, BEARING):
            write_halls(kind, range(given.first, given.first + given.random), given.bias)
            write_straight(kind, range(given.first, given.first + given.straight))
        return
    for run in (1, 2):
        for is_surveyed in (True, False):
            sys.stdout.write(f'{row(run, is_surveyed)}\n')
    for run in (1, 2):
        write_lost(f'Plaza {run}', lost_on_plaza(run))
    for name, kind, in_a_line, walls in (
        ('ranges', RANGE, False, 0.0),
        ('ranges, 20 % of them through walls', RANGE, False, 0.2),
        ('bearings', BEARING, False, 0.0),
        ('ranges, anchors in a line', RANGE, True, 0.0),
    ):
        found = (lost_in_hall(seed, kind, in_a_line, walls) for seed in range(STARTS))
        write_lost(f'halls, {name}', found)


def write_lost(name: str, found: Iterable[Found | None]) -> None:
    """Write how many starts were found, how many of them wrong, and after which drive."""
    results = [each for each in found if each is not None]
    drives = [drive_m for drive_m, _, is_found in results if is_found]
    wrong = sum(off_m > WRONG_M for _, off_m, is_found in results if is_found)
    after = np.percentile(drives, [50, 90]).round(1).tolist() if drives else '–'
    sys.stdout.write(
        f'lost, {name}: found {len(drives)} of {len(results)}, wrong {wrong}, after {after} m '
        '(median, 90 %)\n'
    )


def lost_on_plaza(run: int) -> Iterator[Found]:
    """Start lost at any time of the first three quarters of a run at which there are ranges.

    Plaza 1 has a gap in which the robot drives for longer than MOST_M without any.
    """
    events, truth, anchors = read(run)
    rng, count = np.random.default_rng(1), 0
    while count < STARTS:
        start = int(rng.integers(50, len(events) * 3 // 4))
        found = lost(events[start:], truth, anchors, shipped_settings('uwb'))
        if found is not None:
            count += 1
            yield found


def lost(
    events: Sequence[Event], truth: Trajectory, anchors: LandmarkMap, config: Settings
) -> Found | None:
    """Drive until the robot is found, or for MOST_M; return drive, error, and whether it was.

    None where too little was seen on that drive to search at all.
    """
    estimator, driven_m, seen = Estimator(config), 0.0, 0
    estimator.load_map(anchors)
    last: VelocityEvent | None = None
    for event in events:
        estimator.add(event)
        if isinstance(event, VelocityEvent):
            if last is not None:
                speed = float(np.linalg.norm(last.body_velocity[3:]))
                driven_m += speed * 1e-9 * (event.stamp_ns - last.stamp_ns)
            last = event
        elif estimator.is_localised:
            at = np.searchsorted(truth.stamps_ns, estimator.stamp_ns or 0).clip(max=len(truth) - 1)
            off = (estimator.pose - truth.poses[at])[:3, 3]
            return driven_m, float(np.linalg.norm(off)), True
        seen += isinstance(event, ObservationEvent)
        if driven_m > MOST_M:
            break
    return None if seen < FEWEST_VIEWS else (driven_m, math.nan, False)


def lost_in_hall(seed: int, kind: int, in_a_line: bool, walls: float) -> Found | None:
    """Start lost in a hall of 10 to 40 m with eight anchors, and drive at random."""
    rng, n = np.random.default_rng(seed), 8
    size = rng.uniform(10.0, 40.0, 2)
    points = np.column_stack([rng.uniform(0.0, size, (n, 2)), np.zeros(n)])
    if in_a_line:
        turn = rng.uniform(0.0, np.pi)
        along = rng.uniform(-0.5, 0.5, n) * size[0]
        points[:, :2] = size / 2.0 + np.outer(along, [np.cos(turn), np.sin(turn)])
    anchors = LandmarkMap(
        np.arange(n), points, np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.zeros(n, np.int64)
    )
    x, y = rng.uniform(1.0, size - 1.0).tolist()
    A, turn = pose_of(x, y, rng.uniform(-np.pi, np.pi)), 0.0
    scale = 1.0 + 0.05 * rng.normal()
    events: list[Event] = []
    stamps_ns, poses = [], []
    for step in range(round(MOST_M / SPEED / STEP_S) + 50):
        turn = rng.uniform(-0.6, 0.6) if step % 20 == 0 else turn
        V, stamp_ns = np.array([0.0, 0.0, turn, SPEED, 0.0, 0.0]), round(1e9 * STEP_S) * step
        noise = np.array([0.0, 0.0, 0.01, 0.02, 0.0, 0.0]) / np.sqrt(STEP_S)
        stamps_ns.append(stamp_ns)
        poses.append(A)
        events.append(VelocityEvent(stamp_ns, V + noise * rng.normal(size=6)))
        if step % 4 == 0:
            rows = rng.permutation(n)[:3]
            lines = se3.transform(se3.inverse(A), points[rows])
            ranges_m = np.linalg.norm(lines, axis=1, keepdims=True)
            if kind == BEARING:
                shown = lines / ranges_m + 0.02 * rng.normal(size=lines.shape) * [1.0, 1.0, 0.0]
                shown /= np.linalg.norm(shown, axis=1, keepdims=True)
            else:
                detours = (rng.random((3, 1)) < walls) * rng.exponential(1.0, (3, 1))
                shown = (ranges_m + detours + 0.1 * rng.normal(size=(3, 1))) / scale
                shown = shown * [1.0, 0.0, 0.0]
            events.append(ObservationEvent(stamp_ns, rows, shown, kinds=np.full(3, kind)))
        A = A @ se3.exp(STEP_S * V)
    return lost(events, Trajectory.from_samples(stamps_ns, poses), anchors, HALL)


@dataclass(frozen=True)
class Hall:
    """A random hall and a drive in it, with a sensor and odometry as noisy as its settings say."""

    settings: Settings
    points: FloatArray  # (n, 3)
    events: list[Event]
    truth: Trajectory

    @classmethod
    def random(
        cls,
        seed: int,
        kind: int,
        duration_s: float = 200.0,
        straight: bool = False,
        bias_m: float = 0.0,
    ) -> Hall:
        """Drive from one random place to the next; or ``straight`` on through the middle."""
        rng = np.random.default_rng([seed, kind])
        size, n = rng.uniform(8.0, 40.0, 2), int(rng.integers(5, 16))
        points = np.column_stack([rng.uniform(0.0, size, (n, 2)), np.zeros(n)])
        gyro, slip = rng.uniform(0.005, 0.03), rng.uniform(0.01, 0.05)
        smallest, largest = (0.05, 0.7) if kind == RANGE else (0.005, 0.05)
        sigma = float(np.exp(rng.uniform(math.log(smallest), math.log(largest))))
        half_view = np.pi if kind == RANGE else rng.uniform(0.5, np.pi)
        reach_m = rng.uniform(0.4, 1.2) * float(np.linalg.norm(size))
        scale, track, wheel = 1.0 + np.array([0.05, 0.02, 0.02]) * rng.normal(size=3)
        bias = 0.003 * rng.normal() if kind == BEARING else 0.0
        settings = replace(
            shipped_settings('uwb' if kind == RANGE else 'bearings'),
            angular_velocity_noise=(0.0, 0.0, gyro),
            linear_velocity_noise=(slip, slip, 0.0),
            linear_scale_stddev=(0.03, 0.0, 0.0),
            angular_scale_stddev=(0.0, 0.0, 0.03),
            range_noise=sigma if kind == RANGE else 0.5,
            bearing_noise=sigma if kind == BEARING else 0.01,
        )
        biases_m = bias_m * np.random.default_rng(seed).normal(size=n)
        speed = rng.uniform(0.3, 1.0)
        if straight:
            points = rng.uniform([-2.0, -8.0, 0.0], [25.0 * speed + 2.0, 8.0, 0.0], (8, 3))
            biases_m = np.zeros(8)
            reach_m = np.inf
        heading = rng.uniform(-np.pi, np.pi)
        A = np.eye(4) if straight else pose_of(size[0] / 2.0, size[1] / 2.0, heading)
        goal, turn = size / 2.0, 0.0
        events: list[Event] = []
        stamps_ns, poses = [], []
        for step in range(round(duration_s / STEP_S)):
            stamp_ns = round(1e9 * STEP_S) * step
            ahead = se3.transform(se3.inverse(A), np.array([[*goal, 0.0]]))[0]
            if np.linalg.norm(ahead) < 1.0:
                goal = rng.uniform(0.1, 0.9, 2) * size
            if not straight:
                turn += 0.3 * (np.clip(np.arctan2(ahead[1], ahead[0]), -0.6, 0.6) - turn)
            V = np.array([0.0, 0.0, turn, speed, 0.0, 0.0])
            noise = np.array([0.0, 0.0, gyro, slip, slip, 0.0]) / np.sqrt(STEP_S)
            measured = V * [1, 1, track, wheel, 1, 1] + [0, 0, bias, 0, 0, 0]
            stamps_ns.append(stamp_ns)
            poses.append(A)
            events.append(VelocityEvent(stamp_ns, measured + noise * rng.normal(size=6)))
            if step % 4 == 0:
                lines = se3.transform(se3.inverse(A), points)
                ranges_m = np.linalg.norm(lines, axis=1)
                angles = np.arctan2(lines[:, 1], lines[:, 0])
                seen = (ranges_m < reach_m) & (np.abs(angles) < half_view)
                rows = rng.permutation(np.flatnonzero(seen))[:3]
                off = sigma * rng.normal(size=len(rows))
                shown = np.zeros((len(rows), 3))
                if kind == RANGE:
                    shown[:, 0] = ranges_m[rows] * scale + biases_m[rows] + off
                else:
                    seen_at = angles[rows] + off
                    shown[:, 0], shown[:, 1] = np.cos(seen_at), np.sin(seen_at)
                if len(rows):
                    kinds = np.full(len(rows), kind)
                    events.append(ObservationEvent(stamp_ns, rows, shown, kinds=kinds))
            A = A @ se3.exp(STEP_S * V)
        return cls(settings, points, events, Trajectory.from_samples(stamps_ns, poses))

    def drive(self, is_surveyed: bool) -> tuple[Estimator, Trajectory, float]:
        """Return the estimator, what it has estimated online, and the ANEES of the position."""
        poses: list[tuple[int, FloatArray]] = []
        nees: list[float] = []

        def note(update: Update) -> None:
            poses.append((update.stamp_ns, update.pose))
            at = np.searchsorted(self.truth.stamps_ns, update.stamp_ns)
            off = (update.pose[:3, 3] - self.truth.poses[at, :3, 3])[:2]
            P = np.asarray(estimator.pose_covariance)[3:5, 3:5]
            if P[0, 0] > 0.0:
                nees.append(float(off @ np.linalg.solve(P, off)) / 2.0)

        start = self.truth.poses[0]
        mode = 'uncertain' if is_surveyed else 'off'
        settings = replace(self.settings, localization_mode=mode)
        estimator = Estimator(settings, initial_pose=start, on_update=note)
        if is_surveyed:
            n = len(self.points)
            covariances, counts = np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.zeros(n, np.int64)
            known = LandmarkMap(np.arange(n), self.points, covariances, counts)
            estimator.load_map(known, start, np.zeros((6, 6)))
        for event in self.events:
            estimator.add(event)
        estimator.flush()
        return estimator, Trajectory.from_samples(*zip(*poses, strict=True)), float(np.mean(nees))


def write_halls(kind: int, seeds: Sequence[int], bias_m: float) -> None:
    """Write by how much errors are larger than in a surveyed map, and what has entered.

    Errors are at the best size: without a survey odometry alone says it, by its unknown scale.
    """
    rows: list[tuple[float, ...]] = []
    entered = wrong = count = 0
    for seed in seeds:
        hall = Hall.random(seed, kind, bias_m=bias_m)
        known, of_known, _ = hall.drive(is_surveyed=True)
        found, of_found, anees = hall.drive(is_surveyed=False)
        seen = {id_ for e in hall.events if isinstance(e, ObservationEvent) for id_ in e.ids}
        each = (of_found, of_known, smooth(found), smooth(known))
        errors, sizes = zip(*(sized_errors(path, hall.truth) for path in each), strict=True)
        off_m = np.linalg.norm(found.world_points - hall.points[found.landmark_ids], axis=1)
        sigmas_m = np.sqrt(np.trace(np.asarray(found.landmark_covariances), axis1=1, axis2=2))
        far = int(((off_m > 4.0 * sigmas_m) & (off_m > 0.5)).sum())
        rows.append((errors[0] / errors[1], errors[2] / errors[3], sizes[2], anees))
        entered, count, wrong = entered + len(off_m), count + len(seen), wrong + far
        sys.stdout.write(
            f'{seed:3} {errors[0]:.3f} {errors[1]:.3f} smoothed {errors[2]:.3f} {errors[3]:.3f}, '
            f'{len(off_m)} of {len(seen)} entered, {far} off, size {sizes[2]:.3f}, '
            f'ANEES {anees:.2f}\n'
        )
    if rows:
        spread = np.percentile(rows, [10, 50, 90], axis=0).T
        for name, each_ in zip(('ATE', 'smoothed', 'size', 'ANEES'), spread, strict=True):
            sys.stdout.write(f'{name} {each_.round(2).tolist()} (10, 50, 90 %)\n')
        sys.stdout.write(f'halls, kind {kind}: {entered} of {count} entered, {wrong} far off\n')


def sized_errors(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return the position error after alignment with a free size, metres, and that size."""
    paired, true_paired, _ = associate(estimate, truth)
    spreads = [float(np.ptp(each.positions, axis=0).max()) for each in (paired, true_paired)]
    poses = paired.poses.copy()
    best = (math.inf, 1.0)
    for size in np.linspace(0.8, 1.2, 41) * spreads[1] / max(spreads[0], 1e-3):
        poses[:, :3, 3] = size * paired.positions
        error_m = trajectory_errors(Trajectory(paired.stamps_ns, poses), truth).ate_rmse_m
        best = min(best, (error_m, 1.0 / size))
    return best


def smooth(estimator: Estimator) -> Trajectory:
    """Return the smoothed trajectory."""
    smoothed = estimator.smooth()
    return Trajectory.from_samples(smoothed.stamps_ns.tolist(), list(smoothed.poses))


def write_straight(kind: int, seeds: Sequence[int]) -> None:
    """Write how many landmarks have entered in straight drives, and on the wrong side."""
    entered = wrong = open_ = count = 0
    for seed in seeds:
        hall = Hall.random(seed, kind, duration_s=25.0, straight=True)
        estimator, *_ = hall.drive(is_surveyed=False)
        seen = estimator.world_points, hall.points[estimator.landmark_ids]
        from_ = se3.inverse(np.array([estimator.pose, hall.truth.poses[-1]]))
        y = [se3.transform(back, each)[:, 1] for back, each in zip(from_, seen, strict=True)]
        entered, count = entered + len(y[0]), count + len(hall.points)
        wrong += int(((y[0] * y[1] < 0.0) & (np.abs(y[0] - y[1]) > 1.0)).sum())
        open_ += len(estimator.open_sides)
    sys.stdout.write(
        f'straight, kind {kind}: {entered} of {count} entered, {wrong} on the wrong side, '
        f'{open_} open\n'
    )


def write_worlds(seeds: Sequence[int]) -> None:
    """Write how honest the filter is in surveyed random worlds: the mean NEES, and the worst."""
    for is_planar in (True, False) if seeds else ():
        for name, kinds in WORLDS.items():
            each = np.array([surveyed_world(seed, is_planar, kinds) for seed in seeds])
            (anees, error_m), worst = each.mean(axis=0), each[:, 0].max()
            sys.stdout.write(
                f'{"plane" if is_planar else "space"}, {name}: ANEES {anees:.2f}, worst world '
                f'{worst:.2f}, error {error_m:.3f} m\n'
            )
            sys.stdout.flush()


def surveyed_world(seed: int, is_planar: bool, kinds: Sequence[int]) -> tuple[float, float]:
    """Drive for 100 s past eight anchors; return the mean NEES per axis, and the RMSE, metres."""
    rng, n = np.random.default_rng(seed), 8
    flat = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
    points = rng.uniform([-10.0, -10.0, 0.5], [10.0, 10.0, 5.0], (n, 3)) * flat
    noise = np.array([0.01, 0.01, 0.01, 0.02, 0.01, 0.01]) / np.sqrt(STEP_S)
    counting = [2, 3, 4] if is_planar else list(range(6))
    config = replace(HALL, two_d_mode=is_planar, range_scale_stddev=0.0, reorder_window=0.0)
    estimator = Estimator(config)
    survey = LandmarkMap(
        np.arange(n), points, np.tile(1e-6 * np.eye(3), (n, 1, 1)), np.zeros(n, np.int64)
    )
    start = np.diag(np.array([0.02, 0.02, 0.1, 0.2, 0.2, 0.2]) ** 2)
    A = se3.exp(
        np.where(np.isin(np.arange(6), counting), np.sqrt(np.diagonal(start)), 0.0)
        * rng.normal(size=6)
    )
    estimator.load_map(survey, np.eye(4), start)
    nees, squares = [], []
    for step in range(round(100.0 / STEP_S)):
        if step % 20 == 0:
            # Towards the middle wherever it is far from it.
            ahead = (-A[:3, 3]) @ A[:3, :3]
            turn = rng.uniform(-0.5, 0.5)
            if np.linalg.norm(A[:2, 3]) > 6.0:
                turn = 0.5 * np.sign(ahead[1])
        V = np.array([0.0, 0.0, turn, SPEED, 0.0, 0.0])
        if not is_planar:
            V[5] = 0.1 * math.sin(0.05 * step)
        stamp_ns = round(1e9 * STEP_S) * step
        is_counting = np.isin(np.arange(6), counting)
        estimator.add(VelocityEvent(stamp_ns, V + is_counting * noise * rng.normal(size=6)))
        if step % 4 == 0:
            estimator.add(shown_at(rng, stamp_ns, A, points, kinds, flat))
            pose, P = estimator.pose, np.asarray(estimator.pose_covariance)
            off_m = (pose - A)[:3, 3]
            error = np.append(so3.log(pose[:3, :3] @ A[:3, :3].T), off_m)[counting]
            P = P[np.ix_(counting, counting)]
            nees.append(float(error @ np.linalg.solve(P, error)) / len(counting))
            squares.append(float(off_m @ off_m))
        A = A @ se3.exp(STEP_S * V)
    return float(np.mean(nees)), math.sqrt(float(np.mean(squares)))


def shown_at(
    rng: np.random.Generator,
    stamp_ns: int,
    A: FloatArray,
    points: FloatArray,
    kinds: Sequence[int],
    flat: FloatArray,
) -> ObservationEvent:
    """Return three points at random, each of one of the kinds, as seen from the base."""
    rows = rng.permutation(len(points))[:3]
    lines = se3.transform(se3.inverse(A), points[rows])
    ranges_m = np.linalg.norm(lines, axis=1, keepdims=True)
    across = np.cross(lines / ranges_m, rng.normal(size=(3, 3)) * 0.02)
    units = lines / ranges_m + across * flat
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    ranges_m = ranges_m + 0.1 * rng.normal(size=(3, 1))
    of_each = rng.choice(kinds, 3)
    is_range = (of_each == RANGE)[:, None]
    has_range = np.isin(of_each, (POINT, RANGE, AZIMUTH_RANGE))[:, None]
    shown = np.where(is_range, [1.0, 0.0, 0.0], units) * np.where(has_range, ranges_m, 1.0)
    return ObservationEvent(stamp_ns, rows, shown, kinds=of_each)


def row(run: int, is_surveyed: bool) -> str:
    """Drive once; return position error after alignment, ANEES of the position, and CPU time."""
    events, truth, anchors = read(run)
    start = truth.poses[0]
    poses: list[tuple[int, FloatArray]] = []
    nees: list[float] = []

    def note(update: Update) -> None:
        covariance = estimator.pose_covariance
        poses.append((update.stamp_ns, update.pose))
        if covariance is not None and covariance[3, 3] > 0.0:
            at = np.searchsorted(truth.stamps_ns, update.stamp_ns).clip(max=len(truth) - 1)
            off = (update.pose[:3, 3] - truth.poses[at, :3, 3])[:2]
            nees.append(float(off @ np.linalg.solve(covariance[3:5, 3:5], off)) / 2.0)

    estimator = Estimator(shipped_settings('uwb'), initial_pose=start, on_update=note)
    if is_surveyed:
        sigmas = np.array([0.0, 0.0, START_RAD, START_M, START_M, 0.0])
        estimator.load_map(anchors, start, np.diag(sigmas**2))
    start_s = time.process_time()
    for event in events:
        estimator.add(event)
    estimator.flush()
    seconds = time.process_time() - start_s
    estimate = Trajectory.from_samples([each for each, _ in poses], [pose for _, pose in poses])
    ate_m = trajectory_errors(estimate, truth).ate_rmse_m
    name = 'surveyed' if is_surveyed else 'unknown anchors'
    return f'Plaza {run}, {name:16} ATE {ate_m:.3f} m, ANEES {np.mean(nees):.2f}, {seconds:.1f} s'


def read(run: int) -> tuple[list[Event], Trajectory, LandmarkMap]:
    """Return what was recorded in the order of its stamps, the true poses, and the anchors.

    Velocities are the means over the time until the next, which a TwistStamped can't say.
    """
    plaza = load_plaza(DATA, run)
    velocities = zip(plaza.velocity_stamps_ns.tolist(), plaza.body_velocities, strict=True)
    events: list[Event] = [VelocityEvent(*each, is_mean=True) for each in velocities]
    events = sorted([*events, *plaza.observations], key=lambda event: event.stamp_ns)
    truth = Trajectory(plaza.truth_stamps_ns, plaza.true_poses)
    return events, truth, surveyed(plaza.landmarks)


def pose_of(x: float, y: float, yaw: float) -> FloatArray:
    """Return a pose (4, 4) in the plane."""
    return se3.from_rpy((x, y, 0.0, 0.0, 0.0, yaw))


if __name__ == '__main__':
    main()
