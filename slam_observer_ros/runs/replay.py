"""Events of a recording through the estimator, and how good what comes of it is.

What is measured is the *online* estimate: the pose as it was known at each moment, from the events
received until then, never smoothed. The trajectory is sampled at the stamps of velocities and
observations alike, so that stretches in which nothing is seen count too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import logging
import time
from typing import ParamSpec, Protocol, runtime_checkable

import numpy as np

from slam_observer_ros.common.errors import EvaluationError, UsageError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import RangePower, Smoothed, Update, used_points
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityBlock
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.calibration import DELAY, MOVES, OF_VELOCITY, stated_of_velocity
from slam_observer_ros.models.sensing import RangeErrors
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.trajectory import (
    filled,
    interpolate,
    LandmarkTracks,
    Trajectory,
    Truth,
)
from slam_observer_ros.runs.metrics import (
    anchored_average_nees,
    ConfigurationError,
    landmark_errors,
    trajectory_errors,
    TrajectoryErrors,
)
from slam_observer_ros.runs.recorders import DeadReckoning, PoseSamples, RunRecorder
from slam_observer_ros.settings.estimator_settings import Settings

logger = logging.getLogger(__name__)

P = ParamSpec('P')

MOST_UNCOMPARED = 64
"""Observations that are compared with the truth at once: one by one costs three times as much."""

NEES_PERIOD_NS = 5_000_000_000
"""Time between two covariances of the configuration, nanoseconds: they cost O(n³)."""


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What came of a replay; since the last reset, if the clock jumped.

    Attributes
    ----------
    estimator : Estimate
        In its final state, with the map and the events dropped.
    trajectory, pose_covariances : Trajectory, FloatArray or None
        k poses of the online estimate, and (k, 6, 6) :attr:`.Estimator.pose_covariance` of each;
        None without truth to compare their errors with.
    dead_reckoning : Trajectory
        What the velocities alone give, from the identity pose.
    configuration : ConfigurationError
        Gauge-free error after each observation; empty without truth.
    seconds : float
        CPU time of the estimator alone, without reading and measuring.
    start_ns : int
        Stamp of the first event that was used, nanoseconds; 0 if none was.
    range_power : RangePower or None
        How ranges grow with the cosine of the angle off the sensor's axis.
    localised_ns : (int, int) or None
        First and last stamp at which the pose in its final frame was known; None if it never was.
    events, observations, angular_velocities : int
        Events, dropped ones included; observations with points that were used; angular velocities
        of an Imu that were taken in: all of them also before the last reset.

    """

    estimator: Estimate
    trajectory: Trajectory
    pose_covariances: FloatArray | None
    dead_reckoning: Trajectory
    configuration: ConfigurationError
    events: int
    seconds: float
    in_known_map: bool
    start_ns: int
    localised_ns: tuple[int, int] | None
    range_power: RangePower | None
    observations: int
    angular_velocities: int

    @property
    def resets(self) -> int:
        """How often the estimator was reset by a jump of the clock."""
        resets = self.estimator.settings.on_time_jump == 'reset'
        return self.estimator.jumps if resets else 0

    def seconds_until(self, stamp_ns: int) -> float:
        """Return the time from the first event to a stamp, seconds."""
        return to_s(stamp_ns - self.start_ns)


class Recorder(Protocol):
    """Notes of a run what is shown or written."""

    def note_update(self, update: Update) -> None:
        """Take in an observation, with its innovation."""

    def clear(self) -> None:
        """Forget all: the run has started again."""


@runtime_checkable
class StampRecorder(Recorder, Protocol):
    """Looks at the state of each stamp, too: events are then used one by one."""

    def note_stamp(self, estimator: Estimator) -> None:
        """Take in the state when all events of a stamp have been used."""


def replay(
    events: Iterable[Event | VelocityBlock],
    settings: Settings,
    truth: Truth | None = None,
    landmark_map: LandmarkMap | Sequence[LandmarkMap] | None = None,
    keep_all: bool = True,
    recorders: Sequence[Recorder | StampRecorder] = (),
) -> Replay:
    """Run events through an estimator, from where the settings say, or in known maps.

    The events are in the order in which they were received; the truth is what the configuration
    error is measured against. Where not all is kept, memory does not grow with the recording:
    there are no poses, and of dead reckoning the first and the last.
    What ``recorders`` note is shown or written.
    """
    run = _RunningReplay(settings, truth, landmark_map, keep_all, recorders)
    for event in events:
        run.add(event)
    return run.finish()


