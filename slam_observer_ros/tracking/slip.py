"""Whether a robot is not where odometry has it: nothing else decides that.

Its wheels slip, or someone pushes or carries it. What shows, and what follows:

- The gate rejects most landmarks of an observation. Then there may be a :func:`second_track`,
  which is weighed as one hypothesis among others (:mod:`.interpretations`).
- Landmarks stand still in the robot's frame although it drives on by odometry: its wheels spin.
  Each observation is off by too little to be rejected, and pose and landmarks would be dragged
  along. So would they if it turns and slides. Motion is taken back until landmarks pass again. If
  some stand still, while others pass, the robot carries them along: they are not places
  (:class:`Standing`).
- Views of a map contradict the pose together, though each is within the gate. Then it is less sure
  by as much, and has slipped if they go on to (:class:`MapViews`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.linalg import block_diag

from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.robust import accepted, huber_loss
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import mahalanobis, solve_symmetric, transpose, with_blocks
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion_noise import beyond_driving
from slam_observer_ros.models.point_noise import repetition_factors
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.tracking.matching import (
    all_orientations,
    is_contradiction,
    match,
    MatchedObservation,
)
from slam_observer_ros.tracking.state import State

MAX_DURATION_S = 4.0  # time, seconds, for which odometry is taken to have been wrong, at most
LARGE_TURN_RAD = 0.3  # turn, radians, that a correction, which is linear in it, does not find well

SHORT_S, TURN_RAD = 1.0, 0.5
"""Time without odometry, seconds, and turns, after which points without ids are looked for: what
is about one of these turns is found by corrections that are linear in it.
"""

ITERATIONS = 10  # gauss-Newton steps to the likeliest pose; the last ones hardly move it
MIN_VARIANCE = 1e-6  # least variance of a motion without odometry, rad² or m²

SLIPS = (np.zeros(6), np.repeat([1.0, 0.0], 3))
"""Shares (6,) of a motion that are made where wheels spin: nothing, or the turn alone."""

NOISE, MOVED, CLEAR = 3.0, 2.0, 6.0
"""Standard deviations within which a landmark is where it should be, from which on it has hardly
stood still, and from which on a motion, or a shift in the robot's frame, is clear.
"""

LEAST, MOST = 2, 0.75
"""Landmarks that must agree on a slip, as one alone may move as the robot does; and their share of
those in view, as some points are false.
"""

CERTAIN = 2.0 * CLEAR**2
"""Most evidence that a landmark is carried, −2 ln of a likelihood; it takes two looks or more."""

TEST_NS, LONGEST_WAIT_NS, LAST_TEST_NS = to_ns(0.25), to_ns(1.0), to_ns(15.0)
"""Least and longest time between two comparisons with a start, and for how long it serves, where
landmarks pass slowly.
"""

TOGETHER_NS = to_ns(0.25)
"""Observations of few landmarks each, or of several sensors, are one look for so long.

At the start for half of that.
"""

DROWNED = 1e-12
"""Squared way, in standard deviations, below which covariances drown what is seen of it."""

USUAL, FORGOTTEN = 4.0, 0.95
"""Standard deviations, in the mean, of ways by which it is quickly clear that landmarks pass; and
the factor of the way that this takes, after each comparison: the noise may be less now.
"""

UNSEEN_NS = to_ns(1.0)  # for how long a slip goes on unseen

WINDOWS_S = np.array([0.3, 1.0, 3.0])
"""Times, seconds, after which a view counts for a third: a robot may be pushed fast or slowly."""

UNLIKELY, UNLIKELY_ALONE = {3: 36.0, 6: 44.0}, {3: 25.0, 6: 32.0}
"""χ² of p axes beyond which views contradict a pose that is surer than they are.

