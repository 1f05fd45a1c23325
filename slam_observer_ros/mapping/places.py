"""How likely a place in a map is, by what was seen there.

Each point is one of the landmarks in view with the probability 1 − f, else it is anywhere in view.
How many points are of no landmark is not known beforehand: f has a beta distribution. The *mass*
of a place is the likelihood of all points, integrated over where exactly it is; its *share* is its
part of all masses, 'none of them' among these. Where the points lie by chance, the mean of
the likelihoods of all places together equals 'none of them' (in halls with 2000 reflectors it is
a twentieth): so chance seldom gives a place a large share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import (
    cholesky,
    diagonal_blocks,
    mahalanobis,
    solve_symmetric,
    transpose,
    turned,
    with_blocks,
)
from slam_observer_ros.mapping.landmark_map import MappedLandmarks

GATE = 3.7  # standard deviations that a point may be off
MAX_ROUNDS = 4  # how often a place is fitted to its matches, and matched again
RIVALS = 4  # landmarks near a point among which the most likely one is taken
MAX_VARIANCE_FACTOR = 4.0  # variances may turn out larger than stated: real noise is not white

# Parameters of the beta distribution of f: a point in five is of no landmark, or none, or most.
FALSE, TRUE = 1.0, 4.0
NOWHERE = 0.1  # probability beforehand that the robot is not in the map
LEAST_VIEW_M = 1.0  # radius of what is in view at least, metres
LEAST_STD = 1e-3  # standard deviation of a given pose at least, rad and m
SAMPLED = 64  # landmarks around which others are counted, to know how many are in view anywhere
LEAST_SHARE = 0.01  # probability from which a place is named to a person


@dataclass(frozen=True, slots=True, eq=False)
class Constellation:
    """m points in one frame."""

    points: FloatArray  # (m, 3) metres
    covariance: FloatArray  # (m k, m k) of all together, m²; the frame's own error may be in it
    only: IntArray  # (m,) the landmark that its id names, −1 for a point without one

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: IntArray) -> Constellation:
        """Return the constellation of the points at ``rows``."""
        k = len(self.covariance) // len(self.points)
        at = (k * rows[:, None] + np.arange(k)).ravel()
        return Constellation(self.points[rows], self.covariance[np.ix_(at, at)], self.only[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a constellation may be in a map."""

    transform: FloatArray  # (4, 4) from its frame to the map's
    rows: IntArray  # (m,) the landmark that each point is, −1 for none
    log_mass: float
    share: float = 0.0  # probability that it is here
    map_index: int = 0  # in which of several maps

    @property
    def matches(self) -> int:
        """How many points are landmarks."""
        return int(np.count_nonzero(self.rows >= 0))


@dataclass(frozen=True, slots=True)
class Places:
    """Where a constellation may be, the most likely place first."""

    all: list[Place]
    is_complete: bool  # none that could matter is missing
    log_none: float  # ln of the mass of 'none of them'

    @classmethod
    def weighed(cls, found: Sequence[Place], log_none: float, is_complete: bool) -> Places:
        """Return places with their shares."""
        masses = np.array([place.log_mass for place in found] + [log_none])
        shares = np.exp(masses - masses.max())
        shares /= shares.sum()
        weighed = [
            replace(place, share=float(share))
            for place, share in zip(found, shares[:-1], strict=True)
        ]
        return cls(sorted(weighed, key=lambda place: -place.share), is_complete, log_none)

    @classmethod
    def in_several_maps(cls, parts: Mapping[int, Places]) -> Places:
        """Return the places in all of several maps, any of which the robot may be in alike."""
        log_maps = math.log(len(parts))
        found = [
            replace(place, map_index=i, log_mass=place.log_mass - log_maps)
            for i, part in parts.items()
            for place in part.all
        ]
        is_complete = all(part.is_complete for part in parts.values())
        return cls.weighed(found, next(iter(parts.values())).log_none, is_complete)

    @property
    def likely(self) -> list[Place]:
        """Return the places that are worth to be named."""
        return [place for place in self.all if place.share > LEAST_SHARE]

    def decided(self, error_probability: float) -> Place | None:
        """Return the place that is wrong with at most this probability, if there is one."""
        is_sure = self.is_complete and self.error_probability <= error_probability
        return self.all[0] if is_sure else None

    @property
    def error_probability(self) -> float:
        """Probability that the first place is wrong."""
        return max(1.0 - self.all[0].share, 1e-12) if self.all else 1.0


