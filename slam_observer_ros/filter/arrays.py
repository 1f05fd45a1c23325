"""What one hypothesis estimates, as arrays that are changed in place.

One is a symmetric matrix that grows with the map, and is changed by products of few rows. BLAS
changes one triangle, at half the cost of a product of whole matrices and without a temporary one;
then the other is its mirror image, to the bit. Others are the orientations of tags.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import ClassVar, Protocol, TYPE_CHECKING

import numpy as np
from scipy.linalg.blas import dsyr2k, dsyrk, dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, LandmarkColumns
from slam_observer_ros.filter.landmark_table import LandmarkTable
from slam_observer_ros.lie.matrices import kalman_update, lifted, loses_digits

if TYPE_CHECKING:
    from typing_extensions import Self


UNKNOWN_RAD = 100.0  # standard deviation of an unknown orientation about each axis

FLIP_EVIDENCE = 9.0
"""By how much, as −2 ln of likelihood, an orientation must cost less than its flipped twin."""

FLIP_DISTANCE = 3.0  # standard deviations of the sensor's noise within which a flip does no harm


@dataclass(frozen=True, slots=True, eq=False)
class SeenOrientations:
    """Orientations of m tags that were seen at one instant, body frame."""

    rows: IntArray  # (m,) which landmarks
    Z: FloatArray  # (m, 3, 3) from the tag's own axes
    flipped: FloatArray  # (m, 3, 3) the other orientation that looks nearly the same
    covariances: FloatArray  # (m, 3, 3) of rotation vectors along the body's axes, rad²
    repeated: FloatArray  # (m,) by what factor the covariances grow, as errors last
    # (3, c) how they turn with the calibration, reference frame; None where they don't
    D: FloatArray | None = None

    def select(self, mask: BoolArray) -> SeenOrientations:
        """Return the part of it that ``mask`` (m,) picks."""
        return SeenOrientations(
            self.rows[mask],
            self.Z[mask],
            self.flipped[mask],
            self.covariances[mask],
            self.repeated[mask],
            self.D,
        )


class LandmarkOrientations(LandmarkColumns):
    """Orientations B̂_i of n landmarks in the frame of P°; zero where there is none (yet)."""

    COLUMNS: ClassVar = {
        'B': (np.float64, (3, 3)),
        'counts': (np.int64, ()),
        'rejections': (np.int64, ()),
        'map_sigmas': (np.float64, ()),
    }
    B: FloatArray  # (n, 3, 3)
    # (n,) how often each was seen and accepted, and rejections in a row up to now
    counts: IntArray
    rejections: IntArray
    map_sigmas: FloatArray  # (n,) standard deviations of orientations that a map has, rad

    @property
    def are_known(self) -> BoolArray:
        """(n,) which landmarks have an orientation."""
        return np.asarray(self.B.any(axis=(1, 2)))

    def put(self, rows: IntArray, B: FloatArray) -> None:
        """Let landmarks have orientations (m, 3, 3), seen once."""
        self.B[rows], self.counts[rows], self.rejections[rows] = B, 1, 0

    def put_known(self, rows: IntArray, B: FloatArray, sigmas: FloatArray, seen: int) -> None:
        """Let landmarks have orientations (m, 3, 3) of a map, which count as ``seen`` so often."""
        self.put(rows, B)
        self.counts[rows], self.map_sigmas[rows] = seen, sigmas

    def clear(self, rows: IntArray) -> None:
        """Let landmarks have no orientation."""
        self.B[rows] = 0.0

    def reset(self) -> None:
        """Let no landmark have an orientation, and none ever seen."""
        for name in self.COLUMNS:
            getattr(self, name)[...] = 0

    def turn(self, rows: IntArray | slice, turns: FloatArray) -> None:
        """Turn orientations of landmarks (m,) to R_i B̂_i, with ``turns`` R_i (m, 3, 3)."""
        self.B[rows] = turns @ self.B[rows]

    def count(self, rows: IntArray, accepted: BoolArray) -> None:
        """Count which orientations (m,) were accepted; all others were rejected."""
        self.counts[rows] += accepted
        self.rejections[rows] = np.where(accepted, 0, self.rejections[rows] + 1)

    def in_doubt(self, rows: IntArray, max_rejections: int) -> BoolArray:
        """Return which orientations (m,) were rejected so often that the first one was wrong."""
        needed = np.minimum(self.counts[rows] + 1, max_rejections)
        return np.asarray(self.rejections[rows] >= needed)


def flip_verdicts(evidence: FloatArray, apart: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return which orientations (m,) are less likely than their twins, and which hardly likelier.

    ``evidence`` (m,) says by how much less they cost, as −2 ln of likelihood; ``apart`` (m,) how
    far their twins are from them, by the sensor's noise. Near its twin an orientation is neither.
    """
    differ = apart > FLIP_DISTANCE
    are_flipped = differ & (evidence < 0.0)
    return are_flipped, differ & ~are_flipped & (evidence < FLIP_EVIDENCE)


