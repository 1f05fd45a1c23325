"""Landmarks that stand still in the robot's frame although the robot drives on by odometry.

If all landmarks do, the robot stands and its wheels spin: each observation is off by too little to
be rejected, and pose and landmarks would be dragged along. So would they if it turns and slides.
If some landmarks do, while others pass as odometry has it, the robot carries them along: they are
not places. A push that the gate lets pass in a map shows in several views: :class:`Drift`.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field, replace
from functools import reduce
import math

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.estimates import Update
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import (
    mahalanobis,
    solve_symmetric,
    transpose,
    with_blocks,
)
from slam_observer_ros.models.point_noise import repetition_factors
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.tracking import covariances
from slam_observer_ros.tracking.matching import calibrated
from slam_observer_ros.tracking.slip import MIN_VARIANCE, unknown_motion
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.tags import seen_orientations

SLIPS = (np.zeros(6), np.repeat([1.0, 0.0], 3))
"""Shares (6,) of a motion that are made where wheels spin: nothing, or the turn alone."""

NOISE = 3.0
"""Standard deviations of the sensor within which a landmark is where it should be."""

MOVED = 2.0
"""Standard deviations from which on a landmark has hardly stood still."""

CLEAR = 6.0
"""Standard deviations from which on a motion, or a shift in the robot's frame, is clear."""

LEAST = 2
"""Landmarks that must agree on a slip: one alone may move as the robot does."""

MOST = 0.75
"""Share of the landmarks in view that stands for all of them: some points are false."""

TEST_NS, LONGEST_WAIT_NS = to_ns(0.25), to_ns(1.0)
"""Least and longest time between two comparisons of an observation with the start."""

LAST_TEST_NS = to_ns(15.0)
"""For how long observations are compared with the same start, where landmarks pass slowly."""

USUAL = 4.0
"""Standard deviations, in the mean, of ways by which it is quickly clear that landmarks pass."""

FORGOTTEN = 0.95
"""Factor of the way that this takes, after each comparison: the noise may be less now."""

CERTAIN = 2.0 * CLEAR**2
"""Most evidence that a landmark is carried, −2 ln of a likelihood; it takes two looks or more."""

TOGETHER_NS = to_ns(0.25)
"""Observations of few landmarks each, or of several sensors, are one look for so long.

At the start for half of that.
"""

UNSEEN_NS = to_ns(1.0)
"""For how long a slip goes on unseen."""

WINDOWS_S = np.array([0.3, 1.0, 3.0])
"""Times, seconds, after which a view counts for a third: a robot may be pushed fast or slowly."""

STRAYED = 2.0 * CLEAR
"""Deviations of all windows that contradict the pose, one after the other: it is said then.

One that is :data:`CLEAR` only makes the pose less sure. In the plane honest noise is as far off
once in a hundred hours, in space once in some; noise twice as large as stated often.
"""

MAX_MOTIONS = 500
"""Motions between observations that are remembered."""


@dataclass(frozen=True, slots=True)
class Look:
    """An observation, and how many of the remembered moves were before it."""

    event: ObservationEvent
    moves: int


@dataclass(frozen=True, slots=True)
class SeenTwice:
    """Landmarks (m,) that a sensor has seen twice, as points (m, 3) in the body frame."""

    event: ObservationEvent  # the later one …
    rows: list[int]  # … and which of its points these are
    ids: list[int]
    before: FloatArray  # where they were seen first
    points: FloatArray  # where they are seen now
    expected: FloatArray  # where they should be by odometry
    motion: FloatArray  # (4, 4) in between, by odometry
    since_ns: int

    @classmethod
    def of(cls, start: Look, now: Look, moved: list[FloatArray], but: Set[int]) -> SeenTwice:
        """Return the landmarks of two looks, without the ids ``but``.

        In between the robot has ``moved`` by odometry.
        """
        first = {i: row for row, i in enumerate(start.event.ids.tolist()) if i not in but}
        both = [(row, i) for row, i in enumerate(now.event.ids.tolist()) if i in first]
        rows, ids = [row for row, _ in both], [i for _, i in both]
        before = start.event.points[[first[i] for i in ids]]
        motion = product(moved)
        expected = (before - motion[:3, 3]).dot(motion[:3, :3])
        points = now.event.points[rows]
        return cls(now.event, rows, ids, before, points, expected, motion, start.event.stamp_ns)

    @property
    def lagging(self) -> list[int]:
        """Landmarks that have not gone half of the way that they should have gone."""
        way, made = self.expected - self.before, self.points - self.before
        ahead = np.einsum('ij,ij->i', made - 0.5 * way, way).tolist()
        return [i for i, much in zip(self.ids, ahead, strict=True) if much <= 0.0]

    @property
    def squared_way(self) -> float:
        """Sum of the squares of the ways that they should have gone, m²."""
        way = (self.expected - self.before).ravel()
        return float(way.dot(way))

    def after(self, share: FloatArray) -> FloatArray:
        """Return where (m, 3) they should be if a ``share`` (6,) of the motion was made."""
        back = se3.exp(-share * se3.log(self.motion))
        return se3.transform(back, self.before)


