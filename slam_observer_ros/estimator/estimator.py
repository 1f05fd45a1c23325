"""Time-stamped events in, pose and map out: the one estimator of node, replay and simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import logging
import math
import time

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError, ParameterError
from slam_observer_ros.common.findings import found
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import Change, Reason, Update
from slam_observer_ros.estimator.checks import (
    are_finite,
    check_event,
    check_velocities,
    rigid,
    usable_maps,
    usable_points,
)
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.estimator.event_queue import EventQueue
from slam_observer_ros.estimator.event_warnings import UNEXPECTED_POSES
from slam_observer_ros.estimator.placement import Placement
from slam_observer_ros.estimator.timeline import OnMotion, Timeline
from slam_observer_ros.estimator.undisturbed import Undisturbed
from slam_observer_ros.events import (
    Event,
    MeasuredVelocity,
    ObservationEvent,
    Queued,
    UNKNOWN_ID,
    VelocityBlock,
)
from slam_observer_ros.mapping.landmark_map import heights_of, LandmarkMap
from slam_observer_ros.mapping.loop_closure import LoopClosure
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.settings.parameter_table import checked, table
from slam_observer_ros.tracking.half_points import with_kinds
from slam_observer_ros.tracking.step import step

logger = logging.getLogger(__name__)

DIVERGED_M = 1e9
"""Distance from the start, metres, that no estimate has."""

FLOODED_NS = to_ns(5.0)
"""How long after a flood of points landmarks are forgotten that it has brought in, nanoseconds.

