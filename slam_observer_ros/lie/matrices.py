"""Small matrices: a filter handles several at each observation."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from scipy.linalg.lapack import dgesv, dposv, dpotrf, dpotri

from slam_observer_ros.common.types import BoolArray, FloatArray

_TINY, _EPSILON = np.finfo(np.float64).tiny, np.finfo(np.float64).eps
LARGE = 500  # equations whose solution takes longer than NumPy's overhead
VERY_LARGE = 1500  # equations for which SciPy would keep other threads waiting

# Standard deviation (m, rad, m/s, rad/s) beyond which a message only says 'unknown'. The largest
# number there is, which drivers write for it, can't be turned without overflow.
MAX_DEVIATION = 1e3
LEAST_DEVIATION = 1e-4  # entries of smaller ones (m, rad, m/s, rad/s) are judged beside this one
LEAST_SHARE = 1e-4  # of the largest one: what is below is lost in rounding where both turn
COVARIANCE_ROUNDING = 1e-6  # by how much correlations may be off, or have a negative eigenvalue
LOST = 1e-7  # share of a variance below which a difference of two has lost half of its 16 digits


def transpose(M: FloatArray) -> FloatArray:
    """Transpose each matrix of a stack (…, m, n)."""
    transposed: FloatArray = M.swapaxes(-1, -2)
    return transposed


def symmetric(P: FloatArray) -> FloatArray:
    """Return P (…, q, q) without the skew part that rounding has left in it."""
    return 0.5 * (P + transpose(P))


def solve(S: FloatArray, right: FloatArray) -> FloatArray:
    """Return S⁻¹ b for S (q, q), b (q, …), at half of numpy's cost; LinAlgError if singular."""
    if not right.size:  # which SciPy does not take
        return right
    if len(S) > LARGE:  # with SciPy no other thread would get a word in for seconds
        return np.asarray(np.linalg.solve(S, right), dtype=np.float64)
    _, _, solution, is_singular = dgesv(S, right)
    if is_singular:
        raise np.linalg.LinAlgError('Singular matrix')
    return np.asarray(solution, dtype=np.float64)


def solve_symmetric(S: FloatArray, right: FloatArray) -> FloatArray:
    """Return S⁻¹ b (…, q, k) or (q,), of S (…, q, q) that is positive but for rounding."""
    try:
        return np.asarray(np.linalg.solve(S, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.solve(definite(S), right), dtype=np.float64)


def solve_definite(S: FloatArray, right: FloatArray) -> FloatArray:
    """Return S⁻¹ b for a symmetric, positive definite S (q, q) and b (q, …)."""
    if right.size and len(S) <= VERY_LARGE:
        _, solution, is_indefinite = dposv(S, right)
        if not is_indefinite:
            return np.asarray(solution, dtype=np.float64)
    try:
        return solve(S, right)  # what rounding has made indefinite, too
    except np.linalg.LinAlgError:
        return solve(definite(S), right)


def definite_inverse(S: FloatArray) -> FloatArray:
    """Return S⁻¹ of a symmetric, positive definite S (q, q), at half of what `inv` takes."""
    if 0 < len(S) <= VERY_LARGE:
        L, is_indefinite = dpotrf(S, lower=1)
        if not is_indefinite:
            return inverse_by_factor(L)
    try:
        return np.asarray(np.linalg.inv(S), dtype=np.float64)  # rounding has made it indefinite
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.inv(definite(S)), dtype=np.float64)


def inverse_by_factor(L: FloatArray) -> FloatArray:
    """Return (L Lᵀ)⁻¹ of a lower triangular L (q, q)."""
    if not L.size:  # which LAPACK complains of, on the terminal
        return L
    half, _ = dpotri(L, lower=1)
    whole: FloatArray = np.tril(half)
    whole += np.tril(whole, -1).T
    return whole


def cholesky(S: FloatArray) -> FloatArray:
    """Return L (…, q, q) with L Lᵀ = S, or :func:`definite` in its place."""
    try:
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.cholesky(definite(S)), dtype=np.float64)


def definite(S: FloatArray) -> FloatArray:
    """Return S (…, q, q), which rounding has made indefinite, plus no more than it takes.

    Where some variances are 10¹⁶ times as large as others, of the small ones nothing is left.
    """
    entries = np.abs(S).max(axis=(-2, -1), keepdims=True, initial=_TINY)
    unit = S.shape[-1] * entries * np.eye(S.shape[-1])
    for share in 10.0 ** np.arange(-16, 0):
        with suppress(np.linalg.LinAlgError):
            np.linalg.cholesky(S + share * unit)
            return np.asarray(S + share * unit)
    return np.asarray(S + 2.0 * unit)  # whatever is in S


