"""Rotations R (…, 3, 3); rotation vectors φ (…, 3), rad; quaternions xyzw (…, 4), as ROS has them.

With K = φ_× and θ = |φ|, all maps are polynomials in K whose coefficients are

    a = sin θ / θ,    b = (1 − cos θ) / θ²,    c = (1 − a) / θ² = (θ − sin θ) / θ³.

Near zero, a and b are quotients without cancellation: they need a guard against 0/0, no series.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray

_HAT = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]],
    dtype=np.float64,
)
_IDENTITY = np.eye(3)
_THREE = 3.0 * _IDENTITY
_ZERO_GUARD = 1e-300  # added to θ²: any angle above 1e-142 rad keeps all its bits
ROUNDING = 1e-12  # how far RᵀR may be from identity after many products
QUATERNION_NORM_TOLERANCE = 0.1  # how far from 1 the norm of a rotation's quaternion may be


def hat(phi: FloatArray) -> FloatArray:
    """Return the skew matrix φ_× (…, 3, 3) with φ_× w = φ × w (7)."""
    # One small product with the basis of so(3) costs a third of six indexed assignments.
    K: FloatArray = phi.reshape(-1, 3).dot(_HAT)
    return K.reshape((*phi.shape[:-1], 3, 3))


def vee(K: FloatArray) -> FloatArray:
    """Return the vector of a skew matrix, the inverse of `hat`; reads (2, 1), (0, 2), (1, 0)."""
    return K[..., (2, 0, 1), (1, 2, 0)]


Scale: TypeAlias = FloatArray | float  # what scales a stack of matrices, or one


def coefficients(phi: FloatArray) -> tuple[Scale, Scale, Scale]:
    """Return θ² (≥ 1e-300, as it may divide), a and b, exact to rounding at any angle.

    Each is (…, 1, 1), to scale matrices; a number for a single vector (3,).
    """
    if phi.ndim == 1:  # as in each correction, at a third of the cost
        square = float(phi.dot(phi)) + _ZERO_GUARD
        half_angle = 0.5 * math.sqrt(square)
        ratio = math.sin(half_angle) / half_angle
        return square, ratio * math.cos(half_angle), 0.5 * ratio * ratio
    theta_squared = np.einsum('...i,...i->...', phi, phi)[..., None, None] + _ZERO_GUARD
    half = 0.5 * np.sqrt(theta_squared)
    half_sinc = np.sin(half) / half
    return theta_squared, half_sinc * np.cos(half), 0.5 * half_sinc * half_sinc


def exp(phi: FloatArray) -> FloatArray:
    """Return the rotation R = I + a K + b K² of a rotation vector (Rodrigues)."""
    K = hat(phi)
    _, a, b = coefficients(phi)
    return _IDENTITY + a * K + b * _square(K)


def log(R: FloatArray) -> FloatArray:
    """Return the rotation vector of R, |φ| ≤ π, the inverse of `exp`; at π either sign is right.

    It goes through the quaternion (v, w), φ = 2 atan2(|v|, w) v / |v|, which is well conditioned
    from the identity to half a turn, where the trace and the skew part of R are not.
    """
    quaternion = to_quaternion(R)
    v, w = quaternion[..., :3], quaternion[..., 3:]
    sine: FloatArray = np.sqrt(np.sum(v * v, axis=-1, keepdims=True) + _ZERO_GUARD)
    return (2.0 * np.arctan2(sine, w) / sine) * v


def left_jacobian(phi: FloatArray) -> FloatArray:
    """Return J = ∫₀¹ exp(s φ) ds = I + b K + c K²; exp(φ + δ) ≈ exp(J δ) exp(φ)."""
    K = hat(phi)
    theta_squared, a, b = coefficients(phi)
    # 1 − a cancels near zero, but K² = O(θ²) takes the error back to rounding.
    c = (1.0 - a) / theta_squared
    return _IDENTITY + b * K + c * _square(K)


def left_jacobian_inverse(phi: FloatArray) -> FloatArray:
    """Return J⁻¹ = I − K/2 + (1 − a / 2b) K² / θ² of `left_jacobian`, for |φ| < 2π."""
    K = hat(phi)
    theta_squared, a, b = coefficients(phi)
    return _IDENTITY - 0.5 * K + ((1.0 - 0.5 * a / b) / theta_squared) * (K @ K)


def from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Return R = I + 2 w v_× + 2 v_×² of a quaternion of any length but zero."""
    unit: FloatArray = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    K = hat(unit[..., :3])
    return _IDENTITY + 2.0 * unit[..., 3:, None] * K + 2.0 * (K @ K)


