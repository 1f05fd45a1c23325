"""The group of robot and tags: SLAM_n(3) × SO(3)ⁿ, for landmarks that have an orientation.

A tag has a pose T_i = (R_i, p_i), and is seen with one. SLAM_n(3) moves robot and positions, as
ever; the rotations B_i turn the tags about themselves. Both act from the right, so a change of the
world's frame, which acts from the left, commutes with them, and all lemmas of
:mod:`.slam_group` carry over. Functions take n = 0, 1 or many tags and any leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import slam_group
from slam_group import TotalState

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.filter.chart import SlamElement
from slam_observer_ros.lie import se3, so3


@dataclass(frozen=True, slots=True, eq=False)
class TagElement:
    """Element (X, B_1, …, B_n), or a stack of them."""

    X: SlamElement
    B: FloatArray  # (…, n, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class TagState:
    """Raw coordinates of robot and tags in the world, or a stack of them."""

    Xi: TotalState
    R: FloatArray  # (…, n, 3, 3) orientations, tag to world


@dataclass(frozen=True, slots=True, eq=False)
class TagOutput:
    """Tags as they are seen, in the body frame."""

    y: FloatArray  # (…, n, 3) positions P⁻¹ p_i
    Z: FloatArray  # (…, n, 3, 3) orientations R_Pᵀ R_i


def compose(X: TagElement, Y: TagElement) -> TagElement:
    """Product, part by part."""
    return TagElement(slam_group.compose(X.X, Y.X), X.B @ Y.B)


def inverse(X: TagElement) -> TagElement:
    """Inverse, part by part."""
    return TagElement(slam_group.inverse(X.X), X.B.swapaxes(-1, -2))


def exp(Delta: FloatArray, d: FloatArray, omega: FloatArray) -> TagElement:
    """Group exponential of (Δ, d_i, ω_i), with ω_i (…, n, 3) of the tags' rotations."""
    return TagElement(slam_group.exp(Delta, d), so3.exp(omega))


def alpha(S: FloatArray, state: TagState) -> TagState:
    """Change of reference frame (S⁻¹ P, S⁻¹ p_i, R_Sᵀ R_i), S in SE(3) (11)."""
    R_S_transposed = S[..., None, :3, :3].swapaxes(-1, -2)
    return TagState(slam_group.alpha(S, state.Xi), R_S_transposed @ state.R)


def phi_total(X: TagElement, state: TagState) -> TagState:
    """Right action (P A, p_i + R_P a_i, R_i B_i) (24)."""
    return TagState(slam_group.phi_total(X.X, state.Xi), state.R @ X.B)


def output(state: TagState) -> TagOutput:
    """Observations P⁻¹ T_i = (P⁻¹ p_i, R_Pᵀ R_i) (15)."""
    R_P_transposed = state.Xi.P[..., None, :3, :3].swapaxes(-1, -2)
    return TagOutput(slam_group.output(state.Xi), R_P_transposed @ state.R)


def rho(X: TagElement, seen: TagOutput) -> TagOutput:
    """Right action (A⁻¹ (y_i + a_i), R_Aᵀ Z_i B_i) on observations, as of Lemma 4.5."""
    R_A_transposed = se3.inverse(X.X.A)[..., None, :3, :3]
    return TagOutput(slam_group.rho(X.X, seen.y), R_A_transposed @ seen.Z @ X.B)
