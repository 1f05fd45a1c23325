"""The joint covariance of large maps whose landmarks may have orientations, as tags do.

An orientation's error ω_i moves with nothing, so out of view it is η_i itself
(:mod:`.outside_landmarks`).
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.matrices import transpose
from slam_observer_ros.observer.orientations import UNKNOWN_RAD
from slam_observer_ros.observer.riccati.compressed_covariance import CompressedCovariance
from slam_observer_ros.observer.riccati.tag_covariance import TagCovariance


class CompressedTagCovariance(CompressedCovariance, TagCovariance):
    """P of pose, calibration and active tags, and what all others need to follow."""

    def add_turns(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take over orientations (m,) seen for the first time: ω_i = φ_i + noise (m, q, q)."""
        super().add_turns(rows, covariances, D)
        Phi, C = self._postponed.Phi, self._turn_output(D)
        Phi[self._turn_columns(rows)] = np.tile(C @ Phi[: C.shape[1]], (len(rows), 1))

    def add_known_turns(self, rows: IntArray, covariances: FloatArray) -> None:
        """Take over orientations (m,) whose errors (m, q, q) are independent of all else."""
        is_active = self._places[rows] >= 0
        super().add_known_turns(rows[is_active], covariances[is_active])
        self._postponed.Phi[self._turn_columns(rows[is_active])] = 0.0
        if not is_active.all():
            self._apply()
            slots, entries = self._slots[rows[~is_active]], slice(self._axes.point, self._stride)
            order = np.argsort(slots)
            self._outside.set_independent(slots[order], entries, covariances[~is_active][order])

    def project_turns(
        self, rows: IntArray, D: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P beside H Φ (m q, …) and H P Hᵀ (m q, m q) of φ_i = ε_Ω − ω_i + D c̃."""
        (HP, HPH), C, Phi = (
            super().project_turns(rows, D),
            self._turn_output(D),
            self._postponed.Phi,
        )
        H_Phi = np.tile(C @ Phi[: C.shape[1]], (len(rows), 1)) - Phi[self._turn_columns(rows)]
        return np.hstack([HP, H_Phi]), HPH

    def project_own_turns(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of ω_i alone."""
        HP, HPH = super().project_own_turns(rows)
        return np.hstack([HP, self._postponed.Phi[self._turn_columns(rows)]]), HPH

    def own_turns(self, rows: IntArray) -> FloatArray:
        """Return the covariances (m, q, q) of each ω_i, rad²."""
        is_active, q = self._places[rows] >= 0, self._axes.turn
        covariances, at = np.empty((len(rows), q, q)), np.flatnonzero(~is_active)
        covariances[is_active] = super().own_turns(rows[is_active])
        at = at[np.argsort(self._slots[rows[at]])]
        k, begin = self._axes.point, 0
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
        """Return what orientations ``B`` (m, 3, 3) of tags will be once all is done."""
        every = np.tile(np.eye(3), (len(self._places), 1, 1))
        for view in self._views(np.unique(rows[self._places[rows] < 0])):
            every[view.rows] = view.turns
        turned: FloatArray = every[rows] @ B
        return turned

    def _known_blocks(self, covariances: FloatArray) -> FloatArray:
        k, blocks = self._axes.point, np.zeros((len(covariances), self._stride, self._stride))
        blocks[:, :k, :k] = covariances[:, :k, :k]
        turns = np.arange(k, self._stride)
        blocks[:, turns, turns] = UNKNOWN_RAD**2
        return blocks

    def _turn_columns(self, rows: IntArray) -> IntArray:
        return super()._turn_columns(self._places[rows])
