"""The coordinates of all errors: what x is, where it is in P, and how motions and views act on it.

    x = (ε, c̃, then of each landmark ξ_i, and ω_i or ũ_i where these are estimated)

    Â = exp(ε) A,     ξ_i = ã_i + [ŷ_i]× ε_Ω,     B̂_i = exp(ω_i) B_i,     ũ_i = û_i − R_Ã u_i

Here ã_i is the error of the estimate ŷ_i = y_i° + â_i in the reference frame, c̃ the error of the
calibration; estimated axes are p of ε, k of a point, q of a turn. A point or tag that moves with
the pose has ξ_i = ε_v and ω_i = ε_Ω, so that observations have the residuals

    r_i = ε_v − ξ_i + R̂ D_i c̃,        φ_i = ε_Ω − ω_i + R̂ D c̃

whatever the map is (A. Barrau and S. Bonnabel, *The invariant extended Kalman filter as a stable
observer*, 2017). Other coordinates, or one more thing to estimate, are a change of this module;
step.py and _core.c spell the step out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes

_IDENTITY = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class SlamElement:
    """Element X = (A, a_1, …, a_n) of SLAM_n(3), or a stack of them: a pose and translations."""

    A: FloatArray  # (…, 4, 4)
    a: FloatArray  # (…, n, 3)


class Chart:
    """Columns of P: ``robot`` = p + c of ε and c̃, then from ``first`` on ``stride`` a landmark.

    ``turn`` = q of these are of ω_i, 0 of ``axes`` without turns, ``velocity`` = k of ũ_i where
    velocities are estimated; else 0. Before ``first`` there may be ``postponed`` ones, of what no
    motion and no view acts on: see :class:`.CompressedCovariance`.
    """

    def __init__(
        self, axes: EstimatedAxes, calibrated: int, velocity: int = 0, postponed: int = 0
    ) -> None:
        self.axes, self.turn, self.velocity = axes, axes.turn, velocity
        self.robot = axes.p + calibrated
        self.first = self.robot + postponed
        self.stride = axes.point + axes.turn + velocity
        self._points = self.first + np.arange(axes.point)
        self._turns = self.first + axes.point + np.arange(axes.turn)
        self._velocities = self.first + axes.point + axes.turn + np.arange(velocity)
        self._turned = np.eye(axes.turn, axes.p)

    def with_calibration(self, count: int) -> Chart:
        """Return the chart with so many more entries in c̃."""
        calibrated = self.robot - self.axes.p + count
        return Chart(self.axes, calibrated, self.velocity)

    def with_postponed(self, count: int) -> Chart:
        """Return the chart with so many postponed columns."""
        calibrated = self.robot - self.axes.p
        return Chart(self.axes, calibrated, self.velocity, count)

    # Where in x

    def points(self, rows: IntArray) -> IntArray:
        """Return the columns (m k,) of ξ_i of landmarks ``rows`` (m,)."""
        return (self._points + self.stride * rows[:, None]).ravel()

    def turns(self, rows: IntArray) -> IntArray:
        """Return those (m q,) of ω_i."""
        return (self._turns + self.stride * rows[:, None]).ravel()

    def velocities(self, rows: IntArray) -> IntArray:
        """Return those (m k,) of ũ_i."""
        return (self._velocities + self.stride * rows[:, None]).ravel()

    def of_landmarks(self, rows: IntArray) -> IntArray:
        """Return all columns of landmarks."""
        columns = self.first + np.arange(self.stride)
        return (columns + self.stride * rows[:, None]).ravel()

    # Observations: r_i = C_i (ε, c̃) − ξ_i, and φ_i = C (ε, c̃) − ω_i

    def output(self, shifts: FloatArray, D: FloatArray | None) -> FloatArray:
        """Return C_i (m, k, p), or (m, k, p + c), of points at ``shifts`` (m, 3) from ŷ_i.

        ``D`` is R̂ D_i (m, 3, c), None where no sensor is calibrated. At ŷ_i itself C_i is [0, I].
        """
        C = self.axes.output_matrix(shifts)
        return C if D is None else np.concatenate([C, D[:, : self.axes.point]], axis=2)

    def turn_output(self, D: FloatArray | None) -> FloatArray:
        """Return C (q, p), or (q, p + c) with R̂ D (3, c)."""
        return self._turned if D is None else np.hstack([self._turned, D[self.axes.turned]])

    def still(self, points: FloatArray) -> FloatArray:
        """Return [[y_i]×, 0] (m, k, p): ξ_i of landmarks y_i whose ã_i is zero."""
        return -self.axes.turn_matrix(points)

    def all_still(self, points: FloatArray) -> FloatArray:
        """Return T (n stride, p) of x_i = T ε for n landmarks, but for their velocities.

        A motion of the robot alone does that: it changes neither ã_i nor a tag.
        """
        still = self.still(points)
        if self.stride == self.axes.point:
            return still.reshape(-1, self.axes.p)
        T = np.zeros((len(points), self.stride, self.axes.p))
        T[:, : self.axes.point] = still
        return T.reshape(-1, self.axes.p)

    # The frame

    def gauge(self, n: int) -> FloatArray:
        """Return G (N, p): how x changes when all, with n landmarks, is moved by exp(γ)."""
        rows, p = np.arange(n), self.axes.p
        G = np.zeros((self.first + n * self.stride, p))
        G[:p] = np.eye(p)
        G[self.points(rows)] = self.output(np.zeros((n, 3)), None).reshape(-1, p)
        G[self.turns(rows)] = np.tile(self._turned, (n, 1))
        return G

    def moved(self, points: FloatArray) -> FloatArray:
        """Return J_i = [−[y_i]×, I] (m, k, p): how exp(γ) moves points y_i (m, 3)."""
        return self.axes.output_matrix(points)

    def at_rest(self, n: int, rows: IntArray, points: FloatArray) -> FloatArray:
        """Return G (N, p) likewise if landmarks ``rows`` at ``points`` (m, 3) are not moved."""
        G = np.zeros((self.first + n * self.stride, self.axes.p))
        G[self.points(rows)] = self.still(points).reshape(-1, self.axes.p)
        return G

    def difference(
        self,
        n: int,
        rows: IntArray,
        others: IntArray,
        points: FloatArray,
        other_points: FloatArray,
    ) -> FloatArray:
        """Return H (m k, N) of ã_i − ã_j of landmarks at two points (m, 3)."""
        H = np.zeros((len(rows) * self.axes.point, self.first + n * self.stride))
        each = np.arange(len(H))
        H[each, self.points(rows)], H[each, self.points(others)] = 1.0, -1.0
        H[:, : self.axes.p] = self.still(other_points - points).reshape(-1, self.axes.p)
        return H

    # Coordinates and states

    def of_positions(self, P: FloatArray, points: FloatArray) -> FloatArray:
        """Return the covariance with ã_i in place of ξ_i, for estimates ``points`` (n, 3)."""
        return sheared(P, self.first, -self.all_still(points))

    def from_positions(self, P: FloatArray, points: FloatArray) -> FloatArray:
        """Return P of what :meth:`of_positions` returns."""
        return sheared(P, self.first, self.all_still(points))

    def exp(self, x: FloatArray) -> SlamElement:
        """Return the motion by x: turns ŷ_i by ε_Ω, and shifts it by J(ε_Ω) ξ_i."""
        axes, k, p = self.axes, self.axes.point, self.axes.p
        xi = x[self.first :].reshape(-1, self.stride)[:, :k]
        return slam_exp(axes.full_pose(x[:p]), axes.full_points(xi))


def sheared(P: FloatArray, first: int, L: FloatArray) -> FloatArray:
    """Return the covariance of x whose entries from ``first`` on have grown by L ε, L (…, p)."""
    p = L.shape[1]
    result: FloatArray = P.copy()
    half = L @ P[:p]
    half[:, first:] += 0.5 * half[:, :p] @ L.T
    result[first:] += half
    result[:, first:] += half.T  # its mirror image, so that P stays symmetric
    return result


def slam_exp(Delta: FloatArray, d: FloatArray) -> SlamElement:
    """Exponential of SLAM_n(3): (exp Δ, J(Ω_Δ) d_i), with the left Jacobian J of SO(3).

    With held body velocity and landmark velocities, X · exp(V dt, v dt) solves the
    lifted kinematics exactly over dt.
    """
    phi, v = Delta[..., :3], Delta[..., 3:]
    K, J = so3.hat(phi), so3.left_jacobian(phi)
    # exp φ = I + K J, as J is the integral of exp(s φ).
    if Delta.ndim == 1:  # as at each correction, at half the cost
        return SlamElement(se3.pose(_IDENTITY + K.dot(J), J.dot(v)), d.dot(J.T))
    R = _IDENTITY + K @ J
    return SlamElement(se3.pose(R, (J @ v[..., None])[..., 0]), d @ J.swapaxes(-1, -2))
