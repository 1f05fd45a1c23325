"""Events of a recording through the estimator.

What is measured is the *online* estimate: the pose as it was known at each moment, from the events
received until then, never smoothed. The trajectory is sampled at the stamps of velocities and
observations alike, so that stretches in which nothing is seen count too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import time
from typing import ParamSpec, Protocol, runtime_checkable

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Update, used_points
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityBlock
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.sensing import RangeErrors
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.trajectory import interpolate, LandmarkTracks, Trajectory, Truth
from slam_observer_ros.runs.metrics import ConfigurationError
from slam_observer_ros.runs.reported_run import Replay, RunRecorder
from slam_observer_ros.runs.sampling import DeadReckoning, TrajectorySampler
from slam_observer_ros.settings.estimator_settings import Settings

P = ParamSpec('P')

MOST_UNCOMPARED = 64
"""Observations that are compared with the truth at once: one by one costs three times as much."""

NEES_PERIOD_NS = 5_000_000_000
"""Time between two covariances of the configuration, nanoseconds: they cost O(n³)."""


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
    there are no poses, of dead reckoning the first and the last, and no residuals.
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
        self._sampler = TrajectorySampler()
        self._dead_reckoning = DeadReckoning(self._keep_all)
        self._configuration = ConfigurationError()
        self._updates: list[Update] = []
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
        updates = self._updates
        counts = np.array([len(update.residuals) for update in updates], dtype=np.int64)
        stamps_ns = np.array([update.stamp_ns for update in updates], dtype=np.int64)
        no_points, none = np.empty((0, 3)), np.empty(0, dtype=np.bool_)
        return Replay(
            estimator=self._estimator,
            trajectory=self._sampler.trajectory,
            pose_covariances=self._sampler.covariances,
            dead_reckoning=self._dead_reckoning.trajectory,
            configuration=self._configuration,
            residual_stamps_ns=np.repeat(stamps_ns, counts),
            residuals=np.concatenate([no_points, *(update.residuals for update in updates)]),
            rejected=np.concatenate([none, *(update.rejected for update in updates)]),
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
        if self._keep_all and len(due_ns := self._sampler.due(stamps_ns)):
            has_truth = self._pose_truth is not None and len(self._pose_truth) > 0
            self._sampler.add(due_ns, *self._estimator.poses_at(due_ns, has_truth))

    def _on_motion(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        self._dead_reckoning.advance(velocities, start_ns, end_ns)

    def _on_update(self, update: Update) -> None:
        if self._keep_all:
            self._updates.append(update)
        for recorder in self._recorders:
            recorder.note_update(update)
        known, world_points = self._estimator.landmark_ids, self._estimator.world_points
        self._ranges.note_update(update, known, world_points)
        self._count_observation()
        self._compare_with_truth(update, known, world_points)

    def _on_jump(self) -> None:
        self._next_nees_ns = 0
        if self._settings.on_time_jump == 'reset':
            self._clear_figures()
            for recorder in self._recorders:
                recorder.clear()

    def _count_observation(self) -> None:
        used = used_points(self._estimator.counts)
        self._observations += used > self._used_points
        self._used_points = used

    def _compare_with_truth(self, update: Update, ids: IntArray, points: FloatArray) -> None:
        """Keep what is compared with the truth; compare it now if a covariance may be due."""
        if self._pose_truth is None or self._landmark_tracks is None:
            return
        self._uncompared.append((update, ids, points))
        has_errors = len(ids) > 0 and not self._in_fixed_map
        is_nees_due = has_errors and update.stamp_ns >= self._next_nees_ns
        if is_nees_due or len(self._uncompared) == MOST_UNCOMPARED:
            self._compare(self._pose_truth, self._landmark_tracks, is_nees_due)

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