class Anywhere:
    """A constellation is somewhere in the map; ``largest`` is ln of its density, rad and m."""

    def __init__(self, known: MappedLandmarks) -> None:
        axes = known.axes
        sides_m = np.maximum(np.ptp(known.points[:, : axes.point], axis=0), 1.0)
        turns = 2.0 * math.pi if axes.turn == 1 else 8.0 * math.pi**2
        self.largest = -float(np.log(sides_m).sum()) - math.log(turns)

    def log_density(self, transform: FloatArray, covariance: FloatArray) -> float:
        """Return ln of the density at a transform (4, 4): it is the same everywhere.

        ``covariance`` (p, p) has its turn and position on the axes that are estimated.
        """
        return self.largest


class Near:
    """It is near a pose (4, 4), with a covariance (6, 6) of rotation vector and position."""

    def __init__(self, pose: FloatArray, covariance: FloatArray, axes: EstimatedAxes) -> None:
        self._pose, self._axes = pose, axes
        self._P = covariance[axes.pose, axes.pose] + LEAST_STD**2 * np.eye(axes.p)
        self.largest = -0.5 * float(np.linalg.slogdet(2.0 * math.pi * self._P)[1])

    def log_density(self, transform: FloatArray, covariance: FloatArray) -> float:
        """Return ln of the density: of the sum of both errors."""
        turn = so3.log(transform[:3, :3] @ self._pose[:3, :3].T)
        off = np.concatenate([turn, transform[:3, 3] - self._pose[:3, 3]])[self._axes.pose]
        P = self._P + covariance
        log_det = float(np.linalg.slogdet(2.0 * math.pi * P)[1])
        return -0.5 * (float(off @ solve_symmetric(P, off)) + log_det)


PlacePrior: TypeAlias = Anywhere | Near


@dataclass(frozen=True, slots=True)
class _Fit:
    """A place fitted to n matches."""

    transform: FloatArray
    centre: FloatArray  # (3,) of the matched points, about which it may be turned, metres, map
    information: FloatArray  # (p, p) of where it is, about the centre
    log_likelihood: float  # of the matches, integrated over where exactly it is


