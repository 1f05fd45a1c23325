"""Where points without ids lie in a map: all places that fit, and how likely each of them is.

A *base* of the points, two in the plane and three in space, has the distances of some landmarks of
the map. Each such set of landmarks says where all points are in the map, and there the others are
looked for. Where q of m points are landmarks, there is a base of such points among any m − q + k
of them (k = 2 or 3): so bases of these few find every place with q matches or more, and q is
lowered until no place with fewer could matter. The method is by D. Ronzoni, R. Olmi,
C. Secchi and C. Fantuzzi, *AGV global localization using indistinguishable artificial landmarks*
(ICRA 2011); how likely a place is, is not in it: :mod:`.places`.
"""

from __future__ import annotations

from itertools import combinations
import math

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.lie.matrices import diagonal_blocks, transpose
from slam_observer_ros.mapping.landmark_map import MappedLandmarks
from slam_observer_ros.mapping.places import (
    Constellation,
    GATE,
    Place,
    PlacePrior,
    Places,
    Weighing,
)

MAX_LOOKS = 500_000  # how often a point is looked for in the map: in a second or less
MAX_PLACES = 400  # places that are weighed, which takes a millisecond each
AT_ONCE = 4096  # sets of landmarks that are looked at together. After them the search may be over


def find_places(
    known: MappedLandmarks,
    seen: Constellation,
    prior: PlacePrior,
    error_probability: float,
    log_rival: float = -math.inf,
    looks: int = MAX_LOOKS,
) -> Places:
    """Return the places in a map where a constellation may be, the most likely first.

    Places whose share is far below ``error_probability`` may be missing, also beside a place in
    another map, of mass exp(``log_rival``). The search ends early where two places fit so well
    that none of them can be trusted, and where it would take too long, after so many ``looks``;
    then the result is not complete.
    """
    weighing = Weighing(known, seen, prior)
    search = _Search(known, seen, weighing, log_rival, math.log(error_probability), looks)
    is_complete = len(seen) > known.axes.point and search.run()
    return Places.weighed(search.found, weighing.log_none, is_complete)


