"""The instant of an estimate, and the velocities that lead on from there.

A late observation is carried forward to that instant: to what would be seen from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol, TypeAlias

import numpy as np

from slam_observer_ros.common.errors import InvalidEventError
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import MeasuredVelocity, ObservationEvent, VelocityBlock
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import SPATIAL
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.models.held_velocities import HeldVelocities, LEAD_NS
from slam_observer_ros.models.motion_noise import beyond_driving
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import MAX_DELAY_S, Settings
from slam_observer_ros.tracking.covariances import of_moved_pose
from slam_observer_ros.tracking.matching import point_covariances
from slam_observer_ros.tracking.state import State

OnMotion: TypeAlias = Callable[[VelocityHistory, int, int], None]
"""Called with velocities, and with the stamps of a motion along them: start and end, ns."""

MAX_PENDING_VELOCITIES = 128
"""Velocities that may wait for an observation before the state is moved on without one."""


class Moved(Protocol):
    """Hypotheses as the timeline moves them along the velocities."""

    @property
    def best(self) -> State:
        """The most likely state."""

    def propagate(self, velocities: VelocityHistory, start_ns: int, end_ns: int) -> None:
        """Move on from stamp to stamp, nanoseconds (27)."""


class Timeline:
    """Velocities of the recent past, and how far the hypotheses have been moved along them.

    ``velocity_timeout``, ``late_limit`` and ``two_d_mode`` are read from the settings, and
    ``on_motion`` is called each time before the hypotheses are moved on.
    """

    def __init__(
        self, hypotheses: Moved, settings: Settings, on_motion: OnMotion | None = None
    ) -> None:
        self._hypotheses, self._settings = hypotheses, settings
        timeout_ns = to_ns(settings.velocity_timeout)
        bias = np.array(settings.angular_bias)
        self.velocities = VelocityHistory(timeout_ns, settings.two_d_mode, bias)
        self.stamp_ns: int | None = None  # of the last event used; None before the first
        self.state_ns: int | None = None  # of the hypotheses: velocities since are pending
        # A delay, half of the time over which velocities are averaged to estimate it, and that in
        # which a mean leads to a motion.
        self._kept_ns = to_ns(settings.late_limit + 2.0 * MAX_DELAY_S) + LEAD_NS
        self._on_motion = on_motion
        self._pending = 0
        self.was_late = False  # the last event came after its instant had been passed
        self._in_force_ns = 0  # before this stamp velocities can't be changed any more
        self._newest_ns: dict[str, int] = {}

    def parts(self, velocities: VelocityBlock) -> Iterator[MeasuredVelocity]:
        """Yield velocities in parts as :meth:`append` takes them."""
        if velocities.stamp_ns <= max(self.stamp_ns or -1, self._in_force_ns - 1):
            yield from velocities.events()
            return
        while len(velocities) > (room := MAX_PENDING_VELOCITIES - self._pending):
            yield velocities.part(slice(room))
            velocities = velocities.part(slice(room, None))
        yield velocities

    def _note_stamps(self, first_ns: int, last_ns: int) -> int:
        """Note the stamps of an event that is about to be used; return ``state_ns``."""
        if self.stamp_ns is None or last_ns > self.stamp_ns:
            self.stamp_ns = last_ns
        if self.state_ns is None:
            self.state_ns = first_ns
        return self.state_ns

    def append(self, measured: MeasuredVelocity) -> bool:
        """Add velocities; return whether they are in force: an angular one waits for a linear one.

        A single late one counts from the first stamp on where velocities can be changed. Raise
        :exc:`InvalidEventError` if a newer one of its kind was used before it (``'too_late'``).
        """
        # Each kind in stamp order, and none before velocities that can't be changed.
        first_ns = last_ns = measured.stamp_ns
        count = 1
        if isinstance(measured, VelocityBlock):
            last_ns, count = int(measured.stamps_ns[-1]), len(measured)
        self.was_late = first_ns < self._in_force_ns
        if first_ns < self._newest_ns.get(measured.kind, 0):
            raise InvalidEventError('too_late', 'a newer velocity was already used')
        self._newest_ns[measured.kind] = last_ns
        if self.was_late and not isinstance(measured, VelocityBlock):
            first_ns = last_ns = self._in_force_ns
            measured = replace(measured, stamp_ns=first_ns)
        if not self.velocities.append(measured):
            return False
        # In force from now on; the state follows at the next observation, or after many.
        self._in_force_ns = last_ns
        self._note_stamps(first_ns, last_ns)
        self._pending += count
        return True

    def advance_after_many(self) -> None:
        """Move the hypotheses on without an observation if many velocities wait for one."""
        if self._pending >= MAX_PENDING_VELOCITIES:
            # No further: the stamp of an observation without points may be ahead of velocities.
            self._advance(self._in_force_ns)

    @property
    def body_velocity(self) -> FloatArray | None:
        """(6,) velocity (Ω, v) in force at ``stamp_ns``; None if none is or it has timed out."""
        return None if self.stamp_ns is None else self.velocities.latest(self.stamp_ns)

    @property
    def velocity_in_force(self) -> HeldVelocities | None:
        """As :meth:`.VelocityHistory.in_force` at ``stamp_ns``; None before the first event."""
        return None if self.stamp_ns is None else self.velocities.in_force(self.stamp_ns)

    @property
    def lead_s(self) -> float:
        """Seconds from ``state_ns`` to ``stamp_ns``."""
        return to_s((self.stamp_ns or 0) - (self.state_ns or 0))

    def catch_up(self) -> None:
        """Move the hypotheses on to the last event that was used."""
        if self.stamp_ns is not None:
            self._advance(self.stamp_ns)

    def _advance(self, stamp_ns: int) -> None:
        """Move the hypotheses on from ``state_ns`` to ``stamp_ns``, never back."""
        self._pending = 0
        start_ns = self.state_ns
        if start_ns is None or stamp_ns <= start_ns:
            return
        if self._on_motion is not None:
            self._on_motion(self.velocities, start_ns, stamp_ns)
        self._hypotheses.propagate(self.velocities, start_ns, stamp_ns)
        self.velocities.forget_before(stamp_ns - self._kept_ns)
        self.state_ns = stamp_ns
        self._in_force_ns = max(self._in_force_ns, stamp_ns)

    def synchronise(self, event: ObservationEvent) -> ObservationEvent:
        """Move the hypotheses on to an observation, or it to them if it is late; return it.

        One without points, as an idle sensor sends, moves nothing: it would make others late.
        """
        state_ns = self._note_stamps(event.stamp_ns, event.stamp_ns)
        self.was_late = bool(len(event.ids)) and event.stamp_ns < self._in_force_ns
        if not len(event.ids):
            return replace(event, stamp_ns=state_ns)
        if event.stamp_ns < state_ns:
            event = carried_forward(self._hypotheses.best, event, self.velocities, state_ns)
        self._advance(event.stamp_ns)
        self._in_force_ns = max(self._in_force_ns, event.stamp_ns)
        return event

    def judge_standing(self, event: ObservationEvent, update: Update) -> None:
        """Doubt that the robot stands where all that it sees is rejected, and far off.

        Far as the farthest point is seen: points without ids have other ids in ``update``.
        """
        if not update.rejected.all():
            return
        farthest = event.points[np.argmax(np.linalg.norm(event.points, axis=1))][None]
        if beyond_driving(farthest, update.residuals, self._settings).all():
            self.velocities.doubt_standing()

    def knows_motion_since(self, stamp_ns: int) -> bool:
        """Return whether velocities are known from a stamp on."""
        begins_ns = self.velocities.begins_ns
        return begins_ns is not None and begins_ns <= stamp_ns

    def moved_on(
        self, pose: FloatArray, covariance: FloatArray, stamp_ns: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return how a pose (4, 4) of a stamp, with its covariance (6, 6), is at ``stamp_ns``."""
        end_ns, best = max(self.stamp_ns or 0, stamp_ns), self._hypotheses.best
        motion = best.effect(np.eye(4), self.velocities.flat(), stamp_ns, end_ns)
        noise = best.axes.full_pose_covariance(motion.noise)
        return pose @ motion.A, of_moved_pose(covariance, pose, motion.A, noise)

    def motion(self, start_ns: int, end_ns: int) -> FloatArray:
        """Return how the body moves (4, 4) between two stamps, backwards if need be."""
        if end_ns < start_ns:
            return se3.inverse(self.motion(end_ns, start_ns))
        flat = self.velocities.flat()
        return self._hypotheses.best.effect(np.eye(4), flat, start_ns, end_ns).A


