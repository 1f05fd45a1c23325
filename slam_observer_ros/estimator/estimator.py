"""Time-stamped events in, pose and map out: the one estimator of node, replay and simulation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
import logging
import math
import time

import numpy as np

from slam_observer_ros.association.hypotheses import Hypotheses
from slam_observer_ros.common.errors import InvalidEventError, ParameterError
from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import CalibrationEstimate, MotionFactor, Smoothed, Update
from slam_observer_ros.estimator.checks import (
    check_event,
    check_velocities,
    rigid,
    usable_maps,
    usable_points,
)
from slam_observer_ros.estimator.event_queue import EventQueue
from slam_observer_ros.estimator.event_warnings import EventWarnings, UNEXPECTED_POSES
from slam_observer_ros.estimator.timeline import OnMotion, Timeline
from slam_observer_ros.events import (
    Event,
    MeasuredVelocity,
    ObservationEvent,
    Queued,
    UNKNOWN_ID,
    VelocityBlock,
)
from slam_observer_ros.geometry import se3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.localiser import is_rough, Localiser
from slam_observer_ros.known_map.loop_closure import LoopClosure
from slam_observer_ros.known_map.merging import map_of
from slam_observer_ros.observer.continuous_time import lyapunov
from slam_observer_ros.observer.designs import make_gains
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.settings.parameter_table import changed_names, checked, table
from slam_observer_ros.state.state import State
from slam_observer_ros.state.usual import Outcome

logger = logging.getLogger(__name__)

DIVERGED_M = 1e9
"""Distance from the start, metres, that no estimate has."""

GIVEN_POSE_STD = np.repeat([0.26, 0.5], 3)
"""Standard deviation of a pose in a map that is given without any, rad and m; RViz's."""


