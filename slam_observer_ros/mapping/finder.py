"""Finds the pose in a map by landmarks without ids: by how they lie to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
import logging
import math

import numpy as np

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import EstimatedAxes
from slam_observer_ros.mapping.constellation import find_places, MAX_LOOKS
from slam_observer_ros.mapping.landmark_map import LandmarkMap, MappedLandmarks
from slam_observer_ros.mapping.map_alignment import (
    AlikeMaps,
    Likeness,
    likeness_by_ids,
    place_for_another,
    symmetries,
    turns_onto,
)
from slam_observer_ros.mapping.places import (
    Anywhere,
    Constellation,
    Near,
    Place,
    PlacePrior,
    Places,
    Weighing,
)
from slam_observer_ros.settings.estimator_settings import ERROR_PROBABILITY
from slam_observer_ros.tracking.state import State

logger = logging.getLogger(__name__)

MIN_COUNT = 2  # how often a landmark must have been seen: most false points are seen once
MAX_SOUGHT = 12  # landmarks by which places are searched for, those seen last
MAX_WEIGHED = 60  # landmarks by which the places that were found are weighed
MAX_FITTING = 50  # places that are weighed by all of these
FEWEST_COMPARED = 2  # landmarks beyond those that fix a place by which ids and places are compared
NEWS = 1.3  # how many times as often landmarks must have been seen to be searched for again


def warn_of_symmetry(loaded: LandmarkMap, name: str) -> None:
    """Log that a map looks the same when turned, and where one more landmark would change that."""
    if not (same := symmetries(loaded)):
        return
    differ = int(np.count_nonzero(~same[0].is_same))
    x, y, _ = place_for_another(loaded, same[0]).tolist()
    finding = found(
        'symmetric_map',
        name=f' {name}' if name else '',
        turn_deg=same[0].turn_deg,
        but=f' but for {differ} landmarks' if differ else '',
        consequence='is found only near these' if differ else "can't be found",
        x=x,
        y=y,
    )
    logger.warning('%s', finding)


def _likeness(known: LandmarkMap, other: LandmarkMap) -> Likeness | None:
    """Return how a map is to be moved to look as another, if their ids have not said so."""
    found = turns_onto(known, other) if likeness_by_ids(known, other) is None else []
    return max(found, key=lambda each: int(each.is_same.sum()), default=None)


class Finder:
    """Searches maps for the place where an estimate in a frame of its own is.

    ``rough`` is a pose (4, 4) and its covariance (6, 6) if that is roughly known, in any map.
    """

    def __init__(
        self,
        maps: Sequence[LandmarkMap],
        state: State,
        rough: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        self._maps = [_SearchedMap(known, state, rough) for known in maps]
        self._ids = np.concatenate([known.ids for known in maps])
        self._has_warned = False  # of maps that look alike, to points without ids
        self.alike = AlikeMaps([], _likeness)
        self._searched: tuple[int, int] | None = None
        self._compared = 0  # bits of the number of views at which ids were compared last
        self.contradiction: Finding | None = None  # of ids and places, as it was seen last
        self.places: Places | None = None  # that fit, when it was searched last

    def find(self, state: State) -> tuple[LandmarkMap, tuple[IntArray, IntArray]] | None:
        """Return the map, landmarks (q,) of an estimate, and which of the map's (q,) they are.

        None unless there is one place that fits, or if nothing much is new since the last search.
        """
        if not (rows := self._rows(state)).size:
            return None
        seen_so_often = math.log(float(state.landmarks.counts[rows].sum()))
        last, self._searched = self._searched, (len(rows), int(seen_so_often / math.log(NEWS)))
        if last == self._searched:  # nothing says more than the last time
            return None
        P = state.gains.joint_covariance(rows)
        if P is None:
            return None
        p = state.axes.p
        seen = Constellation(state.observer.points[rows], P[p:, p:], np.full(len(rows), -1))
        ids = state.landmarks.ids[rows]
        self.places = places = self._search(seen, ids)
        place = places.decided(ERROR_PROBABILITY)
        if place is None or self._note_ids(place, ids):
            return None
        matched = place.rows >= 0
        pairs = rows[matched], place.rows[matched]
        return self._maps[place.map_index].loaded, pairs

    def compare_ids(self, state: State) -> None:
        """See whether a map has the ids but other places, or the places but other ids.

        Only who is asked why the pose is not known does so: it may take two seconds.
        """
        landmarks, fewest = state.landmarks, FEWEST_COMPARED + state.axes.point
        rows = np.flatnonzero(~is_automatic(landmarks.ids) & (landmarks.counts >= MIN_COUNT))
        views = int(landmarks.counts[rows].sum()).bit_length()
        if len(rows) < fewest or views == self._compared:
            return
        self._compared = views
        P = state.gains.joint_covariance(rows)
        if P is None:
            return
        p, nameless = state.axes.p, np.full(len(rows), -1)
        seen = Constellation(state.observer.points[rows], P[p:, p:], nameless)
        places = self._search(seen, nameless)
        place = places.decided(ERROR_PROBABILITY)
        if place is not None:
            self._note_ids(place, landmarks.ids[rows])
            return
        named = int(np.isin(landmarks.ids[rows], self._ids).sum())
        fits = places.likely or (self.places is not None and self.places.likely)
        if named >= fewest and not fits:
            self._contradict(found('other_hall', count=named))

    def _note_ids(self, place: Place, ids: IntArray) -> bool:
        """Note if a map has other ids at a place than landmarks (m,) have; return whether so."""
        known, fits = self._maps[place.map_index].loaded, place.rows >= 0
        others = known.ids[place.rows[fits]] != ids[fits]
        count = int(np.count_nonzero(others & ~is_automatic(ids[fits])))
        if 2 * count <= len(ids):
            return False
        name = f' {known.name}' if len(self._maps) > 1 else ''
        self._contradict(found('other_ids', count=count, name=name))
        return True

    def _contradict(self, finding: Finding) -> None:
        if self.contradiction is None or self.contradiction.kind != finding.kind:
            logger.warning('%s', finding)
        self.contradiction = finding

    def _rows(self, state: State) -> IntArray:
        """Return the landmarks to go by, those seen last first; none if their ids are enough."""
        landmarks = state.landmarks
        has_no_id = is_automatic(landmarks.ids) & (landmarks.counts >= MIN_COUNT)
        if has_no_id.any() and not self._has_warned:
            self._has_warned = True
            maps = [known.loaded for known in self._maps]
            for loaded in maps:
                warn_of_symmetry(loaded, loaded.name if len(maps) > 1 else '')
            self.alike = AlikeMaps(maps, _likeness)
        rows = np.flatnonzero(has_no_id | np.isin(landmarks.ids, self._ids))
        are_ids_enough = len(self._maps) == 1 and not has_no_id.any()
        if are_ids_enough or len(rows) <= state.axes.point:
            return np.empty(0, dtype=np.int64)
        return rows[np.argsort(-landmarks.last_seen_ns[rows], kind='stable')][:MAX_WEIGHED]

    def _search(self, seen: Constellation, ids: IntArray) -> Places:
        """Search by the landmarks seen last, and weigh what fits by all of them."""
        reached = [known.mapped.within_reach(seen.points[:MAX_SOUGHT]) for known in self._maps]
        near = reduce(np.intersect1d, reached)
        parts = self._find_places(seen.select(near), ids[near])
        if len(near) < len(seen):
            parts = {i: self._maps[i].weighed(part, seen, ids, near) for i, part in parts.items()}
        return Places.in_several_maps(parts)

    def _find_places(self, sought: Constellation, ids: IntArray) -> dict[int, Places]:
        """Search all maps, that which was the most likely one last time first."""
        best = 0 if self.places is None or not self.places.all else self.places.all[0].map_index
        order = sorted(range(len(self._maps)), key=lambda i: i != best)
        looks, rival = MAX_LOOKS // len(order), -math.inf
        parts: dict[int, Places] = {}
        # Those before the best one may have been left with two places that it makes unlikely.
        for i in [*order, *order[:-1]]:
            if i in parts and rival == _largest_mass(parts[i]):
                break
            known = self._maps[i]
            seen = replace(sought, only=known.named(ids))
            parts[i] = find_places(
                known.mapped, seen, known.prior, ERROR_PROBABILITY, rival, looks
            )
            rival = max(rival, _largest_mass(parts[i]))
        return parts


class _SearchedMap:
    """A map, and what a search of it needs."""

    def __init__(
        self, loaded: LandmarkMap, state: State, rough: tuple[FloatArray, FloatArray] | None
    ) -> None:
        self.loaded = loaded
        covariances = loaded.covariances_or(state.settings.map_noise)
        self.mapped = MappedLandmarks(loaded.world_points, covariances, state.axes)
        self.prior: PlacePrior = (
            Anywhere(self.mapped) if rough is None else Near(*rough, state.axes)
        )

    def weighed(self, places: Places, seen: Constellation, ids: IntArray, at: IntArray) -> Places:
        """Return places that were found by points ``at`` (q,), weighed by all (m,)."""
        weighing = Weighing(self.mapped, replace(seen, only=self.named(ids)), self.prior)
        found: list[Place] = []
        for place in places.all[:MAX_FITTING]:
            rows = np.full(len(seen), -1)
            rows[at] = place.rows
            fitted = weighing.place(place.transform, rows)
            if fitted is not None:
                weighing.add(fitted, found)
        return Places.weighed(found, weighing.log_none, places.is_complete)

    def named(self, ids: IntArray) -> IntArray:
        """Return the landmarks (m,) that ids of a sensor name, −1 for none."""
        return np.where(is_automatic(ids), -1, self.loaded.rows_of(ids))


def _largest_mass(places: Places) -> float:
    """Return ln of the mass of the most likely place."""
    return places.all[0].log_mass if places.all else -math.inf


MAX_PLACES, MAX_SEEN = 600, 12  # places of a look around, and landmarks in view that it goes by


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """What q looks around from places all over a map say."""

    poses: FloatArray  # (q, 4, 4)
    seen: IntArray  # (q,) landmarks in view
    fitting: IntArray  # (q,) places where these fit; 0 where they are too few
    error_probabilities: FloatArray  # (q,) that the most likely place is wrong
    is_found: BoolArray  # (q,) is it sure enough


def look_around(
    known: LandmarkMap,
    axes: EstimatedAxes,
    view_m: float,
    fov_rad: float,
    sigma_m: float,
    map_sigma_m: float,
    error_probability: float,
) -> Looks:
    """Look around from places all over a map, by a sensor that sees ``view_m`` far.

    ``fov_rad`` is its field of view, and ``sigma_m`` the noise of each coordinate; ``map_sigma_m``
    is for landmarks whose file gives none.
    """
    mapped = MappedLandmarks(known.world_points, known.covariances_or(map_sigma_m), axes)
    mapped.reach(2.0 * view_m)
    poses = _poses(known.world_points, fov_rad)
    results = []
    for pose in poses:
        points = se3.transform(se3.inverse(pose), known.world_points)
        ranges_m = np.linalg.norm(points[:, :2], axis=1)
        bearings = np.abs(np.arctan2(points[:, 1], points[:, 0]))
        in_view = np.flatnonzero((ranges_m <= view_m) & (bearings <= 0.5 * fov_rad))
        points = points[in_view[np.argsort(ranges_m[in_view])][:MAX_SEEN]]
        covariance = sigma_m**2 * np.eye(axes.point * len(points))
        constellation = Constellation(points, covariance, np.full(len(points), -1))
        if len(points) <= axes.point:
            results.append((len(points), 0, 1.0, False))
            continue
        places = find_places(mapped, constellation, Anywhere(mapped), error_probability)
        fitting = sum(place.share > error_probability for place in places.all)
        is_found = places.decided(error_probability) is not None
        results.append((len(points), fitting, places.error_probability, is_found))
    return Looks(poses, *(np.array(column) for column in zip(*results, strict=True)))


def _poses(points: FloatArray, fov_rad: float) -> FloatArray:
    """Return poses (q, 4, 4) all over the area of the landmarks, some headings at each place."""
    low, high = points.min(axis=0)[:2], points.max(axis=0)[:2]
    headings = 1 if fov_rad >= 2.0 * math.pi else 4
    sides_m = np.maximum(high - low, 1.0)
    step_m = math.sqrt(float(np.prod(sides_m)) * headings / MAX_PLACES)
    x, y = np.meshgrid(
        *(np.arange(a + 0.5 * step_m, b, step_m) for a, b in zip(low, low + sides_m, strict=True))
    )
    at = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.median(points[:, 2]))])
    yaws = 2.0 * math.pi * np.arange(headings) / headings
    turns = so3.exp(np.column_stack([np.zeros((headings, 2)), yaws]))
    return np.array([se3.pose(R, position) for position in at for R in turns])