@dataclass(frozen=True, slots=True)
class View:
    """How landmarks (m,) have moved in the robot's frame, in standard deviations."""

    ids: list[int]
    shift: FloatArray  # how far each is from where it was
    way: FloatArray  # how far it should be from there by odometry, which may be off as well
    error: FloatArray  # how far it is from where it should be by odometry
    slipped: FloatArray  # (s, m) how far it is from where it should be by each of the SLIPS
    off: FloatArray  # (m, k) the error in metres, body frame
    noise: FloatArray  # (m, k, k) of the sensor in both observations, m²
    C: FloatArray  # (m, k, p) how the motion's error moves each
    motion_noise: FloatArray  # (p, p)

    @classmethod
    def of(cls, state: State, seen: list[SeenTwice], velocities: VelocityHistory) -> View:
        """Return the view of pairs of points of one sensor or several."""
        k, A = state.axes.point, state.observer.A
        noise = sensor_noise(state, seen)
        now = np.concatenate([pairs.points for pairs in seen])
        before = np.concatenate([pairs.before for pairs in seen])
        expected = np.concatenate([pairs.expected for pairs in seen])
        slipped = [np.concatenate([pairs.after(share) for pairs in seen]) for share in SLIPS]
        shifts = (now - np.array([before, *slipped]))[:, :, :k]
        squared = np.einsum('smi,mij,smj->sm', shifts, np.linalg.inv(noise), shifts)
        shift, *slips = np.sqrt(np.maximum(squared, 0.0))
        C = transpose(A[:k, :k]) @ state.axes.output_matrix(se3.transform(A, expected))
        longest = min(seen, key=lambda pairs: pairs.since_ns)
        motion_noise = _motion_noise(state, longest, velocities)
        S, way = noise + C @ motion_noise @ transpose(C), (expected - before)[:, :k]
        off = (now - expected)[:, :k]
        error, way = mahalanobis(off, S), mahalanobis(way, S)
        ids = [landmark_id for pairs in seen for landmark_id in pairs.ids]
        return cls(ids, shift, way, error, np.array(slips), off, noise, C, motion_noise)

    @property
    def passes(self) -> BoolArray:
        """Which landmarks (m,) have clearly moved, and are where odometry has them."""
        return (self.shift > CLEAR) & (2.0 * self.error < self.shift)

    @property
    def is_mixed(self) -> bool:
        """Whether most have neither stood nor gone as odometry says."""
        neither = (self.shift > MOVED) & (self.error > NOISE)
        return bool(2 * np.count_nonzero(neither) > len(neither))

    def shows(self, slipped: FloatArray, places: BoolArray) -> bool:
        """Return whether places clearly show a slip, which leaves landmarks ``slipped`` (m,) off.

        That odometry is off by its noise must not explain them as well.
        """
        gain, agree = self.error**2 - slipped**2, places & (slipped <= NOISE)
        differ = places & (slipped > NOISE) & (gain < -(NOISE**2))
        if (
            np.count_nonzero(agree & (gain > NOISE**2)) < LEAST
            or np.count_nonzero(agree) < MOST * np.count_nonzero(places)
            or differ.any()
        ):
            return False
        C, off = self.C[agree].reshape(-1, self.C.shape[-1]), self.off[agree].ravel()
        S = with_blocks(C @ self.motion_noise @ C.T, self.noise[agree])
        return bool(off @ solve_symmetric(S, off) - np.sum(slipped[agree] ** 2) > CLEAR**2)


