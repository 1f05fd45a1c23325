"""Active landmarks of a large map, which are in P, and how others take their place.

Motions and observations change P alone. Their effect on all other landmarks is gathered in columns
of P that nothing else acts on, and comes later: see :mod:`.postponed`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import FilterArrays, SymmetricMatrix
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.riccati.following_landmarks import FollowingLandmarks
from slam_observer_ros.filter.riccati.outside_landmarks import OutsideLandmarks, PanelChange
from slam_observer_ros.filter.riccati.postponed import PostponedCorrection
from slam_observer_ros.lie.matrices import symmetric

if TYPE_CHECKING:
    from typing_extensions import Self

CHECK_INTERVAL = 20  # observations in which each landmark is compared with its reference once

SHRINK_INTERVAL = 50
"""Observations after which a flood of points is over, if none of them needed half as many."""


@dataclass(frozen=True, slots=True)
class BlockSize:
    """How many landmarks are active."""

    dense: int = 200  # as long as there are no more, all are
    most: int = 48  # then at most so many, or twice as many as are kept
    kept: int = 12  # when others become active, at least so many nearest to the robot are kept
    kept_per_seen: int = 3  # or so many times as many as are seen


class ActiveLandmarks(JointCovariance):
    """P of pose, calibration and active landmarks, which change as the robot moves on."""

    active: IntArray
    is_dense = False

    def __init__(self, dense: JointCovariance, observer: FilterArrays, size: BlockSize) -> None:
        vars(self).update(vars(dense))
        self._form, self._observer, self._size = copy(dense), observer, size
        self._form._matrix = SymmetricMatrix(self.of_robot)
        n = len(observer.y_ref)
        self._places: IntArray = np.empty(0, dtype=np.int64)  # (n,) place in P, −1 for outside
        self._set_active(np.arange(n), n)
        self._following = FollowingLandmarks(self.chart, observer)
        self._checks, self._has_moved, self._most = 0, False, size.most
        self._looks, self._needed = 0, size.most
        observer.postponed = self

    def copy(self, observer: FilterArrays) -> Self:
        """Return an independent copy; it shares large arrays until they change."""
        other = super().copy(observer)
        other._observer, observer.postponed = observer, other
        other._following, other._shifts = self._following.copy(observer), self._shifts.copy()
        return other

    @property
    def _postponed(self) -> PostponedCorrection:
        return self._following.postponed

    @property
    def _outside(self) -> OutsideLandmarks:
        return self._following.outside

    # The step

    def update(self, HP: FloatArray, S: FloatArray, r: FloatArray) -> FloatArray:
        """Update P by H P; return K r of pose, calibration and active landmarks."""
        Kr = super().update(HP, S, r)
        if len(r):
            self.follow(-Kr)
        return Kr

    def places(self, rows: IntArray) -> IntArray:
        """Return which of the landmarks in P these are (m,)."""
        places: IntArray = self._places[rows]
        return places

    def follow(self, x: FloatArray) -> None:
        """Let landmarks outside P follow a move of the state by exp(x).

        Only the entries of x before ``first`` count.
        """
        turn = self._axes.full_pose(x[: self._p])[:3]
        self._postponed.move(turn, x[self._entries])
        self._following.work()
        self._shifts.clear()

    def note_motion(self, duration_s: float) -> None:
        """Let the next observation look at some references, by which motions are judged."""
        self._has_moved = True

    def activate(self, rows: IntArray) -> None:
        """See to it that landmarks ``rows`` (m,), of an observation, are active."""
        self._shrink(len(rows))
        missing = rows[self._places[rows] < 0]
        if len(missing) or len(self.active) > self._most:
            self._switch(self._chosen(rows))
        elif self._has_moved:
            self._check_references()
        self._has_moved = False  # once is enough, however often an observation is looked at

    def _shrink(self, seen: int) -> None:
        """Let fewer be active once observations of so many points have not come for a while."""
        kept = max(self._size.kept, self._size.kept_per_seen * seen)
        self._looks, self._needed = self._looks + 1, max(self._needed, 2 * (seen + kept))
        if self._looks % SHRINK_INTERVAL == 0:
            if self._most > 2 * self._needed:
                self._most = self._needed
            self._needed = self._size.most

    def _check_references(self) -> None:
        """Let references be present estimates, if some of the next panels are far from theirs."""
        self._checks += 1
        if not self._outside.unchanged:
            first = self._checks % CHECK_INTERVAL
            some = range(first, len(self._outside.panels), CHECK_INTERVAL)
            if not self._following.are_near(some):
                self._restart(self.active[:0])

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far the observer has yet to move landmarks (m, 3), metres."""
        # Not done here: those who look at the map must not change the bits of the estimate.
        others = rows[self._places[rows] < 0]
        if not len(others):  # as nearly always
            return np.zeros((len(rows), 3))
        shifts, following = np.zeros((len(self._places), 3)), self._following
        if self._observer.have_moved:
            self._shifts.clear()
        for number, _ in self._outside.by_panel(following.slots[others]):
            if number not in self._shifts:
                (view,) = following.views(following.out_of_view(number))
                self._shifts[number] = view.rows, view.shifts
            shifts[self._shifts[number][0]] = self._shifts[number][1]
        chosen: FloatArray = shifts[rows]
        return chosen

    def add_seen(self, covariances: FloatArray, D: FloatArray | None = None) -> None:
        """Append landmarks (m,) seen for the first time, with covariances (m, 3, 3), R̂ D_i."""
        for start in range(0, len(covariances), self._size.most):
            if len(self.active) > self._most:
                self._switch(self._chosen(self.active[:0]))
            part = slice(start, start + self._size.most)
            super().add_seen(covariances[part], None if D is None else D[part])

    def add_turns(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take over orientations (m,) seen for the first time: ω_i = φ_i + noise (m, q, q)."""
        if (self._places[rows] < 0).any():  # more were added at once than are active
            self._switch(self._chosen(rows))
        super().add_turns(rows, covariances, D)

    def _make_room(self, m: int) -> IntArray:
        """Append rows and columns for m landmarks; return which landmarks they are."""
        super()._make_room(m)
        new = len(self._places) + np.arange(m)
        self._set_active(np.append(self.active, new), len(self._places) + m)
        self._following.slots = np.append(self._following.slots, np.full(m, -1))
        return new

    # Which landmarks are active

    @property
    def _others(self) -> IntArray:
        return np.flatnonzero(self._places < 0)

    def _chosen(self, rows: IntArray) -> IntArray:
        """Return which landmarks should be active when ``rows`` (m,) are seen."""
        kept = max(self._size.kept, self._size.kept_per_seen * len(rows))
        # Without landmarks that are just being added; a postponed shift makes no difference here.
        observer, n = self._observer, len(self._places)
        arms = observer.y_ref[:n] + observer.a[:n] - observer.A[:3, 3]
        distances = np.einsum('ij,ij->i', arms, arms)
        near = np.argpartition(distances, min(kept, len(arms)) - 1)[:kept]
        wanted = np.union1d(rows, near)
        self._most = max(self._size.most, 2 * len(wanted))
        with_active = np.union1d(wanted, self.active)
        return with_active if len(with_active) <= self._most else wanted

    def _switch(self, rows: IntArray) -> None:
        """Make landmarks active, and no others."""
        released = self.active[~np.isin(self.active, rows)]
        if len(released):
            self._restart(released)
        self._take_in(rows[self._places[rows] < 0])

    def _apply(self) -> None:
        """Do all postponed work; let references be present estimates."""
        self._restart(self.active[:0])
        self._following.finish()

    def _restart(self, released: IntArray) -> None:
        """Let x start again, without landmarks (m,); change all others little by little."""
        self._following.finish()
        outside, P, p, angles = self._outside, self.P, self._p, self._p - self._axes.point
        all_slots = self._following.slots.copy()
        new = released[all_slots[released] < 0]
        all_slots[new] = outside.new_slots(len(new))
        released = released[np.argsort(all_slots[released])]
        columns = self.chart.of_landmarks(self._places[released])
        points = self._observer.y_ref[released] + self._observer.a[released]
        # η = ξ − T ε with x and with each other.
        T = self._all_turning(points)
        to_x = P[columns] - T @ P[:p]
        own = symmetric(to_x[:, columns] - to_x[:, :p] @ T.T)
        is_kept = np.ones(len(P), dtype=np.bool_)
        is_kept[columns] = False
        kept = np.flatnonzero(is_kept[self._x])
        slots = all_slots[released]
        change = PanelChange(
            self._postponed,
            P[self._x, self._entries],
            self._postponed.root(-P[self._entries, self._entries]),
            outside.taken,
            P[: angles if self._postponed.has_moved else 0, self._x],
            kept,
            slots,
            points,
            outside.rows(slots),
            columns - outside.width,
            T,
            own,
            to_x[:, self._x[kept]],
        )
        outside.begin(change)
        self._set_active(self.active[~np.isin(self.active, released)], len(self._places))
        self._following.set_slots(all_slots, self._others)
        self._start(self._matrix.among(self._x[kept]))

    def _take_in(self, rows: IntArray) -> None:
        """Make landmarks (m,) active, too."""
        if not len(rows):
            return
        following, p, first = self._following, self._p, self.first
        rows = rows[np.argsort(following.slots[rows])]
        X, among, references = following.catch_up(rows)
        # X gets columns, of η itself, and x entries.
        m = len(among)
        self._matrix.insert_zeros(first, m)
        self._matrix.append_zeros(m)
        P = self.P
        taken, new = first + np.arange(m), len(P) - m + np.arange(m)
        # ξ = η + T ε with x and with each other.
        T = self._all_turning(references)
        eta_to_x = X @ P[self._entries]
        to_x = eta_to_x + T @ P[:p]
        own = among + eta_to_x[:, self._entries] @ X.T + eta_to_x[:, :p] @ T.T + T @ to_x[:, :p].T
        P[-m:], P[:, -m:] = to_x, to_x.T
        P[-m:, -m:] = symmetric(own)
        P[new, taken] = P[taken, new] = 1.0
        self._use(self.chart.with_postponed(first - self.chart.robot + m))
        self._postponed.take(np.diagonal(among))
        self._set_active(np.append(self.active, rows), len(self._places))
        following.set_slots(following.slots, self._others)
        following.outside.take(following.slots[rows])

    @property
    def _x(self) -> IntArray:
        """Columns of x in P."""
        return np.append(np.arange(self.chart.robot), np.arange(self.first, len(self.P)))

    @property
    def _entries(self) -> slice:
        """Columns of the postponed corrections in P."""
        return slice(self.chart.robot, self.first)

    def _start(self, P: FloatArray) -> None:
        """Let x have the covariance P from now on; postpone its effect on other landmarks."""
        count, robot = self._outside.size, self.chart.robot
        self._following.start(np.diagonal(P)[:count])
        self.P = P
        self._matrix.insert_zeros(robot, count)
        self._use(self.chart.with_postponed(count))
        x, entries = self._x[:count], robot + np.arange(count)
        self.P[x, entries] = self.P[entries, x] = 1.0

    def _set_active(self, rows: IntArray, n: int) -> None:
        # Postponed shifts (…, 3) of landmarks (…,) by panel, where somebody looked since a move
        self._shifts: dict[int, tuple[IntArray, FloatArray]] = {}
        self.active, self._places = rows, np.full(n, -1)
        self._places[rows] = np.arange(len(rows))

    def _columns(self, rows: IntArray) -> IntArray:
        return super()._columns(self._places[rows])

    def _turn_columns(self, rows: IntArray) -> IntArray:
        return super()._turn_columns(self._places[rows])
