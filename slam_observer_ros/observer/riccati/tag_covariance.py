"""The joint covariance where landmarks may have orientations, as tags do.

The errors are x = (ε, c̃, (ξ_1, ω_1) … ), with B̂_i = exp(ω_i) B_i of the tag's orientation in the
reference frame. No motion changes ω_i, and what is seen of it, R_Â Z_i B̂_iᵀ = exp(φ_i), says
φ_i = ε_Ω − ω_i, with D c̃ of a calibrated sensor, whatever the map is: the group is
:mod:`slam_observer_ros.geometry.tag_group`. A landmark that has no orientation may have any, and
its columns say so.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry.axes import EstimatedAxes
from slam_observer_ros.geometry.matrices import block_diagonal
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.observer.orientations import UNKNOWN_RAD
from slam_observer_ros.observer.riccati.joint_covariance import (
    ExactMapCovariance,
    JointCovariance,
    sheared,
)
from slam_observer_ros.observer.riccati.symmetric_matrix import SymmetricMatrix
from slam_observer_ros.sensor_models.calibration import Calibration
from slam_observer_ros.sensor_models.motion import Motion


class TagCovariance(JointCovariance):
    """P with columns for orientations, too."""

    def __init__(
        self, axes: EstimatedAxes, calibration: Calibration, matrix: SymmetricMatrix
    ) -> None:
        super().__init__(axes, calibration, matrix)
        self._stride = axes.point + axes.turn

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return ξ_i (n, 3) of x; velocities are not estimated."""
        parts = x[self.first :].reshape(-1, self._stride)
        return self._axes.full_points(parts[:, : self._axes.point]), None

    def turns(self, x: FloatArray) -> FloatArray:
        """Return ω_i (n, 3) of x, rad."""
        parts = x[self.first :].reshape(-1, self._stride)
        return self._axes.full_turns(parts[:, self._axes.point :])

    def propagate(self, motion: Motion, points: FloatArray, u: FloatArray) -> None:
        """Let the robot move; no tag turns."""
        self._propagate(motion, self._all_turning(points))

    def of_landmarks(
        self, rows: IntArray, points: FloatArray, tags: IntArray
    ) -> FloatArray | None:
        """Return the covariance (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,)."""
        p = self._p
        columns = np.concatenate([np.arange(p), self._columns(rows), self._turn_columns(tags)])
        P, L = self.P[np.ix_(columns, columns)], np.zeros((len(columns) - p, p))
        L[: len(rows) * self._axes.point] = -self._turning(points).reshape(-1, p)
        return sheared(P, p, L)[p:, p:]

    def add_correlated(self, known: KnownLandmarks) -> None:
        """Append landmarks of a map with errors of positions and orientations together."""
        first = (len(self.P) - self.first) // self._stride
        super().add_correlated(known)
        rows = first + np.arange(len(known))
        turns, positions = self._turn_columns(rows[known.tags]), self._columns(rows)
        R, q = known.joint_on(self._axes), len(positions)
        self.P[np.ix_(turns, positions)], self.P[np.ix_(positions, turns)] = R[q:, :q], R[:q, q:]
        self.P[np.ix_(turns, turns)] = R[q:, q:]

    def copy_turns(self, source: IntArray, target: IntArray) -> None:
        """Let tags ``target`` (m,) have the orientations, with their errors, of others."""
        source, target = self._turn_columns(source), self._turn_columns(target)
        self.P[target] = self.P[source]
        self.P[:, target] = self.P[:, source]

    def project_turn_differences(
        self, rows: IntArray, others: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of ω_i − ω_j."""
        own, other = self._turn_columns(rows), self._turn_columns(others)
        HP = self.P[own] - self.P[other]
        return HP, HP[:, own] - HP[:, other]

    def gauge(self, n: int) -> FloatArray:
        """Return G (…, p): a motion of everything turns the tags with it."""
        G, q = super().gauge(n), self._axes.turn
        G[self._turn_columns(np.arange(n)), :q] = np.tile(np.eye(q), (n, 1))
        return G

    def forget_turns(self, rows: IntArray) -> None:
        """Let orientations (m,) be unknown."""
        q = self._axes.turn
        self.add_known_turns(rows, np.tile(UNKNOWN_RAD**2 * np.eye(q), (len(rows), 1, 1)))

    def add_turns(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take over orientations (m,) seen for the first time: ω_i = φ_i + noise (m, q, q)."""
        columns, (HP, HPH) = self._turn_columns(rows), self._project_turn(D)
        of_state = np.tile(HP, (len(rows), 1))
        self.P[columns], self.P[:, columns] = of_state, of_state.T
        own = np.tile(HPH, (len(rows), len(rows))) + block_diagonal(covariances)
        self.P[np.ix_(columns, columns)] = 0.5 * (own + own.T)

    def add_known_turns(self, rows: IntArray, covariances: FloatArray) -> None:
        """Take over orientations (m,) whose errors (m, q, q) are independent of all else."""
        columns = self._turn_columns(rows)
        self.P[columns] = self.P[:, columns] = 0.0
        self.P[np.ix_(columns, columns)] = block_diagonal(covariances)

    def project_turns(
        self, rows: IntArray, D: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of φ_i = ε_Ω − ω_i + D c̃, D (3, c)."""
        columns, C = self._turn_columns(rows), self._turn_output(D)
        HP = np.tile(self._project_turn(D)[0], (len(rows), 1)) - self.P[columns]
        return HP, np.tile(HP[:, : C.shape[1]] @ C.T, len(rows)) - HP[:, columns]

    def project_own_turns(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the same of ω_i alone."""
        columns = self._turn_columns(rows)
        return self.P[columns], self.P[np.ix_(columns, columns)]

    def _project_turn(self, D: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return H P (q, …) and H P Hᵀ (q, q) of ε_Ω + D c̃."""
        C = self._turn_output(D)
        HP = C @ self.P[: C.shape[1]]
        return HP, HP[:, : C.shape[1]] @ C.T

    def _turn_output(self, D: FloatArray | None) -> FloatArray:
        """Return C (q, p), or (q, p + c), of ε_Ω + D c̃ = C (ε, c̃)."""
        C = np.eye(self._axes.turn, self._p)
        return C if D is None else np.hstack([C, D[self._axes.turned]])

    def _insert(self, rows: IntArray, C: FloatArray, noise: FloatArray) -> None:
        super()._insert(rows, C, noise)
        self.forget_turns(rows)

    def _turn_columns(self, rows: IntArray) -> IntArray:
        first = self.first + self._axes.point + np.arange(self._axes.turn)
        return (first + self._stride * rows[:, None]).ravel()

    def _all_turning(self, points: FloatArray) -> FloatArray:
        blocks = self._turning(points)
        none = np.zeros((len(points), self._axes.turn, self._p))
        return np.concatenate([blocks, none], axis=1).reshape(-1, self._p)


class ExactTagMapCovariance(ExactMapCovariance, TagCovariance):
    """P of (ε, c̃) alone, in a map whose orientations are exact as well: φ_i = ε_Ω."""

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return ξ_i (0, 3) of no landmark."""
        return np.empty((0, 3)), None

    def project_turns(
        self, rows: IntArray, D: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of φ_i = ε_Ω + D c̃."""
        m, (HP, HPH) = len(rows), self._project_turn(D)
        return np.tile(HP, (m, 1)), np.tile(HPH, (m, m))