def kalman_update(P: FloatArray, CP: FloatArray, S: FloatArray) -> FloatArray:
    """Kalman update of P, in place, in Joseph's form; return the gain K = P Cᵀ S⁻¹.

    It is (I − K C) P (I − K C)ᵀ + K R Kᵀ, S = C P Cᵀ + R: P is positive but for rounding.
    """
    try:
        K: FloatArray = solve(S, CP).T
    except np.linalg.LinAlgError:
        K = solve(definite(S), CP).T
    half = K @ (0.5 * S @ K.T - CP)
    P += half + half.T
    return K


def loses_digits(variances: FloatArray, W: FloatArray, L: FloatArray) -> bool:
    """Return whether P − Wᵀ W has lost the digits that the rest of it is made of.

    ``variances`` (N,) are P's, W (M, N) is L⁻¹ H P, and L (M, M) the factor of S. P − Wᵀ W
    leaves less than LOST of a variance, or a pivot of S less than LOST of the entry it began with.
    """
    left = variances - np.einsum('ij,ij->j', W, W)
    if (left < LOST * variances).any():
        return True
    rows = np.tril(L)
    return bool((L.diagonal() ** 2 < LOST * np.einsum('ij,ij->i', rows, rows)).any())


def lifted(P: FloatArray, before: FloatArray) -> FloatArray:
    """Return P (n, n), whose variances were ``before`` (n,), as far from singular as rounding.

    What a correction has left is known no better than the rounding of what there was before. Of
    its correlations :func:`definite` keeps all that it can.
    """
    least = len(P) * np.finfo(np.float64).eps
    deviations = np.sqrt(np.maximum(P.diagonal(), np.maximum(least * before, _TINY)))
    scales = deviations[:, None] * deviations
    correlations = np.clip(symmetric(P) / scales, -1.0, 1.0)
    np.fill_diagonal(correlations, 1.0)
    return np.asarray(scales * definite(correlations))


def mended(covariances: FloatArray) -> FloatArray:
    """Return covariances (…, d, d) that rounding has left asymmetric, or negative somewhere."""
    P = symmetric(covariances)
    least = np.finfo(np.float64).eps * np.trace(P, axis1=-2, axis2=-1)[..., None, None]
    with suppress(np.linalg.LinAlgError):  # nearly always, at a tenth of the cost
        np.linalg.cholesky(P + np.maximum(least, _TINY) * np.eye(P.shape[-1]))
        return P
    variances, U = np.linalg.eigh(P)
    return symmetric((U * np.maximum(variances, 0.0)[..., None, :]) @ transpose(U))


