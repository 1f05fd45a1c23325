"""The error that belongs to the paper's quotient, of the map as the robot sees it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.evaluation.metrics import root_mean_square
from slam_observer_ros.evaluation.truth import LandmarkTruth
from slam_observer_ros.events import is_automatic
from slam_observer_ros.geometry import se3

MAX_JOINT = 100
"""Landmarks whose errors are normalised together, at most: it costs the cube of them."""

ROUNDING = 1e-13
"""Share of the total variance that rounding may have left out of a direction."""


@dataclass(slots=True)
class ConfigurationError:
    """Error on the quotient M_n(3) of the paper: the map as the robot sees it, gauge-free.

    After each observation, the RMS over all landmarks known so far of |P̂⁻¹ p̂_i − P⁻¹ p_i|;
    over a run, the RMS of that. Where a world frame lies plays no part, so nothing is aligned.
    ``values_m`` are of ``stamps_ns``, when there were landmarks to compare; ``nees`` are the
    normalised squared errors per degree of freedom, of those with a covariance.
    """

    stamps_ns: list[int] = field(default_factory=list)
    values_m: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    _votes: defaultdict[int, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))

    def add(
        self,
        stamp_ns: int,
        pose: FloatArray,
        ids: IntArray,
        world_points: FloatArray,
        true_pose: FloatArray,
        truth: LandmarkTruth,
        covariance_of: Callable[[IntArray], FloatArray | None] | None = None,
        seen_ids: IntArray | None = None,
    ) -> None:
        """Take in one configuration and the truth at that time, once after each observation.

        Parameters
        ----------
        ids : IntArray
            (n,) landmarks known so far; those without truth are passed over. One whose sensor
            gave no id stands for the true landmark that it was nearest to most often when it was
            seen; until then it is passed over, too. At other times drift puts it next to others.
        covariance_of : callable, optional
            Gives the joint covariance (m k, m k) of rows (m,) of the landmarks as seen by the
            robot, of their first k coordinates, m²; None if it is not known.
        seen_ids : IntArray, optional
            Which of the landmarks were seen now; by default all.

        """
        if not len(truth.ids):
            return
        seen = se3.transform(se3.inverse(pose), world_points)
        true_seen = se3.transform(se3.inverse(true_pose), truth.world_points)

        # Which true landmark each is
        without_id = is_automatic(ids)
        if np.count_nonzero(without_id):
            without_id &= np.isin(ids, ids if seen_ids is None else seen_ids)
            self._vote(ids[without_id], seen[without_id], truth.ids, true_seen)
        true_ids = np.array([self._true_id(i) for i in ids.tolist()], dtype=np.int64)
        rows, true_rows = np.nonzero(true_ids[:, None] == truth.ids)
        if not len(rows):
            return

        # How far it is off, and how likely that is
        self.stamps_ns.append(stamp_ns)
        errors = seen[rows] - true_seen[true_rows]
        self.values_m.append(root_mean_square(errors))
        if covariance_of is not None:
            some = slice(None, None, -(-len(rows) // MAX_JOINT))
            P = covariance_of(rows[some])
            if P is not None:
                self.nees.append(_nees(errors[some], P))

    def _vote(
        self, ids: IntArray, seen: FloatArray, true_ids: IntArray, true_seen: FloatArray
    ) -> None:
        """Count for each landmark (n, 3) which true one (m, 3) is the nearest now."""
        for landmark_id, point in zip(ids.tolist(), seen, strict=True):
            nearest = np.argmin(np.linalg.norm(true_seen - point, axis=1))
            self._votes[landmark_id][int(true_ids[nearest])] += 1

    def _true_id(self, landmark_id: int) -> int:
        votes = self._votes.get(landmark_id)
        return landmark_id if votes is None else votes.most_common(1)[0][0]

    @property
    def anees(self) -> float | None:
        """Mean of the normalised squared errors; None if there are none."""
        return float(np.mean(self.nees)) if self.nees else None

    @property
    def rmse_m(self) -> float | None:
        """RMS over the run, metres; None before anything could be compared."""
        return root_mean_square(np.array(self.values_m)) if self.values_m else None


def _nees(errors: FloatArray, P: FloatArray) -> float:
    """Return eᵀ P⁻¹ e per degree of freedom of errors (m, 3), P (m k, m k) that of k of them."""
    e = errors[:, : len(P) // len(errors)].ravel()
    regular = P + ROUNDING * np.trace(P) * np.eye(len(P))
    return float(e @ np.linalg.solve(regular, e)) / len(e)
