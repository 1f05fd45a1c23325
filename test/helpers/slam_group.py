"""The group SLAM_n(3), the spaces it acts on, its actions, and the lifted SLAM kinematics.

The paper writes A p̄ for points and A v⃗ for directions; here these are `se3.transform` and
`se3.rotate`. All functions take n = 0, 1 or many landmarks and any leading axes; metres, rad, s.
The package only uses `exp`, at each correction by Riccati gains that map. The rest is what the
paper states; tests hold :class:`slam_observer_ros.filter.observer.Observer` against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.filter.chart import slam_exp, SlamElement
from slam_observer_ros.lie import se3, so3

exp = slam_exp


@dataclass(frozen=True, slots=True, eq=False)
class TotalState:
    """Raw coordinates Ξ = (P, p_1, …, p_n) in the total space T_n(3), or a stack of them.

    P is the robot's pose, body → world, and p are the landmarks in the world frame.
    """

    P: FloatArray  # (…, 4, 4)
    p: FloatArray  # (…, n, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SlamVelocity:
    """Input u = (V, v_1, …, v_n) of the SLAM kinematics, in body coordinates (19).

    V is the twist (Ω, v) of the robot; v are velocities of the landmarks, zero in a static scene.
    """

    V: FloatArray  # (…, 6)
    v: FloatArray  # (…, n, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Tangent:
    """Time derivative of a `TotalState` or `SlamElement`: matrices Ṗ or Ȧ, vectors ṗ_i or ȧ_i."""

    pose_rate: FloatArray  # (…, 4, 4)
    point_rates: FloatArray  # (…, n, 3)


def identity(n: int) -> SlamElement:
    """Identity (I₄, 0, …, 0) of SLAM_n(3) (22)."""
    return SlamElement(np.eye(4), np.zeros((n, 3)))


def compose(X: SlamElement, Y: SlamElement) -> SlamElement:
    """Product (A, a_i) · (B, b_i) = (A B, a_i + R_A b_i) (22)."""
    return SlamElement(X.A @ Y.A, X.a + se3.rotate(X.A, Y.a))


def inverse(X: SlamElement) -> SlamElement:
    """Inverse (A, a_i)⁻¹ = (A⁻¹, −R_{A⁻¹} a_i) (22)."""
    A_inverse = se3.inverse(X.A)
    return SlamElement(A_inverse, -se3.rotate(A_inverse, X.a))


def alpha(S: FloatArray, Xi: TotalState) -> TotalState:
    """Change of reference frame α(S, (P, p_i)) = (S⁻¹ P, S⁻¹ p_i), S in SE(3) (11)."""
    S_inverse = se3.inverse(S)
    return TotalState(S_inverse @ Xi.P, se3.transform(S_inverse, Xi.p))


def output(Xi: TotalState) -> FloatArray:
    """Observations y_i = P⁻¹ p_i of the landmarks in the body frame (15)."""
    return se3.transform(se3.inverse(Xi.P), Xi.p)


def configuration(Xi: TotalState) -> TotalState:
    """Represent the class π(Ξ) = [P, p_i] of M_n(3) by (I, P⁻¹ p_i) = α(P, Ξ) (13), (14)."""
    return alpha(Xi.P, Xi)


def same_configuration(Xi: TotalState, other: TotalState, tolerance_m: float) -> bool:
    """Return whether two states, to ``tolerance_m``, differ by a change of frame only (13)."""
    difference = configuration(Xi).p - configuration(other).p
    return bool(np.all(np.abs(difference) <= tolerance_m))


def phi_total(X: SlamElement, Xi: TotalState) -> TotalState:
    """Right action Φ((A, a_i), (P, p_i)) = (P A, p_i + R_P a_i) on the total space, (24)."""
    return TotalState(Xi.P @ X.A, Xi.p + se3.rotate(Xi.P, X.a))


def phi(X: SlamElement, Xi: TotalState) -> TotalState:
    """Right action φ(X, [Ξ]) = [Φ(X, Ξ)] on configurations, as `configuration` gives them (23)."""
    return configuration(phi_total(X, Xi))


def psi(X: SlamElement, u: SlamVelocity) -> SlamVelocity:
    """Right action ψ((A, a_i), (V, v_i)) = (Ad_{A⁻¹} V, R_A⁻¹ (v_i + Ω × a_i)) on inputs (26).

    It is Ad_{X⁻¹} of SLAM_n(3) once inputs are read as elements of its Lie algebra.
    """
    A_inverse = se3.inverse(X.A)
    V = (se3.adjoint(A_inverse) @ u.V[..., :, None])[..., 0]
    turned = X.a @ so3.hat(u.V[..., :3]).swapaxes(-1, -2)
    return SlamVelocity(V, se3.rotate(A_inverse, u.v + turned))


def rho(X: SlamElement, y: FloatArray) -> FloatArray:
    """Right action ρ((A, a_i), y_i) = A⁻¹ (y_i + a_i) on outputs (..., n, 3) (Lemma 4.5)."""
    return se3.transform(se3.inverse(X.A), y + X.a)


def kinematics(Xi: TotalState, u: SlamVelocity) -> Tangent:
    """SLAM kinematics f: Ṗ = P V, ṗ_i = R_P v_i (20), (21)."""
    return Tangent(Xi.P @ se3.hat(u.V), se3.rotate(Xi.P, u.v))


def lift(X: SlamElement, u: SlamVelocity) -> Tangent:
    """Lifted kinematics on SLAM_n(3): Ȧ = A V, ȧ_i = R_A v_i (27).

    The paper prints the static scene, ȧ_i = 0. With landmark velocities this lift keeps
    φ(X(t), ξ°) = ξ(t): d/dt (p_i° + R_P° a_i) = R_P° R_A v_i = R_P v_i, as in (20).
    """
    return Tangent(X.A @ se3.hat(u.V), se3.rotate(X.A, u.v))
