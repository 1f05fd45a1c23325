"""Normal equations of a chain of poses that see landmarks, solved exactly.

    [ T   B ] [ x ]     [ g ]
    [ Bᵀ  D ] [ z ] = − [ h ]

T is block-tridiagonal, as each pose is linked to the next one only. The border z is shared by all
poses: c unknowns that each depends on, then k for each landmark.

A pose sees few landmarks, but once those before it are eliminated it depends on all that they
saw. So in C the poses between every :data:`STRIDE`-th one go first: a stretch of these depends on
its two ends, on c and on what was seen along it. The shorter chain that is left is eliminated
with the whole border; so is the whole chain if the border is small, and in numpy.
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky_banded
from scipy.linalg.blas import dtbsv
from scipy.linalg.lapack import dtbtrs

from slam_observer_ros.common.process import compiled
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie.matrices import inverse_by_factor, transpose

COMPILED = compiled('smoothing._gauss_newton')
STRIDE = 8
SMALL_BORDER = 100  # less to carry along the whole chain than a detour costs


class Equations(NamedTuple):
    """The normal equations, block by block, of S poses and a border of b unknowns."""

    diagonal: FloatArray  # (S, d, d) blocks of T
    above: FloatArray  # (S − 1, d, d) blocks of T that link poses s and s + 1
    shared: FloatArray  # (S, d, c) blocks of B that link poses to the border's first c unknowns
    poses: IntArray  # (M,) which pose saw …
    landmarks: IntArray  # (M,) … which landmark; of two that were merged, maybe twice
    seen: FloatArray  # (M, d, k) blocks of B that link the two
    first: FloatArray  # (d, b) the prior's blocks, which link the first pose to the border
    corner: FloatArray  # (b, b) D
    gradient: FloatArray  # (S, d) g
    border_gradient: FloatArray  # (b,) h


class ChainFactors:
    """Factors of the normal equations; LinAlgError is raised if these are singular."""

    def __init__(self, equations: Equations) -> None:
        self._chain = _InNumpy(equations) if COMPILED is None else _Compiled(COMPILED, equations)
        self._equations = equations
        # Symmetric: transposed it is laid out as LAPACK has it.
        self._corner, _ = cho_factor(self._chain.corner.T, lower=True, overwrite_a=True)

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Return the changes (S, d) of the poses and (b,) of the border."""
        border: FloatArray = -cho_solve((self._corner, True), self._chain.border_gradient)
        return self._chain.fill_in(border), border

    def log_det(self) -> float:
        """Return ln of the determinant of the whole matrix."""
        of_chain = cholesky_banded(_band(self._equations))[-1]
        return 2.0 * float(np.log(of_chain).sum() + np.log(np.diagonal(self._corner)).sum())

    def marginal(self) -> FloatArray:
        """Return the covariance (d + b, d + b) of the last pose and the border."""
        root = self._chain.last_root
        d, b = self._chain.last_rows.shape
        corner = inverse_by_factor(self._corner)
        tail = root @ self._chain.last_rows
        covariance = np.empty((d + b, d + b))
        covariance[:d, :d] = root @ root.T + tail @ corner @ tail.T
        covariance[:d, d:] = -tail @ corner
        covariance[d:, :d] = covariance[:d, d:].T
        covariance[d:, d:] = corner
        return covariance


class _Compiled:
    """The same as :class:`_InNumpy` by C, which uses up the equations' border."""

    def __init__(self, compiled: ModuleType, equations: Equations) -> None:
        (S, d), b = equations.gradient.shape, len(equations.corner)
        stretches = 0 if b <= SMALL_BORDER else (S - 1) // STRIDE
        R = S - (STRIDE - 1) * stretches  # poses that are left
        factors, rows = np.empty((R, d, d)), np.empty((R, d, b + 1))
        self._compiled = compiled
        self._equations = equations = Equations._make(map(np.ascontiguousarray, equations))
        self._chain = factors, np.empty((R - 1, d, d)), rows
        if not compiled.eliminate(equations, self._chain):
            raise np.linalg.LinAlgError('some pose of the chain is open')
        flat = rows.reshape(-1, b + 1)
        lost = flat.T @ flat
        self.corner, self.border_gradient = equations.corner, equations.border_gradient
        self.corner -= lost[:b, :b]
        self.border_gradient -= lost[:b, b]
        self.last_root = np.linalg.inv(np.tril(factors[-1])).T
        self.last_rows = rows[-1, :, :b]

    def fill_in(self, border: FloatArray) -> FloatArray:
        """Return the changes (S, d) of the poses from those (b,) of the border."""
        changes = np.empty_like(self._equations.gradient)
        self._compiled.fill_in(self._equations, self._chain, np.append(border, 1.0), changes)
        return changes


class _InNumpy:
    """The equations of the border after the chain of poses is eliminated, T = Uᵀ U.

    This is the reference: a banded Cholesky factor carries the whole border along.
    """

    def __init__(self, equations: Equations) -> None:
        S, self._d = equations.gradient.shape
        d, b = self._d, len(equations.corner)
        k, c = equations.seen.shape[2], equations.shared.shape[2]
        # Bᵀ (b, S, d), and below it the gradient
        rows = np.zeros((b + 1, S, d))
        columns = landmark_columns(equations.landmarks, c, k)
        np.add.at(rows, (columns, equations.poses[:, None]), transpose(equations.seen))
        rows[:c] += equations.shared.transpose(2, 0, 1)
        rows[:b, 0] += equations.first.T
        rows[b] = equations.gradient
        self._factor = np.asfortranarray(cholesky_banded(_band(equations)))
        solved = _forward(self._factor, rows.reshape(b + 1, S * d))
        self._border, self._gradient = solved[:b], solved[b]
        self.corner = equations.corner - self._border @ self._border.T  # (b, b) D − Bᵀ T⁻¹ B
        # (b,) h − Bᵀ T⁻¹ g
        self.border_gradient = equations.border_gradient - self._border @ self._gradient
        self.last_root = _forward(self._factor[:, -d:], np.eye(d))  # (d, d) U⁻¹ of the last pose
        self.last_rows = self._border[:, -d:].T  # (d, b) rows of U⁻ᵀ B of the last pose

    def fill_in(self, border: FloatArray) -> FloatArray:
        """Return the changes (S, d) of the poses from those (b,) of the border."""
        bandwidth = len(self._factor) - 1
        right = self._gradient + border @ self._border
        changes: FloatArray = -dtbsv(bandwidth, self._factor, right)
        return changes.reshape(-1, self._d)


def _band(equations: Equations) -> FloatArray:
    """Return T in its upper banded form (2 d, S d)."""
    S, d = equations.gradient.shape
    band = np.zeros((2 * d, S, d))
    for row in range(d):
        for column in range(row, d):
            band[2 * d - 1 + row - column, :, column] = equations.diagonal[:, row, column]
        for column in range(d):
            band[d - 1 + row - column, 1:, column] = equations.above[:, row, column]
    return band.reshape(2 * d, S * d)


def landmark_columns(landmarks: IntArray, c: int, k: int) -> IntArray:
    """Return the unknowns (…, k) of the border that belong to landmarks (…)."""
    return c + k * landmarks[..., None] + np.arange(k)


def _forward(chain: FloatArray, rows: FloatArray) -> FloatArray:
    """Return U⁻ᵀ b for each row b: half of solving by T = Uᵀ U, and all that is needed."""
    # There must be a row: of none, SciPy 1.17 writes beyond the end.
    solved: FloatArray = dtbtrs(chain, rows.T, trans='T')[0].T
    return solved
