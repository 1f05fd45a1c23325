"""Normal equations of a chain of poses that see landmarks, solved exactly.

    [ T   B ] [ x ]     [ g ]
    [ Bᵀ  D ] [ z ] = − [ h ]

T is block-tridiagonal, as each pose is linked to the next one only. The border z is shared by all
poses: c unknowns that each depends on, then k for each landmark.

A pose sees few landmarks, but once those before it are eliminated it depends on all that they
saw. So the poses between every :data:`STRIDE`-th one go first, all such stretches side by side: a
stretch depends on its two ends, on c and on what was seen along it. The shorter chain that is
left is eliminated by a banded Cholesky factor, with the whole border; so is the whole chain if
the border is small.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky_banded
from scipy.linalg.blas import dtbsv
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import csc_array

from slam_observer_ros.common.process import compiled
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie.matrices import inverse_by_factor, transpose

COMPILED = compiled('smoothing._gauss_newton')

STRIDE = 8

# Size of a border which, carried along the whole chain, costs less than a detour.
SMALL_BORDER = 100


class Equations(NamedTuple):
    """The normal equations, block by block, of S poses and a border of b unknowns."""

    diagonal: FloatArray  # (S, d, d) blocks of T
    above: FloatArray  # (S − 1, d, d) blocks of T that link poses s and s + 1
    shared: FloatArray  # (S, d, c) blocks of B that link poses to the border's first c unknowns
    poses: IntArray  # (M,) which pose saw …
    landmarks: IntArray  # (M,) … which landmark; no two are the same
    seen: FloatArray  # (M, d, k) blocks of B that link the two
    first: FloatArray  # (d, b) the prior's blocks, which link the first pose to the border
    corner: FloatArray  # (b, b) D
    gradient: FloatArray  # (S, d) g
    border_gradient: FloatArray  # (b,) h


class Elimination(Protocol):
    """The equations of the border after the chain of poses is eliminated, T = Uᵀ U."""

    corner: FloatArray  # (b, b) D − Bᵀ T⁻¹ B
    border_gradient: FloatArray  # (b,) h − Bᵀ T⁻¹ g
    last_root: FloatArray  # (d, d) U⁻¹ of the last pose
    last_rows: FloatArray  # (d, b) rows of U⁻ᵀ B of the last pose

    def fill_in(self, border: FloatArray) -> FloatArray:
        """Return the changes (S, d) of the poses from those (b,) of the border."""


class ChainFactors:
    """Factors of the normal equations; LinAlgError is raised if these are singular."""

    def __init__(self, equations: Equations) -> None:
        self._chain: Elimination = (
            _InNumpy(equations) if COMPILED is None else _Compiled(COMPILED, equations)
        )
        # Symmetric: transposed it is laid out as LAPACK has it.
        self._corner, _ = cho_factor(self._chain.corner.T, lower=True, overwrite_a=True)

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Return the changes (S, d) of the poses and (b,) of the border."""
        border: FloatArray = -cho_solve((self._corner, True), self._chain.border_gradient)
        return self._chain.fill_in(border), border

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
    """The same by ``_gauss_newton.c``, which uses up the equations' border."""

    def __init__(self, compiled: ModuleType, equations: Equations) -> None:
        (S, d), b = equations.gradient.shape, len(equations.corner)
        R = S - (STRIDE - 1) * _stretch_count(equations)
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
    """The same in numpy, the reference."""

    def __init__(self, equations: Equations) -> None:
        self._stretches = _Stretches(equations)
        diagonal, above, rows = self._stretches.kept_chain(equations)
        corner, border_gradient = self._stretches.border(equations)
        self._d = d = rows.shape[2]
        self._factor = np.asfortranarray(cholesky_banded(_banded(diagonal, above)))
        rows = _forward(self._factor, rows.reshape(len(rows), -1))
        self._border, self._gradient = rows[:-1], rows[-1]
        self.corner = corner - self._border @ self._border.T
        self.border_gradient = border_gradient - self._border @ self._gradient
        self.last_root = _forward(self._factor[:, -d:], np.eye(d))
        self.last_rows = self._border[:, -d:].T

    def fill_in(self, border: FloatArray) -> FloatArray:
        """Return the changes (S, d) of the poses from those (b,) of the border."""
        bandwidth = len(self._factor) - 1
        kept = -dtbsv(bandwidth, self._factor, self._gradient + border @ self._border)
        return self._stretches.fill_in(kept.reshape(-1, self._d), border)


