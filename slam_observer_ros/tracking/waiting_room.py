"""Views of landmarks that no single one determines: they enter late, as points.

k half measurements and the way between them are one point, seen now, with a covariance: by
generalised least squares from starts all around, where the noise of the way is a random walk
between the views. Two minima that both fit, as on both sides of a straight way, are left open
until a curve decides. Where the past is kept, all that is known since has to
agree that the place is sure, and the views take the place of the point once it has entered.
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
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, RANGE
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.sensor_mounting import directions_of, MEASURED, Sensed, UNMEASURED_M
from slam_observer_ros.smoothing.history import Keyframe

if TYPE_CHECKING:
    from slam_observer_ros.smoothing.relinearisation import Place
    from slam_observer_ros.tracking.state import State

MOST_VIEWS, FEWEST_VIEWS = 80, 8
"""Views of a landmark that are kept, and that it takes."""

TRY_AGAIN, MOST_BETWEEN = 1.3, 40
"""By how many times the views have grown when it is tried again, and after how many at most."""

LEAST_MOVE_M, LEAST_TURN_RAD = 0.05, 0.05
"""By how much a view differs from the last one: from one place all have the same error."""

FURTHEST_RAD = 0.7
"""Deviation of a turn since a view from which it says no more where a landmark is: 40°."""

MOST_TURN_RAD = 0.3
"""Standard deviation of a turn up to which the way since a view is known well: it is linear."""

SURE_RANGES, SURE_BEARINGS = 0.05, 0.1
"""Largest standard deviation of a point, as a share of its distance, that is linear enough."""

FITS, APART = 2.5, 30.0
"""χ² per view of a solution that fits, and by how much more another one has that does not.

The odds of the side are e^15 then, beside errors of the way that are twice as stated e^4.
"""

SIDE = 3.0
"""Times the noise of the way by which views lie off a straight line, if that decides a side."""

MOST_AT_ONCE = 4
"""Sensors, or kinds of views of one, that may show a landmark at once."""

HUBER, STEPS = 2.0, 15
DEPTHS_M = (1.0, 4.0, 15.0)
"""Distances along a bearing from which a solution is sought."""


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

    def is_near(self, other: WaitingView, times: float = 1.0) -> bool:
        """Return whether the robot has moved less than it takes between this view and another."""
        way = se3.log(se3.inverse(self.pose) @ other.pose)
        turn, moved_m = np.linalg.norm(way[:3]), np.linalg.norm(way[3:])
        return bool(moved_m < times * LEAST_MOVE_M and turn < times * LEAST_TURN_RAD)

    def seen(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Return where the sensor was, and its line of sight as calibrated now: (3,) each."""
        R, shift, scale = sensor_values(state, self.sensor_frame)
        flat = np.array([1.0, 1.0, float(state.axes.point == 3)])
        origin, line = (self.mount + shift) * flat, scale * (R @ self.shown) * flat
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
        if len(views) < FEWEST_VIEWS or seen < self._next.get(landmark_id, 0):
            return None
        self._next[landmark_id] = min(math.ceil(TRY_AGAIN * seen), seen + MOST_BETWEEN)
        poses = state.relinearisation.poses_of(each.number for each in views)
        now = [
            each if pose is None else replace(each, pose=pose)
            for each, pose in zip(views, poses, strict=True)
        ]
        problem = _PlaceProblem(now, self._way.covariance, state)
        found = problem.solve(state.settings.range_scale_stddev)
        self.open_sides.discard(landmark_id)
        if found is None:
            if problem.side_is_open:
                self.open_sides.add(landmark_id)
            return None
        # All that is known since of where the robot was says more than odometry alone. But of
        # directions it is too near the robot, and too sure, while the distance is open.
        earlier = [each for each in views if each.number < self._observations]
        again = state.relinearisation.placed(found[0], _as_seen(state, earlier))
        place = found if again is None else again
        are_sure = [_is_sure(state, view, each) for each in (place, found)]
        if not (are_sure[0] and (view.is_range or are_sure[1])):
            return None
        point, of_point = place[0], found[1]
        self._entered[landmark_id] = list(views)
        for kept in (self._views, self._seen, self._next):
            del kept[landmark_id]
        R, _, scale = sensor_values(state, view.sensor_frame)
        in_body = view.pose[:3, :3].T @ (point - view.seen(state)[0])
        turned = R.T @ view.pose[:3, :3].T
        return R.T @ in_body / scale, turned @ of_point @ turned.T / scale**2

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