Those that were seen for longer are places, in a hall that is full of them.
"""


class Estimator(Estimate):
    """Pose and landmark map from time-stamped velocities and observations.

    The state advances only at event stamps, in stamp order, so its bits don't depend on when
    anybody asks for them: a live run and a replay of what it received agree exactly.

    ``initial_pose`` (4, 4), body to world, is the pose at the first event, and the reference P°;
    by default the settings say it, or it is identity. :exc:`ParameterError` is raised if it is no
    rigid motion, or if one of the ``settings`` does not fit its table.

    ``on_update`` is called with an :class:`Update` after each observation that was used.
    ``on_stamps`` is called with stamps (s,), nanoseconds, when all their events have been used:
    before the first event of a later stamp, after a jump of the clock that holds the pose, and by
    :meth:`flush`; since the first of them only velocities have moved the state. ``on_motion`` is
    called with velocities and two stamps before the state is moved on between these, and
    ``on_jump`` when the estimate has gone on after a jump of the clock. ``judges_innovations``
    adds :attr:`.Update.innovation`, which takes time, and ``keeps_outcomes`` keeps what became of
    each unused point and each landmark, for :attr:`.Estimate.outcomes`: memory grows with these.
    """

    def __init__(
        self,
        settings: Settings,
        initial_pose: FloatArray | None = None,
        on_update: Callable[[Update], None] | None = None,
        on_stamps: Callable[[IntArray], None] | None = None,
        on_motion: OnMotion | None = None,
        on_jump: Callable[[], None] | None = None,
        judges_innovations: bool = False,
        keeps_outcomes: bool = False,
    ) -> None:
        settings = checked(settings)
        self._live = LiveSettings.of(settings)
        self._placement = Placement(self._live, judges_innovations, keeps_outcomes)
        super().__init__(settings, self._placement.hypotheses, self._placement.localiser)
        self._on_update, self._on_stamps = on_update, on_stamps
        self._on_motion, self._on_jump = on_motion, on_jump
        self._loop_closure = LoopClosure()
        # The first and last stamp of messages with more points than are used.
        self._flood: tuple[int, int] | None = None
        self.reset(initial_pose)
        self._warnings.unused_settings(settings, self._state.gains)

    def reset(self, pose: FloatArray | None = None) -> None:
        """Forget the motion, what was mapped and events held back, and start again.

        The pose is then ``pose`` (4, 4), body to world; by default as the settings say, or else
        identity, or unknown in a loaded map. Raise :exc:`ParameterError` if it is no rigid motion.
        """
        self._start_pose = None if pose is None else rigid(pose)
        self._placement.reset(self._start_pose)
        self._clear_time()
        self._undisturbed = Undisturbed()
        self.last_update = None

    def handle_clock_jump(self, by_ns: int | None = None) -> None:
        """Go on after a jump of the clock, by so many nanoseconds, as ``on_time_jump`` says.

        ``reset`` starts again where the run began; in a loaded map where the settings say, or
        at an unknown pose. ``hold`` keeps pose and map, and goes on from there.
        """
        way = ''
        if by_ns is not None:
            way = f' {"back" if by_ns < 0 else "ahead"} by {to_s(abs(by_ns)):.3f} s'
        # Events of before the jump that are held back are used first.
        self.release()
        if self.settings.on_time_jump == 'reset':
            logger.warning('%s', found('clock_reset', way=way))
            self.reset(None if self._localiser.maps else self._start_pose)
        else:
            logger.warning('%s', found('clock_held', way=way))
            self._timeline.catch_up()
            self._report_stamp()
            self._hypotheses.clear_time()
            self._placement.was_placed = True
            self._clear_time()
        self.jumps += 1
        if self._on_jump is not None:
            self._on_jump()

    def load_map(
        self,
        landmark_map: LandmarkMap | Sequence[LandmarkMap],
        pose: FloatArray | None = None,
        pose_covariance: FloatArray | None = None,
    ) -> None:
        """Estimate in the frame of a map from now on, as ``localization_mode`` says.

        Of several maps it is the one in which the robot is found; in each of them the robot is
        looked for about a given pose.

        With a ``pose`` (4, 4) in that frame and its ``pose_covariance`` (6, 6; default exact) the
        landmarks mapped so far are forgotten. By default the settings say the pose, if the robot
        is still at its start; else it is unknown, and follows from landmarks of the map that are
        seen, three in space or two in a plane if they have ids. Then landmarks mapped so far are
        carried into the map's frame. Raise MapError or ParameterError if one of them can't be
        right; nothing is changed then.
        """
        maps = usable_maps(landmark_map)
        self._half_points.heights_m = heights_of(maps)
        self._half_points.mapped_ids = np.concatenate([known.ids for known in maps])
        self._half_points.clear()
        if self.settings.localization_mode == 'off':
            largest = max(len(known.ids) for known in maps)
            self._warnings.loaded_map(largest, self.settings.max_landmarks)
        if pose is not None:
            pose = rigid(pose, pose_covariance)
            self._timeline.catch_up()
        is_at_start = self.stamp_ns is None
        self._placement.load(maps, pose, pose_covariance, is_at_start=is_at_start)

    def set_pose(
        self,
        pose: FloatArray,
        covariance: FloatArray | None = None,
        stamp_ns: int | None = None,
        map_name: str = '',
    ) -> None:
        """Move the robot to ``pose`` (4, 4), body to world; the map stays.

        It is where it was at ``stamp_ns``, nanoseconds, by default :attr:`stamp_ns`: the motion
        since is added if it is known (:meth:`knows_motion_since`). If the pose in a loaded map was
        unknown, it is known now; of several maps in ``map_name``. ``covariance`` (6, 6)
        is as in :attr:`pose_covariance`; default exact. Raise :exc:`ParameterError` if one of them
        can't be right; nothing is changed then.
        """
        pose = rigid(pose, covariance)
        self._timeline.catch_up()
        if stamp_ns is not None and self.knows_motion_since(stamp_ns):
            known = np.zeros((6, 6)) if covariance is None else covariance
            pose, covariance = self._timeline.moved_on(pose, known, stamp_ns)
        self._placement.place(pose, covariance, map_name)

    def change_settings(self, settings: Settings) -> None:
        """Use other values of the settings that may change while running, from now on.

        Raise :exc:`ParameterError` if another setting differs, or one does not fit its table.
        """
        settings = checked(settings)
        fixed = [row.name for row in table(Settings) if row.read_only]
        old = self.settings
        changed = [name for name in fixed if getattr(settings, name) != getattr(old, name)]
        if changed:
            raise ParameterError(f'{", ".join(changed)} can only be set before the start')
        self.settings = settings
        self._live.follow(settings)

    def add(self, event: Event) -> bool:
        """Take an event; return whether it was accepted.

        A bad event is dropped whole, counted in ``dropped`` by its reason and logged; the state
        is untouched. Of an observation only the points of which something is NaN or infinite are
        left out, if others remain (``'bad_point'`` in :attr:`counts`). The event's arrays are not
        copied: don't change them any more.
        """
        try:
            check_event(event, self.settings)
            if self._queue.passes(event):  # in stamp order, as nearly always
                self._process(event)
            else:
                self._hold_back(event)
        except InvalidEventError as error:
            if error.reason == 'not_finite' and isinstance(event, ObservationEvent):
                fit = are_finite(event)
                if fit is not None:
                    self._count_bad(event.ids[~fit], event.stamp_ns)
                    return self.add(event.select(fit))
            self._drop(error)
            return False
        return True

    def _count_bad(self, ids: IntArray, stamp_ns: int) -> None:
        self._warnings.warn('bad_point', count=len(ids))
        self._counts['observed_point'] += len(ids)
        self._counts.note(Reason.BAD, ids, stamp_ns)

    def add_velocities(self, velocities: VelocityBlock) -> int:
        """Take velocities, each as :meth:`add` takes it; return how many were accepted.

        All is bit for bit as if they were added one by one; it only takes less time.
        """
        if not self._are_usual(velocities):
            return sum(self.add(event) for event in velocities.events())
        if self._queue.passes(velocities):
            self._process(velocities)
        else:
            self._hold_back(velocities)
        return len(velocities)

    def _are_usual(self, velocities: VelocityBlock) -> bool:
        """Return whether none of the velocities needs to be looked at for itself."""
        try:
            check_velocities(velocities, self.settings)
        except InvalidEventError:
            return False
        return self._queue.follow(velocities)

    def _hold_back(self, item: Queued) -> None:
        """Hold an event back until its turn, and use those whose turn it is.

        Raise InvalidEventError if its stamp can't be right.
        """
        if self._queue.push(item):
            self.handle_clock_jump(item.stamp_ns - (self.newest_stamp_ns or 0))
            self._queue.push(item)
        for ready in self._queue.pop_ready():
            self._process(ready)

    def release(self, limit_s: float = math.inf) -> None:
        """Use the events that are held back for others, as before something is changed.

        One with a stamp far ahead stays: it may be wrong, and would make all others too late.
        After ``limit_s``, seconds, no further one is begun with, and they are dropped.
        """
        end_s = time.monotonic() + limit_s
        for ready in self._queue.pop_believed():
            events = ready.events() if isinstance(ready, VelocityBlock) else (ready,)
            for event in events:
                if time.monotonic() > end_s:
                    self._drop(InvalidEventError('stopped', 'held back when the end came'))
                else:
                    self._process(event)

    def flush(self) -> None:
        """Use all events that are held back and move on to the last: the recording is over."""
        for ready in self._queue.pop_all():
            self._process(ready)
        self._timeline.catch_up()
        self._report_stamp()
        self._look(self.stamp_ns or 0)
        self._undisturbed.end()

    def distrust_odometry(self) -> None:
        """Count what is learnt of it now to no delay or noise that :attr:`undisturbed` reports."""
        self._undisturbed.is_disturbed = True

    def forget(self, landmark_id: int) -> bool:
        """Remove a landmark from the map; return whether it was known."""
        return self._hypotheses.forget(landmark_id)

    @property
    def newest_stamp_ns(self) -> int | None:
        """Newest stamp received, nanoseconds; it may still be held back."""
        return self._queue.newest_ns

    def _drop(self, error: InvalidEventError) -> None:
        self.dropped[error.reason] += 1
        self._warnings.warn('dropped_message', error.reason, reason=error.reason, error=error)

    def _process(self, item: Queued) -> None:
        """Use an event whose turn it is, or velocities that follow each other."""
        if isinstance(item, ObservationEvent):
            if self._on_stamps is not None:
                self._report_before(item.stamp_ns)
            self._process_observation(item)
        elif isinstance(item, VelocityBlock):
            for part in self._timeline.parts(item):
                self._process_velocity(part)
        else:
            self._process_velocity(item)

    def _report_before(self, stamp_ns: int) -> None:
        """Report the present stamp if the next event is of a later one."""
        if stamp_ns > (self.stamp_ns or 0):
            self._report_stamp()

    def _report_stamp(self) -> None:
        """Report that all events of the present stamp have been used."""
        if self._on_stamps is not None and self.stamp_ns is not None:
            self._on_stamps(np.array([self.stamp_ns]))

    def _process_velocity(self, measured: MeasuredVelocity) -> None:
        """Use one velocity, or several that follow each other."""
        count = len(measured) if isinstance(measured, VelocityBlock) else 1
        if self._on_stamps is not None:
            self._report_before(measured.stamp_ns)
        try:
            is_used = self._timeline.append(measured)
        except InvalidEventError as error:
            self._drop(error)
            return
        if is_used:
            self._counts['velocity'] += count
        if self._timeline.was_late:
            self._counts['late_velocity'] += 1
            self._warnings.warn('late_velocity')
        if self._on_stamps is not None and isinstance(measured, VelocityBlock) and count > 1:
            self._on_stamps(measured.stamps_ns[:-1])
        self._timeline.advance_after_many()

    def _process_observation(self, event: ObservationEvent) -> None:
        """Use an observation: by :func:`.step`, then for all that rides on it."""
        state, warnings = self._hypotheses.best, self._warnings
        if event.kinds is not None and self.settings.two_d_mode:
            event = self._half_points.levelled(event, state.observation_noise)
        usable = usable_points(
            event, self.settings, state.gains, state.landmarks, self._counts, warnings
        )
        if self._flood is not None or len(event.ids) > self.settings.max_points:
            self._forget_flood(event, usable)
        event, update = step(self._hypotheses, self._advance, usable)
        if event.kinds is not None:
            update = with_kinds(update, event)
            if self._half_points.remember(self._hypotheses.states):
                update = replace(update, pose=self._state.observer.pose)
        if np.count_nonzero(update.rejected):
            self._timeline.judge_standing(event, update)
        self._counts['observation'] += 1
        self._counts['late_observation'] += self._timeline.was_late
        may_have_moved = self._follow_up(event, update)
        self._warn_of(event, update)
        if may_have_moved:
            update = replace(update, pose=self._state.observer.pose)
        self.last_update = update
        if self._on_update is not None:
            self._on_update(update)

    def _advance(self, event: ObservationEvent) -> ObservationEvent:
        """Move the state on to an observation, or it to the state; return it, of whole points."""
        event = self._timeline.synchronise(event)
        if event.kinds is not None:
            is_lost = not self._localiser.is_localised
            event = self._half_points.completed(event, self._state, is_lost=is_lost)
        if self._localiser.loaded is not None and self._localiser.may_be_rough(event):
            self._placement.doubt(*self.uncertain_pose)
        return event

    def _forget_flood(self, event: ObservationEvent, usable: ObservationEvent) -> None:
        """Forget what a flood of points has brought into the map, some time after its end.

        Else each later observation would cost more, as errors of all landmarks are known together.
        """
        if len(event.ids) > self.settings.max_points == len(usable.ids):
            begin_ns = event.stamp_ns if self._flood is None else self._flood[0]
            self._flood = begin_ns, event.stamp_ns
        elif self._flood is not None and event.stamp_ns - self._flood[1] >= FLOODED_NS:
            (begin_ns, end_ns), self._flood = self._flood, None
            for state in self._hypotheses.states:
                table = state.landmarks
                is_new = (table.born_ns >= begin_ns) & (table.last_seen_ns <= end_ns)
                is_brief = table.last_seen_ns - table.born_ns < FLOODED_NS
                rows = np.flatnonzero(is_new & is_brief)
                state.forget(rows, Change.FORGOTTEN, event.stamp_ns)

    def _follow_up(self, event: ObservationEvent, update: Update) -> bool:
        """Find the pose in a map, close a loop, or start again, as an observation gives reason.

        Return whether that may have moved the robot.
        """
        two_places = self._warnings.two_places
        is_news = two_places.sighted or np.count_nonzero(update.rejected)
        if is_news and self._localiser.is_localised:
            two_places.note(self._hypotheses.best, event, update)
        if self._localiser.maps:
            was_localised = self._localiser.is_localised
            self._placement.localise(event, update, self._half_points.window)
            if self._localiser.is_localised != was_localised:
                self._half_points.clear()
                # It is in the same map again later, unless there are several.
                two_places.doubt(is_all=len(self._localiser.maps) > 1)
            elif (
                was_localised
                and (loaded := self._localiser.loaded) is not None
                and self._hypotheses.judge_views(loaded.ids, loaded.covariances)
            ):
                self._timeline.velocities.doubt_standing()
                shows_turn = event.orientations is not None
                self._localiser.doubt_strayed(self._state, update, shows_turn)
        some_are_unknown = bool(np.count_nonzero(event.ids == UNKNOWN_ID))
        if some_are_unknown:
            self._judge_map(event.stamp_ns)
        distance_m = math.hypot(*self._hypotheses.best.observer.A[:3, 3].tolist())
        has_diverged = not distance_m <= DIVERGED_M  # or it is no number
        if has_diverged:
            self._start_again(distance_m)
        return bool(self._localiser.maps) or some_are_unknown or has_diverged

    def _judge_map(self, stamp_ns: int) -> None:
        """Take landmarks for one that are, and say that another map is shown from now on."""
        closure = self._loop_closure
        closure.note(self._state, stamp_ns)
        if closure.is_due(self._state, stamp_ns):
            # A map of its own, while it is sought in a loaded one, decides nothing of that.
            if not self._localiser.maps or self._localiser.is_localised:
                before = self.counts['merged_landmark']
                self._hypotheses.fork(closure.twins)
                if (merged := self.counts['merged_landmark'] - before) > 1:
                    logger.info('A loop has closed: %d landmarks were seen before.', merged)
            closure.count_doubled(self._state)
        wrong = self.longest_ambiguity
        if wrong is not None and wrong.until_ns == stamp_ns and self.ambiguity is None:
            self._warnings.warn('ambiguous_map', '', **wrong.figures)

    def _start_again(self, distance_m: float) -> None:
        """Start again where settings or measurements have led the estimate out of all bounds."""
        logger.error('%s', found('diverged', distance_m=distance_m))
        self._counts['diverged'] += 1
        self._placement.start(None)

    def _warn_of(self, event: ObservationEvent, update: Update) -> None:
        """Warn of an observation, of what it did, or of the map if something is wrong."""
        warnings, state = self._warnings, self._hypotheses.best
        limit = self.settings.max_landmarks if state.is_mapping else 0
        if 0 < limit < len(event.ids):
            warnings.warn('more_than_max', count=len(event.ids), limit=limit)
        if len(update.moved_ids):
            warnings.moved_landmarks(update.moved_ids, event.stamp_ns)
        if carried_ids := self._hypotheses.standing.carried:
            warnings.carried_landmarks(carried_ids)
        counts = self._hypotheses.some_counts((*UNEXPECTED_POSES, 'carried_landmark'))
        warnings.of_state(counts[:-1], len(state.landmarks.ids), limit, state.gains)
        signs = [*counts, self._localiser.counts['lost']]
        if self._undisturbed.is_due(event.stamp_ns, signs):
            self._look(event.stamp_ns)

    def _look(self, stamp_ns: int) -> None:
        """Look at what was learnt of the odometry, now and then."""
        if self._hypotheses.slips:
            self.distrust_odometry()
        self._undisturbed.look(stamp_ns, self.calibration, self.motion_factors)

    def _clear_time(self) -> None:
        """Forget all that has a stamp but the map."""
        settings = self.settings
        self._flood = None
        self._half_points.clear()
        self._warnings.two_places.doubt(is_all=True)
        self._queue = EventQueue(
            window_ns=to_ns(settings.reorder_window),
            max_jump_ns=to_ns(settings.max_stamp_jump),
            late_limit_ns=to_ns(settings.late_limit),
        )
        self._timeline = Timeline(self._hypotheses, settings, self._on_motion)
