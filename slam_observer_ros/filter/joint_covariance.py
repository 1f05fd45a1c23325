"""The covariance P of all errors x that the Riccati filter knows of (:mod:`.chart`).

The blocks C_i of all methods are of ε (m, k, p), or of (ε, c̃), the first entries of x
(m, k, p + c).
"""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.filter.arrays import FilterArrays, SymmetricMatrix
from slam_observer_ros.filter.chart import Chart, sheared
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.observer import Residuals
from slam_observer_ros.lie.matrices import block_diagonal, mended, transpose

if TYPE_CHECKING:
    from typing_extensions import Self


class JointCovariance:
    """P, kept in ``matrix``, and which of its columns are whose."""

    # Whether all landmarks are in P, and the rows of its landmarks in its order: a correction
    # moves these. See :class:`.CompressedCovariance`.
    is_dense = True
    active: IntArray | slice = slice(None)

    def __init__(
        self, chart: Chart, matrix: SymmetricMatrix, start: FloatArray, unknown: FloatArray
    ) -> None:
        """Begin with ``start`` (p + c, p + c) of pose and calibration.

        ``unknown`` (stride − k,) are the variances of all else of a landmark seen for the first
        time.
        """
        self._axes, self._p, self._matrix = chart.axes, chart.axes.p, matrix
        self.P, self._unknown = start, unknown
        self._use(chart)

    def _use(self, chart: Chart) -> None:
        self.chart, self.first, self._stride = chart, chart.first, chart.stride
        self._robot = slice(chart.robot)

    @property
    def P(self) -> FloatArray:  # noqa: N802 (the field's name for it)
        """(p + c + k n, p + c + k n) covariance of x, as a view."""
        return self._matrix.values

    @P.setter
    def P(self, covariance: FloatArray) -> None:  # noqa: N802
        self._matrix.set(covariance)

    def copy(self, observer: FilterArrays) -> Self:
        """Return an independent copy for a copy of the observer, which has one of P."""
        other = copy(self)
        other._matrix = observer.covariance
        return other

    @property
    def pose(self) -> FloatArray:
        """(p, p) covariance of ε."""
        return self.P[: self._p, : self._p]

    @property
    def of_robot(self) -> FloatArray:
        """(p + c, p + c) covariance of ε and c̃."""
        return self.P[self._robot, self._robot]

    @property
    def calibration_variances(self) -> FloatArray:
        """(c,) variances of the calibration."""
        variances: FloatArray = np.diagonal(self.of_robot)[self._p :]
        return variances

    def add_calibration(self, variances: FloatArray) -> None:
        """Append entries (c,) to c̃ that are independent of all else."""
        before, count = self.P, len(variances)
        at = np.append(np.arange(self.first), np.arange(self.first, len(before)) + count)
        P = np.zeros((len(before) + count,) * 2)
        P[np.ix_(at, at)] = before
        new = np.arange(self.first, self.first + count)
        P[new, new] = variances
        self._use(self.chart.with_calibration(count))
        self.P = P

    def landmarks(self, points: FloatArray, ahead_s: float = 0.0) -> FloatArray:
        """Return the covariances (n, 3, 3) of ã_i for ``points`` (n, 3), ``ahead_s`` from now."""
        n, k, joint = len(points), self._axes.point, self
        if self.chart.velocity:
            joint = copy(self)
            joint._matrix = self._matrix.copy()
            joint._drift_on(n, ahead_s)
        _, own = joint.output(self._turning(points), np.arange(n))
        covariances = np.zeros((n, 3, 3))
        covariances[:, :k, :k] = mended(own)
        return covariances

    def with_pose(self, rows: IntArray, points: FloatArray) -> FloatArray | None:
        """Return the covariance (p + m k, p + m k) of ε and ã_i, for estimates (m, 3)."""
        columns = np.append(np.arange(self._p), self._columns(rows))
        P: FloatArray = self.P[np.ix_(columns, columns)]
        return sheared(P, self._p, -self._turning(points).reshape(-1, self._p))

    def of_landmarks(
        self, rows: IntArray, points: FloatArray, tags: IntArray
    ) -> FloatArray | None:
        """Return the covariance (m k + t q) of ã_i of ``rows`` (m,) and ω_i of ``tags`` (t,)."""
        with_pose, p = self.with_pose(rows, points), self._p
        if with_pose is None or not len(tags):
            return None if with_pose is None else with_pose[p:, p:]
        of_turns = self._turn_columns(tags)
        columns = np.concatenate([np.arange(p), self._columns(rows), of_turns])
        P, L = self.P[np.ix_(columns, columns)], np.zeros((len(columns) - p, p))
        L[: len(L) - len(of_turns)] = -self._turning(points).reshape(-1, p)
        return sheared(P, p, L)[p:, p:]

    def activate(self, rows: IntArray) -> None:
        """Bring landmarks (m,) that are going to be observed into P."""

    def places(self, rows: IntArray) -> IntArray:
        """Return which of the landmarks in P these are (m,)."""
        return rows

    def follow(self, x: FloatArray) -> None:
        """Let all that is not in P follow, too, when the state is moved by exp(x)."""

    def dense(self) -> JointCovariance:
        """Return the same with all landmarks in P."""
        return self

    def turned(self, rows: IntArray, B: FloatArray) -> FloatArray:
        """Return orientations ``B`` (m, 3, 3) of tags after all that is postponed."""
        return B

    # The step

    def note_motion(self, duration_s: float) -> None:
        """Note that the robot has moved, and landmarks for so long."""
        if self.chart.velocity:
            self._drift_on((len(self.P) - self.first) // self._stride, duration_s)

    def _drift_on(self, n: int, duration_s: float) -> None:
        """Let ξ_i of n landmarks grow by ũ_i dt; velocities that are known change none."""
        P, rows = self.P, np.arange(n)
        columns, velocities = self._columns(rows), self.chart.velocities(rows)
        P[columns] += duration_s * P[velocities]
        P[:, columns] += duration_s * P[:, velocities]

    def output_matrix(self, residuals: Residuals, chord: float = 0.0) -> FloatArray:
        """Return C_i of r_i = C_i (ε, c̃) − ξ_i, at ``chord`` from ŷ_i to the point seen."""
        # [0, I] at ŷ_i. Turning ŷ_i to the point seen, by however much, moves it at right angles
        # to the middle between them: judged by C at ŷ_i, a robot that has turned further than it
        # knows would reject what it sees.
        return self.chart.output(chord * residuals.r, residuals.D)

    def project(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return H P (m k, …) and H P Hᵀ (m k, m k) of H x = C_i (ε, c̃) − ξ_i."""
        return self._project(C.reshape(-1, C.shape[2]), self._columns(rows))

    def project_turns(
        self, rows: IntArray, D: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of φ_i = ε_Ω − ω_i + D c̃, D (3, c)."""
        C = np.tile(self.chart.turn_output(D), (len(rows), 1))
        return self._project(C, self._turn_columns(rows))

    def _project(self, C: FloatArray, columns: IntArray) -> tuple[FloatArray, FloatArray]:
        q = C.shape[1]
        HP = C.dot(self.P[:q]) - self._matrix.rows(columns)
        return HP, HP[:, :q].dot(C.T) - HP.take(columns, axis=1)

    def output(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the covariances with ε (m, p, k) and own (m, k, k) of C_i (ε, c̃) − ξ_i alone."""
        P, q = self.P, C.shape[2]
        columns = self._columns(rows).reshape(len(rows), self._axes.point)
        to_state, own = P[columns, :q], P[columns[..., :, None], columns[..., None, :]]
        PC = P[:q, :q] @ transpose(C) - transpose(to_state)
        return PC[:, : self._p], C @ PC - to_state @ transpose(C) + own

    def outputs(self, C: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return :meth:`output` of all together, (p, m k) and (m k, m k)."""
        q, columns = C.shape[2], self._columns(rows)
        C, seen = C.reshape(-1, q), self._matrix.rows(columns)
        to_state = seen[:, :q]
        PC = self.P[:q, :q].dot(C.T) - to_state.T
        return PC[: self._p], C.dot(PC) - to_state.dot(C.T) + seen.take(columns, axis=1)

    def update(self, HP: FloatArray, S: FloatArray, r: FloatArray) -> FloatArray:
        """Update P by what :meth:`project` projected, which is used up; return K r.

        K = P Hᵀ S⁻¹ is the gain.
        """
        if not len(r):
            return np.zeros(len(self.P))
        return self._matrix.correct(self._errors, HP, S, r)

    @property
    def _errors(self) -> IntArray:
        """Columns of P that are entries of x, not of what is postponed."""
        return np.append(np.arange(self.chart.robot), np.arange(self.first, len(self.P)))

    # Landmarks

    def add_seen(self, covariances: FloatArray, D: FloatArray | None = None) -> None:
        """Append landmarks (m,) seen for the first time, with covariances (m, 3, 3), R̂ D_i."""
        self._insert_seen(self._make_room(len(covariances)), covariances, D)

    def add_known(self, points: FloatArray, covariances: FloatArray) -> None:
        """Append landmarks at ``points`` (m, 3) whose errors ã_i are independent of all else."""
        self._insert(self._make_room(len(points)), self._turning(points), self._noise(covariances))

    def add_correlated(self, known: KnownLandmarks) -> None:
        """Append landmarks of a map (m,) whose errors, of turns as well, are correlated."""
        rows, covariance = self._make_room(len(known)), known.covariance_on(self._axes)
        self._insert(rows, self._turning(known.points), covariance)
        if self.chart.turn:
            turns, points = self.chart.turns(rows[known.tags]), self._columns(rows)
            R, q = known.joint_on(self._axes), len(points)
            self.P[np.ix_(turns, points)], self.P[np.ix_(points, turns)] = R[q:, :q], R[:q, q:]
            self.P[np.ix_(turns, turns)] = R[q:, q:]

    def relocate(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take landmarks (m,) for newly seen ones, with covariances (m, 3, 3), R̂ D_i."""
        self._insert_seen(rows, covariances, D)

    def remove(self, rows: IntArray) -> None:
        """Delete the rows and columns of landmarks."""
        columns = self.chart.of_landmarks(rows)
        self.P = np.delete(np.delete(self.P, columns, axis=0), columns, axis=1)

    # Orientations

    def project_own_turns(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of ω_i."""
        columns = self._turn_columns(rows)
        HP = self.P[columns]
        return HP, HP[:, columns]

    def own_turns(self, rows: IntArray) -> FloatArray:
        """Return the covariances (m, q, q) of each ω_i, rad²."""
        columns = self._turn_columns(rows).reshape(len(rows), self.chart.turn)
        covariances: FloatArray = self.P[columns[:, :, None], columns[:, None, :]]
        return covariances

    def project_turn_differences(
        self, rows: IntArray, others: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return H P (m q, …) and H P Hᵀ (m q, m q) of ω_i − ω_j."""
        own, other = self.chart.turns(rows), self.chart.turns(others)
        HP = self.P[own] - self.P[other]
        return HP, HP[:, own] - HP[:, other]

    def add_turns(
        self, rows: IntArray, covariances: FloatArray, D: FloatArray | None = None
    ) -> None:
        """Take over orientations (m,) seen for the first time: ω_i = φ_i + noise (m, q, q)."""
        C = np.tile(self.chart.turn_output(D), (len(rows), 1))
        self.relate(self._turn_columns(rows), C, block_diagonal(covariances))

    def add_known_turns(self, rows: IntArray, covariances: FloatArray) -> None:
        """Take over orientations (m,) whose errors (m, q, q) are independent of all else."""
        columns = self._turn_columns(rows)
        self.relate(columns, np.zeros((len(columns), self._p)), block_diagonal(covariances))

    def copy_turns(self, source: IntArray, target: IntArray) -> None:
        """Let tags ``target`` (m,) have the orientations, with their errors, of others."""
        source, target = self.chart.turns(source), self.chart.turns(target)
        self.P[target] = self.P[source]
        self.P[:, target] = self.P[:, source]

    # Other coordinates

    def of_positions(self, points: FloatArray) -> FloatArray:
        """Return the covariance of (ε, c̃, ã_1 … ã_n) for estimates ``points`` (n, 3)."""
        return self.chart.of_positions(self.P, points)

    def set_of_positions(self, covariance: FloatArray, points: FloatArray) -> None:
        """Take over what :meth:`of_positions` returns."""
        self.P = self.chart.from_positions(covariance, points)

    def set_pose(self, covariance: FloatArray, points: FloatArray) -> None:
        """Let ε have the ``covariance`` (p, p), and be independent of c̃ and of all ã_i."""
        P = self.of_positions(points)
        P[: self._p] = P[:, : self._p] = 0.0
        P[: self._p, : self._p] = covariance
        self.set_of_positions(P, points)

    def _noise(self, covariances: FloatArray) -> FloatArray:
        """Return the covariance (m k, m k) of independent points, given theirs (m, 3, 3)."""
        k = self._axes.point
        return block_diagonal(covariances[:, :k, :k])

    def _insert_seen(self, rows: IntArray, covariances: FloatArray, D: FloatArray | None) -> None:
        C = self.chart.output(np.zeros((len(rows), 3)), D)
        self._insert(rows, C, self._noise(covariances))

    def _insert(self, rows: IntArray, C: FloatArray, noise: FloatArray) -> None:
        # ξ_i = C_i (ε, c̃) + noise of this covariance (m k, m k); of all else nothing is known.
        self.relate(self._columns(rows), C.reshape(-1, C.shape[2]), noise)
        if len(self._unknown):
            others = np.append(self._turn_columns(rows), self.chart.velocities(rows))
            unknown = np.tile(self._unknown, len(rows))
            self.relate(others, np.zeros((len(others), self._p)), np.diag(unknown))

    def relate(self, columns: IntArray, C: FloatArray, noise: FloatArray) -> None:
        """Let entries of x (r,) be C (ε, c̃) + noise of a covariance (r, r)."""
        q = C.shape[1]
        CP = C @ self.P[:q]
        self.P[columns], self.P[:, columns] = CP, CP.T
        own = CP[:, :q] @ C.T + noise
        self.P[np.ix_(columns, columns)] = 0.5 * (own + own.T)

    def _make_room(self, m: int) -> IntArray:
        """Append rows and columns for m landmarks; return which landmarks they are."""
        first_row = (len(self.P) - self.first) // self._stride
        self._matrix.append_zeros(m * self._stride)
        return np.arange(first_row, first_row + m)

    def _columns(self, rows: IntArray) -> IntArray:
        return self.chart.points(rows)

    def _turn_columns(self, rows: IntArray) -> IntArray:
        return self.chart.turns(rows)

    def _all_turning(self, points: FloatArray) -> FloatArray:
        return self.chart.all_still(points)

    def _turning(self, points: FloatArray) -> FloatArray:
        return self.chart.still(points)
