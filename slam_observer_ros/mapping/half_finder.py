"""Finds the pose in a map by ranges or bearings alone: by one pose that explains all of them.

A window of views and the way between them is fitted to the landmarks that their ids name, from
starts all around: given how the robot is turned, where it is follows from linear equations. The
noise of the way is a random walk between the views. A pose is taken if no other one explains the
views nearly as well, nor would if the robot had turned to the other side: that is how ranges from
landmarks in a line look, and then only the sign of the odometry's turns would decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.robust import HEAVY_TAIL, huber_loss, straight_odds, straight_share
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes, PLANAR
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.lie.sensor_mounting import MEASURED
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.tracking.half_points import of_axes
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.waiting_room import FEWEST_VIEWS, Window

HEADINGS = 24  # turns from which a solution is sought in the plane; in space as many and more

# Starts that are followed on after ``FIRST_STEPS``, and minima that are fitted with all noise.
MOST_KEPT, MOST_FITTED = 32, 8
FIRST_STEPS, STEPS, FITTING_STEPS = 5, 20, 10
ONE = 0.03  # rad, and share of the map, within which two descents have ended at one minimum
TRY_AGAIN, MOST_BETWEEN = 1.2, 10  # search again once views have grown by the factor or number

# Share of the views that a pose explains, their χ² per view, and by how much more others have: the
# odds are e^15 then.
MOST, FITS, APART = 0.5, 2.5, 30.0
SAME = 1.0  # standard deviations within which two minima are one, and a line has no sides

# Largest standard deviations of the turn, rad, and of the place, as a share of the distances. With
# three of them the error of the second order is a fiftieth, and the filter can start.
SURE_RAD, SURE = 0.07, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """n views of landmarks, seen from the body as it is now."""

    landmarks: FloatArray  # (n, 3) in the map, metres
    landmark_covariances: FloatArray  # (n, 3, 3) m²
    named: IntArray  # (n,) which landmark each is of
    turns: FloatArray  # (n, 3, 3) how the body was turned
    origins: FloatArray  # (n, 3) where the sensor was
    ranges: FloatArray  # (n,) metres; NaN where none was measured
    directions: FloatArray  # (n, 3) unit vectors along the body's axes then
    is_direction: BoolArray  # (n, 3) what of them was measured: along x, y, z
    variances: FloatArray  # (n, 2) of ranges, m², and of directions, rad²
    walks: FloatArray  # (n, 6, 6) covariance of the way until now, in the body's axes now
    sensors: IntArray  # (n,) which sensor each is of: each has a scale of its own
    frames: tuple[str, ...]  # of the sensors
    bias_m: float = 0.0  # by how much all ranges from one landmark may be too long

    def mirrored(self) -> Views:
        """Return the views as from a way that turned to the other side."""
        M = np.diag([1.0, -1.0, 1.0])
        return replace(self, turns=M @ self.turns @ M, origins=self.origins @ M)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose that fits the views best of all nearby."""

    pose: FloatArray  # (4, 4) of the body now, in the map
    covariance: FloatArray  # (6 + s, 6 + s) of rotation vector and position, map axes, and scales
    cost: float  # −2 ln of the likelihood, but for a constant
    square: float  # χ² of the views that fit, …
    share: float  # … which are so many of all
    degrees: int  # how much is measured
    scales: FloatArray  # (s,) ln of how much too short each sensor's ranges are

    @property
    def place_sigma_m(self) -> float:
        """The largest standard deviation of where the robot is."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1]))

    def is_same(self, other: Fit, axes: EstimatedAxes) -> bool:
        """Return whether another pose is this one, within their errors."""
        turn = so3.log(other.pose[:3, :3] @ self.pose[:3, :3].T)
        off = np.concatenate([turn, other.pose[:3, 3] - self.pose[:3, 3]])[axes.pose]
        P = (self.covariance + other.covariance)[axes.pose, axes.pose] + 1e-6 * np.eye(axes.p)
        return float(off @ np.linalg.solve(P, off)) < SAME**2


class Fix(NamedTuple):
    """Where a robot is that was lost."""

    pose: FloatArray  # (4, 4) in the map
    covariance: FloatArray  # (6 + s, 6 + s) of rotation vector and position, map axes, and scales
    known: LandmarkMap
    scales: dict[str, float]  # ln of how much longer ranges are than as calibrated, by s sensors


class HalfFinder:
    """Searches maps for the pose of a robot by its window of views.

    ``rivals`` are the poses (4, 4) that fit alike, and ``in_a_line`` the ids of landmarks that
    leave the side open; both as the last search left it.
    """

    def __init__(self, maps: Sequence[LandmarkMap]) -> None:
        self._maps, self._next = maps, FEWEST_VIEWS
        self.rivals: list[FloatArray] = []
        self.in_a_line: list[int] = []

    def find(self, state: State, window: Window) -> Fix | None:
        """Return where the robot is; None if no or other poses fit, or little is new."""
        if window.seen < self._next:
            return None
        self._next = min(math.ceil(TRY_AGAIN * window.seen), window.seen + MOST_BETWEEN)
        self.rivals, self.in_a_line = [], []
        axes, scale_sigma = state.axes, state.settings.range_scale_stddev
        fits = [
            (fit, views, known)
            for known in self._maps
            if (views := _views(window, state, known)) is not None
            for fit in find_poses(views, axes, scale_sigma)
        ]
        if not fits:
            return None
        best, views, known = min(fits, key=lambda each: each[0].cost)
        if best.square > FITS * best.degrees or best.share < MOST:
            return None
        # Noise that is larger than stated makes all differences larger.
        margin = APART * max(best.square / max(best.degrees - axes.p, 1), 1.0)
        alike = [fit.pose for fit, *_ in fits if fit.cost < best.cost + margin]
        if axes.is_planar and fits_mirrored(views, best, margin):
            self.in_a_line = known.ids[np.unique(views.named)].tolist()
            return None
        if len(alike) > 1:
            self.rivals = alike
            return None
        # It must be known so well that the filter can start with it.
        distances_m = np.linalg.norm(views.landmarks - best.pose[:3, 3], axis=1)
        turn_sigma = float(np.sqrt(np.trace(best.covariance[:3, :3]) / axes.turn))
        if turn_sigma < SURE_RAD and best.place_sigma_m < SURE * float(np.median(distances_m)):
            scales = dict(zip(views.frames, best.scales.tolist(), strict=True))
            return Fix(best.pose, best.covariance, known, scales)
        return None


def fits_mirrored(views: Views, fit: Fit, margin: float) -> bool:
    """Return whether views in the plane fit a way on the other side of the landmarks, too.

    That is so of ranges from landmarks in a line. The way there turns to the other side, so that
    nothing but the sign of the odometry's turns speaks against it.
    """
    named, first = np.unique(views.named, return_index=True)
    if len(named) < 2:
        return True
    points = views.landmarks[first, :2]
    centre = points.mean(axis=0)
    along = np.linalg.svd(points - centre)[2][0]
    across = np.array([-along[1], along[0]])
    M = np.eye(4)
    M[:2, :2] -= 2.0 * np.outer(across, across)
    M[:2, 3] = 2.0 * (centre @ across) * across
    other = M @ fit.pose @ np.diag([1.0, -1.0, 1.0, 1.0])
    way = se3.transform(fit.pose, views.origins)[:, :2]
    # On the line itself there are no sides.
    if (np.abs((way - centre) @ across).max()) < SAME * fit.place_sigma_m:
        return False
    problem, mirrored = (_Problem(each, PLANAR, 1.0) for each in (views, views.mirrored()))
    costs = [
        float(each.costs(pose[None], fit.scales[None])[0])
        for each, pose in ((problem, fit.pose), (mirrored, other))
    ]
    return costs[1] < costs[0] + margin


def _views(window: Window, state: State, known: LandmarkMap) -> Views | None:
    """Return the views of landmarks that a map has, as seen from where the body is now."""
    rows = known.rows_of(np.array([view.landmark_id for view in window.views], dtype=np.int64))
    views = [view for view, row in zip(window.views, rows, strict=True) if row >= 0]
    named = rows[rows >= 0]
    if len(views) < FEWEST_VIEWS or len(set(named.tolist())) < 2:
        return None
    back = se3.inverse(state.observer.A)
    turns = back[:3, :3] @ np.array([view.pose[:3, :3] for view in views])
    seen = np.array([view.seen(state) for view in views])
    lines = seen[:, 1] @ back[:3, :3].T
    lines = np.einsum('nji,nj->ni', turns, lines)  # along the body's axes then
    kinds = of_axes(np.array([view.kind for view in views]), state)
    range_m = np.linalg.norm(lines, axis=1)
    measured = MEASURED[kinds]
    is_direction = np.repeat(measured[:, [1]], 3, axis=1)
    is_direction[:, 2] = measured[:, 2] & (not state.axes.is_planar)
    partial = lines * is_direction
    level = np.linalg.norm(partial, axis=1, keepdims=True)
    variances = np.array([view.variances for view in views])
    walks = window.way.covariance - np.array([view.walk for view in views])
    Ad = se3.adjoint(back)
    sensors = sorted({view.sensor_frame for view in views})
    return Views(
        landmarks=known.world_points[named],
        landmark_covariances=known.covariances_or(state.settings.map_noise)[named],
        named=named,
        turns=turns,
        origins=se3.transform(back, seen[:, 0]),
        ranges=np.where(measured[:, 0], range_m, np.nan),
        directions=partial / np.maximum(level, 1e-9),
        is_direction=is_direction,
        variances=variances[:, :2],
        walks=Ad @ walks @ Ad.T,
        sensors=np.array([sensors.index(view.sensor_frame) for view in views]),
        frames=tuple(sensors),
        bias_m=state.calibration.range_bias_m,
    )


def find_poses(views: Views, axes: EstimatedAxes, scale_sigma: float) -> list[Fit]:
    """Return the poses that fit views locally best, the best one first."""
    problem = _Problem(views, axes, scale_sigma)
    T, s = problem.starts()
    T, s, costs = problem.descend(T, s, FIRST_STEPS)
    kept = np.argsort(costs, kind='stable')[:MOST_KEPT]
    T, s, costs = problem.descend(T[kept], s[kept], STEPS)
    # Descents may have ended at the same pose.
    apart: list[int] = []
    for i in np.argsort(costs, kind='stable').tolist():
        turned = np.linalg.norm(T[i, :3, :3] - T[apart, :3, :3], axis=(1, 2))
        moved = np.linalg.norm(T[i, :3, 3] - T[apart, :3, 3], axis=1) / problem.span_m
        if np.isfinite(costs[i]) and (np.maximum(turned, moved) > ONE).all():
            apart.append(i)
    fits: list[Fit] = []
    for i in apart[:MOST_FITTED]:
        fit = problem.fit(T[i], s[i])
        if fit is not None and not any(fit.is_same(other, axes) for other in fits):
            fits.append(fit)
    return sorted(fits, key=lambda fit: fit.cost)


class _Problem:
    """Residuals of views at b poses T (b, 4, 4) and ln scales s (b, n_s) at once."""

    def __init__(self, views: Views, axes: EstimatedAxes, scale_sigma: float) -> None:
        self._views, self._axes = views, axes
        self._scale_sigma = max(scale_sigma, 1e-6)
        self._is_range = np.isfinite(views.ranges)
        self._ranges = np.where(self._is_range, views.ranges, 0.0)
        self._sensors = np.eye(views.sensors.max() + 1)[views.sensors]  # (n, s)
        self._mask = np.column_stack([self._is_range, views.is_direction])
        # A unit vector of three numbers is two measured ones, of two it is one.
        of_directions = np.maximum(views.is_direction.sum(axis=1) - 1, 0)
        self._degrees = int(self._is_range.sum() + of_directions.sum())
        self._flat = views.is_direction.astype(float)
        k, n = axes.point, len(views.origins)
        lever = np.concatenate([-so3.hat(views.origins), np.tile(np.eye(3), (n, 1, 1))], axis=2)
        moved = lever @ views.walks @ transpose(lever) + views.landmark_covariances
        self._way_m2 = np.trace(moved[:, :k, :k], axis1=1, axis2=2) / k
        self._way_rad2 = views.walks[:, axes.turned, axes.turned].mean(axis=1)
        spread_m = np.linalg.norm(np.ptp(views.landmarks, axis=0))
        self.span_m = float(spread_m + np.max(self._ranges, initial=1.0))

    def parts(self, T: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return residuals (b, n, 4), lines of sight (b, n, 3) and their lengths (b, n)."""
        views = self._views
        at = (views.landmarks - T[:, None, :3, 3]) @ T[:, :3, :3]  # (b, n, 3)
        lines = np.einsum('nji,bnj->bni', views.turns, at - views.origins)
        lengths = np.maximum(np.linalg.norm(lines, axis=2), 1e-3)
        scales = np.exp(-s @ self._sensors.T)  # (b, n)
        partial = lines * self._flat
        level = np.maximum(np.linalg.norm(partial, axis=2), 1e-3)
        e = np.empty((*lengths.shape, 4))
        e[..., 0] = self._ranges - scales * lengths
        e[..., 1:] = views.directions - partial / level[..., None]
        return np.where(self._mask, e, 0.0), lines, lengths

    def jacobian(
        self, T: FloatArray, s: FloatArray, lines: FloatArray, lengths: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return how residuals (b, n, 4) change with pose errors and scales, and with points.

        The error of the pose is ε in T exp(ε), of all six axes: (b, n, 4, 6 + s); the points are
        the landmarks' along the body's axes now: (b, n, 4, 3).
        """
        views, n_s = self._views, s.shape[1]
        at = (views.landmarks - T[:, None, :3, 3]) @ T[:, :3, :3]
        scales = np.exp(-s @ self._sensors.T)
        b, n = lengths.shape
        u = lines / lengths[..., None]
        D = np.zeros((b, n, 4, 3))  # by the lines of sight along the body's axes then
        D[..., 0, :] = -scales[..., None] * u
        partial = lines * self._flat
        level = np.maximum(np.linalg.norm(partial, axis=2), 1e-3)
        v = partial / level[..., None]
        P = np.eye(3) * self._flat[:, None, :] - v[..., :, None] * v[..., None, :]
        D[..., 1:, :] = -P / level[..., None, None]
        D = np.where(self._mask[..., None], D, 0.0)
        D = D @ transpose(views.turns)  # by points along the body's axes now
        J = np.zeros((b, n, 4, 6 + n_s))
        J[..., :3] = D @ so3.hat(at)
        J[..., 3:6] = -D
        J[..., 0, 6:] = (self._is_range * scales * lengths)[..., None] * self._sensors
        return J, D

    def variances(self, lengths: FloatArray) -> FloatArray:
        """Return how uncertain residuals (b, n, 4) are, each by itself: variances."""
        of_ranges, of_directions = self._views.variances.T
        variances = np.empty((*lengths.shape, 4))
        variances[..., 0] = of_ranges + self._way_m2 + self._views.bias_m**2
        angular = of_directions + self._way_rad2 + self._way_m2 / lengths**2
        variances[..., 1:] = angular[..., None]
        return variances

    def _columns(self, n_s: int) -> IntArray:
        return np.append(np.arange(6)[self._axes.pose], 6 + np.arange(n_s))

    def _robust(
        self, e: FloatArray, s: FloatArray, variances: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return costs (b,) by Huber and of the scales, and weights (b, n, 4)."""
        off = np.abs(e) / np.sqrt(variances)
        of_scales = ((s / self._scale_sigma) ** 2).sum(axis=1)
        costs: FloatArray = huber_loss(off).sum(axis=(1, 2)) + of_scales
        return costs, HEAVY_TAIL / np.maximum(off, HEAVY_TAIL)

    def descend(
        self, T: FloatArray, s: FloatArray, steps: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Follow starts downhill (Levenberg and Marquardt), each view by itself; return costs."""
        columns = self._columns(s.shape[1])
        damping = np.full(len(T), 1e-3)
        e, lines, lengths = self.parts(T, s)
        for _ in range(steps):
            variances = self.variances(lengths)
            costs, weights = self._robust(e, s, variances)
            J, _ = self.jacobian(T, s, lines, lengths)
            J = J[..., columns].reshape(len(T), -1, len(columns))
            W = (weights / variances).reshape(len(T), -1)
            information = transpose(J) @ (W[..., None] * J)
            gradient = np.einsum('bqc,bq->bc', J, W * e.reshape(len(T), -1))
            p = self._axes.p
            scale_at = np.arange(p, len(columns))
            information[:, scale_at, scale_at] += self._scale_sigma**-2
            gradient[:, p:] += s / self._scale_sigma**2
            diagonal = np.einsum('bcc->bc', information)
            ridge = damping[:, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True)
            step = -np.linalg.solve(
                information + ridge[:, :, None] * np.eye(len(columns)), gradient[..., None]
            )[..., 0]
            T_new, s_new = self._moved(T, s, step)
            e_new, lines_new, lengths_new = self.parts(T_new, s_new)
            costs_new, _ = self._robust(e_new, s_new, variances)
            better = costs_new < costs
            damping = np.clip(np.where(better, 0.2 * damping, 8.0 * damping), 1e-6, 1e6)
            T = np.where(better[:, None, None], T_new, T)
            s = np.where(better[:, None], s_new, s)
            e = np.where(better[:, None, None], e_new, e)
            lines = np.where(better[:, None, None], lines_new, lines)
            lengths = np.where(better[:, None], lengths_new, lengths)
        return T, s, self.costs(T, s)

    def costs(self, T: FloatArray, s: FloatArray) -> FloatArray:
        """Return χ² (b,) of poses, each view by itself."""
        e, _, lengths = self.parts(T, s)
        return self._robust(e, s, self.variances(lengths))[0]

    def _moved(
        self, T: FloatArray, s: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        p = self._axes.p
        full = np.zeros((len(T), 6))
        full[:, self._axes.pose] = step[:, :p]
        # No further than to the other end of the map, and no more than a quarter of a turn.
        size = np.linalg.norm(full[:, 3:], axis=1) / self.span_m
        size = np.maximum(size, np.linalg.norm(full[:, :3], axis=1) / (0.25 * np.pi))
        share = 1.0 / np.maximum(size, 1.0)
        return T @ se3.exp(full * share[:, None]), s + step[:, p:] * share[:, None]

    def fit(self, T: FloatArray, s: FloatArray) -> Fit | None:
        """Return the minimum near a pose (4, 4), with the noise that views have in common."""
        views, axes = self._views, self._axes
        T, s = T[None], s[None]
        columns, p = self._columns(s.shape[1]), axes.p
        rows = np.flatnonzero(self._mask.ravel())
        view = rows // 4
        later = np.maximum(view[:, None], view[None, :]) == view[None, :]
        same = views.named[view][:, None] == views.named[view][None, :]
        weights, biases = np.ones(len(rows)), views.bias_m * (rows % 4 == 0)
        cost, square, covariance = np.inf, np.inf, np.eye(len(columns))
        for _ in range(FITTING_STEPS):
            e, lines, lengths = self.parts(T, s)
            J, D = self.jacobian(T, s, lines, lengths)
            R = T[0, :3, :3]
            G, D = J[0].reshape(-1, J.shape[-1])[rows], D[0].reshape(-1, 3)[rows]
            g = G[:, :6]
            # What two views have in common is the way from the later one until now …
            WG = np.einsum('qij,qj->qi', views.walks[view], g)
            ways = g @ WG.T
            ways = np.where(later, ways, ways.T)
            # … and where the landmark is, and how much too long its ranges, if it is the same.
            in_body = R.T @ views.landmark_covariances[view] @ R
            of_landmarks = np.einsum('qi,qij,rj->qr', D, in_body, D) + np.outer(biases, biases)
            of_points = np.where(same, of_landmarks, 0.0)
            own = np.broadcast_to(views.variances[:, [0, 1, 1, 1]], (len(lengths[0]), 4))
            S = ways + of_points + np.diag(own.ravel()[rows])
            r = e[0].ravel()[rows]
            costs, weights = self._judged(r, np.sqrt(np.diagonal(S)), rows)
            try:
                W = np.linalg.inv(S / np.sqrt(np.outer(weights, weights)))
                H = G[:, columns]
                information = H.T @ W @ H
                gradient = H.T @ W @ r
                at = np.arange(p, len(columns))
                information[at, at] += self._scale_sigma**-2
                gradient[p:] += s[0] / self._scale_sigma**2
                covariance = np.linalg.inv(information)
            except np.linalg.LinAlgError:
                return None
            square = float(r @ W @ r)
            by_itself = float((weights * r**2 / np.diagonal(S)).sum())
            cost = square - by_itself + float(costs.sum() + ((s / self._scale_sigma) ** 2).sum())
            step = -covariance @ gradient
            if float(np.abs(step).max()) < 1e-4:
                break
            T, s = self._moved(T, s, step[None])
        if not (np.isfinite(T).all() and np.isfinite(covariance).all()):
            return None
        full, turn = np.zeros((6 + s.shape[1],) * 2), np.eye(6 + s.shape[1])
        full[np.ix_(columns, columns)] = covariance
        turn[:6, :6] = np.kron(np.eye(2), T[0, :3, :3])
        share = float(np.mean(weights > 0.5))
        return Fit(T[0], turn @ full @ turn.T, cost, square, share, self._degrees, s[0])

    def _judged(
        self, r: FloatArray, sigmas: FloatArray, rows: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return costs and weights (q,) of residuals: Huber's, and by odds of ranges too long."""
        off = np.abs(r) / sigmas
        costs, weights = huber_loss(off), HEAVY_TAIL / np.maximum(off, HEAVY_TAIL)
        is_range = rows % 4 == 0
        odds = straight_odds(sigmas, self._ranges[rows // 4])
        share = straight_share(np.where(is_range, np.sqrt(costs) * np.sign(r), 0.0), odds)
        # −2 ln of the density of either, over the density of a straight one without any error
        either = costs + 2.0 * np.log(np.maximum(share, 1e-300))
        return either, np.maximum(weights * share, 1e-9)

    def starts(self) -> tuple[FloatArray, FloatArray]:
        """Return poses (b, 4, 4) of turns all around, and where views put the robot at each."""
        if self._axes.turn == 1:
            angles = np.arange(HEADINGS) * 2.0 * np.pi / HEADINGS
            R = so3.exp(angles[:, None] * np.array([0.0, 0.0, 1.0]))
        else:
            from scipy.spatial.transform import Rotation  # which few runs need

            R = Rotation.create_group('I').as_matrix()
        views, k = self._views, self._axes.point
        # Where the landmark would be seen from, if there was no way: 'virtual' landmarks.
        b = views.landmarks - np.einsum('hij,nj->hni', R, views.origins)
        middle = b.mean(axis=1, keepdims=True)
        b = (b - middle)[..., :k]  # (h, n, k)
        place, square = self._linear(R, b)
        places = [place]
        if self._is_range.any():
            # Ranges may fit on the other side of these, too.
            _, axes = np.linalg.eigh(np.einsum('hni,hnj->hij', b, b))
            away = axes[:, :, 0]  # (h, k), the direction in which they are spread least
            off = np.einsum('hi,hi->h', place, away)[:, None] * away
            level = place - off
            rise = np.sqrt(np.maximum(square - (level**2).sum(axis=1), 0.0))
            rise = rise[:, None] * away
            places += [places[0] - 2.0 * off, level + rise, level - rise]
        T = np.tile(np.eye(4), (len(places) * len(R), 1, 1))
        T[:, :3, :3] = np.tile(R, (len(places), 1, 1))
        T[:, :3, 3] = np.tile(middle[:, 0], (len(places), 1))
        T[:, :k, 3] += np.concatenate(places)
        return T, np.zeros((len(T), self._sensors.shape[1]))

    def _linear(self, R: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the places t (h, k) of the robot and t² (h,), by linear equations.

        |t − b|² = ρ² is 2 b·t − t² = b² − ρ², linear in t and t²; a direction m has
        (t − b) × m = 0.
        """
        views, k = self._views, self._axes.point
        h, n = b.shape[:2]
        size = self.span_m
        M, y = np.zeros((h, n, k + 1, k + 1)), np.zeros((h, n, k + 1))
        M[:, :, 0, :k], M[:, :, 0, k] = 2.0 * b / size, -1.0
        y[:, :, 0] = ((b**2).sum(axis=2) - self._ranges**2) / size
        w = (
            1.0
            / (2.0 * np.maximum(self._ranges, 0.1 * size) / size)
            / np.sqrt(np.maximum(views.variances[:, 0] + self._way_m2, 1e-6))
        )
        M[:, :, 0] *= (self._is_range * w)[:, None]
        y[:, :, 0] *= self._is_range * w
        m = np.einsum('hij,njk,nk->hni', R, views.turns, views.directions)[..., :k]
        sigma = np.sqrt(views.variances[:, 1] + self._way_rad2) * size
        P = np.eye(k) - m[..., :, None] * m[..., None, :]
        is_azimuth = views.is_direction[:, 0] & ~views.is_direction[:, 2]
        if k == 3 and is_azimuth.any():
            upright = np.einsum('hij,nj->hni', R, views.turns[:, :, 2])
            aside = np.cross(upright, m)
            P = np.where(is_azimuth[:, None, None], aside[..., :, None] * aside[..., None, :], P)
        P = P * (views.is_direction[:, 0] / sigma)[:, None, None]
        M[:, :, 1:, :k] = P
        y[:, :, 1:] = np.einsum('hnij,hnj->hni', P, b)
        A, right = M.reshape(h, -1, k + 1), y.reshape(h, -1)
        N = transpose(A) @ A
        # What views leave open is near the landmarks.
        N += (0.1 / size) ** 2 * np.eye(k + 1)
        solved = np.linalg.solve(N, np.einsum('hqi,hq->hi', A, right)[..., None])[..., 0]
        return solved[:, :k], solved[:, k] * size
