"""Consistency: whether the covariances (..., d, d) that are stated match the errors (..., d) made.

NEES: normalised estimation error squared, εᵀ Σ⁻¹ ε; ANEES: its mean, per degree of freedom.
Ellipses of 95 % show such covariances in a plane of the map.
"""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.matrices import transpose
from slam_observer_ros.recordings.trajectory import associate, Trajectory
from slam_observer_ros.runs.metrics import pose_errors

MAX_SHARE_OF_ANCHOR = 0.1
"""ANEES that the anchor's own error may make up at most; 1 is what all errors together have."""

_SINGULAR = 1e-12
"""Eigenvalues of a correlation matrix below this are zero but for rounding."""


def normalised_squared_errors(
    errors: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return NEES (...), χ²-distributed where covariances are honest, and degrees of freedom.

    A direction of no variance is one that is known exactly (roll, pitch and height in planar
    mode): it is left out, and counts for no degree of freedom. Raises an EvaluationError if a
    covariance has a negative eigenvalue.
    """
    variances = np.diagonal(covariances, axis1=-2, axis2=-1)
    deviations = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    # As correlations, radians and metres are of one size and one threshold serves both.
    correlations = covariances / (deviations[..., :, None] * deviations[..., None, :])
    eigenvalues, directions = np.linalg.eigh(correlations)
    if eigenvalues.min(initial=0.0) < -_SINGULAR:
        raise EvaluationError('a covariance has a negative eigenvalue')
    uncertain = eigenvalues > _SINGULAR
    components = (transpose(directions) @ (errors / deviations)[..., None])[..., 0]
    squares = np.where(uncertain, components**2, 0.0) / np.where(uncertain, eigenvalues, 1.0)
    return squares.sum(axis=-1), uncertain.sum(axis=-1)


def average_nees(errors: FloatArray, covariances: FloatArray) -> float | None:
    """Return the ANEES of all runs and times: above 1 is overconfident, below 1 too cautious.

    None where every component is known exactly.
    """
    nees, degrees_of_freedom = normalised_squared_errors(errors, covariances)
    total = int(degrees_of_freedom.sum())
    return float(nees.sum() / total) if total else None


def average_nees_band(
    degrees_of_freedom: int, runs: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the band in which the ANEES of an honest estimator lies with that confidence.

    The χ² distribution of an error of so many degrees of freedom (6 for a pose, 3 for a landmark
    or a planar pose), averaged over independent runs. Each limit is missed as often.
    """
    total = degrees_of_freedom * runs
    from scipy import special  # which few runs need; scipy.stats takes a second to import

    # chdtri inverts the χ² tail.
    tail = 0.5 * (1.0 - confidence)
    return (
        float(special.chdtri(total, 1.0 - tail) / total),
        float(special.chdtri(total, tail) / total),
    )


def anchored_average_nees(
    estimate: Trajectory, covariances: FloatArray, truth: Trajectory
) -> float | None:
    """Return the pose's ANEES of one run, with the truth moved onto its first estimated pose.

    An estimator declares its first pose certain: that is its gauge. A fit over the whole run
    would hide errors that its covariance counts. The covariances (k, 6, 6) are of rotation vector
    and position, world axes. None where the truth covers no pose; an EvaluationError is raised if
    it begins when the pose is uncertain already.
    """
    paired, true_paired, covered = associate(estimate, truth)
    if len(paired) == 0:
        return None
    if _nees_of_anchor(paired, covariances[covered]) > MAX_SHARE_OF_ANCHOR:
        late_s = to_s(paired.stamps_ns[0] - estimate.stamps_ns[0])
        raise EvaluationError(
            f'the truth begins {late_s:.1f} s after the estimate, when the pose is uncertain '
            'already'
        )
    anchored = true_paired.moved(paired.poses[0] @ se3.inverse(true_paired.poses[0]))
    return average_nees(pose_errors(paired.poses, anchored.poses), covariances[covered])


def _nees_of_anchor(estimate: Trajectory, covariances: FloatArray) -> float:
    """Return what the first pose's error adds to the ANEES if the truth is moved onto it.

    It turns all other poses about the first one, and shifts them.
    """
    if not covariances[0].any():  # as nearly always
        return 0.0
    variances, directions = np.linalg.eigh(covariances[0])
    turns, shifts = np.split(
        directions.T * np.sqrt(np.maximum(variances, 0.0))[:, None], 2, axis=1
    )
    arms = estimate.positions - estimate.positions[0]
    moved = shifts + np.cross(turns, arms[:, None])
    errors = np.concatenate([np.broadcast_to(turns, moved.shape), moved], axis=2)
    return average_nees(errors, covariances[:, None]) or 0.0


CHI_SQUARE_95 = 5.991464547107979
"""Squared half-axis, in standard deviations, of the ellipse that holds 95 % in a plane."""

_CORNERS = 37


def ellipses(covariances: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Return half-axes, metres, and the angle of the first one, rad: (n, 3) for 95 %.

    ``covariances`` (n, 3, 3), m², are projected on two of the world's axes.
    """
    in_plane = covariances[:, axes][:, :, axes]
    variances, directions = np.linalg.eigh(in_plane)
    half = np.sqrt(CHI_SQUARE_95 * np.maximum(variances[:, ::-1], 0.0))
    first = directions[:, :, 1]
    return np.column_stack([half, np.arctan2(first[:, 1], first[:, 0])])


def outlines(points: FloatArray, covariances: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Return the ellipses round points (n, 3) as one line (n · 38, 2), with a break after each."""
    half_a, half_b, angles = ellipses(covariances, axes).T[:, :, None]
    turn = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    a, b = half_a * np.cos(turn), half_b * np.sin(turn)
    offsets = np.stack(
        [
            a * np.cos(angles) - b * np.sin(angles),
            a * np.sin(angles) + b * np.cos(angles),
        ],
        axis=2,
    )
    closed = points[:, None, axes] + offsets
    return np.concatenate([closed, np.full((len(points), 1, 2), np.nan)], axis=1).reshape(-1, 2)
