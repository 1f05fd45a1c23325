"""Views of landmarks that no single one determines: they enter late, as points.

k half measurements and the way between them are one point, seen now, with a covariance: by
generalised least squares from starts all around, where the noise of the way is a random walk
between the views. Two minima that both fit, as on both sides of a straight way, are left open
until a curve decides. What has been used so is used up.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.events import ObservationEvent, RANGE
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.sensor_mounting import directions_of

if TYPE_CHECKING:
    from slam_observer_ros.tracking.state import State

MOST_VIEWS, FEWEST_VIEWS = 80, 8
"""Views of a landmark that are kept, and that it takes."""

TRY_AGAIN, MOST_BETWEEN = 1.3, 40
"""By how many times the views have grown when it is tried again, and after how many at most."""

LEAST_MOVE_M, LEAST_TURN_RAD = 0.05, 0.05
"""By how much a view differs from the last one: from one place all have the same error."""

MOST_TURN_RAD = 0.3
"""Standard deviation of a turn up to which the way since a view is known well: it is linear."""

SURE = 0.1
"""Largest standard deviation of a point, as a share of its distance, that is linear enough."""

FITS, APART = 2.5, 30.0
"""χ² per view of a solution that fits, and by how much more another one has that does not.

The odds of the side are e^15 then, beside errors of the way that are twice as stated e^4.
"""

SIDE = 3.0
"""Times the noise of the way by which views lie off a straight line, if that decides a side."""

HUBER, STEPS = 2.0, 15
DEPTHS_M = (1.0, 4.0, 15.0)
"""Distances along a bearing from which a solution is sought."""


@dataclass(frozen=True, slots=True)
class WaitingView:
    """One half measurement, and from where: in the frame of P°."""

    landmark_id: int
    kind: int
    sensor_frame: str
    pose: FloatArray  # (4, 4) of the body
    origin: FloatArray  # (3,) of the sensor
    line: FloatArray  # (3,) of sight, as measured
    variances: FloatArray  # (3,) along it, and across it in rad²
    walk: FloatArray  # (6, 6) covariance of the way until then

    @property
    def is_range(self) -> bool:
        """Whether only the distance was measured."""
        return self.kind == RANGE

    def is_near(self, other: WaitingView, times: float = 1.0) -> bool:
        """Return whether the sensor has moved less than it takes between this view and another."""
        turn = np.linalg.norm(se3.log(se3.inverse(self.pose) @ other.pose)[:3])
        moved_m = float(np.linalg.norm(self.origin - other.origin))
        return moved_m < times * LEAST_MOVE_M and float(turn) < times * LEAST_TURN_RAD


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
        self, state: State, event: ObservationEvent, row: int, covariance: FloatArray
    ) -> WaitingView:
        """Return the half point at ``row``, with the covariance (3, 3) of its line of sight."""
        A = state.observer.A.copy()
        R, shift, scale = sensor_values(state, event)
        origin = event.points[row] - event.lines_of_sight[row] + shift
        line = scale * (R @ event.lines_of_sight[row])
        kind = int(np.asarray(event.kinds)[row])
        basis = directions_of(line[None])[0]
        variances = np.einsum('ij,jk,ik->i', basis, covariance, basis)
        if kind != RANGE:
            variances[1:] /= max(float(line @ line), 1e-9)
        if state.axes.point == 2:
            origin, line = origin * [1.0, 1.0, 0.0], line * [1.0, 1.0, 0.0]
        R_A, x_A = A[:3, :3], A[:3, 3]
        return WaitingView(
            int(event.ids[row]),
            kind,
            event.sensor_frame,
            A,
            R_A @ origin + x_A,
            R_A @ line,
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
        view, turned = self.way.view(state, event, row, covariance), state.axes.turned
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
        self.open_sides: set[int] = set()  # ids whose views fit two places

    def add(
        self, state: State, event: ObservationEvent, row: int, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Take in the half point at ``row``; return line of sight and covariance if it is whole.

        Both are body axes, as the sensor would have shown the point now.
        """
        self._way.go_on(state, event.stamp_ns)
        view = self._way.view(state, event, row, covariance)
        landmark_id = view.landmark_id
        views = self._views.setdefault(landmark_id, deque(maxlen=MOST_VIEWS))
        if views and views[-1].is_near(view):
            return None
        views.append(view)
        seen = self._seen[landmark_id] = self._seen.get(landmark_id, 0) + 1
        if seen < self._next.get(landmark_id, FEWEST_VIEWS):
            return None
        self._next[landmark_id] = min(math.ceil(TRY_AGAIN * seen), seen + MOST_BETWEEN)
        problem = _PlaceProblem(list(views), self._way.covariance, state.axes.point)
        found = problem.solve(state.settings.range_scale_stddev)
        self.open_sides.discard(landmark_id)
        if found is None:
            if problem.side_is_open:
                self.open_sides.add(landmark_id)
            return None
        for kept in (self._views, self._seen, self._next):
            del kept[landmark_id]
        point, of_point = found
        R, _, scale = sensor_values(state, event)
        in_body = view.pose[:3, :3].T @ (point - view.origin)
        turned = R.T @ view.pose[:3, :3].T
        return R.T @ in_body / scale, turned @ of_point @ turned.T / scale**2


def sensor_values(state: State, event: ObservationEvent) -> tuple[FloatArray, FloatArray, float]:
    """Return how a sensor is turned (3, 3), shifted (3,), and how much longer its ranges are."""
    calibration = state.calibration
    if not calibration.corrects_points:
        return np.eye(3), np.zeros(3), 1.0
    values = calibration.sensor(event.sensor_frame)
    return so3.exp(values[:3]), values[3:6], math.exp(values[6])


class _PlaceProblem:
    """Where a landmark is (k,), by views and the way between them."""

    def __init__(self, views: list[WaitingView], walk: FloatArray, k: int) -> None:
        self._k, self._views = k, views
        self.side_is_open = False  # as the solution has shown
        self._origins = np.array([view.origin for view in views])
        self._lines = np.array([view.line for view in views])
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
        if self._is_range.any() and not self._curve_decides():
            self.side_is_open = True
            return None
        solutions = [each for p in self._starts() if (each := self._descend(p)) is not None]
        if not solutions:
            return None
        best = min(solutions, key=lambda each: each[0])
        mirrored = self._descend(self._mirrored(best[1])) if self._is_range.any() else None
        solutions += [] if mirrored is None else [mirrored]
        cost, p, C = min(solutions, key=lambda each: each[0])
        distance_m = float(np.linalg.norm(p - self._origins[-1]))
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(C)[-1]))
        if cost > FITS * len(self._views) or sigma_m > SURE * distance_m:
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