def ids_of(looks: list[Look]) -> set[int]:
    """Return the ids of the points seen."""
    return {i for look in looks for i in look.event.ids.tolist() if i != UNKNOWN_ID}


def sensor_noise(state: State, seen: list[SeenTwice]) -> FloatArray:
    """Return the covariances (m, k, k) of both points of landmarks that stand, m²."""
    each = [state.observation_noise.covariances(pairs.event)[pairs.rows] for pairs in seen]
    both: FloatArray = 2.0 * np.concatenate(each)[:, : state.axes.point, : state.axes.point]
    return both


def product(moved: list[FloatArray]) -> FloatArray:
    """Return moves, one after the other, as one motion (4, 4), in the frame at their start."""
    return reduce(np.dot, moved, np.eye(4))


def _motion_noise(state: State, pairs: SeenTwice, velocities: VelocityHistory) -> FloatArray:
    """Return the covariance (p, p) of the motion between them, its bias included."""
    end_ns = pairs.event.stamp_ns
    # The velocities before are forgotten: they were off by as much.
    since_ns = max(pairs.since_ns, velocities.begins_ns or pairs.since_ns)
    start = state.observer.A.dot(se3.inverse(pairs.motion))
    motion = state.effect(start, velocities.flat(), since_ns, end_ns)
    longer = (end_ns - pairs.since_ns) / max(end_ns - since_ns, 1)
    F = longer * motion.sensitivity
    # As it is stated: slips and carried landmarks themselves have made the factor larger.
    noise = longer / max(1.0, state.motion_noise.factors.applied.max()) * motion.noise
    total: FloatArray = noise + (F * state.gains.calibration_variances) @ F.T
    return total


@dataclass(frozen=True, slots=True)
class Lost:
    """A motion that odometry reports and the robot has not made."""

    back: FloatArray  # (4, 4) motion from where odometry has the robot
    stray: FloatArray  # (6,) twist of all that it may not have made


