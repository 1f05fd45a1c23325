"""The SLAM_n(3) observer: state, propagation (27), error (29) and Lyapunov function (34).

The state X̂ = (Â, â_1 … â_n) lives on the group; with the reference ξ° = [P°, p_i°] it gives the
estimate P̂ = P° Â and p̂_i = p_i° + R_P° â_i (23). Everything here is written in the frame of P°,
where the reference landmarks are y_i° = P°⁻¹ p_i°.

The innovation moves the state from the left by a group element (D, d_i), a :class:`Correction`:

    X̂ ← (D, d_i) · X̂,   that is   Â ← D Â,   â_i ← R_D â_i + d_i.

To first order D = exp(Δ dt) and d_i + R_D â_i − â_i = δ_i dt with the paper's Δ and δ_i (28). How
large D and d_i are is what the gain designs in :mod:`slam_observer_ros.observer.designs` decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.geometry import se3, so3


@dataclass(frozen=True, slots=True)
class Correction:
    """Element (D, d_i) of SLAM_n(3) by which an innovation moves the state from the left.

    Attributes
    ----------
    D : FloatArray
        (4, 4) rigid motion in the reference frame.
    rows : IntArray or slice
        Landmarks that are moved, m of them; the others stay where they are in the world.
    d : FloatArray
        (m, 3) translations in the reference frame, metres.
    u : FloatArray or None
        (m, 3) changes of the landmarks' own velocities, m/s; None where they are not estimated.

    """

    D: FloatArray
    rows: IntArray | slice
    d: FloatArray
    u: FloatArray | None = None


class Observer:
    """State X̂ on SLAM_n(3) with its reference ξ°.

    Parameters
    ----------
    reference_pose : FloatArray
        (4, 4) P°, body to world.

    Attributes
    ----------
    A : FloatArray
        (4, 4) Â.
    a : FloatArray
        (n, 3) â_i, metres, reference frame.
    y_ref : FloatArray
        (n, 3) y_i° = P°⁻¹ p_i°, metres, reference frame.
    u : FloatArray
        (n, 3) velocities R_Â v_i of landmarks that move, m/s, reference frame; else zero.
    have_moved : bool
        Whether any landmark has had a velocity so far.
    reference_pose : FloatArray
        (4, 4) P°.

    """

    def __init__(self, reference_pose: FloatArray) -> None:
        self.reference_pose = reference_pose
        self.A: FloatArray = np.eye(4)
        self.a: FloatArray = np.empty((0, 3))
        self.y_ref: FloatArray = np.empty((0, 3))
        self.u: FloatArray = np.empty((0, 3))
        self.have_moved = False

    @property
    def pose(self) -> FloatArray:
        """(4, 4) estimated pose P̂ = P° Â, body to world."""
        return self.reference_pose @ self.A

    @property
    def world_points(self) -> FloatArray:
        """(n, 3) estimated landmarks p̂_i = p_i° + R_P° â_i = P° (y_i° + â_i), metres, world.

        As far as they have been moved: some gains put that off for landmarks out of view, see
        :attr:`slam_observer_ros.state.state.Slam.world_points`.
        """
        return se3.transform(self.reference_pose, self.points)

    @property
    def points(self) -> FloatArray:
        """(n, 3) the same in the reference frame, y_i° + â_i, metres."""
        return self.y_ref + self.a

    def body_points(self, rows: IntArray) -> FloatArray:
        """Return where landmarks should be seen, Â⁻¹ (y_i° + â_i) (m, 3), metres, body frame."""
        arms = self.y_ref[rows] + self.a[rows] - self.A[:3, 3]
        points: FloatArray = arms @ self.A[:3, :3]
        return points

    def turned(self, covariances: FloatArray) -> FloatArray:
        """Return covariances (m, 3, 3) from the body frame in the reference frame."""
        R = self.A[:3, :3]
        turned: FloatArray = R @ covariances @ R.T
        return turned

    def add_landmarks(self, points: FloatArray) -> None:
        """Append landmarks seen for the first time, so that their residual is zero.

        Parameters
        ----------
        points : FloatArray
            (m, 3) observations y_i, metres, body frame; the reference becomes y_i° = Â y_i.

        """
        self.add_reference_landmarks(se3.transform(self.A, points))

    def add_reference_landmarks(self, y_ref: FloatArray) -> None:
        """Append landmarks with given reference y_i° (m, 3), metres, and â_i = 0."""
        self.y_ref = np.concatenate([self.y_ref, y_ref])
        self.a = np.concatenate([self.a, np.zeros_like(y_ref)])
        self.u = np.concatenate([self.u, np.zeros_like(y_ref)])

    def relocate_landmarks(self, rows: IntArray, points: FloatArray) -> None:
        """Put landmarks, at rest, where seen now: y_i° = Â y_i with ``points`` y_i (m, 3)."""
        self.y_ref[rows] = se3.transform(self.A, points)
        self.a[rows] = self.u[rows] = 0.0

    def fix_landmarks(self, y_ref: FloatArray) -> None:
        """Put all landmarks at ``y_ref`` (n, 3), with â_i = 0, at rest."""
        self.rebase(y_ref)
        self.u = np.zeros_like(y_ref)
        self.have_moved = False

    def rebase(self, y_ref: FloatArray) -> None:
        """Put the landmarks at ``y_ref`` (n, 3), reference frame, with â_i = 0."""
        self.y_ref = y_ref
        self.a = np.zeros(y_ref.shape)

    def remove_landmarks(self, rows: IntArray) -> None:
        """Delete the landmarks at ``rows``; those behind move up."""
        self.y_ref = np.delete(self.y_ref, rows, axis=0)
        self.a = np.delete(self.a, rows, axis=0)
        self.u = np.delete(self.u, rows, axis=0)

    def errors(self, rows: IntArray | slice, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the error (29) and the residual of seen landmarks.

        Parameters
        ----------
        rows : IntArray or slice
            Which landmarks are seen, m of them.
        points : FloatArray
            (m, 3) observations y_i, metres, body frame.

        Returns
        -------
        e : FloatArray
            (m, 3) e_i = ρ(X̂⁻¹, y)_i = R_Â y_i + x_Â − â_i (29), metres, reference frame.
        r : FloatArray
            (m, 3) r_i = e_i − y_i°. The paper prints e_i − p_i°, which is this for P° = I.

        """
        e = se3.transform(self.A, points) - self.a[rows]  # (29)
        return e, e - self.y_ref[rows]

    def propagate(self, path: FloatArray) -> None:
        """Advance Â to the end of a ``path`` (k + 1, 4, 4), along which it is Â exp(V dt) (27)."""
        self.A = path[-1].copy()
        self.A[:3, :3] = so3.normalise(self.A[:3, :3])

    def set_landmark_velocities(self, rows: IntArray, velocities: FloatArray) -> None:
        """Let landmarks move from now on, or rest.

        Parameters
        ----------
        rows : IntArray
            (m,) which landmarks.
        velocities : FloatArray
            (m, 3) their velocities v_i (19), m/s, body frame at this instant.

        """
        self.u[rows] = se3.rotate(self.A, velocities)
        self.have_moved = self.have_moved or bool(velocities.any())

    def move_landmarks(self, duration_s: float) -> None:
        """Add R_Â v_i dt to â_i, where (27) has zero: here landmarks may have velocities (19)."""
        if self.have_moved:  # else this would cost O(n) at every step
            self.a += self.u * duration_s

    def correct(self, correction: Correction) -> None:
        """Move the state from the left by (D, d_i); see the module's text."""
        D, rows = correction.D, correction.rows
        self.A = D @ self.A  # (28), Δ for a finite time
        self.a[rows] = self.a[rows] @ D[:3, :3].T + correction.d  # (28), δ_i
        if correction.u is not None:
            self.u[rows] = self.u[rows] @ D[:3, :3].T + correction.u
            self.have_moved = True


def lyapunov(gain_k: FloatArray | float, r: FloatArray) -> float:
    """Return L = Σ k_i/2 |r_i|² (34) for gains k_i (m,) and residuals ``r`` (m, 3) in metres."""
    return float(0.5 * np.vdot(gain_k * r.T, r.T))
