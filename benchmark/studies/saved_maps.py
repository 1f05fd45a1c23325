"""What correlations in a saved map are worth to the next run, simulated, and what they take.

``python benchmark/studies/saved_maps.py`` prints the tables of docs/localise_in_a_map.md. A robot
maps most of a loop and saves the map; later it starts somewhere, finds itself in it, and goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
import multiprocessing
import os
from pathlib import Path
import sys
import tempfile
import time

import _above  # noqa: F401 (finds the modules of the folder above)
import numpy as np
from odometry import Event
import tags
from worlds import drive, Loop, simulated_settings, World

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import axes_of
from slam_observer_ros.lie.matrices import diagonal_blocks, transpose
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.models.calibration import without_calibration
from slam_observer_ros.runs.metrics import (
    ConfigurationError,
    normalised_squared_errors,
    pose_errors,
)

MAPPED_S, LOCALISED_S, CHECKPOINT_S = 50.0, 60.0, 2.0

TAGS = '3D, tags'
TAG_CASE, TAGS_IN_VIEW = tags.Case('', sigma_rad=0.05), 2

LOOPS = {
    '3D stereo': Loop('stereo_inertial', 60.0, MAPPED_S + LOCALISED_S, 20, 6.0, 5),
    'wheeled': Loop('wheeled_bearing_range', 60.0, MAPPED_S + LOCALISED_S, 20, 6.0, 5),
}
"""The map is saved before the loop is closed, when its ends know little of each other."""

ERRORS = ('correlated', 'independent')
SIZES = (100, 500, 1000)


@dataclass(frozen=True, slots=True)
class Job:
    """One run in a saved map."""

    loop: str
    errors: str
    seed: int


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').splitlines()[0])
    parser.add_argument('--seeds', type=int, default=50, help='runs a row')
    args = parser.parse_args()
    os.environ['OMP_NUM_THREADS'] = os.environ['OPENBLAS_NUM_THREADS'] = '1'
    rows = list(product((*LOOPS, TAGS), ERRORS))
    jobs = [Job(*row, seed) for row in rows for seed in range(args.seeds)]
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn')) as pool:
        figures = np.array(list(pool.map(run, jobs))).reshape(len(rows), args.seeds, -1)
    sys.stdout.write('\n'.join([*table(rows, figures), '', *file_table()]) + '\n')


def table(rows: list[tuple[str, str]], figures: FloatArray) -> Iterator[str]:
    """Yield the lines of the table, for the figures (rows, seeds, 4) of all runs."""
    yield (
        '| loop | errors of the map | position error | heading error | ANEES of the pose '
        '| ANEES of pose and landmarks |'
    )
    yield '| --- | --- | --- | --- | --- | --- |'
    for row, of_runs in zip(rows, figures, strict=True):
        mean = np.nanmean(of_runs, axis=0)
        position_m, turn_rad = np.sqrt(mean[:2])
        errors = f'{100.0 * position_m:.1f} cm | {np.degrees(turn_rad):.2f}°'
        yield f'| {" | ".join(row)} | {errors} | {mean[2]:.2f} | {mean[3]:.2f} |'


def file_table() -> Iterator[str]:
    """Yield the lines of the table of what files take."""
    yield '| landmarks | file | without correlations | to write | to read |'
    yield '| --- | --- | --- | --- | --- |'
    for n in SIZES:
        root = np.random.default_rng(0).normal(scale=0.01, size=(3 * n, 3 * n + 3))
        joint, points = root @ root.T, 10.0 * root[:, :3].reshape(n, 9)[:, :3]
        covariances = diagonal_blocks(joint, 3).copy()
        known = LandmarkMap(np.arange(n), points, covariances, np.full(n, 9))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'map.yaml'
            write_map(path, known, None)
            without_mb = path.stat().st_size / 1e6
            start_s = time.process_time()
            write_map(path, replace(known, joint_covariance=joint), None)
            written_s = time.process_time()
            read_map(path)
            read_s = time.process_time()
            megabytes = f'{path.stat().st_size / 1e6:.1f} MB | {without_mb:.2f} MB'
        yield f'| {n} | {megabytes} | {written_s - start_s:.1f} s | {read_s - written_s:.1f} s |'


def run(job: Job) -> FloatArray:
    """Return squared errors of position and heading, m² and rad², and the NEES of two kinds."""
    if job.loop == TAGS:
        world, events = tags.drive_past_tags(TAG_CASE, TAGS_IN_VIEW, job.seed)
        settings = tags.settings_of(TAG_CASE, world)
        turned = tags.tilted_tags(len(world.landmarks.ids), tags.orientation_rng(job.seed))
    else:
        settings = without_calibration(simulated_settings(LOOPS[job.loop].config))
        world, turned = drive(LOOPS[job.loop], settings, job.seed), None
        events = world.events
    first = Estimator(settings)
    for event in between(events, 0.0, MAPPED_S):
        first.add(event)
    known = saved(first.landmark_map)
    frame = frame_of(known, world.landmarks.world_points, turned, settings.two_d_mode)
    if job.errors == 'independent':
        known = replace(known, joint_covariance=None)
    second = Estimator(replace(settings, localization_mode='uncertain'))
    second.load_map(known)
    figures, due_s = [], MAPPED_S
    for event in between(events, MAPPED_S, MAPPED_S + LOCALISED_S):
        second.add(event)
        is_due = isinstance(event, ObservationEvent) and event.stamp_ns >= due_s * 1e9
        if is_due and second.is_localised:
            figures.append(compared(second, world, frame, event.stamp_ns))
            due_s += CHECKPOINT_S
    return np.asarray(np.mean(figures, axis=0))


def between(events: Sequence[Event], from_s: float, to_s: float) -> list[Event]:
    """Return the events of a part of a run that begins at stamp 0."""
    return [event for event in events if from_s <= event.stamp_ns * 1e-9 <= to_s]


def saved(landmark_map: LandmarkMap) -> LandmarkMap:
    """Return a map as it comes out of a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.yaml'
        write_map(path, landmark_map, None)
        return read_map(path)


