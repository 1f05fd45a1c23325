"""Poses T (…, 4, 4), homogeneous matrices (3); twists ξ = (Ω, v) (…, 6), angular part first (9).

A twist is times a time: rad and m. Points are aligned in closed form (Umeyama 1991, no scale).
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import so3

_HAT = np.array(
    [
        [0, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 0, 0],
        [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0],
    ],
    dtype=np.float64,
)
_IDENTITY = np.eye(4)


def pose(R: FloatArray, x: FloatArray) -> FloatArray:
    """Return the pose [[R, x], [0, 1]] (3) of a rotation R and a translation x (…, 3)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = x
    T[..., 3, 3] = 1.0
    return T


def from_rpy(values: tuple[float, ...]) -> FloatArray:
    """Return the pose of x y z and roll pitch yaw about fixed axes, as URDF has them."""
    roll, pitch, yaw = np.diag(values[3:])
    return pose(so3.exp(yaw) @ so3.exp(pitch) @ so3.exp(roll), np.array(values[:3]))


def inverse(T: FloatArray) -> FloatArray:
    """Return T⁻¹ = [[Rᵀ, −Rᵀ x], [0, 1]]."""
    R_transposed, inverted = T[..., :3, :3].swapaxes(-1, -2), np.zeros(T.shape)
    inverted[..., :3, :3] = R_transposed
    inverted[..., :3, 3] = -(R_transposed @ T[..., :3, 3:])[..., 0]
    inverted[..., 3, 3] = 1.0
    return inverted


def between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return start⁻¹ end (4, 4) of two poses (4, 4): a third of what :func:`inverse` costs."""
    motion: FloatArray = end.copy()
    motion[:3, 3] -= start[:3, 3]
    motion[:3] = start[:3, :3].T.dot(motion[:3])
    return motion


def transform(T: FloatArray, points: FloatArray) -> FloatArray:
    """Move points (…, n, 3): R p + x, the homogeneous product T p̄."""
    moved = rotate(T, points)
    # In place: a second array of 10 000 points or more costs several times the sum itself.
    moved += T[..., None, :3, 3]
    return moved


def rotate(T: FloatArray, directions: FloatArray) -> FloatArray:
    """Turn directions (…, n, 3): R v, the product T v⃗ with a zero in the fourth entry (6)."""
    R_transposed = T[..., :3, :3].swapaxes(-1, -2)
    # A product of two matrices costs two thirds of one of stacks.
    is_one = T.ndim == directions.ndim == 2
    rotated: FloatArray = directions.dot(R_transposed) if is_one else directions @ R_transposed
    return rotated


def hat(xi: FloatArray) -> FloatArray:
    """Return the matrix (Ω, v)_∧ = [[Ω_×, v], [0, 0]] (…, 4, 4) of a twist (9)."""
    V: FloatArray = xi.reshape(-1, 6).dot(_HAT)
    return V.reshape((*xi.shape[:-1], 4, 4))


def vee(V: FloatArray) -> FloatArray:
    """Return the twist of a matrix of se(3): the inverse of `hat`."""
    return np.concatenate([so3.vee(V), V[..., :3, 3]], axis=-1)


def flatten(T: FloatArray) -> FloatArray:
    """Return the pose (4, 4) at the same x, y and yaw, with no height, roll and pitch."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    return pose(so3.exp(np.array([0.0, 0.0, yaw])), T[:3, 3] * np.array([1.0, 1.0, 0.0]))


def project(M: FloatArray) -> FloatArray:
    """Project (…, 4, 4) orthogonally onto se(3): [[(M₁ − M₁ᵀ) / 2, m₂], [0, 0]] (10)."""
    V = np.zeros_like(M)
    V[..., :3, :3] = 0.5 * (M[..., :3, :3] - M[..., :3, :3].swapaxes(-1, -2))
    V[..., :3, 3] = M[..., :3, 3]
    return V


