"""What one hypothesis estimates, as arrays that are changed in place."""

from __future__ import annotations

from typing import ClassVar, Protocol, TYPE_CHECKING

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray, LandmarkColumns
from slam_observer_ros.observer.landmark_table import LandmarkTable
from slam_observer_ros.observer.orientations import LandmarkOrientations
from slam_observer_ros.observer.symmetric_matrix import SymmetricMatrix

if TYPE_CHECKING:
    from typing_extensions import Self


class Postponed(Protocol):
    """Moves of landmarks that have yet to be made, as looking at a map must not change it."""

    def postponed_shifts(self, rows: IntArray) -> FloatArray:
        """Return how far the observer has yet to move landmarks (m, 3), metres."""


class FilterArrays(LandmarkColumns):
    """X̂ and ξ° in the frame of P°, and the covariance of their errors where it is known.

    Only this folder writes to them; others read, and copy what they keep. Attributes are
    ``reference_pose`` P° and ``A`` = Â (4, 4), y_i° (``y_ref``), â_i (``a``) and R_Â v_i (``u``),
    each (n, 3), metres and m/s, the ``orientations`` of tags, what was seen of each landmark
    (``landmarks``), and ``covariance``, P (N, N), empty for gains that know none.
    ``calibration`` (43 + 7 s,) has the values of velocities and of s sensors
    (:mod:`.sensor_models.calibration`).
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