Of honest noise one in ten million is; one in a hundred thousand of a point alone in view, by which
a robot that is pushed aside seems to turn, unless it stands, when errors last. Noise twice as
large as stated, or a map taken as exact, exceed them more often; that costs little, as the pose
only becomes less sure.
"""

STRAYED = 144.0
"""Sum of χ² beyond which views say, one after the other, that the robot has slipped."""


@dataclass(frozen=True, slots=True)
class Slip:
    """A motion that odometry has not seen."""

    motion: FloatArray  # (4, 4) from where odometry has the robot
    covariance: FloatArray  # (6, 6) in the body frame there, rad² and m²
    is_new: bool  # it is to be said


def rejects(state: State, matched: MatchedObservation) -> BoolArray:
    """Return which points (m,) of known landmarks the gate rejects."""
    gate = state.settings.rejection_threshold
    return ~accepted(state.gains.distances(matched.residuals), gate)


def second_track(
    state: State, matched: MatchedObservation, event: ObservationEvent
) -> tuple[State, MatchedObservation, float] | None:
    """Take the robot for slipped; return its state, its match and the motion's cost.

    None if that does not explain all that is seen.
    """
    settings = state.settings
    if not (settings.unknown_linear_motion or settings.unknown_angular_motion):
        return None
    stands = state.observation_noise.stood_s > 0.0
    far = beyond_driving(matched.known.points, matched.residuals.r, settings)
    if stands and not far.all():
        return None
    slipped = state.copy()
    cost = slip(slipped, matched)
    matched = match(slipped, event)
    if rejects(slipped, matched).any():
        return None
    return slipped, matched, cost


def slip(state: State, matched: MatchedObservation) -> float:
    """Let the robot have slipped to where it sees these landmarks; return the cost of the motion.

    Its pose is then as uncertain as if there had been no odometry for as long as that takes. The
    observation is yet to be used.
    """
    # The noise of a motion without odometry, for as long as it takes, to where landmarks put it.
    observer, start = state.observer, state.observer.A.copy()
    points, r = matched.known.points, matched.residuals.r
    needed_s = min(_needed_s(state, points, r), MAX_DURATION_S)
    noise = _noise(state, needed_s)
    variances = np.maximum(np.diagonal(noise)[state.axes.pose], MIN_VARIANCE)
    state.slip(_pose_after(state, matched, variances), noise)
    state.counts['slip'] += 1
    strayed = se3.log(se3.inverse(start) @ observer.A)[state.axes.pose]
    return float(huber_loss(float(np.sqrt(np.sum(strayed**2 / variances)))))


def astray(state: State) -> Iterator[State]:
    """Yield copies of a state from which points without ids show where a slip may have led it."""
    for turn_rad in (0.0, TURN_RAD, -TURN_RAD):
        other = state.copy()
        turn = se3.exp(np.array([0, 0, turn_rad, 0, 0, 0]))
        other.slip(other.observer.A @ turn, _noise(other, SHORT_S))
        yield other


def _noise(state: State, duration_s: float) -> FloatArray:
    """Return the covariance (6, 6) of a motion without odometry for so long."""
    stray = HeldVelocities.unknown(np.array([duration_s]))
    return np.asarray(state.motion_noise.covariances(stray)[0])


def _needed_s(state: State, points: FloatArray, r: FloatArray) -> float:
    """Return how long a robot without odometry would take to get there, seconds.

    By residuals r (m, k) of ``points`` (m, 3) in the body frame.
    """
    settings, k = state.settings, state.axes.point
    turned_m2 = (k - 1) * settings.unknown_angular_motion**2 * np.sum(points**2, axis=1)
    after_1_s_m2 = turned_m2 + k * settings.unknown_linear_motion**2
    needed_s = np.sum(r**2, axis=1) / np.maximum(after_1_s_m2, MIN_VARIANCE)
    return float(np.mean(needed_s))


def _pose_after(state: State, matched: MatchedObservation, variances: FloatArray) -> FloatArray:
    """Return the likeliest Â (4, 4) after a motion of ``variances`` (p,), if it is far off."""
    # If it is not far, the correction that follows, which is linear, finds it as well.
    A, found = state.observer.A, _likeliest_pose(state, matched, variances)
    turn_rad = np.linalg.norm(so3.log(found[:3, :3] @ A[:3, :3].T))
    shift_m = np.linalg.norm(found[:3, 3] - A[:3, 3])
    reach_m = state.settings.unknown_linear_motion * math.sqrt(MAX_DURATION_S)
    return found if turn_rad > LARGE_TURN_RAD or shift_m > reach_m else A


def _likeliest_pose(
    state: State, matched: MatchedObservation, variances: FloatArray
) -> FloatArray:
    """Return Â (4, 4) by Gauss-Newton steps, as if landmarks and start were known exactly."""
    A, axes = state.observer.A, state.axes
    landmarks = state.observer.points[matched.residuals.rows]
    points = matched.known.points
    # First aligned by the landmarks alone, if they suffice.
    W = np.linalg.inv(matched.covariances[matched.rows >= 0][:, : axes.point, : axes.point])
    found = A
    if len(points) >= axes.point:
        weights = np.trace(W, axis1=1, axis2=2)
        found = rigid_alignment(se3.transform(A, points), landmarks, weights) @ A
    # Then by landmarks and motion together.
    for _ in range(ITERATIONS):
        expected = se3.transform(se3.inverse(found), landmarks)
        C = axes.output_matrix(expected)
        CW, left = transpose(C) @ W, (points - expected)[:, : axes.point, None]
        strayed = se3.log(se3.inverse(A) @ found)[axes.pose]
        H = np.diag(1.0 / variances) + np.sum(CW @ C, axis=0)
        gradient = strayed / variances + np.sum(CW @ left, axis=0)[:, 0]
        found = found @ se3.exp(-axes.full_pose(solve_symmetric(H, gradient)))
    return found


@dataclass(frozen=True, slots=True)
class Look:
    """An observation, and the pose (4, 4) of the robot then, by odometry alone."""

    event: ObservationEvent
    pose: FloatArray


class SeenTwice:
    """Landmarks that a sensor has seen twice, as points (m, 3) in the body frame."""

    def __init__(self, starts: list[Look], latest: list[Look]) -> None:
        first, last = _by_landmark(starts), _by_landmark(latest[::-1])
        # Each landmark once a sensor: when it was seen first, and last.
        both = [key for key in last if key in first]
        self.ids = [landmark_id for _, landmark_id in both]
        self.at = [last[key] for key in both]  # looks, and which of their points
        then = [first[key] for key in both]
        self.before = np.array([look.event.points[row] for look, row in then]).reshape(-1, 3)
        self.points = np.array([look.event.points[row] for look, row in self.at]).reshape(-1, 3)
        # By odometry: the motions (m, 4, 4) in between, and where they should be.
        poses = np.array([look.pose for look, _ in then]).reshape(-1, 4, 4)
        ends = np.array([look.pose for look, _ in self.at]).reshape(-1, 4, 4)
        self.motions = se3.inverse(poses) @ ends
        self.expected = self.after(np.ones(6))
        self.longest = min(range(len(both)), key=lambda i: then[i][0].event.stamp_ns, default=0)
        self.since_ns = then[self.longest][0].event.stamp_ns if both else 0

    def after(self, share: FloatArray) -> FloatArray:
        """Return where (m, 3) they should be if a ``share`` (6,) of the motions was made."""
        made = self.motions if share.all() else se3.exp(share * se3.log(self.motions))
        return se3.transform(se3.inverse(made), self.before[:, None])[:, 0]

    @property
    def lagging(self) -> set[int]:
        """Landmarks that have not gone half of the way that they should have gone."""
        way, made = self.expected - self.before, self.points - self.before
        ahead = np.einsum('ij,ij->i', made - 0.5 * way, way).tolist()
        return {i for i, much in zip(self.ids, ahead, strict=True) if much <= 0.0}

    @property
    def squared_way(self) -> float:
        """Mean square of the ways that they should have gone, m²."""
        return float(np.mean(np.sum((self.expected - self.before) ** 2, axis=1)))

    def noise(self, state: State) -> FloatArray:
        """Return the covariances (m, k, k) of both points of landmarks that stand, m²."""
        looks = {id(look): look for look, _ in self.at}
        each = {
            number: state.observation_noise.covariances(look.event)
            for number, look in looks.items()
        }
        k = state.axes.point
        both = [2.0 * each[id(look)][row, :k, :k] for look, row in self.at]
        return np.array(both).reshape(-1, k, k)


def _by_landmark(looks: list[Look]) -> dict[tuple[str, int], tuple[Look, int]]:
    """Return the first look at each landmark with an id, by sensor, and which of its points."""
    first: dict[tuple[str, int], tuple[Look, int]] = {}
    for look in looks:
        for row, landmark_id in enumerate(look.event.ids.tolist()):
            if landmark_id != UNKNOWN_ID:
                first.setdefault((look.event.sensor_frame, landmark_id), (look, row))
    return first


class Shown:
    """How landmarks (m,) have moved in the robot's frame, in standard deviations."""

    def __init__(self, state: State, seen: SeenTwice, velocities: VelocityHistory) -> None:
        k, A = state.axes.point, state.observer.A
        self.ids, self.noise = seen.ids, seen.noise(state)
        # How far each is from where it was, and from where it should be by each of the SLIPS.
        shifts = seen.points - np.array([seen.before, *map(seen.after, SLIPS)])
        squared = np.einsum(
            'smi,mij,smj->sm', shifts[:, :, :k], np.linalg.inv(self.noise), shifts[:, :, :k]
        )
        self.shift, *self.slipped = np.sqrt(np.maximum(squared, 0.0))
        # How far it is from where it should be by odometry, which may be off as well.
        C = transpose(A[:k, :k]) @ state.axes.output_matrix(se3.transform(A, seen.expected))
        self.C, self.motion_noise = C, _motion_noise(state, seen, velocities)
        self.off = (seen.points - seen.expected)[:, :k]
        S = self.noise + C @ self.motion_noise @ transpose(C)
        self.error = mahalanobis(self.off, S)
        self.way = mahalanobis((seen.expected - seen.before)[:, :k], S)  # as it should be

    @property
    def passes(self) -> BoolArray:
        """Which landmarks (m,) have clearly moved, and are where odometry has them."""
        return np.asarray((self.shift > CLEAR) & (2.0 * self.error < self.shift))

    @property
    def is_mixed(self) -> bool:
        """Whether most have neither stood nor gone as odometry says."""
        neither = (self.shift > MOVED) & (self.error > NOISE)
        return bool(2 * np.count_nonzero(neither) > len(neither))

    def slips(self, slipped: FloatArray, places: BoolArray) -> bool:
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


