"""The columns of the benchmark's tables: estimators under one interface, and how they are run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
import time
from typing import Protocol

from ekf_slam import EkfSlam
from gtsam_baselines import accurate_isam2, default_isam2, optimise_batch
import numpy as np
from odometry import Event, Odometry

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import DESIGNS
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.models.calibration import without_calibration
from slam_observer_ros.settings.estimator_settings import Settings

DEAD_RECKONING = 'dead reckoning'
UNCALIBRATED = 'riccati, no calibration'
SMOOTHED = 'smoothed'
EKF = 'textbook EKF'
ISAM2 = 'iSAM2'
ISAM2_DEFAULT = 'iSAM2, its defaults'
BATCH = 'GTSAM batch'


class OnlineEstimator(Protocol):
    """What every estimator that takes events one by one has to offer."""

    @property
    def pose(self) -> FloatArray:
        """(4, 4) pose after the last observation, body to world."""

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the known landmarks."""

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) their positions, metres, world."""

    def add(self, event: Event) -> object:
        """Take in an event."""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """An estimate right after an observation.

    Attributes
    ----------
    stamp_ns : int
        Of the observation, nanoseconds.
    pose : FloatArray
        (4, 4) body to world.
    ids : IntArray
        (n,) landmarks known so far.
    world_points : FloatArray
        (n, 3) their positions, metres.

    """

    stamp_ns: int
    pose: FloatArray
    ids: IntArray
    world_points: FloatArray


@dataclass(frozen=True, slots=True)
class Run:
    """What an estimator made of a world.

    Attributes
    ----------
    snapshots : list of Snapshot
        After each observation.
    cpu_s : float
        CPU time of the estimator's own calls, seconds.

    """

    snapshots: list[Snapshot]
    cpu_s: float


class DeadReckoning:
    """The velocities alone; landmarks stay where they were first seen.

    What it costs is what integrating the velocities costs the EKF and GTSAM, too.
    """

    def __init__(self, settings: Settings) -> None:
        self._odometry = Odometry(settings)
        self._points: dict[int, FloatArray] = {}
        self.pose = np.eye(4)

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the landmarks seen so far."""
        return np.array(list(self._points), dtype=np.int64)

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) their positions, metres, world."""
        return np.array(list(self._points.values())).reshape(-1, 3)

    def add(self, event: Event) -> None:
        """Take in an event; stamps must not decrease."""
        if isinstance(event, VelocityEvent):
            self._odometry.add(event)
            return
        motion, _ = self._odometry.motion_to(event.stamp_ns)
        self.pose = self.pose @ motion
        points = se3.transform(self.pose, event.points)
        for landmark_id, point in zip(event.ids.tolist(), points, strict=True):
            self._points.setdefault(landmark_id, point)


def observer(gains: str) -> Callable[[Settings], Estimator]:
    """Return what makes the project's estimator with that gain design."""
    return lambda settings: Estimator(replace(settings, gains=gains))


ONLINE: dict[str, Callable[[Settings], OnlineEstimator]] = {
    DEAD_RECKONING: DeadReckoning,
    **{gains: observer(gains) for gains in DESIGNS},
    UNCALIBRATED: lambda settings: observer('riccati')(without_calibration(settings)),
    EKF: EkfSlam,
    ISAM2_DEFAULT: default_isam2,
}
"""Estimators that are run on their own; iSAM2 and batch go together, see :func:`run_gtsam`."""

COLUMNS = (*ONLINE, ISAM2, SMOOTHED, BATCH)
"""All columns, in the order of the tables."""


def run_online(estimator: OnlineEstimator, events: Iterable[Event]) -> Run:
    """Feed events to an estimator and note its estimate after each observation."""
    snapshots = []
    cpu_s = 0.0
    start_s = time.process_time()
    for event in events:
        estimator.add(event)
        if isinstance(event, ObservationEvent):
            cpu_s += time.process_time() - start_s
            ids, points = estimator.landmark_ids.copy(), estimator.world_points.copy()
            snapshots.append(Snapshot(event.stamp_ns, estimator.pose.copy(), ids, points))
            # Not at each event: looking at the clock costs a quarter of what a velocity does.
            start_s = time.process_time()
    return Run(snapshots, cpu_s + time.process_time() - start_s)


def run_smoothed(settings: Settings, events: list[Event]) -> Run:
    """Run the Riccati observer, then smooth everything; each snapshot holds the final map."""
    estimator = Estimator(replace(settings, gains='riccati', smoothing_window=0))
    start_s = time.process_time()
    for event in events:
        estimator.add(event)
    result = estimator.smooth()
    cpu_s = time.process_time() - start_s
    snapshots = [
        Snapshot(stamp_ns, pose, result.ids, result.world_points)
        for stamp_ns, pose in zip(result.stamps_ns.tolist(), result.poses, strict=True)
    ]
    return Run(snapshots, cpu_s)


def run_gtsam(settings: Settings, events: list[Event]) -> dict[str, Run]:
    """Run iSAM2, then optimise the batch from its last estimate; that start is not timed."""
    isam2 = accurate_isam2(settings)
    online = run_online(isam2, events)
    start_s = time.process_time()
    poses, points = optimise_batch(events, settings, isam2)
    cpu_s = time.process_time() - start_s
    snapshots = [
        replace(snapshot, pose=pose, world_points=points, ids=isam2.landmark_ids)
        for snapshot, pose in zip(online.snapshots, poses, strict=True)
    ]
    return {ISAM2: online, BATCH: Run(snapshots, cpu_s)}
