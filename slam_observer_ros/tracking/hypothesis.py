"""One of several hypotheses about pose and map: a state, and its view of points without an id.

That is a record of what the sensor sees: which landmarks should have been seen, and which were.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
import math
from typing import TypeAlias

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray, is_automatic
from slam_observer_ros.estimates import Change
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.filter.landmark_table import LandmarkTable
from slam_observer_ros.tracking.state import State

HULL_MARGIN = 0.01
"""How far outside, as a share of what it measures across, a point may be and still be inside.

Points are noisy, and without it each exact one at the sensor's full range would be a corner.
"""


LEAST_VIEW = 0.1
"""Least share of all directions that a sensor sees: the hull of few points is far too small."""


class FieldOfView:
    """The convex hull, in the body frame, of the base and of all points that were ever seen.

    So no sensor has to be described. The hull is rather too large than too small: one wrong point
    behind a camera, and it sees all around. Until it has an inside, which it never has where all
    points lie in one plane with the base, everything counts as in view, and the latest points are
    kept. Of points, the first ``k`` coordinates matter: 2 in the plane, 3 in space.
    """

    def __init__(self, k: int) -> None:
        self.corners = np.zeros((1, k))  # (q, k) the base and points that span the hull, metres
        self._faces: FloatArray = np.empty((0, k + 1))
        self.volume = 0.0  # in which the sensor sees, m^k; 0 while nobody knows
        self._margin_m = 0.0

    @property
    def is_known(self) -> bool:
        """Whether the hull has an inside."""
        return len(self._faces) > 0

    def include(self, points: FloatArray) -> None:
        """Add points (m, 3) that were seen, metres, body frame."""
        from scipy.spatial import ConvexHull, QhullError  # which only points without ids need

        k = self.corners.shape[1]
        known = self.contains(points) & self.is_known
        if known.all():
            return
        corners = np.concatenate([self.corners, points[~known, :k]])
        try:
            hull = ConvexHull(corners)
        except QhullError:  # all of them in one point, on one line or in one plane
            self.corners = np.concatenate([np.zeros((1, k)), corners[1:][-2 * k :]])
            return
        self.corners, self._faces = corners[hull.vertices], hull.equations
        reach_m = np.linalg.norm(self.corners, axis=1).max()
        ball = (math.pi if k == 2 else 4.0 / 3.0 * math.pi) * reach_m**k
        self.volume = max(float(hull.volume), LEAST_VIEW * ball)
        self._margin_m = HULL_MARGIN * float(np.ptp(self.corners, axis=0).max())

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which points (m, 3) lie where the sensor sees, metres, body frame."""
        k = self.corners.shape[1]
        heights_m = points[:, :k] @ self._faces[:, :k].T + self._faces[:, k]
        return np.asarray((heights_m <= self._margin_m).all(axis=1))


IMPROBABLE = 20.0
"""−ln of the probability below which it is no chance that none of several landmarks is seen."""

MOVED_M = 0.5
"""Distance, metres, after which a robot looks from another place, where other things hide."""

MAX_EVIDENCE = 2.0
"""Evidence of one observation at most: what hides a landmark hides others, and for some time."""