GROWTH = 1.125  # how many times as large the storage becomes once it is full

_BLOCK = 128
_LOWER = np.tril(np.ones((_BLOCK, _BLOCK), dtype=np.bool_), -1)


class SymmetricMatrix:
    """Values (N, N), and room for some more rows and columns, which is zero."""

    def __init__(self, values: FloatArray) -> None:
        self.set(values)

    def set(self, values: FloatArray) -> None:
        """Become ``values`` (N, N), of any size."""
        self._storage: FloatArray = np.array(values, order='C')
        self._size = len(values)

    def copy(self) -> SymmetricMatrix:
        """Return an independent copy."""
        other = copy(self)
        other._storage = self._storage.copy()
        return other

    @property
    def values(self) -> FloatArray:
        """(N, N) the matrix, as a view that may be written to, symmetrically."""
        return self._storage[: self._size, : self._size]

    def rows(self, numbers: IntArray) -> FloatArray:
        """Return the (q, N) of these ``numbers`` (q,) of rows; transposed they are columns."""
        # Of the storage, which is contiguous: of a view NumPy would copy all first.
        return self._storage.take(numbers, axis=0)[:, : self._size]

    def append_zeros(self, count: int) -> None:
        """Append rows and columns."""
        size = self._size + count
        if size > len(self._storage):
            roomy = np.zeros((max(size, int(GROWTH * self._size)),) * 2)
            roomy[: self._size, : self._size] = self.values
            self._storage = roomy
        self._size = size

    def insert_zeros(self, at: int, count: int) -> None:
        """Insert rows and columns before number ``at``."""
        before, end = self.values, self._size + count
        self._storage, self._size = np.zeros((end, end)), end
        for rows, to_rows in ((slice(at), slice(at)), (slice(at, None), slice(at + count, end))):
            self._storage[to_rows, :at] = before[rows, :at]
            self._storage[to_rows, at + count :] = before[rows, at:]

    def among(self, numbers: IntArray) -> FloatArray:
        """Return the entries (q, q) of the ``numbers`` (q,) of rows and columns."""
        return self._storage.take(numbers, axis=0).take(numbers, axis=1)

    def correct(
        self, errors: IntArray, HP: FloatArray, S: FloatArray, r: FloatArray
    ) -> FloatArray:
        """As :func:`kalman_correction`, for H P (q, N); return K r (N,)."""
        storage, wide = self._storage, self._widened(HP)
        return kalman_correction(storage, self._size, errors, wide, S, r)[: self._size]

    def add_symmetric_product(self, A: FloatArray, B: FloatArray) -> None:
        """Add Aᵀ B + Bᵀ A for A and B (q, N)."""
        add_symmetric_product(self._storage, self._size, self._widened(A), self._widened(B))

    def _widened(self, rows: FloatArray) -> FloatArray:
        """Return rows (q, N) with zeros for the room that is left."""
        if len(self._storage) == self._size:
            return np.ascontiguousarray(rows)
        wide = np.zeros((len(rows), len(self._storage)))
        wide[:, : self._size] = rows
        return wide


def subtract_square(M: FloatArray, size: int, W: FloatArray) -> None:
    """Subtract Wᵀ W, W (q, room) zero from ``size`` on, from the symmetric M (room, room)."""
    dsyrk(-1.0, W.T, beta=1.0, c=M.T, lower=1, overwrite_c=1)
    _mirror(M, size)


def add_symmetric_product(M: FloatArray, size: int, A: FloatArray, B: FloatArray) -> None:
    """Add Aᵀ B + Bᵀ A likewise, for A and B (q, room)."""
    dsyr2k(1.0, A.T, B.T, beta=1.0, c=M.T, lower=1, overwrite_c=1)
    _mirror(M, size)


