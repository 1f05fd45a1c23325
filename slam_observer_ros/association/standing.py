"""Landmarks that stand still in the robot's frame although the robot drives on by odometry.

If all landmarks do, the robot stands and its wheels spin: each observation is off by too little to
be rejected, and pose and landmarks would be dragged along. So would they if it turns and slides.
If some landmarks do, while others pass as odometry has it, the robot carries them along: they are
not places.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.association.looks import (
    CLEAR,
    ids_of,
    LEAST,
    Look,
    NOISE,
    product,
    SeenTwice,
    sensor_noise,
    SLIPS,
    View,
)
from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.common.types import BoolArray, FloatArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.matrices import mahalanobis
from slam_observer_ros.sensor_models.motion import Motion
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.state.state import State

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

MAX_MOTIONS = 500
"""Motions between observations that are remembered."""


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


def take_back(state: State, lost: Lost) -> None:
    """Take back what was not made of the last motion."""
    A, (turn, way) = state.observer.A, lost.stray.reshape(2, 3)
    motion = Motion(
        path=np.array([A, A @ lost.back]),
        measured_velocities=np.zeros((1, 6)),
        dt_s=np.zeros(1),
        covariances=block_diag(np.outer(turn, turn), np.outer(way, way))[None],
        duration_s=0.0,
        at_ends=None,
        calibration=state.calibration,
        is_slip=True,
    )
    state.propagate(motion)