class Visibility:
    """The view of a sensor without ids, in ``k`` = 2 or 3 dimensions: what it sees and misses."""

    def __init__(self, k: int) -> None:
        self.field_of_view = FieldOfView(k)
        # landmarks without an id that surely exist since the last observation, and false ones
        self.sure_now = self.false_now = 0
        self._last_place: FloatArray | None = None  # (3,) metres, reference frame
        # −ln of the probability that for so long none is seen of the landmarks known before: those
        # without an id that were numbered up to here.
        self._evidence = 0.0
        self._newest_number = 0
        self.missed = 0.0  # confirmed landmarks that should have been seen last, and were not

    def copy(self) -> Visibility:
        """Return an independent copy, of a sensor that sees the same by any hypothesis."""
        return copy(self)

    def note(self, state: State, event: ObservationEvent, some_have_ids: bool) -> float:
        """Count which landmarks were in view of an observation, already used, and which were seen.

        Some of its points came without an id. The field of view is as it was before. Unless others
        have one (``some_have_ids``), which show better where the robot is, the pose is counted as
        unexpected if none of the landmarks in view was seen for so long that it is no chance any
        more. Landmarks that hardly exist are forgotten; landmarks out of view never: one may be
        the only tie to an older part of the map. Return −2 ln of the probability that landmarks in
        view were missed.
        """
        # What should have been seen, and was.
        landmarks = state.landmarks
        is_numbered, everything = is_automatic(landmarks.ids), np.arange(len(landmarks))
        numbers = np.where(is_numbered, landmarks.ids, 0)
        seen = landmarks.last_seen_ns == event.stamp_ns
        in_view = seen | self.field_of_view.contains(state.observer.body_points(everything))
        if not some_have_ids and self._add_evidence(landmarks, numbers, in_view, seen):
            state.counts['unexpected_place'] += 1
        # What it costs to have missed those without an id of their own; and counts of all.
        has_moved, unseen = self._has_moved(state), in_view & ~seen
        cost = self._miss(landmarks, np.flatnonzero(is_numbered & unseen), has_moved)
        self.missed = landmarks.likely_share * np.count_nonzero(unseen & ~landmarks.tentative)
        rows = np.flatnonzero(in_view & (is_numbered | (not some_have_ids)))
        landmarks.note_in_view(rows, seen[rows], has_moved)
        unlikely = landmarks.unlikely()
        self.false_now = len(unlikely)
        state.forget(unlikely, Change.UNSUPPORTED, event.stamp_ns)
        return cost

    def _has_moved(self, state: State) -> bool:
        """Return whether the robot is at another place than when it last was at another one."""
        place, last = state.observer.A[:3, 3], self._last_place
        has_moved = last is not None and math.dist(place.tolist(), last.tolist()) >= MOVED_M
        if last is None or has_moved:
            self._last_place = place.copy()
        return has_moved

    def _miss(self, landmarks: LandmarkTable, unseen: IntArray, has_moved: bool) -> float:
        """Let landmarks (u,) in view be missed once more; return what that costs."""
        if not len(unseen):
            return 0.0
        hidden, exist = landmarks.hidden(unseen, has_moved), landmarks.existence(unseen)
        landmarks.weigh(unseen, np.log(hidden))
        cost = -2.0 * float(np.sum(np.log1p(exist * (hidden - 1.0))))
        return cost if self.field_of_view.is_known else 0.0

    def _add_evidence(
        self,
        landmarks: LandmarkTable,
        numbers: IntArray,
        in_view: BoolArray,
        seen: BoolArray,
    ) -> bool:
        """Count landmarks (n,) in view that were missed; return whether too many, too long."""
        old = in_view & ~landmarks.tentative & (numbers <= self._newest_number)
        if (old & seen).any():
            self._evidence = 0.0
        elif self.field_of_view.is_known:
            evidence = landmarks.rate * int(np.count_nonzero(old))
            self._evidence += min(evidence, MAX_EVIDENCE)
        is_unexpected = self._evidence > IMPROBABLE
        if is_unexpected or self._evidence == 0.0:
            self._evidence = 0.0
            self._newest_number = int(np.max(numbers, initial=0))
        return is_unexpected


IdPairs: TypeAlias = frozenset[tuple[int, int]]  # ids of landmarks that are one, the lower first


@dataclass(frozen=True, slots=True)
class Twins:
    """One answer to which landmarks are one: these."""

    rows: IntArray  # (q,) those that were seen first …
    copies: IntArray  # (q,) … and those that they are, which go
    cost: float  # −2 ln of its likelihood over the likeliest answer's
    seen_costs: FloatArray  # (q,) the part of it that says where each pair was seen
    width: float = 1.0  # factor of what odometry states that it has been off by

    def asked(self, ids: IntArray) -> frozenset[IdPairs]:
        """Return what is not asked again: each pair, or all together where odometry is off."""
        pairs = self.pairs(ids)
        return frozenset([pairs] if self.width > 1.0 else [frozenset([one]) for one in pairs])

    def pairs(self, ids: IntArray) -> IdPairs:
        """Return it by the ids (n,) of all landmarks."""
        return frozenset(id_pairs(ids, self.rows, self.copies))


def id_pairs(ids: IntArray, rows: IntArray, others: IntArray) -> list[tuple[int, int]]:
    """Return the ids of landmarks (q,) and of others (q,), pair by pair, the lower first."""
    pairs = np.sort(np.column_stack([ids[rows], ids[others]]), axis=1).tolist()
    return [(a, b) for a, b in pairs]


@dataclass(frozen=True, slots=True)
class Branch:
    """Where a hypothesis parted from another one that is followed."""

    number: int  # which of the two it is
    stamp_ns: int
    position: FloatArray  # (3,) of the robot, metres, world


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A state, with its view of points without an id."""

    state: State
    visibility: Visibility  # the view of a sensor that gives no ids
    cost: float = 0.0  # −2 ln of its likelihood over the most likely one's
    relinearised: float = 0.0  # what of that is by where landmarks were seen, relinearised
    asked: frozenset[IdPairs] = frozenset()  # pairs, and answers of several
    path: tuple[Branch, ...] = ()  # which way it went where others went another

    @classmethod
    def of(cls, state: State) -> Hypothesis:
        """Return the only hypothesis there is."""
        return cls(state, Visibility(state.axes.point))

    def with_state(self, state: State) -> Hypothesis:
        """Return another hypothesis, which has had the same landmarks in view."""
        return replace(self, state=state, visibility=self.visibility.copy())

    def copy(self) -> Hypothesis:
        """Return an independent copy."""
        return self.with_state(self.state.copy())
