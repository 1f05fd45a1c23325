"""The joint covariance of large maps: a dense one of few landmarks, others follow when needed.

P is that of pose, calibration and the landmarks that are *active*: near, or seen of late. Motions
and observations change P alone, and what they yet have to do to all others is postponed
(:mod:`.postponed_correction`) until other landmarks become active. It is exact but for one thing:
what the noise of a motion does to the error ξ_i of a landmark out of view is judged by a reference
position, which is set again when the estimate is ``REFERENCE_SHIFT_M`` off (J. Guivant and
E. Nebot, *Optimization of the SLAM algorithm for real-time implementation*, 2001). As long as
there are few landmarks all are active.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.geometry.matrices import symmetric, transpose
from slam_observer_ros.observer.chart import sheared
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.observer.riccati.joint_covariance import JointCovariance
from slam_observer_ros.observer.riccati.outside_landmarks import (
    Change,
    Moved,
    OutsideLandmarks,
    View,
)
from slam_observer_ros.observer.riccati.postponed_correction import PostponedCorrection
from slam_observer_ros.observer.riccati.symmetric_matrix import SymmetricMatrix
from slam_observer_ros.sensor_models.motion import Motion

if TYPE_CHECKING:
    from typing_extensions import Self

REFERENCE_SHIFT_M = 0.1
"""How far estimates of landmarks out of view may be from their references."""

CHECK_INTERVAL = 20
"""Corrections in which that is looked at, of each landmark once."""

CHANGE_INTERVAL = 64
"""Corrections in which a change comes to all landmarks, if no other one has to begin before."""

FOLDING = 3e7
"""Multiplications by which postponed corrections are worked off at each correction, at least."""


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

    def __init__(self, dense: JointCovariance, observer: Observer, size: BlockSize) -> None:
        vars(self).update(vars(dense))
        self._form, self._observer, self._size = copy(dense), observer, size
        self._form._matrix = SymmetricMatrix(self.P[: self.first, : self.first])
        n = len(observer.y_ref)
        self._places: IntArray = np.empty(0, dtype=np.int64)  # (n,) place in P, −1 for outside
        self._set_active(np.arange(n), n)
        self._outside = OutsideLandmarks(self.chart, len(self.P))
        # (n,) where each landmark is outside, −1 for nowhere; and (slots,) which ones are there
        self._slots = np.full(n, -1)
        self._in_slots: IntArray = np.empty(0, dtype=np.int64)
        self._postponed = self._nothing_postponed()
        self._corrections, self._most = 0, size.most
        self._changed = 0  # panels, since the last correction

    def copy(self, observer: Observer) -> Self:
        """Return an independent copy, which shares what takes much memory until it changes."""
        other = super().copy(observer)
        other._observer = observer
        other._outside, other._postponed = self._outside.copy(), self._postponed.copy()
        return other

    @property
    def references(self) -> FloatArray:
        """(n, 3) from where errors are judged: estimates of active landmarks, else y_i°."""
        points = self._observer.points
        for view in self._views(self._others):
            points[view.rows] = view.references
        return points

    # The step

    def _project(self, C: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return H P beside H Φ (r, …) and H P Hᵀ (r, r)."""
        HP, HPH = super()._project(C, columns)
        Phi = self._postponed.Phi
        return np.hstack([HP, C @ Phi[: C.shape[1]] - Phi[columns]]), HPH

    def project_own_turns(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of ω_i."""
        HP, HPH = super().project_own_turns(rows)
        return np.hstack([HP, self._postponed.Phi[self._turn_columns(rows)]]), HPH

    def update(self, HP: FloatArray, S: FloatArray, r: FloatArray) -> FloatArray:
        """Update P by what has been projected; return K r of pose, calibration, active ones."""
        if not len(r):
            return np.zeros(len(self.P))
        # L⁻¹ of all that is multiplied by S⁻¹ = L⁻ᵀ L⁻¹.
        whitened = _whitened(S, np.column_stack([HP, r]))
        W, W_Phi, z = np.split(whitened, [len(self.P), whitened.shape[1] - 1], axis=1)
        self._matrix.subtract_square(W)
        Kr: FloatArray = W.T @ z[:, 0]
        turn = self._axes.full_pose(-Kr[: self._p])[:3]
        self._postponed.correct(W, W_Phi, z[:, 0], turn)
        self._work()
        return Kr

    def activate(self, rows: IntArray) -> None:
        """See to it that landmarks ``rows`` (m,), of an observation, are active."""
        missing = rows[self._places[rows] < 0]
        if len(missing) or len(self.active) > self._most:
            self._switch(self._chosen(rows))
            return
        self._corrections += 1
        if not self._outside.unchanged:
            first = self._corrections % CHECK_INTERVAL
            self._check(range(first, len(self._outside.panels), CHECK_INTERVAL))

    def _check(self, numbers: range) -> None:
        """Set all references again if one in these panels is too far off."""
        for number in numbers:
            rows, are_out = self._in_panel(number)
            X = self._outside.complete(number, are_out)
            off = self._points(rows) - self._outside.panels[number].references
            off += self._shifts(off, X)
            if np.linalg.norm(off[are_out], axis=1).max(initial=0.0) > REFERENCE_SHIFT_M:
                self._restart(self.active[:0])
                return
            self._turn(number, X)
        if self.chart.turn:
            self._forget_gains()

    def followed(self, rows: IntArray, a: FloatArray) -> FloatArray:
        """Return what â_i (m, 3) of landmarks are with all that is postponed."""
        return a + self.postponed_shifts(rows)

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far the observer has yet to move landmarks (m, 3), metres."""
        # Not done here: those who look at the map must not change the bits of the estimate.
        shifts = np.zeros((len(self._places), 3))
        for view in self._views(rows[self._places[rows] < 0]):
            shifts[view.rows] = view.shifts
        chosen: FloatArray = shifts[rows]
        return chosen

    def _propagate(self, motion: Motion, J_landmarks: FloatArray) -> None:
        super()._propagate(motion, J_landmarks)
        if self._p < self.first:
            Phi = self._postponed.Phi
            growth = motion.sensitivity @ Phi[self._p : self.first]
            Phi[: self._p] += growth
            Phi[self.first :] += J_landmarks @ growth

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
        self._set_slots(np.concatenate([self._slots, slots]))

    def add_known_turns(self, rows: IntArray, covariances: FloatArray) -> None:
        """Take over orientations (m,) whose errors (m, q, q) are independent of all else."""
        is_active = self._places[rows] >= 0
        super().add_known_turns(rows[is_active], covariances[is_active])
        if not is_active.all():
            self._apply()
            slots = self._slots[rows[~is_active]]
            order, turns = np.argsort(slots), slice(self._axes.point, self._stride)
            self._outside.set_independent(slots[order], turns, covariances[~is_active][order])

    def own_turns(self, rows: IntArray) -> FloatArray:
        """Return the covariances (m, q, q) of each ω_i, rad²."""
        is_active, q = self._places[rows] >= 0, self.chart.turn
        covariances, at = np.empty((len(rows), q, q)), np.flatnonzero(~is_active)
        covariances[is_active] = super().own_turns(rows[is_active])
        at, k, begin = at[np.argsort(self._slots[rows[at]])], self._axes.point, 0
        for view in self._views(rows[at]):
            X, mine = view.X[:, k:], at[begin : begin + len(view.rows)]
            own = view.own[:, k:, k:] - (X @ self._postponed.Psi) @ transpose(X)
            covariances[mine], begin = own, begin + len(view.rows)
        return covariances

    def of_landmarks(
        self, rows: IntArray, points: FloatArray, tags: IntArray
    ) -> FloatArray | None:
        """Return the covariance (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,)."""
        every = np.union1d(rows, tags)
        at, of_tags = np.searchsorted(every, rows), np.searchsorted(every, tags)
        return self.marginal(every).of_landmarks(at, points, of_tags)

    def turned(self, rows: IntArray, B: FloatArray) -> FloatArray:
        """Return what orientations ``B`` (m, 3, 3) of tags are likewise."""
        every = np.tile(np.eye(3), (len(self._places), 1, 1))
        for view in self._views(np.unique(rows[self._places[rows] < 0])):
            every[view.rows] = view.turns
        turned: FloatArray = every[rows] @ B
        return turned

    def remove(self, rows: IntArray) -> None:
        """Delete the rows and columns of landmarks."""
        self._finish()
        places, slots = self._places[rows], self._slots[rows]
        columns = self.chart.of_landmarks(places[places >= 0])
        self.P = np.delete(np.delete(self.P, columns, axis=0), columns, axis=1)
        self._postponed.remove(columns)
        self._outside.remove(slots[slots >= 0])
        kept = np.ones(len(self._places), dtype=np.bool_)
        kept[rows] = False
        number = np.cumsum(kept) - 1
        self._set_active(number[self.active[kept[self.active]]], int(kept.sum()))
        self._set_slots(self._slots[kept])

    # All of it

    def dense(self) -> JointCovariance:
        """Return the same with all landmarks in P, which the observer has moved."""
        self._apply()
        joint = self.marginal(np.arange(len(self._places)))
        self.P = joint.P
        joint._matrix = self._matrix
        return joint

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take ``covariance`` (p, p) for that of ε, independent of c̃ and of all ã_i."""
        self._apply()
        P = super().of_positions(points[self.active])
        # Errors of all others are those of their positions now, too.
        p = self._p
        T = self._all_turning(points[self.active])
        for panel in self._outside.panels:
            X = panel.X.copy()
            X[:, self.first :] -= X[:, :p] @ T.T
            X[:, :p] = 0.0
            panel.X = X
        P[:p] = P[:, :p] = 0.0
        P[:p, :p] = covariance
        self.P = sheared(P, self.first, T)
        self._postponed = self._nothing_postponed()

    def marginal(self, rows: IntArray) -> JointCovariance:
        """Return the covariance of pose, calibration and different landmarks (m,) alone."""
        is_active = self._places[rows] >= 0
        others = np.flatnonzero(~is_active)
        others = others[np.argsort(self._slots[rows[others]])]
        local = np.append(
            np.arange(self.first), self.chart.of_landmarks(self._places[rows[is_active]])
        )
        postponed, outside, views = self._postponed, self._outside, self._views(rows[others])
        Phi, b = postponed.Phi[local], postponed.Phi.shape[1]
        X = np.concatenate([np.empty((0, b)), *(view.X.reshape(-1, b) for view in views)])
        own = outside.among(self._slots[rows[others]], views) - X @ postponed.Psi @ X.T
        to_local = X @ Phi.T
        P = np.block([[self.P[np.ix_(local, local)], to_local.T], [to_local, own]])
        references = np.concatenate([np.empty((0, 3)), *(view.references for view in views)])
        # From η to ξ, and in the order of the rows.
        P = sheared(P, len(local), self._all_turning(references))
        order = np.argsort(np.append(np.flatnonzero(is_active), others))
        joint = copy(self._form)
        columns = np.append(np.arange(self.first), self.chart.of_landmarks(order))
        joint._matrix = SymmetricMatrix(P[np.ix_(columns, columns)])
        return joint

    # Which landmarks are active

    @property
    def _others(self) -> IntArray:
        return np.flatnonzero(self._places < 0)

    def _chosen(self, rows: IntArray) -> IntArray:
        """Return the landmarks to be active when ``rows`` (m,) are seen."""
        kept = max(self._size.kept, self._size.kept_per_seen * len(rows))
        # But those that are just being added; a postponed shift makes no difference here.
        arms = self._observer.points[: len(self._places)] - self._observer.A[:3, 3]
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
        self._finish()

    def _work(self) -> None:
        """Do some of what is left to be done to landmarks outside."""
        outside = self._outside
        share = -(-len(outside.panels) // CHANGE_INTERVAL)
        for number in list(outside.unchanged)[: max(share - self._changed, 0)]:
            self._change(number)
        self._changed = 0
        outside.matrix.fold(FOLDING)

    def _finish(self) -> None:
        """Do all of it that is not only folding."""
        for number in list(self._outside.unchanged):
            self._change(number)

    def _change(self, number: int) -> None:
        """Do what is left to be done to the landmarks of a panel."""
        rows, are_out = self._in_panel(number)
        moved = self._moved(number, rows, are_out)
        self._observer.a[rows[are_out]] += moved.shifts[are_out]
        if self.chart.turn:
            self._observer.orientations.turn(rows[are_out], moved.turns[are_out])
        self._outside.make(number, moved)
        self._changed += 1

    def _moved(self, number: int, rows: IntArray, are_out: BoolArray) -> Moved:
        return self._outside.moved(number, self._points(rows), are_out)

    def _points(self, rows: IntArray) -> FloatArray:
        """Return where the observer has landmarks (m, 3) for now, metres."""
        points: FloatArray = self._observer.y_ref[rows] + self._observer.a[rows]
        return points

    def _in_panel(self, number: int) -> tuple[IntArray, BoolArray]:
        """Return landmarks (slots,) of a panel, and which of them are there; others are any."""
        each = self._outside.slots_each
        rows = self._in_slots[each * number : each * (number + 1)]
        return rows, rows >= 0

    def _views(self, rows: IntArray) -> list[View]:
        """Return what landmarks (m,) out of view are now, panel by panel in ascending order."""
        views, outside, k = [], self._outside, self._axes.point
        for number, local in outside.by_panel(self._slots[rows]):
            in_panel, are_out = self._in_panel(number)
            moved = None
            panel, shifts = outside.panels[number], np.zeros((len(in_panel), 3))
            if number in outside.unchanged:
                moved = self._moved(number, in_panel, are_out)
                panel, shifts = moved.panel, moved.shifts
            X = outside.completed(number, are_out, moved)
            shifts = shifts + self._shifts(self._points(in_panel) + shifts - panel.references, X)
            at, blocks = np.sort(local), X.reshape(len(in_panel), self._stride, -1)
            turns = self._postponed.turns(blocks[at, k:], panel.turned, self._axes)
            turns = turns if moved is None else turns @ moved.turns[at]
            views.append(
                View(
                    in_panel[at],
                    blocks[at],
                    panel.own[at],
                    panel.references[at],
                    shifts[at],
                    turns,
                    moved,
                )
            )
        return views

    def _turn(self, number: int, X: FloatArray) -> None:
        """Turn the tags of a panel."""
        if not self.chart.turn:
            return
        rows, are_out = self._in_panel(number)
        panel, each = self._outside.panels[number], X.reshape(len(rows), self._stride, -1)
        turns = self._postponed.turns(each[:, self._axes.point :], panel.turned, self._axes)
        self._observer.orientations.turn(rows[are_out], turns[are_out])
        panel.turned = len(self._postponed.gains or [])

    def _forget_gains(self) -> None:
        """Forget those by which all tags have been turned."""
        panels, gains = self._outside.panels, self._postponed.gains
        done = min((panel.turned for panel in panels), default=0)
        if gains is not None and done:
            del gains[:done]
            for panel in panels:
                panel.turned -= done

    def _shifts(self, off: FloatArray, X: FloatArray) -> FloatArray:
        """Return how far landmarks of a panel, ``off`` (slots, 3) their references, move."""
        shifts = np.zeros_like(off)
        if self._postponed.has_moved:
            k, X = self._axes.point, X.reshape(len(off), self._stride, -1)
            shifts[:, :k] = self._postponed.shifted(off[:, :k], X[:, :k]) - off[:, :k]
        return shifts

    def _restart(self, released: IntArray) -> None:
        """Let x start again, without landmarks (m,), and all else be changed little by little."""
        self._finish()
        outside, P, p, angles = self._outside, self.P, self._p, self._p - self._axes.point
        all_slots = self._slots.copy()
        new = released[all_slots[released] < 0]
        all_slots[new] = outside.new_slots(len(new))
        released = released[np.argsort(all_slots[released])]
        columns = self.chart.of_landmarks(self._places[released])
        points = self._observer.points[released]
        # η = ξ − T ε with x and with each other.
        T = self._all_turning(points)
        to_x = P[columns] - T @ P[:p]
        own = symmetric(to_x[:, columns] - to_x[:, :p] @ T.T)
        kept = np.delete(np.arange(len(P)), columns)
        slots = all_slots[released]
        change = Change(
            self._postponed,
            self._postponed.root(),
            outside.taken,
            P[: angles if self._postponed.has_moved else 0].copy(),
            kept,
            slots,
            points,
            outside.rows(slots),
            columns,
            T,
            own,
            to_x[:, kept],
        )
        outside.begin(change)
        self.P = P[np.ix_(kept, kept)]
        self._set_active(self.active[~np.isin(self.active, released)], len(self._places))
        self._set_slots(all_slots)
        self._postponed = self._nothing_postponed()

    def _take_in(self, rows: IntArray) -> None:
        """Make landmarks (m,) active, too."""
        if not len(rows):
            return
        outside, P, p, postponed = self._outside, self.P, self._p, self._postponed
        for number, _ in outside.by_panel(self._slots[rows]):
            if number in outside.unchanged:
                self._change(number)
            outside.complete(number, self._in_panel(number)[1])
        rows = rows[np.argsort(self._slots[rows])]
        slots, views = self._slots[rows], self._views(rows)
        X = np.concatenate([view.X for view in views]).reshape(len(rows) * self._stride, -1)
        self._observer.a[rows] += np.concatenate([view.shifts for view in views])
        if self.chart.turn:
            self._observer.orientations.turn(rows, np.concatenate([view.turns for view in views]))
        among, XPsi = outside.among(slots, views), X @ postponed.Psi
        # ξ = η + T ε with x and with each other.
        T = self._all_turning(np.concatenate([view.references for view in views]))
        eta_to_x = X @ postponed.Phi.T
        to_x = eta_to_x + T @ P[:p]
        own = among - XPsi @ X.T + eta_to_x[:, :p] @ T.T + T @ to_x[:, :p].T
        postponed.take(T @ postponed.Phi[:p] - XPsi, np.diagonal(among))
        self.P = np.block([[P, to_x.T], [to_x, symmetric(own)]])
        self._set_active(np.append(self.active, rows), len(self._places))
        self._set_slots(self._slots)
        outside.clear(slots)
        outside.taken = np.append(outside.taken, slots)

    def _set_active(self, rows: IntArray, n: int) -> None:
        self.active, self._places = rows, np.full(n, -1)
        self._places[rows] = np.arange(len(rows))

    def _set_slots(self, slots: IntArray) -> None:
        self._slots, outside = slots, self._others
        self._in_slots = np.full(self._outside.slots_each * len(self._outside.panels), -1)
        self._in_slots[slots[outside]] = outside

    def _of_others(self, rows: IntArray, q: int) -> tuple[FloatArray, FloatArray]:
        """Return covariances with q first entries of x (m, k, q), own (m, k, k) of ξ_i outside."""
        order = np.argsort(np.argsort(self._slots[rows]))
        k, p, postponed, views = self._axes.point, self._p, self._postponed, self._views(rows)
        X = np.concatenate([view.X for view in views])[order, :k]
        T = self._turning(np.concatenate([view.references for view in views])[order])
        own = np.concatenate([view.own for view in views])[order, :k, :k]
        to_state = X @ postponed.Phi[:q].T
        turned = T @ transpose(to_state[:, :, :p])
        own = own - (X @ postponed.Psi) @ transpose(X)
        own = own + turned + transpose(turned) + T @ self.pose @ transpose(T)
        return to_state + T @ self.P[:p, :q], own

    def _set(self, columns: IntArray, C: FloatArray, noise: FloatArray) -> None:
        super()._set(columns, C, noise)
        self._postponed.Phi[columns] = C @ self._postponed.Phi[: C.shape[1]]

    def _make_room(self, m: int) -> IntArray:
        """Append rows and columns for m landmarks; return which landmarks they are."""
        super()._make_room(m)
        new = len(self._places) + np.arange(m)
        self._set_active(np.append(self.active, new), len(self._places) + m)
        self._slots = np.append(self._slots, np.full(m, -1))
        self._postponed.extend(self._stride * m)
        return new

    def _known_blocks(self, covariances: FloatArray) -> FloatArray:
        """Return the covariances (m, …, …) of all that is estimated of known landmarks."""
        k, blocks = self._axes.point, np.zeros((len(covariances), self._stride, self._stride))
        blocks[:, :k, :k] = covariances[:, :k, :k]
        blocks[:, np.arange(k, self._stride), np.arange(k, self._stride)] = self._unknown
        return blocks

    def _nothing_postponed(self) -> PostponedCorrection:
        return PostponedCorrection(self.P, self._axes.point, self.chart.turn > 0)

    def _columns(self, rows: IntArray) -> IntArray:
        return super()._columns(self._places[rows])

    def _turn_columns(self, rows: IntArray) -> IntArray:
        return super()._turn_columns(self._places[rows])


def _whitened(S: FloatArray, right: FloatArray) -> FloatArray:
    """Return L⁻¹ b for b (m, …) and S = L Lᵀ (m, m); without the null space of a singular S."""
    L, is_indefinite = dpotrf(S, lower=1)
    if is_indefinite:  # by rounding, where all but nothing was known
        variances, V = np.linalg.eigh(S)
        known = variances > np.finfo(np.float64).eps * variances[-1]
        whitened: FloatArray = (V[:, known] / np.sqrt(variances[known])).T @ right
        return whitened
    return np.asarray(dtrsm(1.0, L, right, lower=1))