def _motion_noise(state: State, seen: SeenTwice, velocities: VelocityHistory) -> FloatArray:
    """Return the covariance (p, p) of the longest motion between them, its bias included."""
    end_ns = seen.at[seen.longest][0].event.stamp_ns
    # The velocities before are forgotten: they were off by as much.
    since_ns = max(seen.since_ns, velocities.begins_ns or seen.since_ns)
    start = state.observer.A.dot(se3.inverse(seen.motions[seen.longest]))
    motion = state.effect(start, velocities.flat(), since_ns, end_ns)
    longer = (end_ns - seen.since_ns) / max(end_ns - since_ns, 1)
    F = longer * motion.sensitivity
    # As it is stated: slips and carried landmarks themselves have made the factor larger.
    noise = longer / max(1.0, state.motion_noise.factors.applied.max()) * motion.noise
    total: FloatArray = noise + (F * state.gains.calibration_variances) @ F.T
    return total


class Standing:
    """Whether the robot stands while its wheels spin, and which landmarks it carries along.

    Observations are compared with an earlier one, the start, some times a second. Once it is clear
    what has passed, a new start is made, or a slip begins: one of the SLIPS. Then each is compared
    with what that slip expects, until too few landmarks agree.
    """

    def __init__(self) -> None:
        self.carried: set[int] = set()
        self.excluded: set[int] = set()  # landmarks that are carried, or may be
        self._evidence: dict[int, float] = {}  # that each is carried
        self._odd: set[int] = set()  # landmarks that did not pass as they should have
        self.clear_time()

    def clear_time(self) -> None:
        """Compare nothing with what was seen before."""
        self.slip: int | None = None  # which of the SLIPS goes on
        self._starts: list[Look] = []  # looks to compare with, …
        self._latest: list[Look] = []  # … those to be compared, …
        self._tested: list[Look] = []  # … and the ones last compared
        # By odometry alone: the pose, the one before the last motion, and that at the last start.
        self.pose, self.before, self._earlier = np.eye(4), np.eye(4), np.eye(4)
        self.sensor_frame, self.due_ns = '', 0  # an observation is due from another one, or then
        self._test_ns = 0
        self._wait_ns = TEST_NS  # until landmarks have passed so far that it is clear
        self._usual_m2 = 0.0  # mean square of the ways from which on it is clear, …
        self._enough_m2 = 0.0  # … or from which on it is judged again
        # During a slip, when each landmark was seen last, and whether where the slip has it.
        self._agreed: dict[int, tuple[int, bool]] = {}

    def note(
        self, state: State, event: ObservationEvent, velocities: VelocityHistory
    ) -> Slip | None:
        """Judge an observation that is due and yet to be used, by the most likely state.

        If the wheels slip, return the motion back from what was not made since the last one.
        """
        if event.velocities is not None:
            return None  # landmarks may move as the robot does
        look, slip = Look(event, self.pose), None
        if self.slip is not None:
            slip = self._go_on(state, look)
        elif not self._starts:
            self._begin(look)
        elif (
            event.stamp_ns - self._starts[0].event.stamp_ns < TOGETHER_NS // 2
            and len(self._starts[0].event.ids) < LEAST
        ) or all(event.sensor_frame != one.event.sensor_frame for one in self._starts):
            self._starts.append(look)  # later observations are compared with this one, too
        else:
            since_ns = event.stamp_ns - TOGETHER_NS
            self._latest = [one for one in self._latest if one.event.stamp_ns > since_ns]
            self._latest.append(look)
            if event.stamp_ns >= self._test_ns:
                slip = self._test(state, look, velocities)
        # Each observation is due where there are several sensors, or few landmarks in one.
        is_whole = len(self._starts) == 1 and len(self._starts[0].event.ids) >= LEAST
        self.due_ns = self._test_ns if is_whole and self.slip is None else 0
        return slip

    def _begin(self, look: Look) -> None:
        """Compare with this observation from now on."""
        event = look.event
        self.sensor_frame = event.sensor_frame
        if self._starts:
            self._earlier = self._starts[0].pose
        self._starts, self._latest, self._tested = [look], [], []
        self._enough_m2 = self._usual_m2
        more_ns = 0 if len(event.ids) >= LEAST else TOGETHER_NS // 2
        self._test_ns = event.stamp_ns + self._wait_ns + more_ns

    def _test(self, state: State, look: Look, velocities: VelocityHistory) -> Slip | None:
        """Look for a slip, and for landmarks that are carried along."""
        event, seen = look.event, SeenTwice(self._starts, self._latest)
        age_ns = event.stamp_ns - self._starts[0].event.stamp_ns
        if len(set(seen.ids)) < LEAST:
            if len(event.ids) >= LEAST or age_ns > UNSEEN_NS:  # else more may follow
                self._begin(look)
            return None
        tested, self._tested = self._tested, list(self._latest)
        way_m2 = seen.squared_way
        # Until landmarks should have passed so far that it is clear.
        needed = math.sqrt(self._usual_m2 / way_m2) if way_m2 else math.inf
        self._wait_ns = int(min(max(needed * age_ns, TEST_NS), LONGEST_WAIT_NS))
        self._test_ns = event.stamp_ns + max(self._wait_ns - age_ns, TEST_NS)
        if way_m2 <= self._enough_m2:
            if age_ns > LAST_TEST_NS:
                self._begin(look)
        elif self._is_usual(seen) or state.landmark_velocity_stddev:
            self._usual_m2 *= FORGOTTEN
            self._begin(look)
        else:
            shown, places = Shown(state, seen, velocities), self._are_places(state, seen.ids)
            self._usual_m2 = way_m2 * USUAL**2 / max(float(np.mean(shown.way**2)), DROWNED)
            self._enough_m2 = 2.0 * way_m2
            for slip, slipped in enumerate(shown.slipped):
                if shown.slips(slipped, places):
                    return self._begin_slip(slip, seen.ids, event.stamp_ns)
            if shown.passes.any():
                self._sort(shown)
                self._begin(look)
            elif shown.is_mixed and tested:
                # A slip has begun meanwhile, or ended.
                self._starts, self._tested, self._enough_m2 = tested, [], 0.0
                return self._test(state, look, velocities)
        return None

    def _begin_slip(self, slip: int, ids: list[int], stamp_ns: int) -> Slip:
        """Compare with the present looks, by the slip; return what the last motion lost."""
        self.slip, self._agreed = slip, dict.fromkeys(ids, (stamp_ns, True))
        lost = self._lost(self.before, self._earlier, is_new=True)
        self._starts = [self._slipped(one) for one in self._latest]
        return lost

    def _is_usual(self, seen: SeenTwice) -> bool:
        """Return whether all landmarks pass but the carried ones, and one more now and then."""
        odd = seen.lagging ^ self.carried.intersection(seen.ids)
        before, self._odd = self._odd, odd
        return 2 * len(odd) < len(seen.ids) and odd.isdisjoint(before)

    def _go_on(self, state: State, look: Look) -> Slip | None:
        """Return what :meth:`note` returns during a slip; None once it is over."""
        event, made_from = look.event, self._starts[0].pose
        # Else what rounding leaves would grow, as it comes back by the motion that is taken back.
        self.pose[:3, :3] = so3.normalise(self.pose[:3, :3])
        self._starts = [self._slipped(one) for one in self._starts]
        seen = SeenTwice(self._starts, [look])
        shift = (seen.points - seen.before)[:, : state.axes.point]
        agree = mahalanobis(shift, seen.noise(state)) <= NOISE
        for i in np.flatnonzero(self._are_places(state, seen.ids)).tolist():
            self._agreed[seen.ids[i]] = event.stamp_ns, bool(agree[i])
        since_ns = event.stamp_ns - UNSEEN_NS
        self._agreed = {i: last for i, last in self._agreed.items() if last[0] > since_ns}
        count = sum(agrees for _, agrees in self._agreed.values())
        if count < LEAST or 2 * count < len(self._agreed):
            self.slip = None
            self._begin(look)
            return None
        lost = self._lost(made_from, made_from, is_new=False)
        if self.slip and self._starts[0].event.stamp_ns < since_ns:
            self._starts = [look]  # whose turn is exact
        elif not set(event.ids.tolist()).issubset(seen.ids):
            self._starts.append(look)
        return lost

    def _slipped(self, look: Look) -> Look:
        """Return a look as a slip makes of the motion since, at the present pose."""
        made = SLIPS[self.slip or 0] * se3.log(se3.between(look.pose, self.pose))
        points = se3.transform(se3.exp(-made), look.event.points)
        return Look(replace(look.event, points=points), self.pose)

    def _lost(self, since: FloatArray, whole_since: FloatArray, is_new: bool) -> Slip:
        """Return the part of the motion since a pose that was lost.

        As uncertain as the part lost of the whole motion, of which less may be made.
        """
        share, motion = SLIPS[self.slip or 0], se3.between(since, self.pose)
        back = se3.inverse(motion).dot(se3.exp(share * se3.log(motion)))
        stray = (1.0 - share) * se3.log(se3.between(whole_since, self.pose))
        unmade = block_diag(np.outer(stray[:3], stray[:3]), np.outer(stray[3:], stray[3:]))
        return Slip(back, unmade, is_new)

    def _are_places(self, state: State, ids: list[int]) -> BoolArray:
        """Return which landmarks (m,) are at rest for all we know."""
        places = np.array([i not in self.excluded for i in ids], dtype=np.bool_)
        if not state.is_mapping:
            places &= state.landmarks.rows_of(np.array(ids, dtype=np.int64)) >= 0
        return places

    def _sort(self, shown: Shown) -> None:
        """Find out which landmarks stand still while others pass."""
        gain = np.clip(shown.error**2 - shown.shift**2, -(CLEAR**2), CLEAR**2)
        gain[(gain > 0.0) & (shown.shift > NOISE)] = 0.0
        for landmark_id, more in zip(shown.ids, gain.tolist(), strict=True):
            much = self._evidence.get(landmark_id, 0.0) + more
            self._evidence[landmark_id] = min(max(much, 0.0), CERTAIN)
        evidence = self._evidence = {i: much for i, much in self._evidence.items() if much}
        self.carried = {i for i, much in evidence.items() if much == CERTAIN or i in self.carried}
        self.excluded = self.carried | {i for i, much in evidence.items() if much >= CLEAR**2}


