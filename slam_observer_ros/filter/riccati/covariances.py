"""The joint covariance of large maps, and that in a map that is taken to be exact.

The second has pose and calibration alone. The first is a dense one of few landmarks; others
follow when needed: P has pose, calibration and the landmarks that are *active*: near, or
seen of late (:mod:`.active_landmarks`). What motions and observations do to it comes to all others
when these become active. It is exact but for one thing: what the noise of a motion does to the
error ξ_i of a landmark out of view is judged by a reference position, which is set again when the
estimate is too far off (J. Guivant and E. Nebot, *Optimization of the SLAM algorithm for real-time
implementation*, 2001). As long as there are few landmarks all are active. How the others follow:
:mod:`.following_landmarks`.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import SymmetricMatrix
from slam_observer_ros.filter.chart import sheared
from slam_observer_ros.filter.joint_covariance import JointCovariance
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.filter.riccati.active_landmarks import ActiveLandmarks
from slam_observer_ros.lie.matrices import transpose


class ExactMapCovariance(JointCovariance):
    """P of (ε, c̃) alone, in a map that is taken to be exact: ã_i = 0, and ξ_i = [ŷ_i]× ε_Ω."""

    active = slice(0)
    is_dense = False

    def __init__(self, joint: JointCovariance, covariances: FloatArray) -> None:
        chart = joint.chart.with_postponed(0)
        super().__init__(chart, joint._matrix, joint.of_robot, joint._unknown)
        self._covariances = covariances  # (n, 3, 3) of the map, which are only passed on

    def landmarks(self, points: FloatArray, ahead_s: float = 0.0) -> FloatArray:
        """Return the covariances (n, 3, 3) of the landmarks, as the map has them."""
        return self._covariances

    def with_pose(self, rows: IntArray, points: FloatArray) -> FloatArray | None:
        """Return None: how far the map is off, nobody knows."""
        return None

    def output_matrix(self, residuals: Residuals, chord: float = 0.0) -> FloatArray:
        """Return C_i of r_i = C_i (ε, c̃): [−[ŷ_i]×, I] of ε."""
        return self.chart.output(residuals.landmarks + chord * residuals.r, residuals.D)

    def _project(self, C: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        HP = C @ self.P[: C.shape[1]]
        return HP, HP[:, : C.shape[1]] @ C.T

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of each C_i (ε, c̃) alone."""
        q = C.shape[-1]
        PC = self.P[:q, :q] @ transpose(C)
        return PC[..., : self._p, :], C @ PC

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return :meth:`output` of all together, (p, m k) and (m k, m k)."""
        return self.output(C.reshape(-1, C.shape[2]), rows)

    def remove(self, rows: IntArray) -> None:
        """Forget landmarks."""
        self._covariances = np.delete(self._covariances, rows, axis=0)

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Let ε have the ``covariance`` (p, p), and be independent of c̃."""
        super().set_pose(covariance, np.empty((0, 3)))


class CompressedCovariance(ActiveLandmarks):
    """The covariance of all landmarks, active or not."""

    @property
    def references(self) -> FloatArray:
        """(n, 3) positions that errors are judged by: estimates of active landmarks, else y_i°."""
        points = self._observer.y_ref + self._observer.a
        for view in self._following.views(self._others):
            points[view.rows] = view.references
        return points

    # Landmarks

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of C_i (ε, c̃) − ξ_i alone."""
        is_active = self._places[rows] >= 0
        if is_active.all():
            return super().output(C, rows)
        m, k, p, q = len(rows), self._axes.point, self._p, C.shape[2]
        with_pose, own = np.empty((m, p, k)), np.empty((m, k, k))
        with_pose[is_active], own[is_active] = super().output(C[is_active], rows[is_active])
        # Without ids one landmark may be paired with many points.
        unique, at = np.unique(rows[~is_active], return_inverse=True)
        to_state, their_own = self._of_others(unique, q)
        C, to_state = C[~is_active], to_state[at]
        PC = self.P[:q, :q] @ transpose(C) - transpose(to_state)
        with_pose[~is_active] = PC[:, :p]
        own[~is_active] = C @ PC - to_state @ transpose(C) + their_own[at]
        return with_pose, own

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return :meth:`output` of all together, (p, m k) and (m k, m k)."""
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
        """Return orientations ``B`` (m, 3, 3) of tags after all that is postponed."""
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
        """Return the covariance with all landmarks in P, after the observer has moved them."""
        self._apply()
        joint = self.marginal(np.arange(len(self._places)))
        self.P, self._observer.postponed = joint.P, None
        joint._matrix = self._matrix
        return joint

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Let ε have the ``covariance`` (p, p), and be independent of c̃ and of all ã_i."""
        self._apply()
        P = super().of_positions(points[self.active])
        P = P[np.ix_(self._x, self._x)]
        # All other landmarks have the errors ã_i of their positions now, too.
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

    def _of_others(self, rows: IntArray, q: int) -> tuple[FloatArray, FloatArray]:
        """Return covariances of ξ_i outside P: with the first q entries of x, own (m, k, k)."""
        X, own, references = self._following.each(rows, self.P[self._entries, self._entries])
        T, p = self._turning(references), self._p
        to_state = X @ self.P[self._entries, :q]
        turned = T @ transpose(to_state[:, :, :p])
        own = own + turned + transpose(turned) + T @ self.pose @ transpose(T)
        return to_state + T @ self.P[:p, :q], own

    def _known_blocks(self, covariances: FloatArray) -> FloatArray:
        """Return the covariances (m, …, …) of known landmarks, with all their columns."""
        k, blocks = self._axes.point, np.zeros((len(covariances), self._stride, self._stride))
        blocks[:, :k, :k] = covariances[:, :k, :k]
        blocks[:, np.arange(k, self._stride), np.arange(k, self._stride)] = self._unknown
        return blocks