def frame_of(
    known: LandmarkMap, true_points: FloatArray, turned: FloatArray | None, two_d_mode: bool
) -> FloatArray:
    """Return the map's frame (4, 4) in the world: what its landmarks say, by their covariance.

    Of all landmarks by id: ``true_points`` (…, 3), and how tags are ``turned`` (…, 3, 3).
    """
    axes, truth, at = axes_of(two_d_mode), true_points[known.ids], known.tags
    P = known.landmarks_in(np.eye(4), 0.0).joint_on(axes)
    # Of the error of a map's shape P says that it is at right angles to p directions.
    N = np.linalg.eigh(P)[1][:, : axes.p]
    T = rigid_alignment(truth, known.world_points)
    for _ in range(5):
        errors = (known.world_points - se3.transform(T, truth))[:, : axes.point].ravel()
        G = axes.output_matrix(known.world_points).reshape(-1, axes.p)
        if turned is not None and known.orientations is not None:
            there = T[:3, :3] @ turned[known.ids[at]]
            turns = axes.turns(so3.log(known.orientations[at] @ transpose(there)))
            errors = np.append(errors, turns)
            G = np.vstack([G, np.tile(np.eye(axes.turn, axes.p), (len(at), 1))])
        T = se3.exp(axes.full_pose(np.linalg.solve(N.T @ G, N.T @ errors))) @ T
    return T


def compared(
    estimator: Estimator, world: World, frame: FloatArray, stamp_ns: int
) -> tuple[float, float, float, float]:
    """Return what :func:`run` does, of one instant."""
    pose = frame @ world.truth.poses[np.searchsorted(world.truth.stamps_ns, stamp_ns)]
    truth = world.landmarks.world_points
    error = pose_errors(estimator.pose, pose)
    covariance = estimator.pose_covariance
    if covariance is None:
        raise ValueError('it takes gains that know their errors')
    nees, freedom = normalised_squared_errors(error, covariance)
    configuration = ConfigurationError()
    configuration.add(
        stamp_ns,
        estimator.pose,
        estimator.landmark_ids,
        estimator.world_points,
        pose,
        replace(world.landmarks, world_points=se3.transform(frame, truth)),
        estimator.configuration_covariance,
    )
    squares = float(np.sum(error[3:] ** 2)), float(error[2] ** 2)
    return *squares, float(nees / freedom), configuration.anees or float('nan')


if __name__ == '__main__':
    main()
