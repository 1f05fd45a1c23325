"""Landmarks that a map knows, and how they determine where a whole estimate lies in its frame.

A rigid motion exp(γ) of pose and landmarks together changes no observation: it is the gauge of
SLAM. Seen from another frame, with γ unknown, the error of an estimate is x + G γ, where
x ~ N(0, P) as before. Landmarks known there, up to noise of covariance R, differ by
r = H (x + G γ) + noise. With S = H P Hᵀ + R and J = H G, generalised least squares give
γ = Λ Jᵀ S⁻¹ r with Λ = (Jᵀ S⁻¹ J)⁻¹, and a Kalman filter gives x from the rest of r. So no large
number has to stand for 'unknown'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import (
    block_diagonal,
    cholesky,
    solve_symmetric,
    symmetric,
    turned,
)


@dataclass(frozen=True, slots=True, eq=False)
class KnownLandmarks:
    """n landmarks of a map in one frame; t of them are tags with an orientation."""

    points: FloatArray  # (n, 3) metres
    covariances: FloatArray  # (n, 3, 3) of each position, m²
    # (3 (n + t),) squared, of all positions, then of the rotation vectors of the tags, along the
    # axes of the frame; None if errors are independent
    joint: FloatArray | None = None
    orientations: FloatArray | None = None  # (n, 3, 3), zero for points; None without tags
    sigmas: FloatArray | None = None  # (n,) of rotation vectors, rad

    def __len__(self) -> int:
        return len(self.points)

    @property
    def tags(self) -> IntArray:
        """(t,) rows of the tags."""
        return tags_among(self.orientations)

    def select(self, rows: IntArray | BoolArray) -> KnownLandmarks:
        """Return the landmarks at ``rows``."""
        R, sigmas, joint = self.orientations, self.sigmas, self.joint
        return KnownLandmarks(
            self.points[rows],
            self.covariances[rows],
            None if joint is None else part_of_joint(joint, len(self), self.tags, rows),
            None if R is None else R[rows],
            None if sigmas is None else sigmas[rows],
        )

    def moved(self, T: FloatArray) -> KnownLandmarks:
        """Return the same in another frame, into which ``T`` (4, 4) leads."""
        R = T[:3, :3]
        covariances: FloatArray = R @ self.covariances @ R.T
        joint = None if self.joint is None else turned(self.joint, R)
        orientations = None if self.orientations is None else R @ self.orientations
        points = se3.transform(T, self.points)
        return KnownLandmarks(points, covariances, joint, orientations, self.sigmas)

    def covariance_on(self, axes: EstimatedAxes) -> FloatArray:
        """Return the covariance (n k, n k) of all positions on the axes that are estimated."""
        n, k = len(self), axes.point
        if self.joint is None:
            return block_diagonal(self.covariances[:, :k, :k])
        return self.joint_on(axes)[: n * k, : n * k]

    def joint_on(self, axes: EstimatedAxes) -> FloatArray:
        """Return the covariance (n k + t q, …) of positions and turns on the same axes."""
        if self.joint is None:
            raise ValueError('the errors are independent')
        n, numbers = len(self), 3 * np.arange(len(self.joint) // 3)[:, None]
        points, turns = numbers[:n] + np.arange(axes.point), numbers[n:] + axes.turned
        columns = np.append(points, turns)
        part: FloatArray = self.joint[np.ix_(columns, columns)]
        return part


def tags_among(orientations: FloatArray | None) -> IntArray:
    """Return the rows (t,) of those landmarks that have an orientation (3, 3)."""
    if orientations is None:
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(orientations.any(axis=(1, 2)))


def part_of_joint(
    joint: FloatArray, n: int, tags: IntArray, rows: IntArray | BoolArray
) -> FloatArray:
    """Return the part of a joint covariance of n landmarks that ``rows`` have."""
    chosen = np.arange(n)[rows]
    number_of = np.full(n, -1)
    number_of[tags] = n + np.arange(len(tags))
    turns = number_of[chosen]
    numbers = np.append(chosen, turns[turns >= 0])
    columns = (3 * numbers[:, None] + np.arange(3)).ravel()
    part: FloatArray = joint[np.ix_(columns, columns)]
    return part


JITTER_M2 = 1e-12  # added to variances, so that S can be inverted where both sides are exact


def gauge_information(J: FloatArray, S: FloatArray) -> FloatArray:
    """Return Λ⁻¹ = Jᵀ S⁻¹ J (d, d), what landmarks say of γ, for J (q, d) and S (q, q)."""
    information: FloatArray = J.T @ _solve(S, J)
    return information


def anchor(
    P: FloatArray, G: FloatArray, PH: FloatArray, S: FloatArray, J: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the error x + G γ (N,) of an estimate, and the covariance (N, N) after it.

    The module's docstring explains ``P`` (N, N), ``G`` (N, d), ``PH`` = P Hᵀ (N, q), ``S`` (q, q)
    and ``J`` (q, d); ``r`` (q,) is the estimate minus the known coordinates.
    """
    S = S + JITTER_M2 * np.eye(len(r))
    # γ by generalised least squares, then a Kalman filter's gain for the rest.
    information = gauge_information(J, S)
    gamma = solve_symmetric(information, J.T @ _solve(S, r))
    K = _solve(S, PH.T).T
    # The error of γ adds to what remains of P.
    B = G - K @ J
    after = P - K @ PH.T + B @ solve_symmetric(information, B.T)
    return G @ gamma + K @ (r - J @ gamma), symmetric(after)


def _solve(S: FloatArray, right: FloatArray) -> FloatArray:
    try:
        factor = cho_factor(S)
    except np.linalg.LinAlgError:
        factor = cholesky(symmetric(S)), True
    return np.asarray(cho_solve(factor, right), dtype=np.float64)