def _is_sure(state: State, view: WaitingView, place: Place) -> bool:
    """Return whether a place is known so well that what is seen of it is linear."""
    k, (point, covariance) = state.axes.point, place
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:k, :k])[-1]))
    sure = SURE_RANGES if view.is_range else SURE_BEARINGS
    return sigma_m < sure * float(np.linalg.norm(point - view.seen(state)[0]))


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
        sensed = Sensed(np.array(numbers), mounts, shown)
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
        self._k, self._views = state.axes.point, views
        self.side_is_open = False  # as the solution has shown
        seen = np.array([view.seen(state) for view in views])
        self._origins, self._lines = seen[:, 0], seen[:, 1]
        self._lengths = np.linalg.norm(self._lines, axis=1)
        self._is_range = np.array([view.is_range for view in views])
        self._variances = np.array([view.variances for view in views])
        # What is common to two views is the way from the later one of them until now.
        left = walk - np.array([view.walk for view in views])
        n = len(views)
        later = np.maximum(np.arange(n)[:, None], np.arange(n)[None, :])
        self._ways = left[later]
        self._plane = np.array([0.0, 0.0, 1.0])

    def solve(self, scale_sigma: float) -> tuple[FloatArray, FloatArray] | None:
        """Return the point (3,) and its covariance (3, 3); None while something is open.

        A common factor of the ranges moves it along the line of sight, which the step knows, and
        a little otherwise, which is added to the covariance.
        """
        if self._is_range.all() and not self._curve_decides():
            self.side_is_open = True
            return None
        solutions = [each for p in self._starts() if (each := self._descend(p)) is not None]
        if not solutions:
            return None
        best = min(solutions, key=lambda each: each[0])
        mirrored = self._descend(self._mirrored(best[1])) if self._is_range.any() else None
        solutions += [] if mirrored is None else [mirrored]
        cost, p, C = min(solutions, key=lambda each: each[0])
        if cost > FITS * len(self._views):
            return None
        for other_cost, q, _ in solutions:
            d = (q - p)[: self._k]
            away = d @ np.linalg.solve(C + 1e-4 * np.eye(self._k), d)
            if other_cost < cost + APART and away > 9.0:
                self.side_is_open = True
                return None
        e, H, R = self._parts(p)
        lengths = np.where(self._is_range, self._lengths, 0.0)
        if len(e) == len(lengths):
            shift = scale_sigma * (C @ H.T @ np.linalg.solve(R, lengths))
            shift -= scale_sigma * (p - self._origins[-1])[: self._k]
            C = C + np.outer(shift, shift)
        covariance = np.zeros((3, 3))
        covariance[: self._k, : self._k] = C
        return p, covariance

    def _starts(self) -> list[FloatArray]:
        origin = self._origins[-1]
        if not self._is_range.all():
            row = int(np.flatnonzero(~self._is_range)[-1])
            direction = self._lines[row] / self._lengths[row]
            return [self._origins[row] + depth_m * direction for depth_m in DEPTHS_M]
        length_m = float(np.median(self._lengths))
        turns = np.arange(8) * np.pi / 4
        level = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(8)])
        rises = (0.0,) if self._k == 2 else (0.7, -0.7)
        return [
            origin + length_m * (np.cos(rise) * each + np.sin(rise) * self._plane)
            for rise in rises
            for each in level
        ]

    def _parts(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return residuals (q,), how they change with p (q, k), and their covariance (q, q)."""
        d = p - self._origins
        r = np.maximum(np.linalg.norm(d, axis=1), 0.05)
        u = d / r[:, None]
        rows, e, H = [], [], []
        sigma2 = []
        across = self._across(u)
        for i in range(len(r)):
            if self._is_range[i]:
                rows.append(i)
                e.append(self._lengths[i] - r[i])
                H.append(u[i])
                sigma2.append(self._variances[i, 0])
                continue
            shown = self._lines[i] / self._lengths[i]
            for axis in range(self._k - 1):
                rows.append(i)
                b = across[i, axis]
                # Beyond a right angle the projection would become smaller again.
                angle = np.arctan2(shown @ b, shown @ u[i])
                e.append(angle)
                H.append(b / r[i])
                sigma2.append(self._variances[i, 1 + axis])
        at = np.array(rows)
        jacobian = np.array(H)
        # A turn ω and shift of the frame of the view move p − o by −(ω × p + shift).
        g = np.concatenate([-np.cross(p[None], jacobian), -jacobian], axis=1)
        ways = self._ways[np.ix_(at, at)]
        R = np.einsum('ia,ijab,jb->ij', g, ways, g) + np.diag(np.array(sigma2))
        return np.array(e), jacobian[:, : self._k], R

    def _across(self, u: FloatArray) -> FloatArray:
        first = np.cross(self._plane, u)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
        return np.stack([first, np.cross(u, first)], axis=1)

    def _descend(self, start: FloatArray) -> tuple[float, FloatArray, FloatArray] | None:
        """Return χ², point and covariance (k, k) of the minimum near a start; None without one."""
        p, k, weights = start.copy(), self._k, None
        cost, C = np.inf, np.eye(k)
        reach_m = 0.5 * max(float(np.median(self._lengths)), 1.0)
        for _ in range(STEPS):
            e, H, R = self._parts(p)
            w = np.ones(len(e)) if weights is None else weights
            W = np.linalg.inv(R / np.sqrt(np.outer(w, w)))
            information = H.T @ W @ H
            information += 1e-9 * np.trace(information) * np.eye(k)
            step = np.linalg.solve(information, H.T @ W @ e)
            size_m = float(np.linalg.norm(step))
            cost, C = float(e @ W @ e), np.linalg.inv(information)
            p[:k] += step * min(1.0, reach_m / max(size_m, 1e-12))
            off = np.abs(e) / np.sqrt(np.diagonal(R))
            weights = HUBER / np.maximum(off, HUBER)
            if size_m < 1e-3:
                break
        if not np.isfinite(p).all():
            return None
        behind = ~self._is_range & (np.einsum('ij,ij->i', p - self._origins, self._lines) < 0.0)
        return None if behind.any() else (cost, p, C)

    def _mirrored(self, p: FloatArray) -> FloatArray:
        """Return the point on the other side of the way, which ranges fit as well."""
        centre, axes, _ = self._spread()
        off = p - centre
        away = axes[:, self._k - 1]
        mirrored: FloatArray = p - 2.0 * (off @ away) * away
        return mirrored

    def _spread(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the middle of the origins, their axes (3, 3), the longest first, and extents."""
        centre = self._origins.mean(axis=0)
        values, axes = np.linalg.eigh(np.cov(self._origins.T) + 1e-12 * np.eye(3))
        if self._k == 2:
            values[np.abs(axes[2]).argmax()] = -1.0
        order = np.argsort(values)[::-1]
        return centre, axes[:, order], np.sqrt(np.maximum(values[order], 0.0))

    def _curve_decides(self) -> bool:
        """Return whether the way lies off a line (or a plane) by more than its own noise."""
        _, axes, extents = self._spread()
        away = axes[:, self._k - 1]
        walk = self._ways[0, 0][3:, 3:]
        return bool(extents[self._k - 1] > SIDE * np.sqrt(max(float(away @ walk @ away), 1e-8)))
