"""What stands still in the robot's frame while odometry says that the robot drives on.

If all does, the robot stands and its wheels spin, for as long as that lasts: each observation is
off by too little to be rejected, and pose and landmarks would be dragged along. If some of it
does while other landmarks pass as odometry has it, the robot carries them along: these are not
places. A landmark bears witness to a standstill once it has been seen to pass, or if it is of a
map that does not grow; till then it may be one that the robot carries.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.common.units import to_ns
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import mahalanobis, transpose, with_blocks
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.state.state import State

FIRST_TEST_NS, LAST_TEST_NS = to_ns(0.25), to_ns(2.0)
"""When it is looked at what has passed, after its start, and for the last time."""

NOISE = 3.0
"""Standard deviations of what a sensor says, within which a landmark stands still."""

CLEAR = 6.0
"""Standard deviations from which on a motion, or a shift in the robot's frame, is clear."""

LEAST_WITNESSES = 2
"""Landmarks that must agree on a standstill: one alone may move as the robot does."""

MOST = 0.75
"""Share of the landmarks in view that stands for all of them: some points are false."""

MAX_MOTIONS = 1000
"""Motions between observations that are remembered."""


@dataclass(frozen=True, slots=True)
class _View:
    """What landmarks (m,) in view have done in the robot's frame, in standard deviations."""

    ids: IntArray
    shift: FloatArray  # from where each was
    error: FloatArray  # from where odometry has it, with the noise of that
    off: FloatArray  # (m, k) the same in metres, body frame
    noise: FloatArray  # (m, k, k) of the sensor in both observations, m²
    C: FloatArray  # (m, k, p) how the motion's error moves each

    @classmethod
    def of(
        cls,
        state: State,
        start: ObservationEvent,
        event: ObservationEvent,
        motion: FloatArray,
        motion_noise: FloatArray,
    ) -> _View | None:
        """Return what an observation shows after a ``motion`` (4, 4) of noise (p, p), or None."""
        ids, before, now = np.intersect1d(start.ids, event.ids, return_indices=True)
        if len(ids) and ids[0] == UNKNOWN_ID:
            ids, before, now = ids[1:], before[1:], now[1:]
        if len(ids) < LEAST_WITNESSES:
            return None
        axes, points, was_at = state.axes, event.points[now], start.points[before]
        k, A = axes.point, state.observer.A
        # Of both observations: what stands has the same noise in either.
        noise = 2.0 * state.observation_noise.covariances(event)[now, :k, :k]
        expected = se3.transform(se3.inverse(motion), was_at)
        C = transpose(A[:k, :k]) @ axes.output_matrix(se3.transform(A, expected))
        of_motion = C @ motion_noise @ transpose(C)
        shifts = np.concatenate([points - was_at, points - expected])[:, :k]
        distances = mahalanobis(shifts, np.concatenate([noise, noise + of_motion]))
        shift, error = distances.reshape(2, -1)
        return cls(ids, shift, error, (points - expected)[:, :k], noise, C)

    def joint_error(self, mask: BoolArray, motion_noise: FloatArray) -> float:
        """Return the errors of some landmarks as one, in squared standard deviations."""
        C = self.C[mask].reshape(-1, self.C.shape[-1])
        S = with_blocks(C @ motion_noise @ C.T, self.noise[mask])
        off = self.off[mask].ravel()
        return float(off @ np.linalg.solve(S, off))

    @property
    def gain(self) -> FloatArray:
        """(m,) 2 ln of how much likelier it is that each stands than that it passes."""
        return self.error**2 - self.shift**2

    @property
    def stands(self) -> BoolArray:
        """Which (m,) are where they were."""
        return self.shift <= NOISE

    @property
    def passes(self) -> BoolArray:
        """Which (m,) are not, and nearer to where odometry has them."""
        return (self.shift > NOISE) & (2.0 * self.error < self.shift)