class Estimator:
    """Pose and landmark map from time-stamped velocities and observations.

    The state advances only at event stamps, in stamp order, so its bits don't depend on when
    anybody asks for them: a live run and a replay of what it received agree exactly.

    ``initial_pose`` (4, 4), body to world, is that at the first event, and the reference P°; by
    default that of the settings, or identity. :exc:`ParameterError` is raised if it is no rigid
    motion, or if one of the ``settings`` does not fit its table.

    ``on_update`` is called with an :class:`Update` after each observation that was used;
    ``on_stamps`` with the stamps (s,), nanoseconds, of which all events have been used, and since
    which the state has only been moved on by velocities: before the first event of a later stamp
    or after a jump of the clock that holds the pose, and by :meth:`flush`; ``on_motion`` with
    velocities and two stamps, nanoseconds, before the state is moved on between these; and
    ``on_jump`` when the estimate has gone on after a jump of the clock. ``judges_innovations``
    adds :attr:`.Update.innovation`, which takes time.
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
    ) -> None:
        self.settings = settings = checked(settings)  # those in force
        self._live = LiveSettings.of(settings)
        self._counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()  # events refused, by reason
        self.jumps = 0  # how often the clock has jumped
        self._warnings = EventWarnings()
        self.last_update: Update | None = None  # None before the first observation
        self._on_update, self._on_stamps = on_update, on_stamps
        self._on_motion, self._on_jump = on_motion, on_jump
        self._judges_innovations = judges_innovations
        self._start_pose: FloatArray | None = None
        self._was_placed = False  # by somebody, so the pose of the settings is not its start
        self._hypotheses = Hypotheses(self._state_at(np.eye(4)))
        self._localiser = Localiser()
        self._loop_closure = LoopClosure()
        self.reset(initial_pose)
        self._warn_of_unused()

    def reset(self, pose: FloatArray | None = None) -> None:
        """Forget the motion, what was mapped and events held back, and start again.

        At ``pose`` (4, 4), body to world; by default at that of the settings, or else at identity,
        or unknown in a loaded map. Raise :exc:`ParameterError` if it is no rigid motion.
        """
        self._start_pose = pose = None if pose is None else rigid(pose)
        self._was_placed = pose is not None
        if pose is None and self.settings.set_initial_pose:
            self._start_where_settings_say()
        else:
            self._start(pose)
        self._clear_time()
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
            logger.warning(
                'The clock has jumped%s; starting again (on_time_jump: hold keeps pose and map).',
                way,
            )
            self.reset(None if self._localiser.maps else self._start_pose)
        else:
            logger.warning('The clock has jumped%s; pose and map are held.', way)
            self._timeline.catch_up()
            self._report_stamp()
            self._hypotheses.clear_time()
            self._was_placed = True
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

        Of several maps it is the one in which the robot is found; a given pose is then where it is
        looked for in each of them.

        With a ``pose`` (4, 4) in that frame and its ``pose_covariance`` (6, 6; default exact),
        what was mapped is forgotten. By default the pose is that of the settings, if the robot is
        still there, or unknown: then it follows from landmarks of the map that are seen, three in
        space or two in a plane, if they have ids, and what was mapped is carried into the map's
        frame. Raise MapError or ParameterError if one of them can't be right; nothing is changed
        then.
        """
        maps = usable_maps(landmark_map)
        if self.settings.localization_mode == 'off':
            largest = max(len(known.ids) for known in maps)
            self._warnings.loaded_map(largest, self.settings.max_landmarks)
        if pose is not None:
            pose = rigid(pose, pose_covariance)
            self._timeline.catch_up()
        self._localiser.load(maps, self.settings.two_d_mode)
        # The pose in it: the given one, the one of the settings, or the one that landmarks show.
        is_at_start = self.stamp_ns is None and not self._was_placed
        if pose is not None:
            self._move_robot(pose, pose_covariance)
        elif self.settings.set_initial_pose and is_at_start:
            self._start_where_settings_say()
        elif self._state.is_mapping:
            if self._localiser.enter(self._state):
                self._hypotheses.prune_to_best()
        else:  # in a map that does not grow there is nothing to carry into another one
            self._start(None)

    def set_pose(
        self,
        pose: FloatArray,
        covariance: FloatArray | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """Move the robot to ``pose`` (4, 4), body to world; the map stays.

        It is where it was at ``stamp_ns``, nanoseconds, by default :attr:`stamp_ns`: the motion
        since is added if it is known (:meth:`knows_motion_since`). If the pose in a loaded map was
        unknown, it is known now. ``covariance`` (6, 6) is as in :attr:`pose_covariance`; default
        exact. Raise :exc:`ParameterError` if one of them can't be right; nothing is changed then.
        """
        pose = rigid(pose, covariance)
        self._timeline.catch_up()
        if stamp_ns is not None and self.knows_motion_since(stamp_ns):
            known = np.zeros((6, 6)) if covariance is None else covariance
            pose, covariance = self._timeline.moved_on(pose, known, stamp_ns)
        self._move_robot(pose, covariance)

    def knows_motion_since(self, stamp_ns: int) -> bool:
        """Return whether velocities are known from a stamp on, nanoseconds: of seconds at most."""
        return self._timeline.knows_motion_since(stamp_ns)

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
        is untouched. The event's arrays are not copied: don't change them any more.
        """
        try:
            check_event(event, self.settings)
            self._take(event)
        except InvalidEventError as error:
            self._drop(error)
            return False
        return True

    def add_velocities(self, velocities: VelocityBlock) -> int:
        """Take velocities, each as :meth:`add` takes it; return how many were accepted.

        All is bit for bit as if they were added one by one; it only takes less time.
        """
        if not self._are_usual(velocities):
            return sum(self.add(event) for event in velocities.events())
        self._take(velocities)
        return len(velocities)

    def _are_usual(self, velocities: VelocityBlock) -> bool:
        """Return whether none of the velocities needs to be looked at for itself."""
        try:
            check_velocities(velocities, self.settings)
        except InvalidEventError:
            return False
        return self._queue.follow(velocities)

    def _take(self, item: Queued) -> None:
        """Use what is right in itself, in its order; InvalidEventError if its stamp is not."""
        if self._queue.passes(item):  # as nearly always
            self._process(item)
            return
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

    def smooth(self) -> Smoothed:
        """Return the smoothed trajectory and map since the history began; the state is kept.

        The history is that of the whole run with ``smoothing_window`` 0. Raise ParameterError if
        none is kept, and SmoothingError if the observations don't determine everything.
        """
        return self._state.smooth()

    def forget(self, landmark_id: int) -> bool:
        """Remove a landmark from the map; return whether it was known."""
        return self._hypotheses.forget(landmark_id)

    @property
    def counts(self) -> Counter[str]:
        """How many events were used, by kind, and the outcome for the landmarks in them.

        Events used (``'velocity'``, ``'observation'``), late ones among them
        (``'late_velocity'``, ``'late_observation'``), points (``'observed_point'``), observations
        made before the pose in a loaded map was found (``'not_localised'``), how often it was lost
        (``'lost'``) or the estimate has diverged (``'diverged'``), the robot not where odometry
        had it (``'slip'``) or nothing in view where the map has it (``'unexpected_place'``),
        landmarks (``'rejected_landmark'``, ``'moved_landmark'``, ``'carried_landmark'``,
        ``'forgotten_landmark'``, ``'unmapped_landmark'``, ``'unsupported_landmark'``,
        ``'merged_landmark'``, ``'doubled_landmark'``) and points not used (``'unknown_id'``,
        ``'repeated_id'``, ``'reserved_id'``, ``'impossible_id'``, ``'unweighed_point'``).
        """
        return self._counts + self._localiser.counts + self._hypotheses.counts

    @property
    def is_localised(self) -> bool:
        """Whether the estimate is in its final frame, that of a map if one was loaded."""
        return self._localiser.is_localised

    @property
    def localisation_problem(self) -> Finding | None:
        """Why the pose in a loaded map is not known; None if it is."""
        return self._localiser.problem(self._state.observer.A)

    @property
    def possible_poses(self) -> FloatArray:
        """(q, 4, 4) where in a loaded map the robot may be, by points without ids, likely first.

        As of the last search; empty where none fits, and where the pose is known.
        """
        places = [] if self.is_localised else self._localiser.places
        poses = [place.transform @ self._state.observer.A for place in places]
        return np.array(poses).reshape(-1, 4, 4)

    @property
    def map_name(self) -> str:
        """Name of the loaded map in whose frame the estimate is; empty if it is in none."""
        loaded = self._localiser.loaded
        return loaded.name if loaded is not None and self.is_localised else ''

    @property
    def landmark_map(self) -> LandmarkMap:
        """The present map, as it can be saved and loaded: without landmarks that move.

        Unless its frame is that of a loaded map, its covariances are those of its shape alone.
        """
        state, loaded = self._state, self._localiser.loaded if self.is_localised else None
        landmark_map = map_of(state, loaded)
        is_joint = landmark_map.joint_covariance is not None or state.observer.is_exact
        if landmark_map.covariances is not None and not is_joint:
            self._warnings.warn('left_out_correlations', count=len(landmark_map.ids))
        return landmark_map

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last event that was used, nanoseconds; None before the first."""
        return self._timeline.stamp_ns

    @property
    def newest_stamp_ns(self) -> int | None:
        """Newest stamp received, nanoseconds; it may still be held back."""
        return self._queue.newest_ns

    @property
    def pose(self) -> FloatArray:
        """(4, 4) estimated pose at ``stamp_ns``, body to world."""
        leads_on = self._timeline.lead_s > 0.0
        return self.uncertain_pose[0] if leads_on else self._state.observer.pose

    def pose_at(self, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) at any time: the state, moved on by the velocities since."""
        observer, state_ns = self._state.observer, self._timeline.state_ns
        if state_ns is None or stamp_ns == state_ns:
            return observer.pose
        return observer.pose @ self._timeline.motion(state_ns, stamp_ns)

    def poses_at(
        self, stamps_ns: IntArray, with_covariances: bool = True
    ) -> tuple[FloatArray, FloatArray | None]:
        """Return the poses (s, 4, 4) and their covariances (s, 6, 6) as they were known then.

        Of stamps (s,) that ``on_stamps`` has just been called with. None if no covariance is
        known, or asked for: they take longer.
        """
        timeline = self._timeline
        if stamps_ns[0] < (timeline.stamp_ns or 0):
            return self._hypotheses.poses_until(
                timeline.velocities, timeline.state_ns or 0, stamps_ns, with_covariances
            )
        # The present stamp alone, maybe of an observation.
        if not with_covariances:
            return self.pose[None], None
        pose, covariance = self._hypotheses.pose_after(
            timeline.velocities, timeline.state_ns or 0, timeline.stamp_ns or 0
        )
        return pose[None], None if covariance is None else covariance[None]

    @property
    def pose_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of the pose at ``stamp_ns``: rotation vector, position; rad², m².

        Along the world's axes; it includes that the most likely hypothesis may be wrong. None
        where the filter knows no covariance.
        """
        return self.uncertain_pose[1]

    @property
    def uncertain_pose(self) -> tuple[FloatArray, FloatArray | None]:
        """:attr:`pose` and :attr:`pose_covariance`, both for what one of them costs."""
        timeline = self._timeline
        start_ns, end_ns = timeline.state_ns or 0, timeline.stamp_ns or 0
        pose, covariance = self._hypotheses.pose_after(timeline.velocities, start_ns, end_ns)
        return pose if end_ns > start_ns else self._state.observer.pose, covariance

    @property
    def body_velocity(self) -> FloatArray:
        """(6,) newest velocity (Ω, v), calibrated, rad/s and m/s; zero when it has timed out."""
        velocity = self._timeline.body_velocity  # of a little earlier or later if delayed
        return np.zeros(6) if velocity is None else self._state.calibration.apply(velocity)

    @property
    def body_velocity_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of :attr:`body_velocity`, as stated with it or as the settings say.

        That of no velocity is what the robot may do then. None before there are two messages.
        """
        held = self._timeline.velocity_in_force
        if held is None:
            return None
        state, axes = self._state, self._state.axes
        measured = state.motion_noise.velocity_covariance(held)
        if axes.p < len(measured):
            measured = axes.full_pose_covariance(measured[axes.pose, axes.pose])
        return state.calibration.apply_to_covariance(
            measured, held.body_velocities[0], state.gains.calibration_variances
        )

    @property
    def velocity_is_stale(self) -> bool:
        """Whether no velocity was in force at ``stamp_ns``, so that the pose is being held."""
        return self._timeline.body_velocity is None

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the landmarks in the map: those seen ``confirmations`` times or more."""
        return self._state.landmarks.ids[self._state.confirmed]

    @property
    def landmark_counts(self) -> IntArray:
        """(n,) number of observations of each landmark."""
        return self._state.landmarks.counts[self._state.confirmed]

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks at ``stamp_ns``, metres, world."""
        state, lead_s = self._state, self._timeline.lead_s
        points = state.observer.world_points[state.confirmed]
        return points + lead_s * self.landmark_velocities if lead_s else points

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks at ``stamp_ns``, world, m²; None if unknown."""
        of_all = self._state.landmark_covariances(self._timeline.lead_s)
        return None if of_all is None else of_all[self._state.confirmed]

    def configuration_covariance(self, rows: IntArray) -> FloatArray | None:
        """Return the joint covariance (m k, m k) of landmarks as seen from the robot, m².

        In the body frame, of k coordinates (2 in ``two_d_mode``, else 3), as of the last
        observation: ask for it in ``on_update``. ``rows`` (m,) are indices into ``landmark_ids``.
        None where the filter knows none, or landmarks are fixed, whose errors nobody knows.
        """
        return self._state.configuration_covariance(self._state.confirmed[rows])

    @property
    def landmark_velocities(self) -> FloatArray:
        """(n, 3) velocities of landmarks that move, known or estimated, m/s, world."""
        observer = self._state.observer
        return se3.rotate(observer.reference_pose, observer.u[self._state.confirmed])

    @property
    def calibration(self) -> list[CalibrationEstimate]:
        """Scale, bias and delay of the velocity, as far as the settings ask for them."""
        return self._hypotheses.calibration

    @property
    def motion_factors(self) -> list[MotionFactor]:
        """How noisy turning and driving are over what is stated; empty where that is not known."""
        return self._state.motion_noise.factors.estimates

    @property
    def lyapunov(self) -> float:
        """L (34) of the latest observation's residuals; zero before the first."""
        return 0.0 if self.last_update is None else self.last_update.lyapunov

    @property
    def _state(self) -> State:
        """The most likely state."""
        return self._hypotheses.best

    def _drop(self, error: InvalidEventError) -> None:
        self.dropped[error.reason] += 1
        self._warnings.warn('dropped_message', error.reason, reason=error.reason, error=error)

    def _process(self, item: Queued) -> None:
        """Use what has its turn: what is of one stamp, or velocities that follow each other."""
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
        state, warnings = self._state, self._warnings
        usable = usable_points(
            event, self.settings, state.gains, state.landmarks, self._counts, warnings
        )
        event = self._timeline.synchronise(usable)
        if self._localiser.loaded is not None:
            self._doubt_rough_pose(event)
        outcome = self._hypotheses.observe(event)
        self._localise(event, outcome)
        if np.count_nonzero(event.ids == UNKNOWN_ID):
            self._close_loops(event.stamp_ns)
        self._counts['observation'] += 1
        self._counts['late_observation'] += self._timeline.was_late
        self._warn_of(event, outcome)
        self.last_update = self._update(event.stamp_ns, outcome)
        if self._on_update is not None:
            self._on_update(self.last_update)

    def _close_loops(self, stamp_ns: int) -> None:
        """Merge landmarks without ids that turn out to be one."""
        state, closure = self._state, self._loop_closure
        closure.note(state, stamp_ns)
        if not closure.is_due(state, stamp_ns):
            return
        merged = state.counts['merged_landmark']
        if closure.close(state, stamp_ns):
            self._hypotheses.prune_to_best()
            merged = state.counts['merged_landmark'] - merged
            logger.info('A loop has closed: %d landmarks without ids were seen before.', merged)
        if len(self._hypotheses) == 1:
            closure.merge_twins(state)
            closure.count_doubled(state)

    def _doubt_rough_pose(self, event: ObservationEvent) -> None:
        """Search about a given pose that is too rough for the points of an observation."""
        if not self._localiser.may_be_rough(event):
            return
        pose, covariance = self.pose, self.pose_covariance
        if covariance is not None and is_rough(covariance):
            self._start(None)
            self._localiser.search_near(pose, covariance)

    def _localise(self, event: ObservationEvent, outcome: Outcome) -> None:
        """Look for the pose in a loaded map if it is not known, or not any more."""
        if not self._localiser.maps:
            return
        missed = self._hypotheses.missed
        reason = self._localiser.reason_to_reset(self._state, event, outcome, missed)
        if reason is not None:
            logger.warning('%s; localising again.', reason)
            self._start(None)
        if self._localiser.search(self._state):
            self._hypotheses.prune_to_best()
        elif (found := self._localiser.pose_by_tag(self._state)) is not None:
            self._start(found.pose, found.covariance, found.known)
            self._localiser.try_tag(found.tag_id)

    def _start_again(self, distance_m: float) -> None:
        """Start again where settings or measurements have led the estimate out of all bounds."""
        logger.error(
            'The estimate has diverged: the pose is %.1e m from its origin. Starting again; the '
            'noise of velocities and landmarks may be set orders of magnitude wrong.',
            distance_m,
        )
        self._counts['diverged'] += 1
        self._start(None)

    def _move_robot(self, pose: FloatArray, covariance: FloatArray | None) -> None:
        """Move the robot; if the pose in a loaded map was not known, it is now."""
        self._was_placed = True
        if self.is_localised:
            self._hypotheses.prune_to_best().set_pose(self._allowed(pose), covariance)
            self._localiser.doubt_pose()
        else:
            self._start(pose, covariance)

    def _start_where_settings_say(self) -> None:
        settings = self.settings
        turn = settings.initial_roll, settings.initial_pitch, settings.initial_yaw
        deviations = settings.initial_angle_stddev, settings.initial_position_stddev
        pose = se3.from_rpy((*settings.initial_position, *turn))
        self._start(pose, np.diag(np.repeat(deviations, 3) ** 2))

    def _start(
        self,
        pose: FloatArray | None,
        covariance: FloatArray | None = None,
        known: LandmarkMap | None = None,
    ) -> None:
        """Start again with an empty map, or the loaded one, at ``pose`` (4, 4) if it is known.

        ``known`` is the map that it is in; of several ones it is searched for if that is None.
        """
        rough = pose if known is None and len(self._localiser.maps) > 1 else None
        pose = pose if rough is None else None
        state = self._state_at(np.eye(4) if pose is None else self._allowed(pose))
        self._hypotheses.reset(state)
        self._localiser.start(state, pose is not None, covariance, known)
        if rough is not None:
            given = np.zeros((6, 6)) if covariance is None else covariance
            self._localiser.search_near(rough, given + np.diag(GIVEN_POSE_STD**2))

    def _state_at(self, pose: FloatArray) -> State:
        """Return a state at its start, with P° = ``pose`` (4, 4)."""
        state = State(make_gains(self._live, pose), self._live)
        state.judges_innovations = self._judges_innovations
        return state

    def _allowed(self, pose: FloatArray) -> FloatArray:
        """Return a pose (4, 4), or with ``two_d_mode`` what of it lies in the plane."""
        return se3.flatten(pose) if self.settings.two_d_mode else pose

    def _warn_of_unused(self) -> None:
        """Name settings that have been changed and have no effect."""
        settings = self.settings
        changed = set(changed_names(settings))
        if unused := [name for name in self._state.gains.ignores if name in changed]:
            logger.warning('No effect on %s gains: %s.', settings.gains, ', '.join(unused))
        is_ignored = 'use_tag_orientation' in self._state.gains.ignores
        if settings.use_tag_orientation and self._state.gains.tags is None and not is_ignored:
            logger.warning(
                'use_tag_orientation has no effect with landmark_velocity_stddev: landmarks are '
                'points that move (set landmark_velocity_stddev: 0.0 for tags at rest).'
            )
        is_given = any(settings.initial_position) or settings.initial_yaw != 0.0
        if is_given and not settings.set_initial_pose:
            logger.warning(
                'initial_position and initial_yaw have no effect (use set_initial_pose: true).'
            )

    def _warn_of(self, event: ObservationEvent, outcome: Outcome) -> None:
        """Warn of what is wrong with an observation, its outcome, or the map."""
        warnings, state = self._warnings, self._state
        limit = self.settings.max_landmarks if state.is_mapping else 0
        if 0 < limit < len(event.ids):
            warnings.warn('more_than_max', count=len(event.ids), limit=limit)
        if len(outcome.moved_ids):
            warnings.moved_landmarks(outcome.moved_ids, event.stamp_ns)
        if carried_ids := self._hypotheses.carried_ids:
            warnings.carried_landmarks(carried_ids)
        warnings.unexpected_poses(self._hypotheses.some_counts(UNEXPECTED_POSES))
        warnings.large_map(len(state.landmarks), limit, state.gains)
        distance_m = math.hypot(*state.observer.A[:3, 3].tolist())
        if not distance_m <= DIVERGED_M:  # nor is what is no number
            self._start_again(distance_m)

    def _update(self, stamp_ns: int, outcome: Outcome) -> Update:
        observer = self._state.observer
        return Update(
            stamp_ns,
            observer.pose,
            outcome.ids,
            se3.rotate(observer.reference_pose, outcome.residuals),
            outcome.rejected,
            lyapunov(self.settings.gain_k, outcome.residuals),
            outcome.moved_ids,
            outcome.innovation,
        )

    def _clear_time(self) -> None:
        """Forget all that has a stamp but the map."""
        settings = self.settings
        self._queue = EventQueue(
            window_ns=to_ns(settings.reorder_window),
            max_jump_ns=to_ns(settings.max_stamp_jump),
            late_limit_ns=to_ns(settings.late_limit),
        )
        self._timeline = Timeline(self._hypotheses, settings, self._on_motion)