def to_quaternion(R: FloatArray) -> FloatArray:
    """Return the unit quaternion q = (v, w), w ≥ 0, of a rotation.

    4 q qᵀ = [[R + Rᵀ + (1 − tr R) I, (R − Rᵀ)^∨], [·, 1 + tr R]]. Each row is a multiple of q, and
    the one with the largest diagonal entry (at least 1) is well conditioned at any angle.
    """
    if R.ndim == 2:  # as at each pose that goes out, at a sixth of the cost
        return _to_one_quaternion(R)
    R_transposed = R.swapaxes(-1, -2)
    trace = np.trace(R, axis1=-2, axis2=-1)[..., None]
    products = np.empty((*R.shape[:-2], 4, 4))
    products[..., :3, :3] = R + R_transposed + (1.0 - trace[..., None]) * _IDENTITY
    products[..., 3, :3] = products[..., :3, 3] = vee(R - R_transposed)
    products[..., 3, 3:] = 1.0 + trace
    rows = products.reshape(-1, 4, 4)
    largest = np.argmax(np.diagonal(rows, axis1=1, axis2=2), axis=1)
    q: FloatArray = rows[np.arange(len(rows)), largest].reshape((*R.shape[:-2], 4))
    length: FloatArray = np.linalg.norm(q, axis=-1, keepdims=True)
    return q / np.copysign(length, q[..., 3:])


def _to_one_quaternion(R: FloatArray) -> FloatArray:
    """As :func:`to_quaternion`, bit for bit, of one rotation (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    rest, x, y, z = 1.0 - trace, h - f, c - g, d - b
    rows = (
        (a + a + rest, b + d, c + g, x),
        (d + b, e + e + rest, f + h, y),
        (g + c, h + f, i + i + rest, z),
        (x, y, z, 1.0 + trace),
    )
    q = rows[max(range(4), key=lambda row: rows[row][row])]
    length = math.copysign(math.sqrt(sum(number * number for number in q)), q[3])
    return np.array([number / length for number in q])


def normalise(R: FloatArray) -> FloatArray:
    """Take the drift of rounding off a rotation: R (3 I − RᵀR) / 2.

    One Newton step towards the polar factor: an orthogonality error ε becomes about ε². For
    matrices that come from repeated products, not for arbitrary ones.
    """
    if R.ndim == 2:  # as at each step, at half the cost
        one: FloatArray = (0.5 * R).dot(_THREE - R.T.dot(R))
        return one
    normalised: FloatArray = 0.5 * R @ (_THREE - R.swapaxes(-1, -2) @ R)
    return normalised


def exact(R: FloatArray) -> FloatArray:
    """Return rotations (…, 3, 3) that are off by a thousandth at most as rotations.

    What is off by no more than products round, or zero, remains as it is, bit for bit.
    """
    off = np.abs(R.swapaxes(-1, -2) @ R - _IDENTITY).max(axis=(-2, -1), keepdims=True)
    near = normalise(normalise(normalise(R)))
    return np.where(off > ROUNDING, near, R)


def _square(K: FloatArray) -> FloatArray:
    """Return K K of matrices (…, 3, 3), of one at a third of what `@` costs."""
    return K.dot(K) if K.ndim == 2 else K @ K
