"""Views of landmarks that no single one determines: they enter late, as points.

k half measurements and the way between them are one point, seen now, with a covariance: by
generalised least squares from starts all around, where the noise of the way is a random walk
between the views. Where the past is kept, all that was seen since is linearised again at each of
these places, together with others that wait and are nearly sure, and the views take the place of
the point once it has entered. Two places that both fit, as on both sides of a straight way, are
left open until a curve decides.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
import math
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import AZIMUTH, AZIMUTH_RANGE, ObservationEvent, RANGE, RANGES
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.sensor_mounting import (
    directions_of,
    LEAST_M,
    MEASURED,
    Sensed,
    UNMEASURED_M,
    without_bias,
)
from slam_observer_ros.smoothing.history import Keyframe
from slam_observer_ros.smoothing.relinearisation import Placed

if TYPE_CHECKING:
    from slam_observer_ros.tracking.state import State

MOST_VIEWS, FEWEST_VIEWS = 80, 8  # views of a landmark that are kept, and that it takes

TRY_AGAIN, MOST_BETWEEN = 1.3, 40
"""By how many times the views have grown when it is tried again, and after how many at most."""

LEAST_MOVE_M, LEAST_TURN_RAD = 0.05, 0.05
"""By how much a view differs from the last one: from one place all have the same error."""

FURTHEST_RAD = 0.7
"""Deviation of a turn since a view from which it says no more where a landmark is: 40°."""

MOST_TURN_RAD = 0.3
"""Standard deviation of a turn up to which the way since a view is known well: it is linear."""

SURE_RANGES, SURE_BEARINGS = 0.2, 0.4
"""Largest standard deviation of a point, as a share of its least distance, that is linear enough
to begin with: as it enters all is linearised again.

In random halls half as much lets landmarks enter later, with errors a sixth larger; a quarter
leaves some of them out.
"""

LIKELY = 2.0  # times as uncertain as sure a place may be that helps others to become sure

FITS, APART = 2.5, 30.0
"""χ² per view of a solution that fits, and by how much more another one has that does not.