class MapViews:
    """What views of a map together say against a pose, each of them being within the gate.

    With C_i = [−[ȳ_i]×, I] about the robot, an error ε of its pose gives landmarks the residuals
    r_i = C_i ε + noise, R_i of sensor and map. With W = Σ Cᵀ R⁻¹ C and S = C P Cᵀ + R a view says

        u = Cᵀ S⁻¹ r = (I + W P)⁻¹ Σ Cᵀ R⁻¹ r,   of covariance   G = Cᵀ S⁻¹ C = (I + W P)⁻¹ W,

    and nothing that another one says, as long as all noise is as stated. With m = Σ λ u and
    M = Σ λ² G over a window, mᵀ M⁻¹ m is χ² of p then. If in truth the robot moves otherwise by δ
    from one view to the next, m is about L δ, with L = Σ λ G. R is the noise while driving: to
    what lasts while the robot stands, its pose has adapted.

    How tags are turned, φ_i = Ω + noise, says what a shift hides. Of one point alone nothing does:
    a turn by which views have corrected the pose may have been a shift.

    Landmarks ``ids`` (n,) are in the map, with ``covariances`` (n, 3, 3), m², or None if it is
    exact.
    """

    def __init__(self, axes: EstimatedAxes, ids: IntArray, covariances: FloatArray | None) -> None:
        self._axes, self._ids, self._covariances = axes, ids, covariances
        self._place = np.zeros(3)
        self._stamp_ns = self._contradicted_ns = 0
        self._sum = 0.0  # of χ² of all contradictions, one after the other
        self._begin()

    def _begin(self) -> None:
        w, p = len(WINDOWS_S), self._axes.p
        self._m, self._M, self._L = np.zeros((w, p)), np.zeros((w, p, p)), np.zeros((w, p, p))
        self._is_alone = False
        self._c, self._W = np.zeros((w, p)), np.zeros((p, p))

    def add(self, state: State, event: ObservationEvent) -> None:
        """Take in an observation that is yet to be used."""
        in_map = event.ids[:, None] == self._ids
        if not in_map.any():
            return
        seen = in_map.any(axis=1)
        matched, in_map = match(state, event.select(seen)), in_map[seen]
        residuals = matched.residuals
        if len(residuals.rows) < len(in_map):
            return
        axes, lasting_s = self._axes, state.settings.observation_correlation_time
        r, noise = residuals.on(axes)
        repeated = repetition_factors(residuals.dt_s, lasting_s)[:, None, None]
        noise = noise * repeated
        if self._covariances is not None:
            turn = state.observer.reference_pose[: axes.point, : axes.point]
            of_map = self._covariances[in_map.argmax(axis=1), : axes.point, : axes.point]
            noise += turn.T @ of_map @ turn
        if event.kinds is not None and residuals.D is not None:
            # Ranges may be as much longer as is known of their scale.
            D, p = residuals.D[:, : axes.point], axes.p
            noise = noise + D @ state.known_errors.joint.of_robot[p:, p:] @ transpose(D)
        # About the robot, not the origin, which may be far off.
        place = state.observer.A[:3, 3].copy()
        C = axes.output_matrix(state.observer.points[residuals.rows] - place + 0.5 * residuals.r)
        to_place = self._moved(-place)
        P = to_place @ state.known_errors.joint.pose @ to_place.T
        far = mahalanobis(r, noise + C @ P @ transpose(C))
        gate = state.settings.rejection_threshold
        passed = accepted(far, gate)
        if is_contradiction(~passed):
            return
        # No view of one landmark says more than a few: it may be an outlier.
        r = passed[:, None] * np.minimum(1.0, CLEAR / np.maximum(far, CLEAR))[:, None] * r
        CW = passed[:, None, None] * transpose(solve_symmetric(noise, C))
        W, w = np.sum(CW @ C, axis=0), np.sum(CW @ r[:, :, None], axis=0)
        stands = state.observation_noise.stood_s > 0.0
        self._is_alone = len(r) < axes.point and event.orientations is None and not stands
        if event.orientations is not None:
            W_turns, w_turns = _by_turns(state, matched, passed, repeated, P)
            W[: axes.turn, : axes.turn] += W_turns
            w[: axes.turn, 0] += w_turns
        said = np.linalg.solve(np.eye(axes.p) + W @ P, np.column_stack([w, W]))
        # What was said of the pose where the robot was, is said of it where it is.
        there, back = self._moved(place - self._place), self._moved(self._place - place)
        self._place = place
        elapsed_s = to_s(max(event.stamp_ns - self._stamp_ns, 0))
        self._stamp_ns = event.stamp_ns
        share = np.exp(-elapsed_s / WINDOWS_S)[:, None, None]
        self._m = share[:, 0] * (self._m @ there) + said[:, 0]
        self._M = share**2 * (there.T @ self._M @ there) + said[:, 1:]
        self._L = share * (there.T @ self._L @ there) + said[:, 1:]
        # Half points leave more open than a turn about a point.
        whole = float(event.kinds is None)
        self._W = share[0] * (there.T @ self._W @ there) + whole * W
        self._c = share[:, 0] * (self._c @ back.T) + whole * (P @ said[:, 0])

    def _moved(self, shift: FloatArray) -> FloatArray:
        """Return which error (p, p) about a point is one about the point ``shift`` (3,) on."""
        there = np.eye(6)
        there[3:, :3] = so3.hat(shift)
        return there[self._axes.pose, self._axes.pose]

    def contradiction(self, state: State) -> Slip | None:
        """Return the motion that explains the views, if the pose is surer than they are."""
        m, M = self._m, self._M
        if not np.isfinite(M).all():
            return None
        # Along directions that no view has shown, both are zero.
        scales = np.sqrt(np.maximum(np.diagonal(M, axis1=1, axis2=2), np.finfo(np.float64).tiny))
        m = (m / scales)[:, :, None]
        M = M / (scales[:, :, None] * scales[:, None]) + 1e-9 * np.eye(m.shape[1])
        squares = np.sum(m * np.linalg.solve(M, m), axis=(1, 2))
        window = int(np.argmax(squares))
        unlikely = UNLIKELY_ALONE if self._is_alone else UNLIKELY
        if squares[window] <= unlikely[self._axes.p]:
            return None
        is_first = self._stamp_ns - self._contradicted_ns > to_ns(WINDOWS_S[-1])
        earlier, self._contradicted_ns = 0.0 if is_first else self._sum, self._stamp_ns
        self._sum = earlier + float(squares[window])
        full = _explained(state, self._m[window], self._L[window])
        full += _instead_of_turn(self._axes, self._c[window], self._W)
        explained = self._axes.full_pose_covariance(full)
        self._begin()
        turn = block_diag(state.observer.A[:3, :3], state.observer.A[:3, :3])
        is_new = earlier <= STRAYED < self._sum
        return Slip(np.eye(4), turn.T @ explained @ turn, is_new)


