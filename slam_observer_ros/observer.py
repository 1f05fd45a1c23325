"""The SLAM_n(3) observer: state, propagation (27), error (29) and Lyapunov function (34).

The state X̂ = (Â, â_1 … â_n) lives on the group; with the reference ξ° = [P°, p_i°] it gives the
estimate P̂ = P° Â and p̂_i = p_i° + R_P° â_i (23). Everything here is written in the frame of P°,
where the reference landmarks are y_i° = P°⁻¹ p_i°.

The innovation moves the state from the left by a group element (D, d_i), a :class:`Correction`:

    X̂ ← (D, d_i) · X̂,   that is   Â ← D Â,   â_i ← R_D â_i + d_i.

To first order D = exp(Δ dt) and d_i + R_D â_i − â_i = δ_i dt with the paper's Δ and δ_i (28). How
large D and d_i are is what the gain designs in :mod:`slam_observer_ros.gains` decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Correction:
    """Element (D, d_i) of SLAM_n(3) by which an innovation moves the state from the left.

    Attributes
    ----------
    D : FloatArray
        (4, 4) rigid motion in the reference frame.
    indices : IntArray or slice
        Landmarks that are moved, m of them; the others stay where they are in the world.
    d : FloatArray
        (m, 3) translations in the reference frame, metres.
    u : FloatArray or None
        (m, 3) changes of the landmarks' own velocities, m/s; None where they are not estimated.

    """

    D: FloatArray
    indices: IntArray | slice
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
        :attr:`slam_observer_ros.slam.Slam.world_points`.
        """
        return se3.transform(self.reference_pose, self.y_ref + self.a)

    def body_points(self, indices: IntArray) -> FloatArray:
        """Return where landmarks should be seen, Â⁻¹ (y_i° + â_i) (m, 3), metres, body frame."""
        arms = self.y_ref[indices] + self.a[indices] - self.A[:3, 3]
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

    def relocate_landmarks(self, indices: IntArray, points: FloatArray) -> None:
        """Give landmarks a new reference y_i° = Â y_i where seen now, ``points`` (m, 3)."""
        self.y_ref[indices] = se3.transform(self.A, points)
        self.a[indices] = 0.0

    def rebase(self, A: FloatArray, y_ref: FloatArray) -> None:
        """Take Â (4, 4) and the landmarks (n, 3) as they are for the reference, with â_i = 0."""
        self.A = A
        self.y_ref = y_ref
        self.a = np.zeros_like(y_ref)

    def remove_landmarks(self, indices: IntArray) -> None:
        """Delete the landmarks at ``indices``; those behind move up."""
        self.y_ref = np.delete(self.y_ref, indices, axis=0)
        self.a = np.delete(self.a, indices, axis=0)
        self.u = np.delete(self.u, indices, axis=0)

    def errors(
        self, indices: IntArray | slice, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the error (29) and the residual of seen landmarks.

        Parameters
        ----------
        indices : IntArray or slice
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
        e = se3.transform(self.A, points) - self.a[indices]  # (29)
        return e, e - self.y_ref[indices]

    def path(self, body_velocities: FloatArray, dt_s: FloatArray) -> FloatArray:
        """Return Â along k held velocities, exactly: Â exp(V_1 dt_1) … exp(V_k dt_k) (27).

        Parameters
        ----------
        body_velocities : FloatArray
            (k, 6) velocities (Ω, v), rad/s and m/s, body frame.
        dt_s : FloatArray
            (k,) how long each is held, seconds.

        Returns
        -------
        FloatArray
            (k + 1, 4, 4) Â before, between and after the k motions.

        """
        motions = se3.exp(body_velocities * dt_s[:, None])
        path = np.concatenate([self.A[None], motions])
        reach = 1
        while reach < len(path):  # log k products of stacks cost less than k of matrices
            path[reach:] = path[:-reach] @ path[reach:]
            reach *= 2
        return path

    def propagate(self, path: FloatArray) -> None:
        """Advance Â to the end of a ``path`` (k + 1, 4, 4)."""
        self.A = path[-1].copy()
        self.A[:3, :3] = so3.normalise(self.A[:3, :3])

    def set_landmark_velocities(self, indices: IntArray, velocities: FloatArray) -> None:
        """Let landmarks move from now on.

        Parameters
        ----------
        indices : IntArray
            (m,) which landmarks.
        velocities : FloatArray
            (m, 3) their velocities v_i (19), m/s, body frame at this instant.

        """
        self.u[indices] = se3.rotate(self.A, velocities)
        self.have_moved = self.have_moved or bool(velocities.any())

    def move_landmarks(self, duration_s: float) -> None:
        """Add R_Â v_i dt to â_i, where (27) has zero: here landmarks may have velocities (19)."""
        if self.have_moved:  # else this would cost O(n) at every step
            self.a += self.u * duration_s

    def correct(self, correction: Correction) -> None:
        """Move the state from the left by (D, d_i); see the module's text."""
        D, indices = correction.D, correction.indices
        self.A = D @ self.A
        self.a[indices] = self.a[indices] @ D[:3, :3].T + correction.d
        if correction.u is not None:
            self.u[indices] = self.u[indices] @ D[:3, :3].T + correction.u
            self.have_moved = True


def lyapunov(gain_k: FloatArray | float, r: FloatArray) -> float:
    """Return L = Σ k_i/2 |r_i|² (34) for gains k_i (m,) and residuals ``r`` (m, 3) in metres."""
    return float(0.5 * np.vdot(gain_k * r.T, r.T))


def lyapunov_rate(gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray) -> float:
    """Return dL/dt under the paper's innovation: −‖P(Σ k_i r_i ē_iᵀ)‖² − Σ l_i |r_i|² (35).

    Parameters
    ----------
    gain_k, gain_l : FloatArray
        (m,) gains k_i and l_i.
    e, r : FloatArray
        (m, 3) errors (29) and residuals, metres.

    """
    projection = se3.project(_outer_sum(gain_k, e, r))
    return float(-np.sum(projection**2) - np.sum(gain_l * np.sum(r * r, axis=-1)))


def paper_innovation(
    gain_k: FloatArray, gain_l: FloatArray, e: FloatArray, r: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the paper's innovation (Δ, δ_i) in continuous time, with the signs put right.

    As printed, (30) lacks a minus and (31) has one too many: with the printed signs L grows. The
    signs here follow from ė_i = Δ e_i + Δ â_i − δ_i, for which (35) holds.

    Parameters
    ----------
    gain_k, gain_l : FloatArray
        (m,) gains k_i and l_i.
    e, r : FloatArray
        (m, 3) errors (29) and residuals, metres.
    a : FloatArray
        (m, 3) â_i, metres.

    Returns
    -------
    Delta : FloatArray
        (4, 4) Δ ∈ se(3).
    delta : FloatArray
        (m, 3) δ_i, m/s.

    """
    Delta = -se3.project(_outer_sum(gain_k, e, r))  # (30)
    delta = a @ Delta[:3, :3].T + (gain_l / gain_k)[:, None] * r  # (31)
    return Delta, delta


def _outer_sum(k: FloatArray, e: FloatArray, r: FloatArray) -> FloatArray:
    """Return Σ k_i r_i ē_iᵀ (4, 4), with r_i a direction and ē_i = (e_i, 1) a point."""
    M = np.zeros((4, 4))
    M[:3, :3] = np.einsum('i,ij,ik->jk', k, r, e)
    M[:3, 3] = k @ r
    return M