@dataclass(slots=True)
class Standing:
    """Whether the robot stands while its wheels spin, and which landmarks it carries along.

    It compares observations that are due with an earlier one, the start. Its states:

    ============ =================== ========================================================
    ``_starts``  ``slip``            what the next observation does
    ============ =================== ========================================================
    none         None                becomes the start (:meth:`_begin`)
    one a sensor None                is compared with it; once it is clear what has passed, a
                                     new start is made, or a slip begins (:meth:`_test`)
    one a sensor a row of the SLIPS  is compared with what that slip expects; where too few
                                     agree, it is over, and a new start made (:meth:`_go_on`)
    ============ =================== ========================================================
    """

    carried: set[int] = field(default_factory=set)
    excluded: set[int] = field(default_factory=set)  # landmarks that are carried, or may be
    slip: int | None = None  # which of the SLIPS goes on
    # (4, 4) moves by odometry, without corrections, since the start …
    moved: list[FloatArray] = field(default_factory=list)
    sensor_frame: str = ''  # an observation is due from another one, …
    due_ns: int = 0  # … or from here on
    _evidence: dict[int, float] = field(default_factory=dict)  # that each is carried
    _starts: list[Look] = field(default_factory=list)  # looks to compare with, …
    _latest: list[Look] = field(default_factory=list)  # … and those to be compared
    _tested: list[Look] = field(default_factory=list)  # the latest ones of the last comparison
    _test_ns: int = 0
    _wait_ns: int = TEST_NS  # until landmarks have passed so far that it is clear
    _odd: set[int] = field(default_factory=set)  # landmarks that did not pass as they should have
    _usual_m2: float = 0.0  # mean square of the ways from which on it is clear, …
    _enough_m2: float = 0.0  # … or from which on it is judged again
    # During a slip, when each landmark was seen last, and whether where the slip has it.
    _agreed: dict[int, tuple[int, bool]] = field(default_factory=dict)
    _earlier: list[FloatArray] = field(default_factory=list)  # … and since the one before

    def clear_time(self) -> None:
        """Compare nothing with what was seen before."""
        self.slip, self.due_ns = None, 0
        self._starts, self._latest, self._tested = [], [], []
        self.moved, self._earlier = [], []

    def note(
        self, state: State, event: ObservationEvent, velocities: VelocityHistory
    ) -> Lost | None:
        """Judge an observation that is due and yet to be used, by the most likely state.

        If the wheels slip, return the part of the motion since the last observation that was not
        made.
        """
        if event.velocities is not None:
            return None  # landmarks may move as the robot does
        look, lost = Look(event, len(self.moved)), None
        if self.slip is not None:
            lost = self._go_on(state, look)
        elif not self._starts:
            self._begin(look)
        elif self._belongs_to_start(event):
            self._starts.append(look)
        else:
            since_ns = event.stamp_ns - TOGETHER_NS
            self._latest = [one for one in self._latest if one.event.stamp_ns > since_ns]
            self._latest.append(look)
            if event.stamp_ns >= self._test_ns:
                lost = self._test(state, look, velocities)
        # Each observation is due where there are several sensors, or few landmarks in one.
        is_whole = len(self._starts) == 1 and len(self._starts[0].event.ids) >= LEAST
        self.due_ns = self._test_ns if is_whole and self.slip is None else 0
        return lost

    def _belongs_to_start(self, event: ObservationEvent) -> bool:
        """Return whether later observations are compared with this one."""
        if all(event.sensor_frame != start.event.sensor_frame for start in self._starts):
            return True
        if len(self._starts[0].event.ids) >= LEAST:
            return False
        return event.stamp_ns - self._starts[0].event.stamp_ns < TOGETHER_NS // 2

    def _begin(self, look: Look) -> None:
        """Compare with this observation from now on."""
        event = look.event
        self.sensor_frame = event.sensor_frame
        self._starts, self._latest = [Look(event, 0)], []
        self._earlier, self.moved = self.moved, []
        self._tested, self._enough_m2 = [], self._usual_m2
        more_ns = 0 if len(event.ids) >= LEAST else TOGETHER_NS // 2
        self._test_ns = event.stamp_ns + self._wait_ns + more_ns

    def _test(self, state: State, look: Look, velocities: VelocityHistory) -> Lost | None:
        """Look for a slip, and for landmarks that are carried along."""
        event = look.event
        age_ns = event.stamp_ns - self._starts[0].event.stamp_ns
        if len(ids_of(self._latest) & ids_of(self._starts)) < LEAST:
            if len(event.ids) >= LEAST or age_ns > UNSEEN_NS:  # else more may follow
                self._begin(look)
            return None
        seen = self._pairs()
        tested, self._tested = self._tested, list(self._latest)
        ids = [i for pairs in seen for i in pairs.ids]
        way_m2 = sum(pairs.squared_way for pairs in seen) / max(len(ids), 1)
        self._wait(event.stamp_ns, age_ns, way_m2)
        if way_m2 <= self._enough_m2:
            if age_ns > LAST_TEST_NS:
                self._begin(look)
            return None
        is_usual = self._is_usual(ids, {i for pairs in seen for i in pairs.lagging})
        if is_usual or state.landmark_velocity_stddev:
            self._usual_m2 *= FORGOTTEN
            self._begin(look)
            return None
        view = View.of(state, seen, velocities)
        self._usual_m2 = way_m2 * USUAL**2 / np.mean(view.way**2)
        self._enough_m2 = 2.0 * way_m2
        if self._slips(state, view):
            return self._begin_slip(ids, event.stamp_ns)
        if view.passes.any():
            self._sort(view)
            self._begin(look)
        elif view.is_mixed and tested:
            # A slip has begun meanwhile, or ended.
            self._starts, self._tested, self._enough_m2 = tested, [], 0.0
            return self._test(state, look, velocities)
        return None

    def _wait(self, stamp_ns: int, age_ns: int, way_m2: float) -> None:
        """Wait with the next test until landmarks should have passed so far that it is clear."""
        needed = math.sqrt(self._usual_m2 / way_m2) if way_m2 else math.inf
        self._wait_ns = int(min(max(needed * age_ns, TEST_NS), LONGEST_WAIT_NS))
        self._test_ns = stamp_ns + max(self._wait_ns - age_ns, TEST_NS)

    def _begin_slip(self, ids: list[int], stamp_ns: int) -> Lost:
        """Compare with the present looks, by the slip; return what the last motion lost."""
        self._agreed = dict.fromkeys(ids, (stamp_ns, True))
        self._starts = self._latest
        lost = self._lost(self.moved[-1:], self._earlier + self.moved)
        self.moved = []
        return lost

    def _is_usual(self, ids: list[int], lagging: set[int]) -> bool:
        """Return whether all landmarks pass but the carried ones, and one more now and then."""
        odd = lagging ^ self.carried.intersection(ids)
        before, self._odd = self._odd, odd
        return 2 * len(odd) < len(ids) and odd.isdisjoint(before)

    def _pairs(self) -> list[SeenTwice]:
        """Return pairs of points seen at the start and lately, each landmark once a sensor."""
        seen, known = [], dict[str, set[int]]()
        for now in reversed(self._latest):
            but = known.setdefault(now.event.sensor_frame, {UNKNOWN_ID})
            for start in self._starts:
                if start.event.sensor_frame == now.event.sensor_frame:
                    pairs = SeenTwice.of(start, now, self.moved[start.moves : now.moves], but)
                    but.update(pairs.ids)
                    seen += [pairs] if pairs.ids else []
        return seen

    def _slips(self, state: State, view: View) -> bool:
        """Find out whether one of the SLIPS has begun."""
        places = self._are_places(state, view.ids)
        for slip, slipped in enumerate(view.slipped):
            if view.shows(slipped, places):
                self.slip = slip
                return True
        return False

    def _go_on(self, state: State, look: Look) -> Lost | None:
        """Return what :meth:`note` returns during a slip; None once it is over."""
        event, made = look.event, self.moved
        self._slip_on(made)
        self._latest, look = [Look(event, 0)], Look(event, 0)
        new = set(event.ids.tolist())
        for pairs in self._pairs():
            shift = (pairs.points - pairs.before)[:, : state.axes.point]
            agree = mahalanobis(shift, sensor_noise(state, [pairs])) <= NOISE
            are_places = self._are_places(state, pairs.ids)
            for i, agrees, is_place in zip(pairs.ids, agree, are_places, strict=True):
                new.discard(i)
                if is_place:
                    self._agreed[i] = event.stamp_ns, bool(agrees)
        since_ns = event.stamp_ns - UNSEEN_NS
        self._agreed = {i: last for i, last in self._agreed.items() if last[0] > since_ns}
        count = sum(agrees for _, agrees in self._agreed.values())
        if count < LEAST or 2 * count < len(self._agreed):
            self.slip = None
            self._begin(look)
            return None
        if self.slip and self._starts[0].event.stamp_ns < since_ns:
            self._starts = [look]  # whose turn is exact
        elif new:
            self._starts.append(look)
        return self._lost(made, made)

    def _slip_on(self, made: list[FloatArray]) -> None:
        """Move the looks to compare with as a slip makes of motions; forget the motions."""
        back = se3.exp(-SLIPS[self.slip or 0] * se3.log(product(made)))
        self._starts = [
            Look(replace(one.event, points=se3.transform(back, one.event.points)), 0)
            for one in self._starts
        ]
        self.moved = []

    def _lost(self, made: list[FloatArray], whole: list[FloatArray]) -> Lost:
        """Return the part of motions that was lost, and of the ``whole`` that may be."""
        share, motion = SLIPS[self.slip or 0], product(made)
        back = se3.inverse(motion).dot(se3.exp(share * se3.log(motion)))
        return Lost(back, (1.0 - share) * se3.log(product(whole)))

    def _are_places(self, state: State, ids: list[int]) -> BoolArray:
        """Return which landmarks (m,) are at rest for all we know."""
        places = np.array([i not in self.excluded for i in ids], dtype=np.bool_)
        if not state.is_mapping:
            places &= state.landmarks.rows_of(np.array(ids)) >= 0
        return places

    def _sort(self, view: View) -> None:
        """Find out which landmarks stand still while others pass."""
        gain = np.clip(view.error**2 - view.shift**2, -(CLEAR**2), CLEAR**2)
        gain[(gain > 0.0) & (view.shift > NOISE)] = 0.0
        for landmark_id, more in zip(view.ids, gain.tolist(), strict=True):
            much = self._evidence.get(landmark_id, 0.0) + more
            self._evidence[landmark_id] = min(max(much, 0.0), CERTAIN)
        evidence = self._evidence = {i: much for i, much in self._evidence.items() if much}
        self.carried = {i for i, much in evidence.items() if much == CERTAIN or i in self.carried}
        self.excluded = self.carried | {i for i, much in evidence.items() if much >= CLEAR**2}