def _explained(state: State, m: FloatArray, L: FloatArray) -> FloatArray:
    """Return δ δᵀ and the covariance of δ, (p, p), the motion that explains sums over a window.

    As of a motion without odometry, for as long as it most likely takes.
    """
    unknown = np.maximum(np.diagonal(_noise(state, 1.0))[state.axes.pose], MIN_VARIANCE)
    taken_s = 1.0
    for _ in range(ITERATIONS):
        covariance = np.linalg.inv(L + np.diag(1.0 / (taken_s * unknown)))
        delta = covariance @ m
        # Of each axis the share that is known by what was seen (D. MacKay, 1992).
        known = np.sum(1.0 - np.diagonal(covariance) / (taken_s * unknown))
        taken_s = max(float(np.sum(delta**2 / unknown) / known), MIN_VARIANCE)
    return np.outer(delta, delta) + covariance


def _by_turns(
    state: State,
    matched: MatchedObservation,
    passed: BoolArray,
    repeated: FloatArray,
    P: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return Σ R⁻¹ (q, q) and Σ R⁻¹ φ (q,) of how tags are turned whose points ``passed`` (m,).

    ``repeated`` (m, 1, 1) is by what their errors last, and P (p, p) of the pose.
    """
    tags, of_all, q = state.gains.tags, state.observer.orientations, state.axes.turn
    event, rows = matched.known, matched.residuals.rows
    if tags is None or event.orientations is None:
        return np.zeros((q, q)), np.zeros(q)
    seen = all_orientations(state, event, rows, event.orientations)
    known = passed & of_all.are_known[seen.rows] & seen.Z.any(axis=(1, 2))
    seen = seen.select(known)
    phi, noise, clear = tags.clear_turns(seen)
    noise = noise * repeated[known]
    noise += of_all.map_sigmas[seen.rows, None, None] ** 2 * np.eye(q)
    far = mahalanobis(phi, noise + P[:q, :q])
    used = clear & accepted(far, state.settings.rejection_threshold)
    weights = np.linalg.inv(noise[used])
    return np.sum(weights, axis=0), np.einsum('ijk,ik->j', weights, phi[used])


def _instead_of_turn(axes: EstimatedAxes, c: FloatArray, W: FloatArray) -> FloatArray:
    """Return e eᵀ (p, p) of the error e if what corrections ``c`` (p,) turned was shifted instead.

    As likely as what the views say together, ``W`` (p, p): one point is seen the same way.
    """
    q = axes.p - axes.point
    shift = np.linalg.lstsq(W[q:, q:], W[q:, :q] @ c[:q], rcond=None)[0]
    error = np.concatenate([c[:q], -shift])
    share: float = math.exp(-0.5 * max(error @ W @ error, 0.0))
    return share * np.outer(error, error)