The odds of the side are e^15 then, beside errors of the way that are twice as stated e^4.
"""

SAME, LEAST_APART_M = 1.0, 0.01
"""Standard deviations within which two minima are one, beside what a descent may leave."""

MOST_PLACES = 4  # places that are compared by all that was seen since
MOST_AT_ONCE = 4  # sensors, or kinds of views of one, that may show a landmark at once

HUBER, STEPS = 2.0, 20
DEPTHS_M = (1.0, 4.0, 15.0)  # distances along a bearing from which a solution is sought


@dataclass(frozen=True, slots=True)
class WaitingView:
    """One half measurement, and from where: in the frame of P°."""

    number: int  # of the observation
    stamp_ns: int
    landmark_id: int
    kind: int
    sensor_frame: str
    pose: FloatArray  # (4, 4) of the body
    mount: FloatArray  # (3,) where the sensor is said to be, body axes
    shown: FloatArray  # (3,) line of sight as it was shown, body axes
    variances: FloatArray  # (3,) along it, and across it in rad²
    walk: FloatArray  # (6, 6) covariance of the way until then

    @property
    def is_range(self) -> bool:
        """Whether only the distance was measured."""
        return self.kind == RANGE

    @property
    def anchors(self) -> IntArray:
        """(1,) which landmark's bias is in it, −1 for none."""
        return np.array([self.landmark_id if self.kind in RANGES else -1])

    def biases_m(self, state: State) -> FloatArray:
        """Return by how much (1,) its range is too long."""
        return state.calibration.biases(self.anchors)[0]

    def is_near(self, other: WaitingView, times: float = 1.0) -> bool:
        """Return whether the robot has moved less than it takes between this view and another."""
        way = se3.log(se3.inverse(self.pose) @ other.pose)
        turn, moved_m = np.linalg.norm(way[:3]), np.linalg.norm(way[3:])
        return bool(moved_m < times * LEAST_MOVE_M and turn < times * LEAST_TURN_RAD)

    def seen(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Return where the sensor was, and its line of sight as calibrated now: (3,) each."""
        R, shift, scale = sensor_values(state, self.sensor_frame)
        flat = np.array([1.0, 1.0, float(not state.axes.is_planar)])
        shown = without_bias(self.shown[None], self.biases_m(state))[0] * self.shown
        origin, line = (self.mount + shift) * flat, scale * (R @ shown) * flat
        turn = self.pose[:3, :3]
        return turn @ origin + self.pose[:3, 3], turn @ line


class Way:
    """The covariance of the way since the first view, in the frame of P°."""

    def __init__(self) -> None:
        self.covariance = np.zeros((6, 6))
        self._last_ns: int | None = None
        self._last_pose = np.eye(4)

    def go_on(self, state: State, stamp_ns: int) -> None:
        """Add the noise of the way since the last view."""
        A, settings = state.observer.A, state.settings
        if self._last_ns is not None and stamp_ns > self._last_ns:
            dt_s = to_s(stamp_ns - self._last_ns)
            move = np.abs(se3.log(se3.inverse(self._last_pose) @ A))
            density = np.array([*settings.angular_velocity_noise, *settings.linear_velocity_noise])
            share = np.array([*settings.angular_scale_noise, *settings.linear_scale_noise])
            variances = density**2 * dt_s + (share * move) ** 2
            Ad = se3.adjoint(A)
            self.covariance = self.covariance + (Ad * variances) @ Ad.T
        if self._last_ns is None or stamp_ns > self._last_ns:
            self._last_ns, self._last_pose = stamp_ns, A.copy()

    def view(
        self, state: State, event: ObservationEvent, row: int, covariance: FloatArray, number: int
    ) -> WaitingView:
        """Return the half point at ``row``, with the covariance (3, 3) of its line of sight."""
        shown = event.lines_of_sight[row]
        kind = int(np.asarray(event.kinds)[row])
        basis = directions_of(shown[None])[0]
        variances = np.einsum('ij,jk,ik->i', basis, covariance, basis)
        if kind != RANGE:
            variances[1:] /= max(float(shown @ shown), 1e-9)
        return WaitingView(
            number,
            event.stamp_ns,
            int(event.ids[row]),
            kind,
            event.sensor_frame,
            state.observer.A.copy(),
            event.points[row] - shown,
            shown,
            variances,
            self.covariance,
        )


class Window:
    """Views of a robot that is lost, along all of the way that is still known well.

    They lie the farther apart the longer it is: all are kept until they are too many.
    """

    def __init__(self) -> None:
        self.way = Way()
        self.views: list[WaitingView] = []
        self.seen = 0
        self._last: dict[tuple[int, int, str], WaitingView] = {}
        self._times = 1.0  # by how much farther apart they are than it takes

    def add(self, state: State, event: ObservationEvent, row: int, covariance: FloatArray) -> None:
        """Add the half point at ``row``, unless its landmark was seen nearby already."""
        self.way.go_on(state, event.stamp_ns)
        view, turned = self.way.view(state, event, row, covariance, 0), state.axes.turned
        if not self._takes(view):
            return
        self.seen += 1
        if len(self.views) > MOST_VIEWS:
            self._times *= 2.0
            views, self._last = self.views, {}
            self.views = [each for each in views if self._takes(each)]
        uncertain = [view.walk - each.walk for each in self.views]
        while uncertain and np.diagonal(uncertain[0])[turned].max() > MOST_TURN_RAD**2:
            del uncertain[0], self.views[0]
        self.views.append(view)

    def _takes(self, view: WaitingView) -> bool:
        """Return whether a view is not near the last one of the same, and note it."""
        of = view.landmark_id, view.kind, view.sensor_frame
        if of in self._last and self._last[of].is_near(view, self._times):
            return False
        self._last[of] = view
        return True


class WaitingRoom:
    """Keeps views by id, and the covariance of the way between them."""

    def __init__(self) -> None:
        self._views: dict[int, deque[WaitingView]] = {}
        self._seen: dict[int, int] = {}  # views of each, and …
        self._next: dict[int, int] = {}  # … how many it takes until it is tried again
        self._way = Way()
        self._observations = self._stamp_ns = 0
        self._has_new = False  # views, since all was remembered
        self._entered: dict[int, list[WaitingView]] = {}  # since then
        self._likely: dict[int, FloatArray] = {}  # where some are (3,) that are not sure yet
        self.open_sides: set[int] = set()  # ids whose views fit two places

    def begin(self, stamp_ns: int) -> None:
        """Begin with another observation."""
        self._observations += 1
        self._stamp_ns = stamp_ns

    def add(
        self, state: State, event: ObservationEvent, row: int, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Take in the half point at ``row``; return line of sight and covariance if it is whole.

        Both are body axes, as the sensor would have shown the point now.
        """
        self._way.go_on(state, event.stamp_ns)
        view = self._way.view(state, event, row, covariance, self._observations)
        if not state.axes.is_planar and view.kind in (AZIMUTH, AZIMUTH_RANGE):
            return None  # no height follows from it, or hardly
        landmark_id = view.landmark_id
        views = self._views.setdefault(landmark_id, deque(maxlen=MOST_VIEWS))
        of_sensor = view.kind, view.sensor_frame
        if any(
            (last.kind, last.sensor_frame) == of_sensor and last.is_near(view)
            for last in islice(reversed(views), MOST_AT_ONCE)
        ):
            return None
        turned = state.axes.turned
        while views and np.diagonal(view.walk - views[0].walk)[turned].max() > FURTHEST_RAD**2:
            views.popleft()
        views.append(view)
        self._has_new = True
        seen = self._seen[landmark_id] = self._seen.get(landmark_id, 0) + 1
        if len(views) < FEWEST_VIEWS:
            self._likely.pop(landmark_id, None)
            return None
        if seen < self._next.get(landmark_id, 0):
            return None
        self._next[landmark_id] = min(math.ceil(TRY_AGAIN * seen), seen + MOST_BETWEEN)
        state.calibrate_ranges(view.anchors)
        poses = state.relinearisation.poses_of(each.number for each in views)
        now = [
            each if pose is None else replace(each, pose=pose)
            for each, pose in zip(views, poses, strict=True)
        ]
        problem = _PlaceProblem(now, self._way.covariance, state)
        found = problem.solve()
        self.open_sides.discard(landmark_id)
        self._likely.pop(landmark_id, None)
        seen_all = [
            _as_seen(state, [e for e in self._views[each] if e.number < self._observations])
            for each in (landmark_id, *self._likely)
        ]
        place, has_rival = self._placed(state, problem, found, seen_all)
        if has_rival:
            self.open_sides.add(landmark_id)
            return None
        if place is None:
            return None
        if not problem.is_sure(place):
            if problem.is_sure(place, LIKELY):
                self._likely[landmark_id] = place.point
            return None
        for each in self._likely:
            self._next[each] = 0
        self._entered[landmark_id] = list(views)
        for kept in (self._views, self._seen, self._next):
            del kept[landmark_id]
        R, _, scale = sensor_values(state, view.sensor_frame)
        k, of_point = state.axes.point, np.zeros((3, 3))
        of_point[:k, :k] = place.covariance
        turned = R.T @ view.pose[:3, :3].T
        line = turned @ (place.point - view.seen(state)[0]) / scale
        line = line * without_bias(line[None], -view.biases_m(state))[0]
        return line, turned @ of_point @ turned.T / scale**2

    def _placed(
        self, state: State, problem: _PlaceProblem, found: list[Placed], seen: list[Keyframe]
    ) -> tuple[Placed | None, bool]:
        """Return which of the places ``found`` is best, if any, and whether another fits, too.

        All that is known since of where the robot was says more than odometry alone.
        """
        if not found:
            return None, False
        has_rival = any(_is_rival(each, found[0]) for each in found)
        others = np.array(list(self._likely.values())).reshape(-1, 3)
        past = state.relinearisation

        def placed(point: FloatArray) -> Placed | None:
            return past.placed(np.concatenate([point[None], others]), seen)

        place = placed(found[0].point)
        if place is None:
            return found[0], has_rival
        starts = [each.point for each in found[1:]]
        if problem.has_ranges:  # which fit on the other side of the way, too
            starts.insert(0, problem.mirrored(place.point))
        for point in starts:
            if not problem.is_sure(place, LIKELY):
                return None, has_rival
            other = placed(point)
            if other is not None:
                place, other = sorted((place, other), key=lambda each: each.cost)
                if _is_rival(other, place):
                    return None, True
        return place, False

    def remember(self, states: Sequence[State]) -> bool:
        """Keep views, to be linearised again; return whether a landmark has entered."""
        entered, self._entered = self._entered, {}
        has_new, self._has_new = self._has_new, False
        for state in states:
            if has_new:
                state.relinearisation.mark(self._observations, self._stamp_ns)
            for landmark_id, views in entered.items():
                (row,) = state.landmarks.rows_of(np.array([landmark_id])).tolist()
                if row >= 0:
                    state.relinearisation.enter(row, _as_seen(state, views))
        return bool(entered)


def _is_rival(other: Placed, best: Placed) -> bool:
    """Return whether another place than the best one fits nearly as well."""
    return other.cost < best.cost + APART and not _is_same(other, best)


def _is_same(other: Placed, place: Placed) -> bool:
    """Return whether two places are one, within the errors of the second."""
    off = (other.point - place.point)[: len(place.covariance)]
    P = place.covariance + LEAST_APART_M**2 * np.eye(len(off))
    return bool(off @ np.linalg.solve(P, off) < SAME**2)


def _as_seen(state: State, views: list[WaitingView]) -> Keyframe:
    """Return views of a landmark to be linearised again."""
    calibration = state.calibration
    shown, mounts = np.array([each.shown for each in views]), np.array([e.mount for e in views])
    kinds = np.array([each.kind for each in views])
    basis, lengths = directions_of(shown), np.linalg.norm(shown, axis=1)
    variances = np.array([each.variances for each in views])
    variances[:, 1:] *= lengths[:, None] ** 2
    variances = np.where(MEASURED[kinds], variances, UNMEASURED_M**2)
    covariances = np.einsum('mij,mi,mik->mjk', basis, variances, basis)
    sensed = None
    if calibration.corrects_points:
        numbers = [calibration.sensors.index(each.sensor_frame) for each in views]
        anchors = np.concatenate([each.anchors for each in views])
        sensed = Sensed(np.array(numbers), mounts, shown, anchors)
    since_s = np.diff([each.stamp_ns for each in views]) * 1e-9
    repeated = state.observation_noise.repetitions(np.append(np.inf, since_s))
    return Keyframe(
        views[-1].stamp_ns,
        np.empty(0, dtype=np.int64),
        mounts + shown,
        shown,
        covariances,
        repeated,
        sensed=sensed,
        kinds=kinds,
        origins=mounts,
        marks=[each.number for each in views],
    )


def sensor_values(state: State, frame: str) -> tuple[FloatArray, FloatArray, float]:
    """Return how a sensor is turned (3, 3), shifted (3,), and how much longer its ranges are."""
    calibration = state.calibration
    if not calibration.corrects_points:
        return np.eye(3), np.zeros(3), 1.0
    values = calibration.sensor(frame)
    return so3.exp(values[:3]), values[3:6], math.exp(values[6])


class _PlaceProblem:
    """Where a landmark is (k,), by views and the way between them."""

    def __init__(self, views: list[WaitingView], walk: FloatArray, state: State) -> None:
        self._k = k = state.axes.point
        self._scale_sigma = state.settings.range_scale_stddev
        seen = np.array([view.seen(state) for view in views])
        self._origins, self._lines = seen[:, 0], seen[:, 1]
        self._lengths = np.linalg.norm(self._lines, axis=1)
        self._is_range = np.array([view.is_range for view in views])
        self.has_ranges = bool(self._is_range.any())
        # A range has one row, a direction one for each axis across: azimuth, then elevation.
        of_view = np.where(self._is_range, 1, k - 1)
        self._at = at = np.repeat(np.arange(len(views)), of_view)  # (q,)
        self._axis = np.arange(len(at)) - np.repeat(np.cumsum(of_view) - of_view, of_view)
        self._axis[~self._is_range[at]] += 1
        variances = np.array([view.variances for view in views])
        self._variances = variances[at, self._axis]
        # What is common to ranges is their bias …
        ranges = self._is_range[at] * state.calibration.range_bias_m
        self._biases = np.outer(ranges, ranges)
        # … and to two views the way from the later one of them until now.
        self._ways = (walk - np.array([view.walk for view in views]))[at]

    def solve(self) -> list[Placed]:
        """Return places that the views fit, the best one first; none where even that does not.

        A common factor of the ranges moves a place along the line of sight, which the step knows,
        and a little otherwise, which is added to the covariance.
        """
        minima = self._descend(self._starts())
        if minima and self.has_ranges:
            mirrored = self.mirrored(min(minima, key=lambda each: each.cost).point)
            minima += self._descend(mirrored[None])
        minima.sort(key=lambda each: each.cost)
        if not minima or minima[0].cost > FITS * len(self._lengths):
            return []
        places: list[Placed] = []
        for each in minima:
            if each.cost > minima[0].cost + 2.0 * APART or len(places) == MOST_PLACES:
                break
            if not any(_is_same(each, other) for other in places):
                places.append(each)
        return [self._with_scale(each) for each in places] if self._is_range.all() else places

    def is_sure(self, place: Placed, times: float = 1.0) -> bool:
        """Return whether a place is known so well that all that was seen of it is linear."""
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(place.covariance)[-1]))
        distance_m = float(np.linalg.norm(place.point - self._origins, axis=1).min())
        # Far away the completion alone says where it is.
        sure = SURE_RANGES if self._is_range[-1] else SURE_BEARINGS
        return sigma_m < times * sure * min(distance_m, 0.1 * UNMEASURED_M)

    def _with_scale(self, place: Placed) -> Placed:
        """Return a place whose covariance has the factor of the ranges in it."""
        _, H, R = self._parts(place.point[None])
        at = H[0, :, : self._k]
        shift = place.covariance @ at.T @ np.linalg.solve(R[0], self._lengths)
        shift -= (place.point - self._origins[-1])[: self._k]
        scale = self._scale_sigma**2 * np.outer(shift, shift)
        return place._replace(covariance=place.covariance + scale)

    def _starts(self) -> FloatArray:
        """Return points (b, 3) all around, or along the last direction."""
        origin = self._origins[-1]
        if not self._is_range.all():
            row = int(np.flatnonzero(~self._is_range)[-1])
            direction = self._lines[row] / self._lengths[row]
            along: FloatArray = self._origins[row] + np.array(DEPTHS_M)[:, None] * direction
            return along
        turns = np.arange(12) * np.pi / 6
        level = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(12)])
        rises = np.array([0.0] if self._k == 2 else [0.7, -0.7])[:, None, None]
        around = np.cos(rises) * level + np.sin(rises) * [0.0, 0.0, 1.0]
        starts: FloatArray = origin + self._lengths[-1] * around.reshape(-1, 3)
        return starts

    def _parts(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return residuals (b, q), how they change with points (b, q, 3), covariances (b, q, q).

        Of points p (b, 3).
        """
        d = p[:, None] - self._origins[self._at]
        r = np.maximum(np.linalg.norm(d, axis=2), LEAST_M)
        directions = directions_of(d.reshape(-1, 3)).reshape(*d.shape, 3)
        u = directions[:, :, 0]
        b = np.take_along_axis(directions, self._axis[None, :, None, None], axis=2)[:, :, 0]
        lines, ranges = self._lines[self._at], self._is_range[self._at]
        # Beyond a right angle the projection would become smaller again.
        angles = np.arctan2((lines * b).sum(axis=2), (lines * u).sum(axis=2))
        e = np.where(ranges, self._lengths[self._at] - r, angles)
        H = np.where(ranges[:, None], b, b / r[:, :, None])
        # A turn ω and shift of the frame of the view move p − o by −(ω × p + shift).
        g = np.concatenate([-np.cross(p[:, None], H), -H], axis=2)
        later = np.triu(g @ np.einsum('qij,bqj->biq', self._ways, g))
        R = later + np.triu(later, 1).transpose(0, 2, 1) + self._biases
        R[:, np.arange(len(self._at)), np.arange(len(self._at))] += self._variances
        return e, H, R

    def _descend(self, starts: FloatArray) -> list[Placed]:
        """Return the minima that starts (b, 3) lead to."""
        k, p, n = self._k, starts.copy(), len(starts)
        best, costs, damping = p, np.full(n, np.inf), np.full(n, 1e-3)
        H_best, g_best = np.zeros((n, k, k)), np.zeros((n, k))
        for _ in range(STEPS):
            e, H, R = self._parts(p)
            off = np.abs(e) / np.sqrt(np.diagonal(R, axis1=1, axis2=2))
            shares = np.sqrt(HUBER / np.maximum(off, HUBER))[:, :, None]
            rows = shares * np.concatenate([H[:, :, :k], e[:, :, None]], axis=2)
            normal = rows.transpose(0, 2, 1) @ np.linalg.solve(R, rows)
            is_better = normal[:, k, k] < costs
            best = np.where(is_better[:, None], p, best)
            costs = np.where(is_better, normal[:, k, k], costs)
            H_best = np.where(is_better[:, None, None], normal[:, :k, :k], H_best)
            g_best = np.where(is_better[:, None], normal[:, :k, k], g_best)
            damping = np.where(is_better, 0.2 * damping, 10.0 * damping)
            scaled = damping[:, None] * np.diagonal(H_best, axis1=1, axis2=2) + 1e-12
            step = np.linalg.solve(H_best + scaled[:, :, None] * np.eye(k), g_best[:, :, None])
            size_m = np.linalg.norm(step, axis=1)
            if size_m.max() < 1e-3:
                break
            reach_m = 0.5 * np.linalg.norm(best - self._origins[-1], axis=1) + 0.1
            p = best.copy()
            p[:, :k] += step[:, :, 0] * np.minimum(1.0, reach_m[:, None] / size_m)
        ahead = np.einsum('bni,ni->bn', best[:, None] - self._origins, self._lines) > 0.0
        kept = (ahead | self._is_range).all(axis=1)
        trace = np.trace(H_best, axis1=1, axis2=2)[:, None, None]
        C = np.linalg.inv(H_best + 1e-9 * trace * np.eye(k))
        return [Placed(best[i], C[i], float(costs[i])) for i in np.flatnonzero(kept)]

    def mirrored(self, p: FloatArray) -> FloatArray:
        """Return the point on the other side of the way, which ranges fit as well."""
        centre = self._origins.mean(axis=0)
        values, axes = np.linalg.eigh(np.cov(self._origins.T) + 1e-12 * np.eye(3))
        if self._k == 2:
            values[np.abs(axes[2]).argmax()] = np.inf
        away = axes[:, np.argmin(values)]
        mirrored: FloatArray = p - 2.0 * ((p - centre) @ away) * away
        return mirrored