class Drift:
    """What the innovations of the last views say together, each being within the gate.

    With C_i = [−[ȳ_i]×, I] about the robot, an error ε of its pose gives landmarks of a map the
    residuals r_i = C_i ε + noise, R_i of sensor and map, and the turns of tags C = [I, 0]. With
    W = Σ Cᵀ R⁻¹ C and S = C P Cᵀ + R, a view says

        u = Cᵀ S⁻¹ r = (I + W P)⁻¹ Σ Cᵀ R⁻¹ r,   of covariance   G = Cᵀ S⁻¹ C = (I + W P)⁻¹ W,

    and is independent of the views before it, as long as all noise is as stated. Summed over a
    window, m = Σ λ u and M = Σ λ² G, mᵀ M⁻¹ m is χ² of p then. If in truth the robot moves
    otherwise by δ from each view to the next, m is about L δ, L = Σ λ G. R is the noise while
    driving: what lasts while the robot stands, the pose has adapted to.
    """

    def __init__(self) -> None:
        self.is_followed = False  # nowhere but in a map
        self.has_strayed = False  # the last contradiction leaves no doubt that it moves otherwise
        self.clear()

    def clear(self) -> None:
        """Begin again, as the pose has changed otherwise."""
        # The pose (4, 4) before the present view, and the covariance (6, 6) of its error ε.
        self.before: tuple[FloatArray, FloatArray] | None = None
        self._position = np.zeros(3)
        self._stamp_ns = self._contradicted_ns = 0
        self._squares = 0.0  # of all contradictions, one after the other
        self._begin()

    def _begin(self) -> None:
        w = len(WINDOWS_S)
        self._m, self._M, self._L = np.zeros((w, 6)), np.zeros((w, 6, 6)), np.zeros((w, 6, 6))

    def note(
        self,
        state: State,
        event: ObservationEvent,
        update: Update,
        known_ids: IntArray,
        known_covariances: FloatArray | None,
    ) -> FloatArray | None:
        """Take what an observation did; return how uncertain a pose is that views contradict.

        The covariance (6, 6) of a motion that explains them, body frame; None if nothing has to
        be explained. Landmarks ``known_ids`` (n,) are in a map, with ``known_covariances``
        (n, 3, 3), m², or None if it is exact.
        """
        self.is_followed = True
        elapsed_s = to_s(max(update.stamp_ns - self._stamp_ns, 0))
        before, self.before = self.before, None
        if elapsed_s > WINDOWS_S[-1]:
            self.clear()
        self._stamp_ns = update.stamp_ns
        # Which of the points seen, in the order of the event, were taken for a landmark.
        seen = np.isin(event.ids, update.ids) | (event.ids == UNKNOWN_ID)
        is_whole = event.kinds is None and np.count_nonzero(seen) == len(update.ids)
        if before is None or not is_whole:
            return None
        rows, in_map = state.landmarks.rows_of(update.ids), known_ids == update.ids[:, None]
        used = (rows >= 0) & ~update.rejected & in_map.any(axis=1)
        if not used.any():
            return None
        event = replace(calibrated(state, event).select(seen).select(used), sensed=None)
        rows, in_map = rows[used], in_map[used]
        observer, axes, (A, P) = state.observer, state.axes, before
        pose, k, p, R = axes.pose, axes.point, axes.p, A[:3, :3]
        P = covariances.of_pose(observer, P, se3.inverse(observer.reference_pose) @ A)[pose, pose]
        lasting = state.settings.observation_correlation_time
        repeated = repetition_factors(np.array([elapsed_s]), lasting)
        noise = repeated * (R @ state.observation_noise.covariances(event) @ R.T)
        if known_covariances is not None:
            noise += known_covariances[in_map.argmax(axis=1)]
        r = se3.transform(A, event.points) - observer.world_points[rows]
        parts = [(axes.output_matrix(event.points @ R.T - 0.5 * r), noise[:, :k, :k], r[:, :k])]
        if (tags := seen_orientations(state, event, rows)) is not None:
            parts.append(_turned(state, tags, R, repeated))
        W, w = np.zeros((p, p)), np.zeros(p)
        for C, noise, r in parts:
            # No view of one landmark says more than a few: it may be an outlier.
            far = mahalanobis(r, noise + C @ P @ transpose(C))
            r = np.minimum(1.0, CLEAR / np.maximum(far, CLEAR))[:, None] * r
            CW = transpose(solve_symmetric(noise, C))
            W, w = W + np.sum(CW @ C, axis=0), w + np.sum(CW @ r[:, :, None], axis=0)[:, 0]
        back = np.linalg.inv(np.eye(p) + W @ P)
        # What was said of the pose where the robot was, is said of it where it is.
        there = np.eye(6)
        there[3:, :3] = so3.hat(A[:3, 3] - self._position)
        there, self._position = there[pose, pose], A[:3, 3].copy()
        share = np.exp(-elapsed_s / WINDOWS_S)[:, None]
        m, M, L = self._m[:, :p], self._M[:, :p, :p], self._L[:, :p, :p]
        self._m = m = share * (m @ there) + back @ w
        self._M = M = share[:, None] ** 2 * (there.T @ M @ there) + back @ W
        self._L = L = share[:, None] * (there.T @ L @ there) + back @ W
        if not np.isfinite(M).all():
            return None
        # Along directions that no view has shown, both are zero.
        scales = np.sqrt(np.maximum(np.diagonal(M, axis1=1, axis2=2), np.finfo(np.float64).tiny))
        scaled = m / scales
        M = M / (scales[:, :, None] * scales[:, None]) + 1e-9 * np.eye(p)
        squares = np.sum(scaled * np.linalg.solve(M, scaled[:, :, None])[:, :, 0], axis=1)
        at = int(np.argmax(squares))
        if squares[at] <= CLEAR**2:
            return None
        is_first = update.stamp_ns - self._contradicted_ns > to_ns(WINDOWS_S[-1])
        earlier = 0.0 if is_first else self._squares
        self._squares, self._contradicted_ns = earlier + float(squares[at]), update.stamp_ns
        self.has_strayed = earlier <= STRAYED**2 < self._squares
        self._begin()
        turn = block_diag(observer.pose[:3, :3], observer.pose[:3, :3])
        explained = axes.full_pose_covariance(_explained(state, m[at], L[at]))
        return np.asarray(turn.T @ explained @ turn)