class _Search:
    """The search for places of m points, from those with the most matches to those with fewer."""

    def __init__(
        self,
        known: MappedLandmarks,
        seen: Constellation,
        weighing: Weighing,
        log_rival: float,
        margin: float,
        looks: int,
    ) -> None:
        self.known, self.seen, self.weighing = known, seen, weighing
        self.log_rival, self.margin = log_rival, margin
        self.found: list[Place] = []
        self.looks_left, self.places_left = looks, MAX_PLACES
        self.sides = _Sides(known, seen)
        self._is_within_reach = known.reach(self.sides.longest_m) >= self.sides.longest_m

    def run(self) -> bool:
        """Find the places; return whether none is missing that could matter."""
        m, k = len(self.seen), self.known.axes.point
        if not self._is_within_reach:
            return False
        for matches in range(m, k, -1):
            if not self._could_matter(matches):
                return True
            if not self._find(matches):
                return False
            if self._is_undecided():
                return True
        return True

    def _could_matter(self, matches: int) -> bool:
        """Return whether a place with so many matches could be as likely as the best one."""
        masses = [place.log_mass for place in self.found]
        best = max(self.log_rival, self.weighing.log_none, *masses)
        return self.weighing.at_best(matches) > best + self.margin

    def _is_undecided(self) -> bool:
        """Return whether a second place is so likely that none can be trusted."""
        masses = [self.log_rival, *(place.log_mass for place in self.found)]
        second, first = sorted([-math.inf, *masses])[-2:]
        return second > first + self.margin

    def _find(self, matches: int) -> bool:
        """Find all places with so many matches; return whether that could be done."""
        bases, sets = [], []
        for base in self.sides.bases(matches):
            rows = self._sets(base)
            if rows is None:
                return False
            if len(rows):
                bases.append(base)
                sets.append(rows)
        if not bases:
            return True
        which = np.repeat(np.arange(len(bases)), [len(rows) for rows in sets])
        base_rows = np.concatenate(sets)
        gates = _Gates(np.array(bases), self.known, self.seen)
        for first in range(0, len(which), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            placed = self._look_for_others(gates, which[part], base_rows[part], matches)
            if placed is None or not self._weigh(*placed):
                return False
            if self._is_undecided():
                return True
        return True

    def _sets(self, base: IntArray) -> IntArray | None:
        """Return the landmarks (h, k) that have the distances of a base; None for too many."""
        sides_m, tolerances_m = self.sides.of(base)
        if len(base) == 2:
            rows: IntArray | None = self.known.pairs(sides_m[0], tolerances_m[0])
        else:
            rows = self.known.triangles(sides_m, tolerances_m)
        only = self.seen.only[base]
        if rows is None or (only < 0).all():
            return rows
        may_be: BoolArray = ((only < 0) | (rows == only)).all(axis=1)
        return rows[may_be]

    def _look_for_others(
        self, gates: _Gates, which: IntArray, base_rows: IntArray, matches: int
    ) -> tuple[IntArray, FloatArray] | None:
        """Look for all points where sets of landmarks (h, k) have put them.

        Return the landmarks (q, m) that were found, −1 for none, and the transforms (q, 4, 4) to
        the map, of sets with as many ``matches``. None if there are too many to look at.
        """
        known, seen, m = self.known, self.seen, len(self.seen)
        k, bases = known.axes.point, gates.bases[which]
        T = _aligned(seen.points[bases], known.points[base_rows], known.axes)
        rows = np.full((len(which), m), -1)
        np.put_along_axis(rows, bases, base_rows, axis=1)
        alive, missed = np.arange(len(which)), np.zeros(len(which), dtype=np.int64)
        for others, radii_m in zip(gates.others.T, gates.radii_m.T, strict=True):
            self.looks_left -= len(alive)
            if self.looks_left < 0:
                return None
            # The landmark next to where the point should be.
            at, radius_m = others[which[alive]], radii_m[which[alive]]
            where = np.einsum('hij,hj->hi', T[alive, :k, :k], seen.points[at, :k])
            where += T[alive, :k, 3]
            limit_m = float(np.max(radius_m, initial=0.0))
            distances, near = known.tree.query(where, distance_upper_bound=limit_m)
            # It is near, may be meant, and is no other point already.
            hit = (distances <= radius_m) & ((seen.only[at] < 0) | (seen.only[at] == near))
            hit &= ~(rows[alive] == near[:, None]).any(axis=1)
            rows[alive[hit], at[hit]] = near[hit]
            missed[alive[~hit]] += 1
            alive = alive[missed[alive] <= m - matches]
        return rows[alive], T[alive]

    def _weigh(self, rows: IntArray, T: FloatArray) -> bool:
        """Weigh places (q,), those with most matches first; return whether that could be done."""
        counts = np.count_nonzero(rows >= 0, axis=1)
        for q in np.argsort(-counts, kind='stable'):
            if not self._could_matter(int(counts[q])):
                return True
            # Another place may have all its matches.
            if any(((rows[q] == place.rows) | (rows[q] < 0)).all() for place in self.found):
                continue
            self.places_left -= 1
            if self.places_left < 0:
                return False
            place = self.weighing.place(T[q], rows[q])
            if place is not None:
                self.weighing.add(place, self.found)
                if self._is_undecided():
                    return True
        return True


class _Sides:
    """Distances between m points, how well they are known, and which bases to take."""

    def __init__(self, known: MappedLandmarks, seen: Constellation) -> None:
        m, k = len(seen), known.axes.point
        self._k = k
        lines = seen.points[:, None] - seen.points[None]
        self.lengths_m: FloatArray = np.linalg.norm(lines, axis=2)
        u = lines[..., :k] / np.maximum(self.lengths_m, 1e-9)[..., None]
        blocks = seen.covariance.reshape(m, k, m, k).swapaxes(1, 2)
        own = diagonal_blocks(seen.covariance, k) + known.largest_covariance
        joint = own[:, None] + own[None] - blocks - transpose(blocks)
        variances = np.einsum('abi,abij,abj->ab', u, joint, u)
        self._deviations_m = np.sqrt(np.maximum(variances, 0.0))
        # Those first that make good bases: far apart, well known
        precise = self.lengths_m / np.maximum(self._deviations_m, 1e-3)
        order = list(np.unravel_index(np.argmax(precise), precise.shape))
        while len(order) < m:
            nearest_m = self.lengths_m[:, order].min(axis=1)
            nearest_m[order] = -1.0
            order.append(np.argmax(nearest_m))
        self._order = np.array(order, dtype=np.int64)

    @property
    def longest_m(self) -> float:
        """The longest distance that is looked for in the map."""
        return float(np.max(self.lengths_m + GATE * self._deviations_m))

    def bases(self, matches: int) -> IntArray:
        """Return points (b, k) of the bases for places with so many matches, but not with more."""
        m, k = len(self._order), self._k
        pool = self._order[: m - matches + k].tolist()
        if matches == m:
            return np.array([pool])
        return np.array([(*others, pool[-1]) for others in combinations(pool[:-1], k - 1)])

    def of(self, base: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return lengths and tolerances of the sides of a base, 0–1 first, then 0–2 and 1–2."""
        a, b = np.array(list(combinations(base.tolist(), 2))).T
        return self.lengths_m[a, b], GATE * self._deviations_m[a, b]


class _Gates:
    """How far from where b bases put them the other points may be."""

    def __init__(self, bases: IntArray, known: MappedLandmarks, seen: Constellation) -> None:
        self.bases, m, k = bases, len(seen), known.axes.point
        J, blocks = known.axes.output_matrix(seen.points), seen.covariance.reshape(m, k, m, k)
        owns = diagonal_blocks(seen.covariance, k)
        others, radii = [], []
        for base in bases:
            rest = np.setdiff1d(np.arange(m), base)
            # Of a point's own error, and what the base's error adds: (m − k, k, k k)
            moved = -J[rest] @ np.linalg.pinv(J[base].reshape(-1, known.axes.p))
            of_base = blocks[base][:, :, base].reshape(k * len(base), -1)
            of_base = of_base + np.kron(np.eye(len(base)), known.largest_covariance)
            cross = blocks[rest][:, :, base].reshape(len(rest), k, -1) @ transpose(moved)
            own = owns[rest] + known.largest_covariance
            total = own + moved @ of_base @ transpose(moved) + cross + transpose(cross)
            radii_m = GATE * np.sqrt(np.linalg.eigvalsh(total)[:, -1])
            order = np.argsort(radii_m)  # the surest first
            others.append(rest[order])
            radii.append(radii_m[order])
        self.others: IntArray = np.array(others, dtype=np.int64).reshape(-1, m - k)
        self.radii_m: FloatArray = np.array(radii).reshape(-1, m - k)


def _aligned(source: FloatArray, target: FloatArray, axes: EstimatedAxes) -> FloatArray:
    """Return the transforms (h, 4, 4) that align k points (h, k, 3) each, in least squares."""
    source_centre, target_centre = source.mean(axis=1), target.mean(axis=1)
    from_centre = source - source_centre[:, None]
    H = transpose(target - target_centre[:, None]) @ from_centre
    T = np.tile(np.eye(4), (len(source), 1, 1))
    if axes.turn == 1:
        angle = np.arctan2(H[:, 1, 0] - H[:, 0, 1], H[:, 0, 0] + H[:, 1, 1])
        T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
        T[:, 1, 0] = np.sin(angle)
        T[:, 0, 1] = -T[:, 1, 0]
    else:
        U, _, Vt = np.linalg.svd(H)
        U[:, :, 2] *= (np.linalg.det(U) * np.linalg.det(Vt))[:, None]
        T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = target_centre - np.einsum('hij,hj->hi', T[:, :3, :3], source_centre)
    return T