def exp(xi: FloatArray) -> FloatArray:
    """Return the pose I + V + b V² + c V³ of V = (Ω, v)_∧, with b and c as in `so3`."""
    V = hat(xi)
    theta_squared, a, b = so3.coefficients(xi[..., :3])
    # 1 − a cancels near zero, but V³ = O(θ²) takes the error back to rounding.
    c = (1.0 - a) / theta_squared
    V_squared = V @ V
    return _IDENTITY + V + b * V_squared + c * (V_squared @ V)


def log(T: FloatArray) -> FloatArray:
    """Return the twist (φ, J(φ)⁻¹ x) of a pose, |φ| ≤ π: the inverse of `exp`."""
    phi = so3.log(T[..., :3, :3])
    v = so3.left_jacobian_inverse(phi) @ T[..., :3, 3:]
    return np.concatenate([phi, v[..., 0]], axis=-1)


def adjoint(T: FloatArray) -> FloatArray:
    """Return the matrix (…, 6, 6) of Ad_T V = T V T⁻¹ on twists: [[R, 0], [x_× R, R]]."""
    R = T[..., :3, :3]
    return _lower_triangular(R, so3.hat(T[..., :3, 3]) @ R)


def left_jacobian(xi: FloatArray) -> FloatArray:
    """Return [[J, 0], [Q, J]] (…, 6, 6) with exp(ξ + δ) = exp(J(ξ) δ) exp(ξ) to first order.

    Q is the derivative of J(φ) = I + b K + c K² of SO(3) along v: twists are dual vectors φ + ε v.
    """
    return _lower_triangular(so3.left_jacobian(xi[..., :3]), _jacobian_coupling(xi))