def _explained(state: State, m: FloatArray, L: FloatArray) -> FloatArray:
    """Return δ δᵀ and the covariance of δ, (p, p), the motion that explains sums over a window.

    As of a motion without odometry, for as long as that takes.
    """
    unknown = np.maximum(np.diagonal(unknown_motion(state, 1.0))[state.axes.pose], MIN_VARIANCE)
    taken_s = 1.0
    for _ in range(2):
        covariance = np.linalg.inv(L + np.diag(1.0 / (taken_s * unknown)))
        delta = covariance @ m
        taken_s = float(np.mean((delta**2 + np.diagonal(covariance)) / unknown))
    return np.outer(delta, delta) + covariance


def _turned(
    state: State, tags: SeenOrientations, R: FloatArray, repeated: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return C (t, q, p), noise (t, q, q) and residuals (t, q) of tags' turns, about the world.

    ``R`` (3, 3) turned the body before they were used. Of each tag the orientation counts that
    fits better, of two that look nearly the same; none that was rejected: the map may have other
    axes than the detector.
    """
    known = state.observer.orientations
    is_used = known.are_known[tags.rows] & (known.rejections[tags.rows] == 0)
    tags = tags.select(tags.Z.any(axis=(1, 2)) & is_used)
    B = state.observer.reference_pose[:3, :3] @ known.B[tags.rows]
    both = so3.log(R @ np.array([tags.Z, tags.flipped]) @ transpose(B))
    nearer = np.argmin(np.sum(both**2, axis=2), axis=0)
    of_map = known.map_sigmas[tags.rows, None, None] ** 2 * np.eye(3)
    noise = repeated * (R @ tags.covariances @ R.T) + of_map
    axes, C = state.axes, np.zeros((len(tags.rows), state.axes.turn, state.axes.p))
    C[:, :, : axes.turn] = np.eye(axes.turn)
    turns = both[nearer, np.arange(len(nearer))]
    return C, axes.turn_covariances(noise), axes.turns(turns)


def take_back(state: State, lost: Lost) -> None:
    """Take back what was not made of the last motion."""
    turn, way = lost.stray.reshape(2, 3)
    unmade = block_diag(np.outer(turn, turn), np.outer(way, way))
    state.slip(state.observer.A @ lost.back, unmade)