def carried_forward(
    state: State, event: ObservationEvent, velocities: VelocityHistory, state_ns: int
) -> ObservationEvent:
    """Return what would be seen at ``state_ns``: Φ⁻¹ (y + v τ), Φ the motion since ``event``.

    Its points are as uncertain as any seen from there, and more by the motion. The motion's error
    is one for all m points, which would average it down: each is given m times its covariance.
    Where velocities of landmarks are estimated, v is as uncertain as they may be.
    """
    # The motion of the robot since then, and of the landmarks.
    lag_s = to_s(state_ns - event.stamp_ns)
    motion = state.effect(np.eye(4), velocities.flat(), event.stamp_ns, state_ns)
    back = se3.inverse(motion.A)
    shifts = _landmark_velocities(state, event, state.observer.A @ back) * lag_s
    points = event.points + shifts
    # The sensor with them: the distance stays as it was measured.
    sensor = shifts if event.sensor is None else event.sensor + shifts
    shifted = replace(event, stamp_ns=state_ns, points=points, sensor=sensor)
    moved = shifted.moved(back)
    # What both add to the noise.
    Q = state.axes.full_pose_covariance(motion.noise)
    C = back[:3, :3] @ SPATIAL.output_matrix(points)
    shared = len(points) * C @ Q @ transpose(C)
    rows = state.landmarks.rows_of(event.ids)
    own = (lag_s * state.landmark_velocity_stddev) ** 2 * np.eye(3)
    moved = replace(moved, covariances=point_covariances(state, moved, rows) + shared + own)
    if moved.orientations is None:
        return moved
    R, turns = (
        back[:3, :3],
        state.observation_noise.orientation_covariances(moved, moved.orientations),
    )
    turns = turns + len(points) * R @ Q[:3, :3] @ R.T
    return replace(moved, orientation_covariances=turns)


def _landmark_velocities(state: State, event: ObservationEvent, A: FloatArray) -> FloatArray:
    """Return how the landmarks (m, 3) seen move, m/s, along the axes of the body at Â = ``A``."""
    velocities = np.zeros_like(event.points)
    if not state.landmark_velocity_stddev:  # not estimated: as the sensor says
        return velocities if event.velocities is None else event.velocities
    rows = state.landmarks.rows_of(event.ids)
    velocities[rows >= 0] = state.observer.u[rows[rows >= 0]]
    return se3.rotate(se3.inverse(A), velocities)