def left_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Return [[J⁻¹, 0], [−J⁻¹ Q J⁻¹, J⁻¹]], the inverse of `left_jacobian` for |Ω| < 2π."""
    J_inverse = so3.left_jacobian_inverse(xi[..., :3])
    return _lower_triangular(J_inverse, -J_inverse @ _jacobian_coupling(xi) @ J_inverse)


# Where θ² < 0.1 the series of c below is used: its first missing term is θ¹² / 15! < 1e-18.
_SERIES_BELOW = 0.1
_C_SERIES = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)


def _jacobian_coupling(xi: FloatArray) -> FloatArray:
    """Q = b U + c (K U + U K) + (φ·v) (b′ K + c′ K²), U = v_×, primes for d/d(θ²/2)."""
    phi, v = xi[..., :3], xi[..., 3:]
    K, U = so3.hat(phi), so3.hat(v)
    theta_squared, a, b = so3.coefficients(phi)
    # Unlike in exp, the rounding error of 1 − a is not multiplied by θ² here.
    small = theta_squared < _SERIES_BELOW
    series = np.polynomial.polynomial.polyval(theta_squared, _C_SERIES)
    c = np.where(small, series, (1.0 - a) / theta_squared)
    b_prime = (a - 2.0 * b) / theta_squared
    c_prime = (b - 3.0 * c) / theta_squared
    along = phi[..., None, :] @ v[..., :, None]
    return b * U + c * (K @ U + U @ K) + along * (b_prime * K + c_prime * (K @ K))


def _lower_triangular(diagonal: FloatArray, lower: FloatArray) -> FloatArray:
    """Block matrix [[D, 0], [L, D]] of shape (..., 6, 6)."""
    matrix = np.zeros((*diagonal.shape[:-2], 6, 6))
    matrix[..., :3, :3] = diagonal
    matrix[..., 3:, 3:] = diagonal
    matrix[..., 3:, :3] = lower
    return matrix


def path(start: FloatArray, twists: FloatArray) -> FloatArray:
    """Return A, A exp(ξ_1), A exp(ξ_1) exp(ξ_2), … (k + 1, 4, 4) from A = ``start`` on, exactly.

    The ``twists`` ξ_i = V_i dt_i (k, 6) are motions along held velocities, body frame.
    """
    poses = np.concatenate([start[None], exp(twists)])
    reach = 1
    while reach < len(poses):  # log k products of stacks cost less than k of matrices
        poses[reach:] = poses[:-reach] @ poses[reach:]
        reach *= 2
    return poses


def at_poses(pieces: FloatArray) -> FloatArray:
    """Return what belongs to k pieces of a path (k, …) as shares (k + 1, …) of its poses.

    Half at either end: Σ Ad_A (share) over poses is that over pieces by the trapezoidal rule.
    """
    shares, half = np.zeros((len(pieces) + 1, *pieces.shape[1:])), 0.5 * pieces
    shares[:-1] = half
    shares[1:] += half
    return shares


def interpolate(start: FloatArray, end: FloatArray, share: FloatArray | float) -> FloatArray:
    """Return poses at a ``share`` (…) of the way between two: in a line, and about one axis."""
    R, share = start[..., :3, :3], np.asarray(share)[..., None]
    turn = so3.log(R.swapaxes(-1, -2) @ end[..., :3, :3])
    shift = end[..., :3, 3] - start[..., :3, 3]
    return pose(R @ so3.exp(share * turn), start[..., :3, 3] + share * shift)


# Singular values (m²) below this part of the largest carry no direction, only rounding.
_RANK_TOLERANCE = 1e-12
_ROUNDING = 1e-14  # offsets from the mean below this part of the largest coordinate are rounding


def rigid_alignment(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """Return T (4, 4) with target ≈ T source in least squares, for points (n, 3), n ≥ 1, metres.

    A proper rotation even where a reflection would fit better. What the points leave open stays
    as it is: of all best rotations the one nearest to the identity is returned, so collinear
    points cause no roll about their line, and one point is only shifted. Sets that are both flat
    in z turn about the vertical only, as turned over they would be their own mirror images.
    ``weights`` (n,) > 0 say how much each squared distance counts; all the same by default.
    """
    weights = np.ones(len(source)) if weights is None else weights
    source_centre = np.average(source, axis=0, weights=weights)
    target_centre = np.average(target, axis=0, weights=weights)
    offsets = _offsets(source, source_centre)
    correlation = (weights[:, None] * _offsets(target, target_centre)).T @ offsets
    R = _closest_rotation(correlation)
    return pose(R, target_centre - R @ source_centre)


def _offsets(points: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the offsets from the mean; what is only rounding becomes zero, lest it turn R."""
    offsets = points - centre
    return np.where(np.abs(offsets) > _ROUNDING * np.abs(points).max(), offsets, 0.0)


def _closest_rotation(correlation: FloatArray) -> FloatArray:
    """Maximise tr(Rᵀ C) over rotations R; among equals, take the one nearest to the identity."""
    if not (correlation[2].any() or correlation[:, 2].any()):  # both sets are flat in z
        rotation = np.eye(3)
        rotation[:2, :2] = _procrustes(correlation[:2, :2], handedness=1.0)
        return rotation
    U, sizes, Vt = np.linalg.svd(correlation)
    rank = int(np.sum(sizes > _RANK_TOLERANCE * sizes[0]))
    # R = U diag(1, Q) Vᵀ is optimal for each orthogonal Q that makes det R = 1: one sign where
    # the points span a plane or more, a whole circle of choices about a line.
    fixed, middle = min(rank, 2), np.eye(3)
    handedness = np.linalg.det(U) * np.linalg.det(Vt)
    middle[fixed:, fixed:] = _procrustes((Vt @ U)[fixed:, fixed:].T, handedness)
    return np.asarray(U @ middle @ Vt)


def _procrustes(matrix: FloatArray, handedness: float) -> FloatArray:
    """Maximise tr(Qᵀ M) over orthogonal Q whose determinant has the sign of ``handedness``."""
    U, _, Vt = np.linalg.svd(matrix)
    U[:, -1] *= np.sign(handedness * np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(U @ Vt)
