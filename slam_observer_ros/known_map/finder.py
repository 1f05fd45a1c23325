"""Finds the pose in a map by landmarks without ids: by how they lie to each other."""

from __future__ import annotations

import logging
import math

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import is_automatic
from slam_observer_ros.known_map.constellation import find_places
from slam_observer_ros.known_map.distances import MappedLandmarks
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_check import place_for_another, symmetries
from slam_observer_ros.known_map.places import (
    Anywhere,
    Constellation,
    Near,
    Place,
    PlacePrior,
    Places,
    Weighing,
)
from slam_observer_ros.state.state import State

logger = logging.getLogger(__name__)

MIN_COUNT = 2
"""How often a landmark must have been seen: most false points are seen once."""

MAX_SOUGHT = 12
"""Landmarks by which places are searched for, those seen last."""

MAX_WEIGHED = 60
"""Landmarks by which the places that were found are weighed."""

MAX_FITTING = 50
"""Places that are weighed by all of these."""

NEWS = 1.3
"""How many times as often landmarks must have been seen before it is worth searching again."""


def warn_of_symmetry(loaded: LandmarkMap) -> None:
    """Log that a map looks the same when turned, and where one more landmark would change that."""
    if not (same := symmetries(loaded)):
        return
    differ = int(np.count_nonzero(~same[0].is_same))
    x, y, _ = place_for_another(loaded, same[0]).tolist()
    logger.warning(
        'This map is the same turned by %.0f°%s: without ids or a start pose the robot %s; one '
        'more landmark, at (%.1f m, %.1f m), would do.',
        same[0].turn_deg,
        f' but for {differ} landmarks' if differ else '',
        'is found only near these' if differ else "can't be found",
        x,
        y,
    )


class Finder:
    """Searches a map for the place where an estimate in a frame of its own is.

    ``rough`` is a pose (4, 4) and its covariance (6, 6) if the place of that frame is roughly
    known.
    """

    def __init__(
        self,
        loaded: LandmarkMap,
        state: State,
        rough: tuple[FloatArray, FloatArray] | None,
    ) -> None:
        self._loaded = loaded
        covariances = loaded.covariances_or(state.settings.map_noise)
        self._known = MappedLandmarks(loaded.world_points, covariances, state.axes)
        self._prior: PlacePrior = (
            Anywhere(self._known) if rough is None else Near(*rough, state.axes)
        )
        warn_of_symmetry(loaded)
        self._searched: tuple[int, int] | None = None
        self.places: Places | None = None  # that fit, when it was searched last

    def find(self, state: State) -> tuple[IntArray, IntArray] | None:
        """Return landmarks (q,) of an estimate, and which of the map's (q,) they are.

        None unless there is one place that fits, or if nothing much is new since the last search.
        """
        if not (rows := self._rows(state)).size or not self._is_due(state, rows):
            return None
        seen = self._constellation(state, rows)
        if seen is None:
            return None
        error_probability = state.settings.localization_error_probability
        places = self._search(seen, error_probability)
        self.places = places
        place = places.decided(error_probability)
        if place is None:
            return None
        matched = place.rows >= 0
        return rows[matched], place.rows[matched]

    def _rows(self, state: State) -> IntArray:
        """Return the landmarks to go by, those seen last first; none if all have ids."""
        landmarks = state.landmarks
        has_no_id = is_automatic(landmarks.ids) & (landmarks.counts >= MIN_COUNT)
        rows = np.flatnonzero(has_no_id | np.isin(landmarks.ids, self._loaded.ids))
        if not has_no_id.any() or len(rows) <= state.axes.point:
            return np.empty(0, dtype=np.int64)
        return rows[np.argsort(-landmarks.last_seen_ns[rows], kind='stable')][:MAX_WEIGHED]

    def _is_due(self, state: State, rows: IntArray) -> bool:
        """Return whether a search may say more than the last one."""
        seen_so_often = math.log(float(state.landmarks.counts[rows].sum()))
        news = (len(rows), int(seen_so_often / math.log(NEWS)))
        is_due = news != self._searched
        self._searched = news
        return is_due

    def _constellation(self, state: State, rows: IntArray) -> Constellation | None:
        """Return landmarks of an estimate as points; None of gains without a covariance."""
        P = state.filter.joint_covariance(rows)
        if P is None:
            return None
        ids, known_ids = state.landmarks.ids[rows], self._loaded.ids
        order = np.argsort(known_ids)
        at = order[np.searchsorted(known_ids, ids, sorter=order) % len(known_ids)]
        is_named = (known_ids[at] == ids) & ~is_automatic(ids)
        only = np.where(is_named, at, -1)
        p = state.axes.p
        return Constellation(state.filter.points[rows], P[p:, p:], only)

    def _search(self, seen: Constellation, error_probability: float) -> Places:
        """Search by the landmarks seen last, and weigh what fits by all of them."""
        near = self._known.within_reach(seen.points[:MAX_SOUGHT])
        sought = seen.select(near)
        places = find_places(self._known, sought, self._prior, error_probability)
        if len(sought) == len(seen):
            return places
        weighing = Weighing(self._known, seen, self._prior)
        found: list[Place] = []
        for place in places.all[:MAX_FITTING]:
            rows = np.full(len(seen), -1)
            rows[near] = place.rows
            fitted = weighing.place(place.transform, rows)
            if fitted is not None:
                weighing.add(fitted, found)
        return weighing.places(found, places.is_complete)