class _Stretches:
    """The J stretches of poses between every :data:`STRIDE`-th one, eliminated.

    A stretch depends on its start, its end and a part of the border: ``_columns`` (J, c + k m),
    filled up with columns behind the border's last where it saw less than m landmarks.
    """

    def __init__(self, equations: Equations) -> None:
        S, self._d = equations.gradient.shape
        self._count = _stretch_count(equations)
        self._inner = STRIDE * np.arange(self._count)[:, None] + np.arange(1, STRIDE)
        self._kept = np.setdiff1d(np.arange(S), self._inner)
        stretch, offset = np.divmod(equations.poses, STRIDE)
        self._is_inner = (stretch < self._count) & (offset > 0)
        T, X = self._matrices(equations), self._links(equations)
        self._solved = np.linalg.solve(T, X)
        self._lost = transpose(X) @ self._solved

    def _matrices(self, equations: Equations) -> FloatArray:
        """Return the part of T (J, (STRIDE − 1) d, (STRIDE − 1) d) of each stretch."""
        J, d, row = self._count, self._d, np.arange(STRIDE - 1)
        T = np.zeros((J, STRIDE - 1, d, STRIDE - 1, d))
        above = equations.above[self._inner[:, :-1]].swapaxes(0, 1)
        T[:, row, :, row] = equations.diagonal[self._inner].swapaxes(0, 1)
        T[:, row[:-1], :, row[1:]] = above
        T[:, row[1:], :, row[:-1]] = transpose(above)
        return T.reshape(J, (STRIDE - 1) * d, (STRIDE - 1) * d)

    def _links(self, equations: Equations) -> FloatArray:
        """Return (J, (STRIDE − 1) d, …): links to start, end and columns; then the gradient."""
        J, d, (k, c) = self._count, self._d, (equations.seen.shape[2], equations.shared.shape[2])
        # Which landmarks each stretch saw, and the columns they have in it.
        stretch, offset = np.divmod(equations.poses[self._is_inner], STRIDE)
        beyond = (len(equations.corner) - c) // k
        local, slots = _group(stretch, equations.landmarks[self._is_inner], J, beyond)
        own = landmark_columns(local, c, k).reshape(J, k * local.shape[1])
        self._columns = np.hstack([np.tile(np.arange(c), (J, 1)), own])
        seen = np.zeros((J, STRIDE - 1, d, local.shape[1], k))
        seen[stretch, offset - 1, :, slots] = equations.seen[self._is_inner]
        # The links of its first pose to the start, of its last to the end.
        to_start, to_end = np.zeros((2, J, STRIDE - 1, d, d))
        to_start[:, 0] = transpose(equations.above[self._inner[:, 0] - 1])
        to_end[:, -1] = equations.above[self._inner[:, -1]]
        shared, gradient = equations.shared[self._inner], equations.gradient[self._inner]
        own_links = seen.reshape(J, STRIDE - 1, d, own.shape[1])
        X = np.concatenate([to_start, to_end, shared, own_links, gradient[..., None]], axis=-1)
        return X.reshape(J, (STRIDE - 1) * d, X.shape[-1])

    def kept_chain(self, equations: Equations) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return blocks (R, d, d) and (R − 1, d, d) of the R poses left, and rows (b + 1, R, d).

        The rows are their links to the border, and last their gradient.
        """
        J, d, start, end = self._count, self._d, slice(self._d), slice(self._d, 2 * self._d)
        diagonal, gradient = equations.diagonal[self._kept], equations.gradient[self._kept]
        # Less what the stretches from each pose and to it have taken along.
        diagonal[:J] -= self._lost[:, start, start]
        diagonal[1 : J + 1] -= self._lost[:, end, end]
        gradient[:J] -= self._lost[:, start, -1]
        gradient[1 : J + 1] -= self._lost[:, end, -1]
        above = np.concatenate([-self._lost[:, start, end], equations.above[STRIDE * J :]])
        rows, stretch = self._kept_links(equations), np.arange(J)[:, None]
        rows[self._columns, stretch] -= transpose(self._lost[:, start, 2 * d : -1])
        rows[self._columns, stretch + 1] -= transpose(self._lost[:, end, 2 * d : -1])
        b = len(equations.corner)
        rows[b] = gradient
        return diagonal, above, rows[: b + 1]

    def _kept_links(self, equations: Equations) -> FloatArray:
        """Return the links (b + k, R, d) of the poses that are left to the border and beyond."""
        b, k, c = len(equations.corner), equations.seen.shape[2], equations.shared.shape[2]
        is_kept = ~self._is_inner
        columns = landmark_columns(equations.landmarks[is_kept], c, k)
        positions = np.searchsorted(self._kept, equations.poses[is_kept])
        rows = np.zeros((b + k, len(self._kept), self._d))
        rows[columns, positions[:, None]] = transpose(equations.seen[is_kept])
        rows[:c] += equations.shared[self._kept].transpose(2, 0, 1)
        rows[:b, 0] += equations.first.T
        return rows

    def border(self, equations: Equations) -> tuple[FloatArray, FloatArray]:
        """Return D (b, b) and its gradient (b,) after the elimination."""
        b, columns = len(equations.corner), self._columns
        size, own = b + equations.seen.shape[2], slice(2 * self._d, -1)
        entries = size * columns[:, :, None] + columns[:, None]
        corner = sum_by(entries.ravel(), size**2, self._lost[:, own, own].ravel())
        gradient = sum_by(columns.ravel(), size, self._lost[:, own, -1].ravel())
        return (
            equations.corner - corner.reshape(size, size)[:b, :b],
            equations.border_gradient - gradient[:b],
        )

    def fill_in(self, kept: FloatArray, border: FloatArray) -> FloatArray:
        """Return the changes (S, d) of all poses from those (R, d) left and (b,) of the border."""
        J, d = self._count, self._d
        beyond = np.append(border, np.zeros(self._columns.max(initial=0)))
        ends = np.hstack([kept[:J], kept[1 : J + 1], beyond[self._columns], np.ones((J, 1))])
        changes = np.empty((len(self._kept) + self._inner.size, d))
        changes[self._kept] = kept
        changes[self._inner] = -(self._solved @ ends[:, :, None]).reshape(J, STRIDE - 1, d)
        return changes


def _stretch_count(equations: Equations) -> int:
    """Return how many stretches of poses are eliminated before the others."""
    is_small = len(equations.corner) <= SMALL_BORDER
    return 0 if is_small else (len(equations.gradient) - 1) // STRIDE


def landmark_columns(landmarks: IntArray, c: int, k: int) -> IntArray:
    """Return the unknowns (…, k) of the border that belong to landmarks (…)."""
    return c + k * landmarks[..., None] + np.arange(k)


def sum_by(labels: IntArray, count: int, values: FloatArray) -> FloatArray:
    """Return the sum of the ``values`` (M, …) of each label (count, …)."""
    M = len(labels)
    selection = csc_array((np.ones(M), labels, np.arange(M + 1)), (count, M))
    sums: FloatArray = selection @ values.reshape(M, math.prod(values.shape[1:]))
    return sums.reshape(count, *values.shape[1:])


def _group(
    stretch: IntArray, landmarks: IntArray, count: int, beyond: int
) -> tuple[IntArray, IntArray]:
    """Give the landmarks that each of ``count`` stretches saw numbers of its own.

    Return which they are (count, m), filled up with ``beyond``, and the number of each (M,).
    """
    pairs, inverse = np.unique(stretch * (beyond + 1) + landmarks, return_inverse=True)
    of_stretch, landmark = np.divmod(pairs, beyond + 1)
    number = np.arange(len(pairs)) - np.searchsorted(of_stretch, of_stretch)
    local = np.full((count, number.max(initial=-1) + 1), beyond)
    local[of_stretch, number] = landmark
    return local, number[inverse]


def _forward(chain: FloatArray, rows: FloatArray) -> FloatArray:
    """Return U⁻ᵀ b for each row b: half of solving by T = Uᵀ U, and all that is needed."""
    # There must be a row: of none, SciPy 1.17 writes beyond the end.
    solved: FloatArray = dtbtrs(chain, rows.T, trans='T')[0].T
    return solved


def _banded(diagonal: FloatArray, above: FloatArray) -> FloatArray:
    """Return the upper banded form (2 d, S d) of a block-tridiagonal matrix."""
    S, d = diagonal.shape[:2]
    band = np.zeros((2 * d, S, d))
    for row in range(d):
        for column in range(row, d):
            band[2 * d - 1 + row - column, :, column] = diagonal[:, row, column]
        for column in range(d):
            band[d - 1 + row - column, 1:, column] = above[:, row, column]
    return band.reshape(2 * d, S * d)