def kalman_correction(
    M: FloatArray, size: int, errors: IntArray, HP: FloatArray, S: FloatArray, r: FloatArray
) -> FloatArray:
    """Return K r (room,), K = P Hᵀ S⁻¹, and let P become P − K H P, for H P (q, room).

    ``errors`` are the columns of P, kept in ``M`` (room, room), that are entries of x.
    """
    before = M.diagonal()[errors]
    L, is_indefinite = dpotrf(S, lower=1)
    if is_indefinite:  # by rounding, where all but nothing was known
        Kr: FloatArray = kalman_update(M, HP, S).dot(r)
        is_lost = True
    else:
        # P − Wᵀ W and Wᵀ z, W = L⁻¹ H P, z = L⁻¹ r, L Lᵀ = S.
        z = dtrsv(L, r, lower=1)
        W = dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1).T
        is_lost = loses_digits(before, W[:, errors], L)
        subtract_square(M, size, W)
        Kr = z.dot(W)
    if is_lost:  # rounding has left too little: make it a covariance again
        at = np.ix_(errors, errors)
        M[at] = lifted(M[at], before)
    return Kr


def _mirror(M: FloatArray, size: int) -> None:
    """Copy the upper triangle, the one that BLAS takes for a lower one, to the lower one."""
    for begin in range(0, size, _BLOCK):
        end = min(begin + _BLOCK, size)
        M[end:size, begin:end] = M[begin:end, end:size].T
        block = M[begin:end, begin:end]
        np.copyto(block, block.T, where=_LOWER[: end - begin, : end - begin])


class Postponed(Protocol):
    """Moves of landmarks that have yet to be made, as looking at a map must not change it."""

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far the observer has yet to move landmarks (m, 3), metres."""


class FilterArrays(LandmarkColumns):
    """X̂ and ξ° in the frame of P°, and the covariance of their errors where it is known.

    Gains write to them, and what takes over a step, a relinearised past or a map; others read, and
    copy what they keep. Attributes are
    ``reference_pose`` P° and ``A`` = Â (4, 4), y_i° (``y_ref``), â_i (``a``) and R_Â v_i (``u``),
    each (n, 3), metres and m/s, the ``orientations`` of tags, what was seen of each landmark
    (``landmarks``), and ``covariance``, P (N, N), empty for gains that know none.
    ``calibration`` (43 + 7 s + b,) has the values of velocities, of s sensors and of b landmarks
    (:mod:`.models.calibration`).
    ``have_moved`` says whether any landmark has had a velocity so far, ``is_exact`` that the map
    is, and no landmark is moved. ``postponed`` says what â_i have yet to follow, in large maps.
    """

    COLUMNS: ClassVar = dict.fromkeys(('y_ref', 'a', 'u'), (np.float64, (3,)))
    y_ref: FloatArray
    a: FloatArray
    u: FloatArray

    def __init__(self, reference_pose: FloatArray) -> None:
        super().__init__()
        self.reference_pose: FloatArray = np.array(reference_pose)
        self.A: FloatArray = np.eye(4)
        self.covariance = SymmetricMatrix(np.zeros((0, 0)))
        self.calibration: FloatArray = np.empty(0)
        self.orientations, self.landmarks = LandmarkOrientations(), LandmarkTable()
        self.have_moved = self.is_exact = False
        self.postponed: Postponed | None = None

    @property
    def P(self) -> FloatArray:  # noqa: N802 (the field's name for it)
        """(N, N) the covariance, as a view."""
        return self.covariance.values

    def copy(self) -> Self:
        """Return an independent copy: one copy of memory an array."""
        other = super().copy()
        other.reference_pose, other.A = self.reference_pose.copy(), self.A.copy()
        other.covariance, other.calibration = self.covariance.copy(), self.calibration.copy()
        other.orientations, other.landmarks = self.orientations.copy(), self.landmarks.copy()
        return other

    def append_zeros(self, m: int) -> IntArray:
        """Append landmarks; return which (m,)."""
        self.orientations.append_zeros(m)
        self.landmarks.append_zeros(m)
        return super().append_zeros(m)

    def delete(self, rows: IntArray) -> None:
        """Delete landmarks; those behind move up."""
        self.orientations.delete(rows)
        self.landmarks.delete(rows)
        super().delete(rows)
