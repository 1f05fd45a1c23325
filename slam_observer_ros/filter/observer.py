"""The SLAM_n(3) observer: state X̂, errors (29), and how an innovation acts.

X̂ = (Â, â_1 … â_n) lives on the group; with the reference ξ° = [P°, p_i°] it gives the estimate
P̂ = P° Â and p̂_i = p_i° + R_P° â_i (23). Everything here is in the frame of P°, where the
reference landmarks are y_i° = P°⁻¹ p_i°, in metres; points y_i (m, 3) seen are in the body frame.

At the end are (28)–(31) in continuous time, and the Lyapunov function that they lower: tests hold
gains against them. Signs are put right: as printed, (30) has no minus and (31) has one too many,
and L grows. They follow from ė_i = Δ e_i + Δ â_i − δ_i, for which (35) holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import EstimatedAxes


class Observer(FilterArrays):
    """State X̂ on SLAM_n(3) with its reference ξ°: what the paper does to these arrays.

    What methods return are copies, with moves that are ``postponed``.
    """

    @property
    def pose(self) -> FloatArray:
        """(4, 4) estimated pose P̂ = P° Â, body to world."""
        pose: FloatArray = self.reference_pose.dot(self.A)
        return pose

    @property
    def points(self) -> FloatArray:
        """(n, 3) estimated landmarks y_i° + â_i, metres, reference frame."""
        return self.y_ref + self.translations(np.arange(len(self)))

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) the same in the world."""
        return se3.transform(self.reference_pose, self.points)

    def translations(self, rows: IntArray) -> FloatArray:
        """Return â_i (m, 3) of landmarks, metres."""
        a: FloatArray = self.a.take(rows, axis=0, mode='wrap')
        return a if self.postponed is None else a + self.postponed.postponed_shifts(rows)

    def body_points(self, rows: IntArray) -> FloatArray:
        """Return where landmarks should be seen (m, 3), metres, body frame; −1 for a new one."""
        points = self.y_ref.take(rows, axis=0, mode='wrap') + self.translations(rows)
        seen: FloatArray = (points - self.A[:3, 3]).dot(self.A[:3, :3])  # Â⁻¹ (y_i° + â_i)
        return seen

    def turned(self, covariances: FloatArray) -> FloatArray:
        """Return covariances (m, 3, 3) from the body frame in the reference frame."""
        # (C Rᵀ)ᵀ Rᵀ, as they are symmetric: products of two matrices cost a fifth of stacks.
        R_transposed = self.A[:3, :3].T
        half = covariances.reshape(-1, 3).dot(R_transposed).reshape(-1, 3, 3)
        turned: FloatArray = half.swapaxes(1, 2).reshape(-1, 3).dot(R_transposed)
        return turned.reshape(-1, 3, 3)

    def errors(self, rows: IntArray | slice, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors e_i (29) and residuals r_i (m, 3) of landmarks seen at ``points``."""
        e = se3.transform(self.A, points) - self.a[rows]  # (29)  ρ(X̂⁻¹, y)_i
        return e, e - self.y_ref[rows]  # the paper prints e_i − p_i°, which it is for P° = I

    def correct(self, D: FloatArray, rows: IntArray | slice, d: FloatArray) -> None:
        """Move the state from the left: X̂ ← (D, d_i) · X̂, d_i (m, 3) for landmarks ``rows``.

        To first order D (4, 4) = exp(Δ dt), and d_i + R_D â_i − â_i = δ_i dt (28).
        """
        self.A[...] = D.dot(self.A)  # (28), Δ for a finite time
        self.a[rows] = self.a[rows].dot(D[:3, :3].T) + d  # (28), δ_i

    def correct_velocities(
        self, D: FloatArray, rows: IntArray | slice, change: FloatArray
    ) -> None:
        """Turn the velocities of landmarks by D (4, 4), and add ``change`` (m, 3), m/s."""
        self.u[rows] = se3.rotate(D, self.u[rows]) + change
        self.have_moved = self.have_moved or len(change) > 0

    def add_landmarks(self, points: FloatArray) -> None:
        """Append landmarks where they are seen: y_i° = Â y_i for ``points`` y_i (m, 3)."""
        self.add_reference_landmarks(se3.transform(self.A, points))

    def add_reference_landmarks(self, y_ref: FloatArray) -> None:
        """Append landmarks with given y_i° (m, 3), metres, and â_i = 0."""
        rows = self.append_zeros(len(y_ref))
        self.y_ref[rows] = y_ref

    def relocate_landmarks(self, rows: IntArray, points: FloatArray) -> None:
        """Put landmarks, at rest, where they are seen: y_i° = Â y_i with ``points`` y_i (m, 3)."""
        self.y_ref[rows] = se3.transform(self.A, points)
        self.a[rows] = self.u[rows] = 0.0
        self.orientations.clear(rows)

    def fix_landmarks(self, y_ref: FloatArray) -> None:
        """Put all landmarks at ``y_ref`` (n + m, 3), at rest and for good; the last m are new."""
        self.append_zeros(len(y_ref) - len(self))
        self.set_reference(y_ref)
        self.u[...] = 0.0
        self.orientations.reset()
        self.have_moved, self.is_exact = False, True

    def set_reference(self, y_ref: FloatArray) -> None:
        """Put the landmarks at ``y_ref`` (n, 3), reference frame, with â_i = 0."""
        self.y_ref[...] = y_ref
        self.a[...] = 0.0

    def remove_landmarks(self, rows: IntArray) -> None:
        """Delete the landmarks at ``rows``; those behind move up."""
        self.delete(rows)

    def set_landmark_velocities(self, rows: IntArray, velocities: FloatArray) -> None:
        """Let landmarks move at ``velocities`` v_i (m, 3), m/s, body frame now, or rest (19)."""
        self.u[rows] = se3.rotate(self.A, velocities)
        self.have_moved = self.have_moved or bool(velocities.any())

    def set_pose(self, A: FloatArray) -> None:
        """Put the robot at Â = ``A`` (4, 4)."""
        self.A[...] = A

    def set_reference_pose(self, pose: FloatArray) -> None:
        """Let P° be ``pose`` (4, 4), body to world: all that is estimated moves with it."""
        self.reference_pose[...] = pose


@dataclass(frozen=True, slots=True)
class Residuals:
    """What an observation of m known landmarks says against the state, in the reference frame."""

    rows: IntArray  # (m,) which landmarks are seen
    e: FloatArray  # (m, 3) errors (29), metres
    r: FloatArray  # (m, 3) residuals e_i − y_i°, metres
    a: FloatArray  # (m, 3) â_i, metres
    covariances: FloatArray  # (m, 3, 3) of the points seen, m²
    dt_s: FloatArray  # (m,) seconds since each was seen before, in this run; else infinite
    repeated: FloatArray  # (m,) by what factor the covariances grow, as errors last
    # (m, 3, c) how points change with the calibration, reference frame; None where they don't
    D: FloatArray | None = None

    @property
    def landmarks(self) -> FloatArray:
        """(m, 3) estimated landmarks y_i° + â_i, metres, reference frame."""
        return self.e - self.r + self.a

    def on(self, axes: EstimatedAxes) -> tuple[FloatArray, FloatArray]:
        """Return r (m, k), metres, and the covariances (m, k, k), m², on estimated axes."""
        k = axes.point
        return self.r[:, :k], self.covariances[:, :k, :k]

    def select(self, mask: BoolArray | IntArray | slice) -> Residuals:
        """Return the part of it that ``mask`` (m,), rows, or a slice, picks."""
        if isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.all():
            return self
        return replace(
            self,
            rows=self.rows[mask],
            e=self.e[mask],
            r=self.r[mask],
            a=self.a[mask],
            covariances=self.covariances[mask],
            dt_s=self.dt_s[mask],
            repeated=self.repeated[mask],
            D=None if self.D is None else self.D[mask],
        )


def innovation(
    gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (Δ, δ_i): Δ (4, 4) in se(3) moves the pose, δ_i (m, 3) in m/s the landmarks."""
    Delta = -se3.project(_outer_sum(gain_k, e, r))  # (30)
    delta = a @ Delta[:3, :3].T + (gain_l / gain_k)[:, None] * r  # (31)
    return Delta, delta


def lyapunov(gain_k: FloatArray | float, r: FloatArray) -> float:
    """Return L = Σ k_i/2 |r_i|² (34)."""
    return float(0.5 * np.vdot(gain_k * r.T, r.T))


def lyapunov_rate(gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray) -> float:
    """Return dL/dt = −‖P(Σ k_i r_i ē_iᵀ)‖² − Σ l_i |r_i|² under the innovation (35)."""
    projection = se3.project(_outer_sum(gain_k, e, r))
    return float(-np.sum(projection**2) - np.sum(gain_l * np.sum(r * r, axis=-1)))


def _outer_sum(k: FloatArray, e: FloatArray, r: FloatArray) -> FloatArray:
    """Return Σ k_i r_i ē_iᵀ (4, 4), with r_i a direction and ē_i = (e_i, 1) a point."""
    M = np.zeros((4, 4))
    M[:3, :3] = np.einsum('i,ij,ik->jk', k, r, e)
    M[:3, 3] = k @ r
    return M
