"""Drift: how far an estimate goes astray over a length of the true path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.metrics import TrajectoryErrors
from slam_observer_ros.evaluation.trajectory import MAX_GAP_NS, Trajectory
from slam_observer_ros.geometry import se3, so3

LENGTHS_M = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
"""Lengths of path over which drift is measured: the first that fits twice into the true path."""

LENGTH_TOLERANCE = 0.1
"""By how much a piece of path may be longer or shorter than asked for, as a share."""


GAP = 3.0
"""Usual periods of a trajectory after which there is a gap in it."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativeErrors:
    """Relative pose errors (RPE) over k pieces of the true path, each ``length_m`` long.

    Of the motions between first and last pose of a piece, (Q⁻¹Q')⁻¹ P⁻¹P' with true poses Q and
    estimates P; ``translations_m`` (k,) and ``rotations_rad`` (k,) are how large it is. Pieces
    begin at every pose, as those of ``evo_rpe --all_pairs --pairs_from_reference``.
    """

    length_m: float
    translations_m: FloatArray
    rotations_rad: FloatArray

    @property
    def drift(self) -> float:
        """Mean error of the position as a share of the path."""
        return float(self.translations_m.mean()) / self.length_m

    @property
    def turn_rad_per_m(self) -> float:
        """Mean error of the attitude by the path, rad/m."""
        return float(self.rotations_rad.mean()) / self.length_m


def path_lengths(trajectory: Trajectory) -> FloatArray:
    """Return how long (k,) the path is until each pose, metres."""
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    return np.concatenate([np.zeros(min(1, len(trajectory))), np.cumsum(steps)])


def fitting_length(truth: Trajectory) -> float | None:
    """Return the length of path over which drift is to be measured; None if there is no motion."""
    whole_m = path_lengths(truth)[-1] if len(truth) else 0.0
    return next((length_m for length_m in LENGTHS_M if 2.0 * length_m <= whole_m), None)


def trajectory_figures(errors: TrajectoryErrors, truth: Trajectory) -> dict[str, int | float]:
    """Return by what a trajectory is compared with others, beside its ATE; ``truth`` is whole."""
    distances_m = errors.distances_m
    figures: dict[str, int | float] = {
        'poses_compared': len(errors.truth),
        'time_compared': _seconds_of(errors.truth) / max(_seconds_of(truth), 1e-9),
        'ate_max_m': float(distances_m.max()),
        'ate_median_m': float(np.median(distances_m)),
        'ate_std_m': float(distances_m.std()),
        'path_length_m': float(path_lengths(errors.estimate)[-1]),
        'true_path_length_m': float(path_lengths(errors.truth)[-1]),
    }
    length_m = fitting_length(truth)
    relative = None if length_m is None else relative_errors(errors, length_m)
    if relative is not None:
        figures |= {
            'drift': relative.drift,
            'drift_rad_per_m': relative.turn_rad_per_m,
            'drift_length_m': relative.length_m,
        }
    return figures


def _seconds_of(trajectory: Trajectory) -> float:
    """Return the time that poses cover, without the gaps between them, seconds."""
    steps_s = to_s(np.diff(trajectory.stamps_ns))
    if not len(steps_s):
        return 0.0
    longest_s = max(to_s(MAX_GAP_NS), GAP * float(np.median(steps_s)))
    return float(steps_s[steps_s <= longest_s].sum())


def relative_errors(errors: TrajectoryErrors, length_m: float) -> RelativeErrors | None:
    """Return those of a trajectory over a length of path; None if no piece is so long."""
    lengths_m = path_lengths(errors.truth)
    first = np.arange(len(lengths_m))
    last = _nearest(lengths_m, lengths_m + length_m)
    off_m = np.abs(lengths_m[last] - lengths_m - length_m)
    is_piece = (last > first) & (off_m <= LENGTH_TOLERANCE * length_m)
    if not is_piece.any():
        return None
    first, last = first[is_piece], last[is_piece]
    true_poses, poses = errors.truth.poses, errors.estimate.poses
    true_motions = se3.inverse(true_poses[first]) @ true_poses[last]
    motions = se3.inverse(poses[first]) @ poses[last]
    E = se3.inverse(true_motions) @ motions
    return RelativeErrors(
        length_m,
        np.linalg.norm(E[:, :3, 3], axis=1),
        np.linalg.norm(so3.log(E[:, :3, :3]), axis=1),
    )


def _nearest(increasing: FloatArray, wanted: FloatArray) -> IntArray:
    """Return the first row of what is nearest to each of ``wanted``."""
    after = np.minimum(np.searchsorted(increasing, wanted), len(increasing) - 1)
    before = np.searchsorted(increasing, increasing[np.maximum(after - 1, 0)])
    is_before = wanted - increasing[before] <= increasing[after] - wanted
    rows: IntArray = np.where(is_before, before, after)
    return rows
