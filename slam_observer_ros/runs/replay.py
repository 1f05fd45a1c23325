"""A recording through the estimator: from a :class:`.Request` to its :class:`.Result`.

What is measured is the *online* estimate: the pose as it was known at each moment, from the events
received until then, never smoothed. The trajectory is sampled at the stamps of velocities and
observations alike, so that stretches in which nothing is seen count too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
import logging
import time
from typing import ParamSpec, Protocol, runtime_checkable, TypeAlias

import numpy as np

from slam_observer_ros.common.errors import EvaluationError, UsageError
from slam_observer_ros.common.findings import Finding, found, Level, muted_warnings
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import Reason, Smoothed, Update, used_points
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import AngularVelocityEvent, Event, ObservationEvent, VelocityBlock
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_maps
from slam_observer_ros.models.calibration import DELAY, MOVES, OF_VELOCITY, stated_of_velocity
from slam_observer_ros.models.sensing import RangeErrors
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.trajectory import filled, interpolate, Trajectory, Truth
from slam_observer_ros.runs.estimate_writer import estimate_writer
from slam_observer_ros.runs.metrics import (
    anchored_average_nees,
    ConfigurationError,
    landmark_rmse_m,
    trajectory_errors,
    TrajectoryErrors,
)
from slam_observer_ros.runs.mistakes import judgeable, LEAST_DRIVEN_S, leaves_mount_open, mistakes
from slam_observer_ros.runs.recorders import DeadReckoning, NisTally, PoseSamples, RunRecorder
from slam_observer_ros.runs.result import Replay, Request, Result, SmoothedRun
from slam_observer_ros.runs.run_health import judged, of_use, unused_messages
from slam_observer_ros.settings.estimator_settings import Settings

logger = logging.getLogger(__name__)

P = ParamSpec('P')

MOST_UNCOMPARED = 64  # observations compared with the truth at once, in a third of the time
NEES_PERIOD_NS = 5_000_000_000  # between two covariances of the configuration, which cost O(n³)


Events: TypeAlias = Iterable[Event | VelocityBlock]


def result_of(
    request: Request, show_progress: Callable[[Events, int], Events] | None = None
) -> Result:
    """Replay a recording; refuse an outcome without what is asked of it.

    What gives reason to warn is logged. ``show_progress`` passes on events, of so many in all.
    """
    settings, map_path = request.settings, request.load_map
    if settings.localization_mode != 'off' and map_path is None:
        logger.warning(
            "No map is loaded, so localization_mode '%s' has no effect (use --load-map).",
            settings.localization_mode,
        )
    maps: Sequence[LandmarkMap] = () if map_path is None else read_maps(map_path)
    with Recording(request.recording) as recording:
        selected, inputs, truth = request.select_inputs(recording)
        map_frame = maps[0].frame_id if maps else inputs.map_frame
        events: Events = recording.blocks(selected, inputs, settings.velocity_timeout)
        if show_progress is not None:
            events = show_progress(events, recording.event_count(selected))
        notes = RunRecorder()
        tally = notes if request.keeps_run else NisTally()
        needs_poses = request.keeps_poses or request.keeps_run or len(truth.stamps_ns) > 0

        def look_for_mistakes(of_mount_only: bool = False) -> list[Finding]:
            """Read the recording again, and look whether a mistake of the set-up explains it."""
            estimator, may_be_mount = run.estimator, leaves_mount_open(settings)
            if not estimator.jumps:
                may_be_mount &= run.seconds_until(estimator.stamp_ns or 0) >= LEAST_DRIVEN_S
            if not run.has_points or (of_mount_only and not may_be_mount):
                return []
            with muted_warnings(), Recording(request.recording) as again:
                events = again.events(selected, inputs, settings.velocity_timeout)
                return mistakes(settings, events, maps or None, of_mount_only)

        with estimate_writer(request, recording, selected, inputs, map_frame) as writer:
            recorders: list[Recorder] = [] if writer is None else [writer]
            recorders += [tally] if request.keeps_run or request.keeps_nis else []
            run = replay(events, settings, truth, maps or None, needs_poses, recorders)
            unused = list(of_use(recording, selected, inputs, run))
            needs_some = request.smooth or request.keeps_map or map_path is not None
            for finding in unused:
                if needs_some and finding.kind in ('no_observation', 'nothing_used'):
                    raise UsageError(
                        f'{finding.what}; --smooth, --map and --load-map need some: '
                        f'{finding.remedy}'
                    )
            if maps and not run.estimator.is_localised:
                _check_localised(request, run, maps, look_for_mistakes)
            result = Result(
                run,
                selected,
                truth,
                *_errors(run, truth),
                recording.duration_s,
                unused_messages(recording, selected),
                recording.contents.missing_ids(selected.landmarks),
                recording.loss,
                map_frame,
                tally.mean_nis,
                notes.innovations,
                notes.finish(run.estimator) if request.keeps_run else (),
            )
            if writer is not None:
                writer.finish(result)
        findings = judged(result, recording, inputs, unused, map_path, look_for_mistakes)
    for finding in findings:
        if finding.level >= Level.WARNING:
            logger.warning('%s', finding)
    smoothed = smoothed_run(run, truth) if request.smooth else None
    if map_frame != request.inputs.map_frame:
        logger.warning(
            "The map is in frame '%s', and so is what is written; the node takes it with "
            'map_frame: %s only.',
            map_frame,
            map_frame,
        )
    return replace(result, judged=findings, smoothed=smoothed)


def _check_localised(
    request: Request,
    run: Replay,
    maps: Sequence[LandmarkMap],
    look_for_mistakes: Callable[[], Sequence[Finding]],
) -> None:
    """Refuse an outcome that is not in the frame of the map that was loaded.

    Where the pose in it was found and lost again the trajectory is still of use, but not the map:
    a UsageError says if the pose was never found, or not at the end and the map is asked for.
    """
    if run.localised_ns is None:
        why = '; '.join(map(str, look_for_mistakes())) or _never_found(run, maps)
        raise UsageError(f'the pose in the map {request.load_map} was not found: {why}')
    if request.keeps_map or request.smooth:
        end_s = run.seconds_until(run.localised_ns[1])
        raise UsageError(
            f'the pose in the map {request.load_map} was lost after {end_s:.1f} s, and not found '
            'again; --map and --smooth need it at the end'
        )


def _never_found(run: Replay, maps: Sequence[LandmarkMap]) -> str:
    """Say why the landmarks seen did not determine the pose, and what to do."""
    estimator, counts, settings = run.estimator, run.estimator.counts, run.estimator.settings
    if counts['unknown_id']:
        advice = f'; {counts["unknown_id"]} points without id take --gains riccati'
    elif 2 * counts['repeated_id'] > counts['observed_point']:
        advice = f'; {counts["repeated_id"]} points were {Reason.REPEATED_ID.words}'
    elif settings.set_initial_pose:
        advice = '; they contradict the pose that was given'
    else:
        advice = (
            '. Where the start is known: --set set_initial_pose=true '
            '--set initial_pose=[X,Y,Z,ROLL,PITCH,YAW]'
        )
    problem = estimator.localisation_problem
    if problem and problem.kind in ('other_hall', 'other_ids'):
        return f'{problem.what}; {problem.remedy}'
    if problem and (is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses)):
        return f'{problem.what}{advice}'
    least = 'two' if settings.two_d_mode else 'three'
    ids = np.concatenate([known.ids for known in maps])
    seen = np.isin(ids[~is_automatic(ids)], estimator.landmark_ids).sum()
    return (
        f'that takes {least} of its landmarks or more, recognised by their ids, well apart, and '
        f'seen where the map has them; {seen} of its {len(ids)} were seen{advice}'
    )


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
        self._settings, self._keep_all, self._recorders = settings, keep_all, recorders
        self._stamp_recorders = [each for each in recorders if isinstance(each, StampRecorder)]
        self._estimator = Estimator(
            settings,
            on_update=self._untimed(self._on_update),
            on_stamps=self._untimed(self._on_stamps),
            on_motion=self._untimed(lambda *motion: self._dead_reckoning.advance(*motion)),
            on_jump=self._untimed(self._on_jump),
            judges_innovations=bool(recorders),
            keeps_outcomes=any(isinstance(each, RunRecorder) for each in recorders),
        )
        self._in_known_map = landmark_map is not None
        if landmark_map is not None:
            self._estimator.load_map(landmark_map)
        self._pose_truth = truth.trajectory if truth else None
        self._landmark_tracks = truth.tracks if truth else None
        self._events = self._observations = self._used_points = self._angular_velocities = 0
        self._seconds, self._has_points = 0.0, False
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
        if isinstance(event, VelocityBlock) and self._stamp_recorders:
            for velocity in event.events():
                self.add(velocity)
            return
        if isinstance(event, ObservationEvent):
            self._ranges.note_event(event)
            self._has_points = self._has_points or bool(judgeable(event).any())
        start_s = time.thread_time()
        if isinstance(event, VelocityBlock):
            self._events += len(event)
            self._estimator.add_velocities(event)
        else:
            self._events += 1
            is_taken = self._estimator.add(event)
            self._angular_velocities += is_taken and isinstance(event, AngularVelocityEvent)
        self._seconds += time.thread_time() - start_s

    def finish(self) -> Replay:
        start_s = time.thread_time()
        self._estimator.flush()
        self._seconds += time.thread_time() - start_s
        self._compare(is_nees_due=False)
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
            has_points=self._has_points,
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
        self._localised_ns = (self._localised_ns or (first_ns,))[0], last_ns
        if self._keep_all and len(due_ns := stamps_ns[self._samples.due(stamps_ns)]):
            has_truth = self._pose_truth is not None and len(self._pose_truth) > 0
            self._samples.add(due_ns, *self._estimator.poses_at(due_ns, has_truth))

    def _on_update(self, update: Update) -> None:
        for recorder in self._recorders:
            recorder.note_update(update)
        known, world_points = self._estimator.landmark_ids, self._estimator.world_points
        self._ranges.note_update(update, known, world_points)
        used = used_points(self._estimator.counts)
        self._observations += used > self._used_points
        self._used_points = used
        if self._landmark_tracks is None:
            return
        # What is compared with the truth is kept; it is compared now if a covariance may be due.
        self._uncompared.append((update, known, world_points))
        in_fixed_map = self._in_known_map and self._settings.localization_mode == 'fixed'
        has_errors = len(known) > 0 and not in_fixed_map
        is_nees_due = has_errors and update.stamp_ns >= self._next_nees_ns
        if is_nees_due or len(self._uncompared) == MOST_UNCOMPARED:
            self._compare(is_nees_due)

    def _on_jump(self) -> None:
        self._next_nees_ns = 0
        if self._settings.on_time_jump == 'reset':
            self._clear_figures()
            for recorder in self._recorders:
                recorder.clear()

    def _compare(self, is_nees_due: bool) -> None:
        """Compare what is kept with the truth; a covariance is known of the last of it."""
        if self._pose_truth is None or self._landmark_tracks is None:
            return
        kept, self._uncompared = self._uncompared, []
        stamps_ns = np.array([update.stamp_ns for update, *_ in kept], dtype=np.int64)
        true_poses, covered = interpolate(self._pose_truth, stamps_ns)
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
                self._landmark_tracks.at(update.stamp_ns),
                covariance_of,
                update.ids[~update.rejected],
            )


STILL = 1e-12  # change of a pose, m and rad, that is rounding: a robot at rest has no bias


def _errors(
    run: Replay, truth: Truth
) -> tuple[TrajectoryErrors | None, TrajectoryErrors | None, float | None, float | None]:
    """Return the errors of a :class:`.Result`: trajectory, dead reckoning, map; and the ANEES."""
    pose_truth, estimator = truth.trajectory, run.estimator
    errors = _pose_errors('trajectory', run.trajectory, pose_truth)
    reckoned = _pose_errors('dead reckoning', run.dead_reckoning, pose_truth)
    map_rmse_m = _map_rmse_m(estimator.landmark_ids, estimator.world_points, truth)
    anees = None
    if not run.in_known_map and (covariances := run.pose_covariances) is not None:
        with _unknown_if_unfit('unknown_anees'):
            anees = anchored_average_nees(run.trajectory, covariances, pose_truth)
    return errors, reckoned, map_rmse_m, anees


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
    same = np.isin(online.stamps_ns, trajectory.stamps_ns)
    before = Trajectory(online.stamps_ns[same], online.poses[same])
    return SmoothedRun(
        smoothed,
        trajectory,
        _pose_errors('smoothed trajectory', trajectory, truth.trajectory),
        _pose_errors('trajectory before smoothing', before, truth.trajectory),
        _map_rmse_m(smoothed.ids, smoothed.world_points, truth),
    )


def smoothed_trajectory(
    smoothed: Smoothed, stamps_ns: IntArray, dead_reckoning: Trajectory, estimator: Estimate
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


def _map_rmse_m(ids: IntArray, world_points: FloatArray, truth: Truth) -> float | None:
    if truth.landmarks is None or (len(ids) and is_automatic(ids).all()):
        return None  # landmarks without ids of their own have no counterpart
    with _unknown_if_unfit('uncompared', figure='map'):
        return landmark_rmse_m(ids, world_points, truth.landmarks)
    return None


@contextmanager
def _unknown_if_unfit(kind: str, **figures: str) -> Iterator[None]:
    """Log, as a finding of a kind, what can't be compared."""
    try:
        yield
    except EvaluationError as error:
        logger.warning('%s', found(kind, error=error, **figures))
