"""Time-stamped events in, pose and map out: the one estimator of node, replay and simulation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
import logging

import numpy as np

from slam_observer_ros.errors import InvalidEventError
from slam_observer_ros.event_queue import EventQueue
from slam_observer_ros.events import Event, flatten, ObservationEvent, VelocityEvent
from slam_observer_ros.gains import make_gains
from slam_observer_ros.gains.base import Innovation, Motion, Seen
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.landmark_table import LandmarkTable
from slam_observer_ros.noise import NoiseModel
from slam_observer_ros.observer import lyapunov, Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.validation import check_event
from slam_observer_ros.velocity_history import VelocityHistory

logger = logging.getLogger(__name__)

MAX_PENDING_VELOCITIES = 64
"""Velocities that may wait for an observation before the state is moved on without one."""


@dataclass(frozen=True, slots=True)
class Update:
    """The state right after an observation was used.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the state, nanoseconds.
    pose : FloatArray
        (4, 4) estimated pose, body to world.
    ids : IntArray
        (m,) ids of the known landmarks that were seen.
    residuals : FloatArray
        (m, 3) their residuals r_i before the correction, metres, reference frame.
    lyapunov : float
        L (34) of these residuals.

    """

    stamp_ns: int
    pose: FloatArray
    ids: IntArray
    residuals: FloatArray
    lyapunov: float


class Estimator:
    """Pose and landmark map from time-stamped velocities and observations.

    The state advances only at event stamps, in stamp order, so its bits don't depend on when
    anybody asks for them: a live run and a replay of what it received agree exactly.

    Parameters
    ----------
    settings : Settings
        All settings.
    initial_pose : FloatArray, optional
        (4, 4) pose at the first event, body to world; also the reference P°. Default identity.
    on_update : callable, optional
        Called with an :class:`Update` after each observation that was used.

    Attributes
    ----------
    counts : Counter
        Events used, by kind (``'velocity'``, ``'observation'``, ``'late_observation'``).
    dropped : Counter
        Events refused, by reason.

    """

    def __init__(
        self,
        settings: Settings,
        initial_pose: FloatArray | None = None,
        on_update: Callable[[Update], None] | None = None,
    ) -> None:
        self.settings = settings
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._on_update = on_update
        self._queue = EventQueue(
            _nanoseconds(settings.reorder_window),
            _nanoseconds(settings.max_stamp_jump),
            _nanoseconds(settings.late_limit),
        )
        self._noise = NoiseModel(settings)
        self.reset(initial_pose)

    def reset(self, pose: FloatArray | None = None) -> None:
        """Forget the map and the motion, and start again at ``pose`` (4, 4), default identity."""
        self._observer = Observer(np.eye(4) if pose is None else pose)
        self._gains = make_gains(self.settings)
        self._landmarks = LandmarkTable()
        self._velocities = VelocityHistory(_nanoseconds(self.settings.velocity_timeout))
        self._state_ns: int | None = None
        self._stamp_ns: int | None = None
        self._innovation_ns: int | None = None
        self._last: Update | None = None

    def change_settings(self, settings: Settings) -> None:
        """Use other gains from now on; parameters that are read-only keep their effect."""
        self.settings = settings
        self._gains.change_settings(settings)

    def add(self, event: Event) -> bool:
        """Take an event; return whether it was accepted.

        A bad event is dropped whole, counted in ``dropped`` by its reason and logged; the state
        is untouched.
        """
        try:
            check_event(event)
            event = flatten(event) if self.settings.two_d_mode else event
            jumped = self._queue.push(event)
        except InvalidEventError as error:
            self._drop(error)
            return False
        if jumped:
            logger.warning('The clock has jumped; starting again.')
            self.reset(self._observer.reference_pose)
            self._queue.restart(event)
        for ready in self._queue.pop_ready():
            self._process(ready)
        return True

    def flush(self) -> None:
        """Use the events that are still held back, as at the end of a recording."""
        for ready in self._queue.pop_all():
            self._process(ready)

    def forget(self, landmark_id: int) -> bool:
        """Remove a landmark from the map; return whether it was known."""
        rows = self._landmarks.indices_of(np.array([landmark_id]))
        if rows[0] < 0:
            return False
        self._remove(rows)
        return True

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last event that was used, nanoseconds; None before the first."""
        return self._stamp_ns

    @property
    def newest_stamp_ns(self) -> int | None:
        """Newest stamp received, nanoseconds; it may still be held back."""
        return self._queue.newest_ns

    @property
    def pose(self) -> FloatArray:
        """(4, 4) estimated pose at ``stamp_ns``, body to world."""
        return self._observer.pose if self._stamp_ns is None else self.pose_at(self._stamp_ns)

    def pose_at(self, stamp_ns: int) -> FloatArray:
        """Return the pose (4, 4) at any time: the state, moved on by the velocities since."""
        if self._state_ns is None:
            return self._observer.pose
        return self._observer.pose @ self._motion(self._state_ns, stamp_ns)

    @property
    def pose_covariance(self) -> FloatArray | None:
        """(6, 6) covariance of the pose at ``stamp_ns``: rotation vector, then position.

        Both along the world's axes, rad² and m². None where the gains know none.
        """
        covariance = self._gains.pose_covariance
        if covariance is None:
            return None
        return self._world_covariance(covariance)

    @property
    def body_velocity(self) -> FloatArray:
        """(6,) velocity (Ω, v) in force at ``stamp_ns``; zero when it has timed out."""
        event = None if self._stamp_ns is None else self._velocities.latest(self._stamp_ns)
        return np.zeros(6) if event is None else event.body_velocity

    @property
    def velocity_is_stale(self) -> bool:
        """Whether no velocity was in force at ``stamp_ns``, so that the pose is being held."""
        return self._stamp_ns is None or self._velocities.latest(self._stamp_ns) is None

    @property
    def landmark_ids(self) -> IntArray:
        """(n,) ids of the known landmarks."""
        return self._landmarks.ids

    @property
    def landmark_counts(self) -> IntArray:
        """(n,) number of observations of each landmark."""
        return self._landmarks.counts

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks, metres, world."""
        return self._observer.world_points

    @property
    def landmark_covariances(self) -> FloatArray | None:
        """(n, 3, 3) covariances of the landmarks, world, m²; None where the gains know none."""
        covariances = self._gains.landmark_covariances
        R = self._observer.reference_pose[:3, :3]
        return None if covariances is None else R @ covariances @ R.T

    @property
    def last_update(self) -> Update | None:
        """The latest update; None before the first observation."""
        return self._last

    @property
    def lyapunov(self) -> float:
        """L (34) of the latest observation's residuals; zero before the first."""
        return 0.0 if self._last is None else self._last.lyapunov

    def _drop(self, error: InvalidEventError) -> None:
        self.dropped[error.reason] += 1
        if _is_power_of_ten(self.dropped[error.reason]):
            logger.warning(
                'Dropped an event (%s, %d so far): %s',
                error.reason,
                self.dropped[error.reason],
                error,
            )

    def _process(self, event: Event) -> None:
        if isinstance(event, VelocityEvent):
            self._process_velocity(event)
        else:
            self._process_observation(event)

    def _process_velocity(self, event: VelocityEvent) -> None:
        if self._stamp_ns is not None and event.stamp_ns < self._stamp_ns:
            self._drop(InvalidEventError('too_late', 'a newer velocity was already used'))
            return
        self._velocities.append(event)
        self._begin(event.stamp_ns)
        self.counts['velocity'] += 1
        if self._velocities.count_since(self._state_ns or 0) >= MAX_PENDING_VELOCITIES:
            self._advance(event.stamp_ns)

    def _process_observation(self, event: ObservationEvent) -> None:
        self._begin(event.stamp_ns)
        if event.stamp_ns < (self._state_ns or 0):
            event = self._carry_forward(event)
        self._advance(event.stamp_ns)
        rows = self._landmarks.indices_of(event.ids)
        ids, residuals = (
            event.ids[rows >= 0],
            self._innovate(_select(event, rows >= 0), rows[rows >= 0]),
        )
        self._drop_moved()
        rows = self._landmarks.indices_of(event.ids)
        self._initialise(_select(event, rows < 0))
        rows = self._landmarks.indices_of(event.ids)
        seen = Seen(event.stamp_ns, rows, event.points, self._noise.observation(event))
        self._gains.look_back(self._observer, seen)
        self.counts['observation'] += 1
        level = lyapunov(self.settings.gain_k, residuals)
        self._last = Update(event.stamp_ns, self._observer.pose, ids, residuals, level)
        if self._on_update is not None:
            self._on_update(self._last)

    def _drop_moved(self) -> None:
        """Forget landmarks that were rejected so often that they must have moved."""
        moved = np.flatnonzero(self._landmarks.rejections >= self.settings.max_rejections)
        if len(moved):
            self.counts['moved_landmark'] += len(moved)
            self._remove(moved)

    def _remove(self, rows: IntArray) -> None:
        self._observer.remove_landmarks(rows)
        self._gains.remove_landmarks(rows)
        self._landmarks.remove(rows)

    def _begin(self, stamp_ns: int) -> None:
        self._stamp_ns = max(stamp_ns, self._stamp_ns or stamp_ns)
        if self._state_ns is None:
            self._state_ns = stamp_ns

    def _motion(self, start_ns: int, end_ns: int) -> FloatArray:
        """Return exp(V_1 dt_1) … (4, 4): the body's motion, backwards if the end comes first."""
        if end_ns < start_ns:
            return se3.inverse(self._motion(end_ns, start_ns))
        held = self._velocities.held(start_ns, end_ns)
        V = self._gains.calibrated(held.body_velocities)
        return reduce(np.matmul, se3.exp(V * held.dt_s[:, None]), np.eye(4))

    def _carry_forward(self, event: ObservationEvent) -> ObservationEvent:
        """Return what would be seen at the state's stamp: Φ⁻¹ y(t − τ), Φ the motion since."""
        state_ns = self._state_ns or 0
        back = self._motion(state_ns, event.stamp_ns)
        self.counts['late_observation'] += 1
        turn = back[:3, :3]
        return replace(
            event,
            stamp_ns=state_ns,
            points=se3.transform(back, event.points),
            covariances=None if event.covariances is None else turn @ event.covariances @ turn.T,
            velocities=None if event.velocities is None else se3.rotate(back, event.velocities),
        )

    def _advance(self, stamp_ns: int) -> None:
        """Move the state on to ``stamp_ns`` along the velocities held since."""
        start_ns = stamp_ns if self._state_ns is None else self._state_ns
        if stamp_ns > start_ns:
            held = self._velocities.held(start_ns, stamp_ns)
            V = self._gains.calibrated(held.body_velocities)
            path = self._observer.propagate(V, held.dt_s)
            covariances = self._noise.motion(held)
            self._gains.predict(Motion(path, held.body_velocities, held.dt_s, covariances))
            self._velocities.forget_before(stamp_ns - _nanoseconds(self.settings.late_limit))
        self._state_ns = stamp_ns

    def _innovate(self, event: ObservationEvent, rows: IntArray) -> FloatArray:
        """Correct the state by m known landmarks; return their residuals (m, 3)."""
        e, r = self._observer.errors(rows, event.points)
        if not len(rows):
            return r
        R = self._observer.A[:3, :3]
        covariances = R @ self._noise.observation(event) @ R.T
        since_ns = event.stamp_ns if self._innovation_ns is None else self._innovation_ns
        dt_s = (event.stamp_ns - since_ns) * 1e-9
        correction, weights = self._gains.correct(Innovation(rows, e, r, covariances, dt_s))
        self._observer.correct(correction)
        self._landmarks.see(rows, weights > 0.0, event.stamp_ns)
        self._innovation_ns = event.stamp_ns
        self.counts['rejected_landmark'] += int(np.sum(weights == 0.0))
        return r

    def _initialise(self, event: ObservationEvent) -> None:
        if not len(event.ids):
            return
        R = self._observer.A[:3, :3]
        self._observer.add_landmarks(event.points)
        y_ref = self._observer.y_ref[-len(event.ids) :]
        self._gains.add_landmarks(y_ref, R @ self._noise.observation(event) @ R.T)
        self._landmarks.add(event.ids, event.stamp_ns)
        self._innovation_ns = self._innovation_ns or event.stamp_ns

    def _world_covariance(self, covariance: FloatArray) -> FloatArray:
        """Return the covariance of (rotation, position) from that of ε in Â = exp(ε) A."""
        J = np.eye(6)
        J[3:, :3] = -so3.hat(self._observer.A[:3, 3])
        R = self._observer.reference_pose[:3, :3]
        turn = np.kron(np.eye(2), R) @ J
        world: FloatArray = turn @ covariance @ turn.T
        return world


def _select(event: ObservationEvent, mask: BoolArray) -> ObservationEvent:
    """Return the part of an observation that ``mask`` (m,) picks."""
    return replace(
        event,
        ids=event.ids[mask],
        points=event.points[mask],
        covariances=None if event.covariances is None else event.covariances[mask],
        velocities=None if event.velocities is None else event.velocities[mask],
    )


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _is_power_of_ten(count: int) -> bool:
    return str(count).rstrip('0') == '1'
