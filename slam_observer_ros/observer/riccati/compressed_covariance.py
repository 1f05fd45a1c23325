"""The joint covariance of large maps: a dense one of few landmarks, others follow when needed.

P is that of pose, calibration and the landmarks that are *active*: near, or seen of late. Motions
and observations change P alone, and what they yet have to do to all others is postponed
(:mod:`.postponed_correction`) until other landmarks become active: it is gathered in columns of P
that nothing else acts on. It is exact but for one thing:
what the noise of a motion does to the error ξ_i of a landmark out of view is judged by a reference
position, which is set again when the estimate is too far off (J. Guivant and E. Nebot,
*Optimization of the SLAM algorithm for real-time implementation*, 2001). As long as there are few
landmarks all are active. How the others follow: :mod:`.following_landmarks`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import symmetric, transpose
from slam_observer_ros.observer.arrays import FilterArrays
from slam_observer_ros.observer.chart import sheared
from slam_observer_ros.observer.joint_covariance import JointCovariance
from slam_observer_ros.observer.riccati.following_landmarks import FollowingLandmarks
from slam_observer_ros.observer.riccati.outside_landmarks import Change, OutsideLandmarks
from slam_observer_ros.observer.riccati.postponed_correction import PostponedCorrection
from slam_observer_ros.observer.symmetric_matrix import SymmetricMatrix

if TYPE_CHECKING:
    from typing_extensions import Self

CHECK_INTERVAL = 20
"""Observations in which each landmark is looked at once, whether it is near its reference."""


@dataclass(frozen=True, slots=True)
class BlockSize:
    """How many landmarks are active."""

    dense: int = 200  # as long as there are no more, all are
    most: int = 48  # then at most so many, or twice as many as are kept
    kept: int = 12  # when others become active, at least so many nearest to the robot are kept
    kept_per_seen: int = 3  # or so many times as many as are seen


class CompressedCovariance(JointCovariance):
    """P of pose, calibration and active landmarks, and what all others need to follow."""

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
        observer.postponed = self

    def copy(self, observer: FilterArrays) -> Self:
        """Return an independent copy, which shares what takes much memory until it changes."""
        other = super().copy(observer)
        other._observer, observer.postponed = observer, other
        other._following = self._following.copy(observer)
        return other

    @property
    def _postponed(self) -> PostponedCorrection:
        return self._following.postponed

    @property
    def _outside(self) -> OutsideLandmarks:
        return self._following.outside

    @property
    def references(self) -> FloatArray:
        """(n, 3) from where errors are judged: estimates of active landmarks, else y_i°."""
        points = self._observer.y_ref + self._observer.a
        for view in self._following.views(self._others):
            points[view.rows] = view.references
        return points

    # The step

    def update(self, HP: FloatArray, S: FloatArray, r: FloatArray) -> FloatArray:
        """Update P by what has been projected; return K r of pose, calibration, active ones."""
        Kr = super().update(HP, S, r)
        if len(r):
            self.follow(-Kr)
        return Kr

    def places(self, rows: IntArray) -> IntArray:
        """Return which of the landmarks in P these are (m,)."""
        places: IntArray = self._places[rows]
        return places

    def follow(self, x: FloatArray) -> None:
        """Let all others follow when the state is moved by exp(x), of which ``first`` count."""
        turn = self._axes.full_pose(x[: self._p])[:3]
        self._postponed.move(turn, x[self._entries])
        self._following.work()

    def note_motion(self) -> None:
        """Let the next observation look at some references, by which motions are judged."""
        self._has_moved = True

    def activate(self, rows: IntArray) -> None:
        """See to it that landmarks ``rows`` (m,), of an observation, are active."""
        missing = rows[self._places[rows] < 0]
        if len(missing) or len(self.active) > self._most:
            self._switch(self._chosen(rows))
        elif self._has_moved:  # once, however often an observation is looked at
            self._has_moved = False
            self._check_references()

    def _check_references(self) -> None:
        """Refer to present estimates if some of those that it is the turn of are far off."""
        self._checks += 1
        if not self._outside.unchanged:
            first = self._checks % CHECK_INTERVAL
            some = range(first, len(self._outside.panels), CHECK_INTERVAL)
            if not self._following.are_near(some):
                self._restart(self.active[:0])

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far the observer has yet to move landmarks (m, 3), metres."""
        # Not done here: those who look at the map must not change the bits of the estimate.
        shifts = np.zeros((len(self._places), 3))
        for view in self._following.views(rows[self._places[rows] < 0]):
            shifts[view.rows] = view.shifts
        chosen: FloatArray = shifts[rows]
        return chosen

    # Landmarks

    def add_seen(self, covariances: FloatArray, D: FloatArray | None = None) -> None:
        """Append landmarks (m,) seen for the first time, with covariances (m, 3, 3), R̂ D_i."""
        for start in range(0, len(covariances), self._size.most):
            if len(self.active) > self._most:
                self._switch(self._chosen(self.active[:0]))
            part = slice(start, start + self._size.most)
            super().add_seen(covariances[part], None if D is None else D[part])

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of C_i (ε, c̃) − ξ_i alone."""
        is_active = self._places[rows] >= 0
        if is_active.all():
            return super().output(C, rows)
        m, k, p, q = len(rows), self._axes.point, self._p, C.shape[2]
        with_pose, own = np.empty((m, p, k)), np.empty((m, k, k))
        with_pose[is_active], own[is_active] = super().output(C[is_active], rows[is_active])
        to_state, their_own = self._of_others(rows[~is_active], q)
        C = C[~is_active]
        PC = self.P[:q, :q] @ transpose(C) - transpose(to_state)
        with_pose[~is_active] = PC[:, :p]
        own[~is_active] = C @ PC - to_state @ transpose(C) + their_own
        return with_pose, own

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of all together, (p, m k) and (m k, m k)."""
        if (self._places[rows] >= 0).all():
            return super().outputs(C, rows)
        unique, at = np.unique(rows, return_inverse=True)
        return self.marginal(unique).outputs(C, at)

    def with_pose(self, rows: IntArray, points: FloatArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i, for estimates (m, 3)."""
        if (self._places[rows] >= 0).all():
            return super().with_pose(rows, points)
        return self.marginal(rows).with_pose(np.arange(len(rows)), points)

    def add_known(self, points: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks at ``points`` (m, 3) whose errors ã_i are independent of all else."""
        self._apply()
        m = len(points)
        slots = self._outside.add_independent(points, self._known_blocks(covariances))
        self._places = np.concatenate([self._places, np.full(m, -1)])
        self._following.set_slots(np.concatenate([self._following.slots, slots]), self._others)

    def add_known_turns(self, rows: IntArray, covariances: FloatArray) -> None:
        """Take over orientations (m,) whose errors (m, q, q) are independent of all else."""
        is_active = self._places[rows] >= 0
        super().add_known_turns(rows[is_active], covariances[is_active])
        if not is_active.all():
            self._apply()
            following = self._following
            slots = following.slots[rows[~is_active]]
            order, turns = np.argsort(slots), slice(self._axes.point, self._stride)
            following.outside.set_independent(slots[order], turns, covariances[~is_active][order])

    def own_turns(self, rows: IntArray) -> FloatArray:
        """Return the covariances (m, q, q) of each ω_i, rad²."""
        is_active, q = self._places[rows] >= 0, self.chart.turn
        covariances = np.empty((len(rows), q, q))
        covariances[is_active] = super().own_turns(rows[is_active])
        taken_back = self.P[self._entries, self._entries]
        covariances[~is_active] = self._following.own_turns(rows[~is_active], taken_back)
        return covariances

    def of_landmarks(
        self, rows: IntArray, points: FloatArray, tags: IntArray
    ) -> FloatArray | None:
        """Return the covariance (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,)."""
        every = np.union1d(rows, tags)
        at, of_tags = np.searchsorted(every, rows), np.searchsorted(every, tags)
        return self.marginal(every).of_landmarks(at, points, of_tags)

    def turned(self, rows: IntArray, B: FloatArray) -> FloatArray:
        """Return what orientations ``B`` (m, 3, 3) of tags are with all that is postponed."""
        every = np.tile(np.eye(3), (len(self._places), 1, 1))
        for view in self._following.views(np.unique(rows[self._places[rows] < 0])):
            every[view.rows] = view.turns
        turned: FloatArray = every[rows] @ B
        return turned

    def remove(self, rows: IntArray) -> None:
        """Delete the rows and columns of landmarks."""
        self._following.finish()
        places, slots = self._places[rows], self._following.slots[rows]
        columns = self.chart.of_landmarks(places[places >= 0])
        self.P = np.delete(np.delete(self.P, columns, axis=0), columns, axis=1)
        self._outside.remove(slots[slots >= 0])
        kept = np.ones(len(self._places), dtype=np.bool_)
        kept[rows] = False
        number = np.cumsum(kept) - 1
        self._set_active(number[self.active[kept[self.active]]], int(kept.sum()))
        self._following.set_slots(self._following.slots[kept], self._others)

    # All of it

    def dense(self) -> JointCovariance:
        """Return the same with all landmarks in P, which the observer has moved."""
        self._apply()
        joint = self.marginal(np.arange(len(self._places)))
        self.P, self._observer.postponed = joint.P, None
        joint._matrix = self._matrix
        return joint

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take ``covariance`` (p, p) for that of ε, independent of c̃ and of all ã_i."""
        self._apply()
        P = super().of_positions(points[self.active])
        P = P[np.ix_(self._x, self._x)]
        # Errors of all others are those of their positions now, too.
        p = self._p
        T = self._all_turning(points[self.active])
        for panel in self._outside.panels:
            X = panel.X.copy()
            X[:, self.chart.robot :] -= X[:, :p] @ T.T
            X[:, :p] = 0.0
            panel.X = X
        P[:p] = P[:, :p] = 0.0
        P[:p, :p] = covariance
        self._start(sheared(P, self.chart.robot, T))

    def marginal(self, rows: IntArray) -> JointCovariance:
        """Return the covariance of pose, calibration and different landmarks (m,) alone."""
        is_active = self._places[rows] >= 0
        others = np.flatnonzero(~is_active)
        others = others[np.argsort(self._following.slots[rows[others]])]
        local = np.append(
            np.arange(self.chart.robot), self.chart.of_landmarks(self._places[rows[is_active]])
        )
        following = self._following
        X, B, references = following.joined(rows[others], following.views(rows[others]))
        to_x = X @ self.P[self._entries]
        to_local, own = to_x[:, local], B + to_x[:, self._entries] @ X.T
        P = np.block([[self.P[np.ix_(local, local)], to_local.T], [to_local, own]])
        # From η to ξ, and in the order of the rows.
        P = sheared(P, len(local), self._all_turning(references))
        order = np.argsort(np.append(np.flatnonzero(is_active), others))
        joint = copy(self._form)
        columns = np.append(np.arange(self.chart.robot), joint.chart.of_landmarks(order))
        joint._matrix = SymmetricMatrix(P[np.ix_(columns, columns)])
        return joint

    # Which landmarks are active

    @property
    def _others(self) -> IntArray:
        return np.flatnonzero(self._places < 0)

    def _chosen(self, rows: IntArray) -> IntArray:
        """Return the landmarks to be active when ``rows`` (m,) are seen."""
        kept = max(self._size.kept, self._size.kept_per_seen * len(rows))
        # But landmarks that are just being added; a postponed shift makes no difference here.
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
        """Do what is postponed; refer to present estimates."""
        self._restart(self.active[:0])
        self._following.finish()

    def _restart(self, released: IntArray) -> None:
        """Let x start again, without landmarks (m,), and all else be changed little by little."""
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
        change = Change(
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
        self._start(P[np.ix_(self._x[kept], self._x[kept])])

    def _take_in(self, rows: IntArray) -> None:
        """Make landmarks (m,) active, too."""
        if not len(rows):
            return
        following, P, p, first = self._following, self.P, self._p, self.first
        rows = rows[np.argsort(following.slots[rows])]
        X, among, references = following.catch_up(rows)
        # ξ = η + T ε with x and with each other.
        T = self._all_turning(references)
        eta_to_x = X @ P[self._entries]
        to_x = eta_to_x + T @ P[:p]
        own = among + eta_to_x[:, self._entries] @ X.T + eta_to_x[:, :p] @ T.T + T @ to_x[:, :p].T
        # X gets columns, of η itself.
        m, size = len(own), len(P)
        old = np.append(np.arange(first), np.arange(first, size) + m)
        taken, new = first + np.arange(m), size + m + np.arange(m)
        M = np.zeros((size + 2 * m,) * 2)
        M[np.ix_(old, old)] = P
        M[np.ix_(new, old)], M[np.ix_(old, new)] = to_x, to_x.T
        M[np.ix_(new, new)] = symmetric(own)
        M[new, taken] = M[taken, new] = 1.0
        self._use(self.chart.with_postponed(first - self.chart.robot + m))
        self.P = M
        self._postponed.take(np.diagonal(among))
        self._set_active(np.append(self.active, rows), len(self._places))
        following.set_slots(following.slots, self._others)
        following.outside.take(following.slots[rows])

    @property
    def _x(self) -> IntArray:
        """Which entries of P are those of x."""
        return np.append(np.arange(self.chart.robot), np.arange(self.first, len(self.P)))

    @property
    def _entries(self) -> slice:
        """Those of what is postponed."""
        return slice(self.chart.robot, self.first)

    def _start(self, P: FloatArray) -> None:
        """Let x have the covariance P from now on, and postpone what it has to do to others."""
        size, count = len(P), self._outside.size
        self._use(self.chart.with_postponed(count))
        x = np.arange(size)
        x[self.chart.robot :] += count
        M = np.zeros((size + count,) * 2)
        M[np.ix_(x, x)] = P
        entries = self.chart.robot + np.arange(count)
        M[x[:count], entries] = M[entries, x[:count]] = 1.0
        self.P = M
        self._following.start(np.diagonal(P)[:count])

    def _set_active(self, rows: IntArray, n: int) -> None:
        self.active, self._places = rows, np.full(n, -1)
        self._places[rows] = np.arange(len(rows))

    def _of_others(self, rows: IntArray, q: int) -> tuple[FloatArray, FloatArray]:
        """Return covariances with q first entries of x (m, k, q), own (m, k, k) of ξ_i outside."""
        X, own, references = self._following.each(rows, self.P[self._entries, self._entries])
        T, p = self._turning(references), self._p
        to_state = X @ self.P[self._entries, :q]
        turned = T @ transpose(to_state[:, :, :p])
        own = own + turned + transpose(turned) + T @ self.pose @ transpose(T)
        return to_state + T @ self.P[:p, :q], own

    def _make_room(self, m: int) -> IntArray:
        """Append rows and columns for m landmarks; return which landmarks they are."""
        super()._make_room(m)
        new = len(self._places) + np.arange(m)
        self._set_active(np.append(self.active, new), len(self._places) + m)
        self._following.slots = np.append(self._following.slots, np.full(m, -1))
        return new

    def _known_blocks(self, covariances: FloatArray) -> FloatArray:
        """Return the covariances (m, …, …) of all that is estimated of known landmarks."""
        k, blocks = self._axes.point, np.zeros((len(covariances), self._stride, self._stride))
        blocks[:, :k, :k] = covariances[:, :k, :k]
        blocks[:, np.arange(k, self._stride), np.arange(k, self._stride)] = self._unknown
        return blocks

    def _columns(self, rows: IntArray) -> IntArray:
        return super()._columns(self._places[rows])

    def _turn_columns(self, rows: IntArray) -> IntArray:
        return super()._turn_columns(self._places[rows])