class _RunningReplay:
    """Keeps what the metrics need, and the estimator's time apart from it."""

    def __init__(
        self,
        settings: Settings,
        truth: Truth | None,
        landmark_map: LandmarkMap | Sequence[LandmarkMap] | None,
        keep_all: bool,
        recorders: Sequence[Recorder | StampRecorder],
    ) -> None:
        self._settings = settings
        self._keep_all = keep_all
        self._recorders = recorders
        self._stamp_recorders = [each for each in recorders if isinstance(each, StampRecorder)]
        self._estimator = Estimator(
            settings,
            on_update=self._untimed(self._on_update),
            on_stamps=self._untimed(self._on_stamps),
            on_motion=self._untimed(self._on_motion),
            on_jump=self._untimed(self._on_jump),
            judges_innovations=bool(recorders),
            keeps_outcomes=any(isinstance(each, RunRecorder) for each in recorders),
        )
        self._in_known_map = landmark_map is not None
        self._in_fixed_map = self._in_known_map and settings.localization_mode == 'fixed'
        if landmark_map is not None:
            self._estimator.load_map(landmark_map)
        self._landmark_tracks = truth.tracks if truth else None
        self._pose_truth = Trajectory(truth.stamps_ns, truth.poses) if truth else None
        self._observations = self._used_points = self._angular_velocities = 0
        self._events = 0
        self._seconds = 0.0
        self._clear_figures()

    def _clear_figures(self) -> None:
        self._samples = PoseSamples()
        self._dead_reckoning = DeadReckoning(self._keep_all)
        self._configuration = ConfigurationError()
        self._ranges = RangeErrors(self._settings.two_d_mode)
        # Updates, with ids (n,) and positions (n, 3) of the landmarks, that await the truth.
        self._uncompared: list[tuple[Update, IntArray, FloatArray]] = []
        self._start_ns: int | None = None
        self._localised_ns: tuple[int, int] | None = None
        self._next_nees_ns = 0

    def add(self, event: Event | VelocityBlock) -> None:
        if not isinstance(event, VelocityBlock):
            self._add_event(event)
        elif self._stamp_recorders:
            for velocity in event.events():
                self._add_event(velocity)
        else:
            self._events += len(event)
            start_s = time.thread_time()
            self._estimator.add_velocities(event)
            self._seconds += time.thread_time() - start_s

    def _add_event(self, event: Event) -> None:
        self._events += 1
        if isinstance(event, ObservationEvent):
            self._ranges.note_event(event)
        start_s = time.thread_time()
        is_taken = self._estimator.add(event)
        self._seconds += time.thread_time() - start_s
        self._angular_velocities += is_taken and isinstance(event, AngularVelocityEvent)

    def finish(self) -> Replay:
        start_s = time.thread_time()
        self._estimator.flush()
        self._seconds += time.thread_time() - start_s
        if self._pose_truth is not None and self._landmark_tracks is not None:
            self._compare(self._pose_truth, self._landmark_tracks, is_nees_due=False)
        return Replay(
            estimator=self._estimator,
            trajectory=self._samples.trajectory,
            pose_covariances=self._samples.covariances,
            dead_reckoning=self._dead_reckoning.trajectory,
            configuration=self._configuration,
            events=self._events,
            seconds=self._seconds,
            in_known_map=self._in_known_map,
            start_ns=self._start_ns or 0,
            localised_ns=self._localised_ns,
            range_power=self._ranges.power,
            observations=self._observations,
            angular_velocities=self._angular_velocities,
        )

    def _untimed(self, callback: Callable[P, None]) -> Callable[P, None]:
        """Return a callback whose time is not counted as the estimator's."""

        def call(*args: P.args, **kwargs: P.kwargs) -> None:
            start_s = time.thread_time()
            callback(*args, **kwargs)
            self._seconds -= time.thread_time() - start_s

        return call

    def _on_stamps(self, stamps_ns: IntArray) -> None:
        first_ns, last_ns = stamps_ns[[0, -1]].tolist()
        if self._start_ns is None:
            self._start_ns = first_ns
        for recorder in self._stamp_recorders:
            recorder.note_stamp(self._estimator)
        if not self._estimator.is_localised:
            return
        if self._localised_ns is not None:
            first_ns = self._localised_ns[0]
        self._localised_ns = first_ns, last_ns
        if self._keep_all and len(due_ns := stamps_ns[self._samples.due(stamps_ns)]):
            has_truth = self._pose_truth is not None and len(self._pose_truth) > 0
            self._samples.add(due_ns, *self._estimator.poses_at(due_ns, has_truth))

    def _on_motion(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        self._dead_reckoning.advance(velocities, start_ns, end_ns)

    def _on_update(self, update: Update) -> None:
        for recorder in self._recorders:
            recorder.note_update(update)
        known, world_points = self._estimator.landmark_ids, self._estimator.world_points
        self._ranges.note_update(update, known, world_points)
        used = used_points(self._estimator.counts)
        self._observations += used > self._used_points
        self._used_points = used
        if self._pose_truth is None or self._landmark_tracks is None:
            return
        # What is compared with the truth is kept; it is compared now if a covariance may be due.
        self._uncompared.append((update, known, world_points))
        has_errors = len(known) > 0 and not self._in_fixed_map
        is_nees_due = has_errors and update.stamp_ns >= self._next_nees_ns
        if is_nees_due or len(self._uncompared) == MOST_UNCOMPARED:
            self._compare(self._pose_truth, self._landmark_tracks, is_nees_due)

    def _on_jump(self) -> None:
        self._next_nees_ns = 0
        if self._settings.on_time_jump == 'reset':
            self._clear_figures()
            for recorder in self._recorders:
                recorder.clear()

    def _compare(self, poses: Trajectory, tracks: LandmarkTracks, is_nees_due: bool) -> None:
        """Compare what is kept with the truth; a covariance is known of the last of it."""
        kept, self._uncompared = self._uncompared, []
        stamps_ns = np.array([update.stamp_ns for update, *_ in kept], dtype=np.int64)
        true_poses, covered = interpolate(poses, stamps_ns)
        for row in np.flatnonzero(covered).tolist():
            update, ids, points = kept[row]
            covariance_of = None
            if is_nees_due and row == len(kept) - 1:
                self._next_nees_ns = update.stamp_ns + NEES_PERIOD_NS
                covariance_of = self._estimator.configuration_covariance
            self._configuration.add(
                update.stamp_ns,
                update.pose,
                ids,
                points,
                true_poses[row],
                tracks.at(update.stamp_ns),
                covariance_of,
                update.ids[~update.rejected],
            )


STILL = 1e-12
"""Change of a pose, m and rad, below which it is rounding: a robot at rest has no bias."""


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """Errors of a replay; None where the truth that it takes is not in the recording.

    Poses, dead reckoning and the map are each compared after one rigid alignment of
    their own; the configuration (:class:`.ConfigurationError`) takes none. ``anees`` of the pose
    is also None where the gains know no covariance, and where no pose is certain to which the
    truth could be moved: in a known map, or if the truth begins too late. ``configuration_anees``
    needs no certain pose, but a joint covariance.
    """

    pose_errors: TrajectoryErrors | None
    dead_reckoning_errors: TrajectoryErrors | None
    landmark_rmse_m: float | None
    configuration_rmse_m: float | None
    anees: float | None
    configuration_anees: float | None


def measure(run: Replay, truth: Truth) -> Accuracy:
    """Compare what came of a replay with the truth."""
    pose_truth, estimator = Trajectory(truth.stamps_ns, truth.poses), run.estimator
    errors = (
        _pose_errors('trajectory', run.trajectory, pose_truth),
        _pose_errors('dead reckoning', run.dead_reckoning, pose_truth),
        _landmark_rmse_m(estimator.landmark_ids, estimator.world_points, truth),
    )
    anees = None
    if not run.in_known_map and (covariances := run.pose_covariances) is not None:
        with _unknown_if_unfit('unknown_anees'):
            anees = anchored_average_nees(run.trajectory, covariances, pose_truth)
    return Accuracy(*errors, run.configuration.rmse_m, anees, run.configuration.anees)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """What was smoothed, and its errors as :class:`Accuracy` has them.

    The trajectory is at the stamps of the online one since the first of these observations, and
    ``online_errors`` are of that part.
    """

    estimate: Smoothed
    trajectory: Trajectory
    pose_errors: TrajectoryErrors | None
    online_errors: TrajectoryErrors | None
    landmark_rmse_m: float | None


def smoothed_run(run: Replay, truth: Truth) -> SmoothedRun:
    """Smooth trajectory and map; raise a UsageError if there is no observation to smooth."""
    estimator, online = run.estimator, run.trajectory
    smoothed, stamps_ns = estimator.smooth(), online.stamps_ns
    if not len(smoothed.stamps_ns):
        raise UsageError(f'nothing to smooth: no observation since {smoothed.since}')
    parked = estimator.counts['parked_observation']
    if len(smoothed.stamps_ns) + parked < run.observations:
        stamps_ns = stamps_ns[stamps_ns >= smoothed.stamps_ns[0]]
        logger.warning(
            'Only the last %d observations are smoothed: those since %s.',
            len(smoothed.stamps_ns),
            smoothed.since,
        )
    trajectory = smoothed_trajectory(smoothed, stamps_ns, run.dead_reckoning, estimator)
    pose_truth = Trajectory(truth.stamps_ns, truth.poses)
    same = np.isin(online.stamps_ns, trajectory.stamps_ns)
    before = Trajectory(online.stamps_ns[same], online.poses[same])
    return SmoothedRun(
        smoothed,
        trajectory,
        _pose_errors('smoothed trajectory', trajectory, pose_truth),
        _pose_errors('trajectory before smoothing', before, pose_truth),
        _landmark_rmse_m(smoothed.ids, smoothed.world_points, truth),
    )


def smoothed_trajectory(
    smoothed: Smoothed,
    stamps_ns: IntArray,
    dead_reckoning: Trajectory,
    estimator: Estimate,
) -> Trajectory:
    """Return the smoothed poses at any stamps (m,), such as the online trajectory's.

    Between observations, and beyond the first and last one, the robot moved as the velocities
    have it by the calibration of an ``estimator``.
    """
    estimate = Trajectory.from_samples(smoothed.stamps_ns.tolist(), list(smoothed.poses))
    return filled(estimate, _calibrated(dead_reckoning, estimator), stamps_ns)


def _calibrated(motion: Trajectory, estimator: Estimate) -> Trajectory:
    """Return dead reckoning as it is with the scales, biases and the delay of the velocities."""
    if len(motion) < 2:
        return motion
    values = stated_of_velocity(estimator.settings)
    found = {estimate.name: estimate.value for estimate in estimator.calibration}
    for entry in OF_VELOCITY:
        values[entry.place] = found.get(entry.name, values[entry.place])
    rates = values[:DELAY].reshape(6, 7)
    dt_s = to_s(np.diff(motion.stamps_ns))[:, None]
    twists = se3.log(se3.inverse(motion.poses[:-1]) @ motion.poses[1:])
    moves = np.abs(twists).max(axis=1, keepdims=True) > STILL
    biases = rates[:, MOVES] * np.where(moves, dt_s, 0.0)
    poses = se3.path(motion.poses[0], twists @ rates[:, :MOVES].T + biases)
    return Trajectory(motion.stamps_ns + to_ns(values[DELAY]), poses)


def _pose_errors(name: str, estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors | None:
    with _unknown_if_unfit('uncompared', figure=name):
        return trajectory_errors(estimate, truth) if len(truth) else None
    return None


def _landmark_rmse_m(ids: IntArray, world_points: FloatArray, truth: Truth) -> float | None:
    if truth.landmarks is None or (len(ids) and is_automatic(ids).all()):
        return None  # landmarks without ids of their own have no counterpart
    with _unknown_if_unfit('uncompared', figure='map'):
        return landmark_errors(ids, world_points, truth.landmarks).rmse_m
    return None


@contextmanager
def _unknown_if_unfit(kind: str, **figures: str) -> Iterator[None]:
    """Log, as a finding of a kind, what can't be compared."""
    try:
        yield
    except EvaluationError as error:
        logger.warning('%s', found(kind, error=error, **figures))