@dataclass(slots=True)
class Standing:
    """Whether the robot stands while its wheels spin, and which landmarks it carries along."""

    carried: set[int] = field(default_factory=set)
    suspects: set[int] = field(default_factory=set)  # that may be carried, and those that are
    is_spinning: bool = False
    _witnesses: set[int] = field(default_factory=set)
    _evidence: dict[int, float] = field(default_factory=dict)  # that each is carried
    _start: ObservationEvent | None = None  # that later ones are compared with
    _motions: list[Motion] = field(default_factory=list)  # since then
    _left: FloatArray | None = None  # Â (4, 4) that the last observation led to
    _step: FloatArray = field(default_factory=lambda: np.eye(4))  # motion since it
    _motion: FloatArray = field(default_factory=lambda: np.eye(4))  # motion since the start
    _before: FloatArray = field(default_factory=lambda: np.eye(4))  # motion up to the start
    _test_ns: int = FIRST_TEST_NS  # after the start
    _compared_ns: int = 0  # when anything was compared with it, or it was seen

    def clear_time(self) -> None:
        """Compare nothing with what was seen before."""
        self.is_spinning, self._start = False, None
        self._motions, self._before = [], np.eye(4)

    def move(self, motion: Motion) -> None:
        """Remember a motion by odometry."""
        if self._start is not None:
            if self._left is None:
                self._left = motion.path[0]
            self._motions.append(motion)
            if len(self._motions) > MAX_MOTIONS:
                self.clear_time()

    def note(self, state: State, event: ObservationEvent) -> FloatArray | None:
        """Judge an observation that is yet to be used, by the most likely state.

        Return motions (2, 4, 4) if the wheels spin: the one since the last observation, which has
        not been made, and the one in all that may not have been.
        """
        start, lost = self._start, None
        self._add_step(state)
        if start is None or event.stamp_ns - self._compared_ns > 2 * LAST_TEST_NS:
            self.clear_time()
            self._begin(event)
        elif event.sensor_frame != start.sensor_frame:
            lost = np.array([self._step, self._step]) if self.is_spinning else None
        elif self.is_spinning:
            lost = self._go_on(state, start, event)
        elif event.stamp_ns - start.stamp_ns >= self._test_ns:
            lost = self._test(state, start, event)
        return lost

    def _add_step(self, state: State) -> None:
        """Add the motion since the last observation to that since the start."""
        self._step = np.eye(4)
        if self._left is not None:
            self._step = se3.inverse(self._left) @ state.observer.A
            self._motion, self._left = self._motion @ self._step, None

    def _begin(self, event: ObservationEvent) -> None:
        """Compare with this observation from now on."""
        self._start, self._motions, self._test_ns = event, [], FIRST_TEST_NS
        self._compared_ns, self._motion = event.stamp_ns, np.eye(4)

    def _test(
        self, state: State, start: ObservationEvent, event: ObservationEvent
    ) -> FloatArray | None:
        """Look for a standstill, and for landmarks that are carried along."""
        self._compared_ns, self._test_ns = event.stamp_ns, 2 * self._test_ns
        motion, is_over = self._motion, self._test_ns > LAST_TEST_NS
        noise = self._motion_noise(state)
        view = _View.of(state, start, event, motion, noise)
        if view is None:
            is_over = True
        elif self._all_stand(state, view, noise):
            self.is_spinning = True
            return np.array([self._step, self._before @ motion])
        elif is_over or self._is_decided(state, view):
            is_over = True
            self._sort(state, view)
        if is_over:
            self._before = motion
            self._begin(event)
        return None

    def _go_on(
        self, state: State, start: ObservationEvent, event: ObservationEvent
    ) -> FloatArray | None:
        """Return what :meth:`note` does while the wheels spin, or None once they don't."""
        p = state.axes.p
        view = _View.of(state, start, event, np.eye(4), np.zeros((p, p)))
        if view is not None:
            stands = view.stands[self._may_witness(state, view.ids)]
            if len(stands) >= LEAST_WITNESSES and 2 * np.count_nonzero(stands) >= len(stands):
                self._compared_ns, self._motions = event.stamp_ns, []
                return np.array([self._step, self._step])
        self.clear_time()
        self._begin(event)
        return None

    def _is_decided(self, state: State, view: _View) -> bool:
        """Return whether most of what was in view has passed, or some of it clearly stands."""
        stands = view.stands[~np.isin(view.ids, list(self.suspects))]
        clear = view.stands & (view.gain > CLEAR**2) & ~self._may_witness(state, view.ids)
        return bool(2 * np.count_nonzero(stands) <= len(stands) or clear.any())

    def _all_stand(self, state: State, view: _View, motion_noise: FloatArray) -> bool:
        """Return whether all that is in view says that the robot stands, and clearly so."""
        witnesses = self._may_witness(state, view.ids)
        stands = view.stands & witnesses
        if (
            np.count_nonzero(stands & (view.gain > NOISE**2)) < LEAST_WITNESSES
            or np.count_nonzero(stands) < MOST * np.count_nonzero(witnesses)
            or (view.passes & witnesses).any()
        ):
            return False
        likelier = view.joint_error(stands, motion_noise) - np.sum(view.shift[stands] ** 2)
        return bool(likelier > CLEAR**2)

    def _may_witness(self, state: State, ids: IntArray) -> BoolArray:
        """Return which landmarks (m,) are places, as far as is known."""
        if state.is_mapping:
            return np.isin(ids, list(self._witnesses))
        return np.ones(len(ids), dtype=np.bool_)

    def _motion_noise(self, state: State) -> FloatArray:
        """Return the covariance (p, p) of the motion since the start, with that of its bias."""
        noise = np.zeros((state.axes.p, state.axes.p))
        if not self._motions:
            return noise
        # A sensor whose calibration has begun since has no part in it.
        c = self._motions[0].sensitivity.shape[1]
        F = sum(motion.sensitivity[:, :c] for motion in self._motions)
        noise += sum(motion.noise for motion in self._motions)
        noise += (F * state.filter.calibration_variances[:c]) @ F.T
        return noise

    def _sort(self, state: State, view: _View) -> None:
        """Tell landmarks that pass, and are places, from those that stand still in view."""
        passed = view.ids[view.passes].tolist()
        self._witnesses.update(passed)
        for landmark_id in self._evidence.keys() & passed:
            del self._evidence[landmark_id]
        others_pass = len(passed) >= LEAST_WITNESSES
        stands = view.stands & (view.gain > NOISE**2)
        if not others_pass:
            stands &= ~self._may_witness(state, view.ids)
        for landmark_id, gain in zip(view.ids[stands].tolist(), view.gain[stands], strict=True):
            self._evidence[landmark_id] = self._evidence.get(landmark_id, 0.0) + float(gain)
            if others_pass and self._evidence[landmark_id] > 2.0 * CLEAR**2:
                self.carried.add(landmark_id)
        self.suspects = {i for i, evidence in self._evidence.items() if evidence > CLEAR**2}


def take_back(state: State, lost: FloatArray) -> None:
    """Take the first of two motions (2, 4, 4) back, which was not made, nor perhaps the second."""
    A, (turn, way) = state.observer.A, se3.log(lost[1]).reshape(2, 3)
    noise = block_diag(np.outer(turn, turn), np.outer(way, way))
    motion = Motion(
        path=np.array([A, A @ se3.inverse(lost[0])]),
        measured_velocities=np.zeros((1, 6)),
        dt_s=np.zeros(1),
        covariances=noise[None],
        duration_s=0.0,
        at_ends=None,
        calibration=state.filter.calibration,
        is_slip=True,
    )
    state.propagate(motion)