class Weighing:
    """What places of m points in a map weigh."""

    def __init__(self, known: MappedLandmarks, seen: Constellation, prior: PlacePrior) -> None:
        self._known, self._seen, self._prior, k = known, seen, prior, known.axes.point
        self._own = diagonal_blocks(seen.covariance, k)
        self._centre = seen.points.mean(axis=0)
        spread_m = np.linalg.norm(seen.points - self._centre, axis=1).max(initial=0.0)
        self._view_m = max(LEAST_VIEW_M, 1.1 * float(spread_m))
        unit = math.pi if k == 2 else 4.0 / 3.0 * math.pi
        self._log_view = math.log(unit) + k * math.log(self._view_m)
        self.log_none = math.log(NOWHERE / (1.0 - NOWHERE)) - len(seen) * self._log_view
        # Around some landmarks all over the map.
        some = known.points[:: max(1, len(known) // SAMPLED), :k]
        counts = known.tree.query_ball_point(some, self._view_m, return_length=True)
        self._fewest_in_view = int(np.min(counts))
        self._at_best: dict[int, float] = {}

    def at_best(self, matches: int) -> float:
        """Return the largest mass that a place with so many matches may have, about."""
        if matches not in self._at_best:
            part = self._seen.select(np.arange(matches))
            fit = self._fitted(np.eye(4), part, part.points, np.zeros_like(self._own[:matches]))
            in_view = max(matches, self._fewest_in_view)
            self._at_best[matches] = (
                math.inf
                if fit is None
                else self._mass(fit.log_likelihood, matches, in_view) + self._prior.largest
            )
        return self._at_best[matches]

    def place(self, transform: FloatArray, rows: IntArray) -> Place | None:
        """Fit a place to its matches, and weigh it; None if too few of these remain."""
        fit, matched = self._fit(transform, rows), rows
        for _ in range(MAX_ROUNDS):
            if fit is None:
                return None
            rows, fit = matched, self._fit(fit.transform, matched)
            matched = rows if fit is None else self._matched(fit)
            if np.array_equal(matched, rows):
                break
        if fit is None:
            return None
        known, n = self._known, int(np.count_nonzero(rows >= 0))
        centre = se3.transform(fit.transform, self._centre[None])[:, : known.axes.point]
        in_view = len(known.tree.query_ball_point(centre[0], self._view_m))
        mass = self._mass(fit.log_likelihood, n, max(n, in_view))
        # Its turn and position, from those about the centre of the matches
        J = np.eye(6)
        J[3:, :3] = so3.hat(fit.centre - fit.transform[:3, 3])
        J = J[known.axes.pose, known.axes.pose]
        covariance = np.asarray(J @ solve_symmetric(fit.information, J.T))
        mass += self._prior.log_density(fit.transform, covariance)
        return Place(fit.transform, rows, mass)

    def _fit(self, transform: FloatArray, rows: IntArray) -> _Fit | None:
        """Fit a place to its matches (m,); None if these are too few."""
        matched = np.flatnonzero(rows >= 0)
        if len(matched) <= self._known.axes.point:
            return None
        part, at = self._seen.select(matched), rows[matched]
        return self._fitted(transform, part, self._known.points[at], self._known.covariances[at])

    def add(self, place: Place, found: list[Place]) -> None:
        """Add a place to those found, or its mass to one that is the same."""
        points = se3.transform(place.transform, self._seen.points)
        tolerance_m = GATE * math.sqrt(np.linalg.eigvalsh(self._own)[:, -1].max())
        for i, other in enumerate(found):
            shifts = points - se3.transform(other.transform, self._seen.points)
            if np.linalg.norm(shifts, axis=1).max() <= tolerance_m:
                first = place if place.log_mass > other.log_mass else other
                mass = float(np.logaddexp(place.log_mass, other.log_mass))
                found[i] = replace(first, log_mass=mass)
                return
        found.append(place)

    def _mass(self, log_likelihood: float, n: int, in_view: int) -> float:
        """Return ln of the mass of n matches, by how many landmarks are in view; no prior yet."""
        m = len(self._seen)
        # ∫ (1 − f)ⁿ fᵐ⁻ⁿ over the distribution of f
        log_share = (
            math.lgamma(n + TRUE)
            + math.lgamma(m - n + FALSE)
            - math.lgamma(m + TRUE + FALSE)
            - math.lgamma(TRUE)
            - math.lgamma(FALSE)
            + math.lgamma(TRUE + FALSE)
        )
        return log_share - n * math.log(in_view) - (m - n) * self._log_view + log_likelihood

    def _fitted(
        self, transform: FloatArray, part: Constellation, there: FloatArray, noise: FloatArray
    ) -> _Fit | None:
        """Fit a place to n points and the landmarks (n, 3) that they are; None if it may turn."""
        axes, k = self._known.axes, self._known.axes.point
        placed = se3.transform(transform, part.points)
        S = with_blocks(turned(part.covariance, transform[:k, :k]), noise)
        L = cholesky(S + 1e-12 * np.eye(len(S)))
        centre = placed.mean(axis=0)
        J = axes.output_matrix(placed - centre).reshape(-1, axes.p)
        J = np.asarray(np.linalg.solve(L, J), dtype=np.float64)
        r = np.linalg.solve(L, (placed - there)[:, :k].ravel())
        information = J.T @ J
        sign, log_det = np.linalg.slogdet(information)
        if sign <= 0 or log_det < -2.0 * axes.p:
            return None
        step = -solve_symmetric(information, J.T @ r)
        left, dof = r + J @ step, len(r) - axes.p
        # The variances may be larger than stated: as these say, within limits.
        factor = min(max(float(left @ left) / max(dof, 1), 1.0), MAX_VARIANCE_FACTOR)
        cost = float(left @ left) / factor + dof * math.log(2.0 * math.pi * factor)
        log_likelihood = -0.5 * (cost + log_det) - float(np.log(np.diagonal(L)).sum())
        about, back = se3.pose(np.eye(3), centre), se3.pose(np.eye(3), -centre)
        moved = about @ se3.exp(axes.full_pose(step)) @ back @ transform
        return _Fit(moved, centre, information, log_likelihood)

    def _matched(self, fit: _Fit) -> IntArray:
        """Return the landmarks (m,) that the points are at a place, −1 for none."""
        known, seen, axes = self._known, self._seen, self._known.axes
        k, R = axes.point, fit.transform[: axes.point, : axes.point]
        placed = se3.transform(fit.transform, seen.points)
        J = axes.output_matrix(placed - fit.centre)
        of_place = J @ solve_symmetric(fit.information, transpose(J))
        covariances = R @ self._own @ R.T + known.largest_covariance + of_place
        rivals = min(RIVALS, len(known))
        _, near = known.tree.query(placed[:, :k], k=rivals)
        near = near.reshape(len(seen), rivals)
        off = (placed[:, None] - known.points[near])[..., :k].reshape(-1, k)
        distances = mahalanobis(off, np.repeat(covariances, rivals, axis=0)).reshape(near.shape)
        distances[(seen.only >= 0)[:, None] & (near != seen.only[:, None])] = np.inf
        # Each landmark is the point that fits it best.
        best = distances.argmin(axis=1)
        everything = np.arange(len(seen))
        rows, distances = near[everything, best], distances[everything, best]
        order = np.argsort(distances)
        _, first = np.unique(rows[order], return_index=True)
        taken = order[first]
        matched = np.full(len(seen), -1)
        matched[taken] = np.where(distances[taken] <= GATE, rows[taken], -1)
        return matched
