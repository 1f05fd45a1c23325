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
class _Pairs:
    """Landmarks (m,) that two observations are of, and where they were seen, body frame."""

    event: ObservationEvent  # the later one …
    rows: IntArray  # … and which of its points these are
    before: FloatArray  # (m, 3) metres, as points

    @classmethod
    def of(cls, start: ObservationEvent, event: ObservationEvent) -> _Pairs:
        """Return those of two observations."""
        are_same = (start.ids[:, None] == event.ids) & (event.ids != UNKNOWN_ID)
        before, now = np.nonzero(are_same)
        return cls(event, now, start.points[before])

    @property
    def ids(self) -> IntArray:
        return self.event.ids[self.rows]

    @property
    def points(self) -> FloatArray:
        return self.event.points[self.rows]

    def share(self, motion: FloatArray) -> float:
        """Return how much of their shift by a ``motion`` (4, 4) has been seen."""
        predicted = se3.transform(se3.inverse(motion), self.before) - self.before
        square = np.vdot(predicted, predicted)
        return float(np.vdot(predicted, self.points - self.before) / square) if square else 0.0


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
        cls, state: State, pairs: _Pairs, motion: FloatArray, motion_noise: FloatArray
    ) -> _View:
        """Return what pairs of points show after a ``motion`` (4, 4) of noise (p, p)."""
        axes, k, A = state.axes, state.axes.point, state.observer.A
        # Of both observations: what stands has the same noise in either.
        noise = 2.0 * state.observation_noise.covariances(pairs.event)[pairs.rows, :k, :k]
        expected = se3.transform(se3.inverse(motion), pairs.before)
        C = transpose(A[:k, :k]) @ axes.output_matrix(se3.transform(A, expected))
        shifts = np.concatenate([pairs.points - pairs.before, pairs.points - expected])[:, :k]
        with_motion = noise + C @ motion_noise @ transpose(C)
        shift, error = mahalanobis(shifts, np.concatenate([noise, with_motion])).reshape(2, -1)
        return cls(pairs.ids, shift, error, shifts[len(pairs.ids) :], noise, C)

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
    _used: int = 0  # of these, before the last observation
    _before: FloatArray = field(default_factory=lambda: np.eye(4))  # motion up to the start
    _test_ns: int = FIRST_TEST_NS  # after the start
    _compared_ns: int = 0  # when anything was compared with it, or it was seen
    _sorted_ns: int = 0  # when landmarks were told apart

    def clear_time(self) -> None:
        """Compare nothing with what was seen before."""
        self.is_spinning, self._start = False, None
        self._motions, self._before = [], np.eye(4)

    def move(self, motion: Motion) -> None:
        """Remember a motion by odometry."""
        if self._start is not None:
            self._motions.append(motion)
            if len(self._motions) > MAX_MOTIONS:
                self.clear_time()

    def note(self, state: State, event: ObservationEvent) -> FloatArray | None:
        """Judge an observation that is yet to be used, by the most likely state.

        Return motions (2, 4, 4) if the wheels spin: the one since the last observation, which has
        not been made, and the one in all that may not have been.
        """
        start, lost = self._start, None
        if start is None or event.stamp_ns - self._compared_ns > 2 * LAST_TEST_NS:
            self.clear_time()
            self._begin(event)
        elif event.sensor_frame != start.sensor_frame:
            lost = self._all_lost() if self.is_spinning else None
        elif self.is_spinning:
            lost = self._go_on(state, _Pairs.of(start, event))
        elif event.stamp_ns - start.stamp_ns >= self._test_ns:
            lost = self._test(state, _Pairs.of(start, event))
        self._used = len(self._motions)
        return lost

    def _begin(self, event: ObservationEvent) -> None:
        """Compare with this observation from now on."""
        self._start, self._motions, self._test_ns = event, [], FIRST_TEST_NS
        self._compared_ns = event.stamp_ns

    def _test(self, state: State, pairs: _Pairs) -> FloatArray | None:
        """Look for a standstill, and for landmarks that are carried along."""
        self._compared_ns, self._test_ns = pairs.event.stamp_ns, 2 * self._test_ns
        if len(pairs.rows) < LEAST_WITNESSES:
            self._before = np.eye(4)
            self._begin(pairs.event)
            return None
        motion = _product(self._motions)
        if not self._is_usual(pairs, motion):
            noise = self._motion_noise(state)
            view = _View.of(state, pairs, motion, noise)
            if self._all_stand(state, view, noise):
                self.is_spinning = True
                return np.array([self._all_lost()[0], self._before @ motion])
            if self._test_ns <= LAST_TEST_NS and not self._has_passed(view):
                return None
            self._sort(view)
            self._sorted_ns = pairs.event.stamp_ns
        self._before = motion
        self._begin(pairs.event)
        return None

    def _is_usual(self, pairs: _Pairs, motion: FloatArray) -> bool:
        """Return whether places have passed, as nearly always.

        What has passed before is judged one by one from time to time: it may have been picked up.
        """
        return (
            pairs.event.stamp_ns - self._sorted_ns < LAST_TEST_NS
            and self._witnesses.issuperset(pairs.ids.tolist())
            and pairs.share(motion) > 0.5
        )

    def _go_on(self, state: State, pairs: _Pairs) -> FloatArray | None:
        """Return what :meth:`note` does while the wheels spin, or None once they don't."""
        if len(pairs.rows) >= LEAST_WITNESSES:
            view = _View.of(state, pairs, np.eye(4), np.zeros((state.axes.p, state.axes.p)))
            stands = view.stands[self._may_witness(state, view.ids)]
            if len(stands) >= LEAST_WITNESSES and 2 * np.count_nonzero(stands) >= len(stands):
                lost = self._all_lost()
                self._compared_ns, self._motions = pairs.event.stamp_ns, []
                return lost
        self.clear_time()
        self._begin(pairs.event)
        return None

    def _all_lost(self) -> FloatArray:
        """Return the motion since the last observation, twice (2, 4, 4)."""
        return np.tile(_product(self._motions[self._used :]), (2, 1, 1))

    def _has_passed(self, view: _View) -> bool:
        """Return whether most of what was in view is elsewhere now, but for what is carried."""
        stands = view.stands[[i not in self.suspects for i in view.ids.tolist()]]
        return bool(2 * np.count_nonzero(stands) <= len(stands))

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
            return np.array([i in self._witnesses for i in ids.tolist()], dtype=np.bool_)
        return np.ones(len(ids), dtype=np.bool_)

    def _motion_noise(self, state: State) -> FloatArray:
        """Return the covariance (p, p) of the motion since the start, with that of its bias."""
        noise = np.zeros((state.axes.p, state.axes.p))
        if not self._motions:
            return noise
        # A sensor whose calibration has begun since has no part in it.
        c = self._motions[0].sensitivity.shape[1]
        F = np.sum([motion.sensitivity[:, :c] for motion in self._motions], axis=0)
        noise += np.sum([motion.noise for motion in self._motions], axis=0)
        noise += (F * state.filter.calibration_variances[:c]) @ F.T
        return noise

    def _sort(self, view: _View) -> None:
        """Tell landmarks that pass, and are places, from those that stand still meanwhile."""
        passed = view.ids[view.passes].tolist()
        self._witnesses.update(passed)
        for landmark_id in self._evidence.keys() & passed:
            del self._evidence[landmark_id]
        if len(passed) >= LEAST_WITNESSES:
            stands = view.stands & (view.gain > NOISE**2)
            gains = dict(zip(view.ids[stands].tolist(), view.gain[stands].tolist(), strict=True))
            self._evidence |= {i: self._evidence.get(i, 0.0) + gain for i, gain in gains.items()}
        self.suspects = {i for i, evidence in self._evidence.items() if evidence > CLEAR**2}
        self.carried |= {i for i in self.suspects if self._evidence[i] > 2.0 * CLEAR**2}


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


def _product(motions: list[Motion]) -> FloatArray:
    """Return motions, one after the other, as one (4, 4), in the robot's frame at their start."""
    whole = np.eye(4)
    for motion in motions:
        whole = whole @ se3.inverse(motion.path[0]) @ motion.path[-1]
    return whole