def mahalanobis(r: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return √(r_iᵀ Σ_i⁻¹ r_i) (m,) of residuals (m, k) with covariances (m, k, k)."""
    whitened = solve_symmetric(covariances, r[:, :, None])
    squared = np.einsum('ij,ij->i', r, whitened[:, :, 0])
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))  # < 0 where rounding has made them so


def squares_and_log_dets(S: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rᵀ S⁻¹ r (…,) of r (…, k), and ln |S| (…,), of small S (…, k, k), at once.

    By elimination: of few matrices LAPACK's overhead is most of what they cost.
    """
    k = S.shape[-1]
    lower = [[S[..., i, j] for j in range(i + 1)] for i in range(k)]
    left = [r[..., i] for i in range(k)]
    squares, product = left[0] * left[0] / lower[0][0], lower[0][0]
    for c in range(1, k):
        for i in range(c, k):
            share = lower[i][c - 1] / lower[c - 1][c - 1]
            left[i] = left[i] - share * left[c - 1]
            for j in range(c, i + 1):
                lower[i][j] = lower[i][j] - share * lower[j][c - 1]
        # Rounding may have made it negative.
        lower[c][c] = pivot = np.maximum(lower[c][c], _EPSILON * S[..., c, c])
        squares, product = squares + left[c] * left[c] / pivot, product * pivot
    return squares, np.log(product)


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return the block-diagonal matrix (m k, m k) of blocks (m, k, k)."""
    m, k = blocks.shape[:2]
    return with_blocks(np.zeros((m * k, m * k)), blocks)


def with_blocks(matrix: FloatArray, blocks: FloatArray) -> FloatArray:
    """Return a matrix (m k, m k) plus the block-diagonal one of blocks (m, k, k)."""
    total: FloatArray = matrix.copy()
    diagonal = diagonal_blocks(total, blocks.shape[1])
    diagonal += blocks
    return total


def diagonal_blocks(matrix: FloatArray, k: int) -> FloatArray:
    """Return the blocks (m, k, k) on the diagonal of a matrix (m k, m k), as a view of it."""
    down, along = matrix.strides
    shape, strides = (len(matrix) // k, k, k), (k * (down + along), down, along)
    # Half the cost of einsum('ijik->ijk'), where the matrix is contiguous.
    if matrix.flags.c_contiguous:
        blocks: FloatArray = np.ndarray(shape, np.float64, matrix, 0, strides)
        return blocks
    return np.lib.stride_tricks.as_strided(matrix, shape, strides)


def turned(joint: FloatArray, R: FloatArray) -> FloatArray:
    """Return a covariance (k n, k n) of n vectors that have been turned by R (k, k), each."""
    half = (joint.reshape(-1, len(R)) @ R.T).reshape(joint.shape)
    whole: FloatArray = (half.T.reshape(-1, len(R)) @ R.T).reshape(joint.shape)
    return whole


def limited(covariances: FloatArray, largest: FloatArray) -> FloatArray:
    """Return covariances (…, d, d) of deviations up to ``largest`` (d,), as correlated."""
    # Rounding may have left a variance a hair below zero.
    deviations = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
    scales = largest / np.maximum(deviations, largest)
    return covariances * scales[..., :, None] * scales[..., None, :]


def are_covariances(matrices: FloatArray) -> BoolArray:
    """Return which (…, d, d) are symmetric and nowhere negative, in their own deviations."""
    # Nearly all have a Cholesky factor, but for exact entries: that costs a fifth.
    exact, rooted = matrices.diagonal(axis1=-2, axis2=-1) == 0.0, matrices
    is_other = False
    if np.count_nonzero(exact):
        is_other = bool(matrices[exact].any() or transpose(matrices)[exact].any())
        rooted = matrices + exact[..., None] * np.eye(exact.shape[-1])
    least = rooted.diagonal(axis1=-2, axis2=-1).min(initial=1.0)
    with np.errstate(over='ignore'), suppress(np.linalg.LinAlgError):
        skew = np.abs(matrices - matrices.swapaxes(-1, -2)).max(initial=0.0)
        if skew <= COVARIANCE_ROUNDING * least and not is_other:
            np.linalg.cholesky(rooted)
            return np.ones(matrices.shape[:-2], dtype=np.bool_)
    largest = np.full(matrices.shape[-1], MAX_DEVIATION)
    with np.errstate(over='ignore'):
        scaled = in_own_deviations(limited(matrices, largest), LEAST_SHARE)
        are_small = np.abs(scaled).max(axis=(-2, -1)) <= 1.0 + COVARIANCE_ROUNDING
    scaled = np.where(are_small[..., None, None], scaled, 0.0)
    skew = np.abs(scaled - transpose(scaled)).max(axis=(-2, -1))
    least = np.linalg.eigvalsh(scaled)[..., 0]
    fit: BoolArray = are_small & (skew <= COVARIANCE_ROUNDING) & (least >= -COVARIANCE_ROUNDING)
    return fit


def in_own_deviations(matrices: FloatArray, least_share: float = 0.0) -> FloatArray:
    """Return covariances (…, d, d) as correlations, whatever the scales of their entries are."""
    variances = np.diagonal(matrices, axis1=-2, axis2=-1)
    least = least_share**2 * variances.max(axis=-1, keepdims=True)
    deviations = np.sqrt(np.maximum(variances, np.maximum(least, LEAST_DEVIATION**2)))
    scaled: FloatArray = matrices / deviations[..., None, :]
    scaled /= deviations[..., :, None]
    return scaled


def with_variances_above(least_m2: float, covariances: FloatArray) -> FloatArray:
    """Return covariances (…, k, k) whose variances rounding has made neither too small nor < 0."""
    variances, U = np.linalg.eigh(symmetric(covariances))
    clipped: FloatArray = (U * np.maximum(variances, least_m2)[..., None, :]) @ transpose(U)
    return clipped


def correlations_of(covariance: FloatArray) -> FloatArray:
    """Return the correlations (d, d) of a covariance without zeros on its diagonal."""
    deviations = np.sqrt(np.diagonal(covariance))
    correlations: FloatArray = covariance / np.outer(deviations, deviations)
    return correlations
