"""Which landmarks without an id should have been seen, and which were."""

from __future__ import annotations

import math

import numpy as np

from slam_observer_ros.association.field_of_view import FieldOfView
from slam_observer_ros.common.types import BoolArray, IntArray
from slam_observer_ros.events import is_automatic, ObservationEvent
from slam_observer_ros.observer.observer import Observer
from slam_observer_ros.state.landmark_table import LandmarkTable

IMPROBABLE = 20.0
"""−ln of the probability below which it is no chance that none of several landmarks is seen."""

MIN_SHARE, MOST_SHARE = 0.1, 0.9
"""How often a landmark in view is seen at least, as in a map that was loaded, and at most: one
that was seen each time may yet be hidden.
"""

MAX_SURPRISE = 2.0
"""Surprise of one observation at most: what hides a landmark hides others, and for some time."""


class Surroundings:
    """What a sensor that gives no ids sees of the landmarks around it.

    Parameters
    ----------
    observer, landmarks : Observer, LandmarkTable
        The state.
    k : int
        Leading coordinates that matter: 2 in the plane, 3 in space.

    """

    def __init__(self, observer: Observer, landmarks: LandmarkTable, k: int) -> None:
        self._observer, self._landmarks = observer, landmarks
        self._field_of_view = FieldOfView(k)
        # −ln of the probability that none is seen for so long of the landmarks known before: those
        # without an id that were numbered up to here.
        self._surprise = 0.0
        self._newest_number = 0

    def note(self, event: ObservationEvent, some_have_ids: bool) -> tuple[float, bool]:
        """Count which landmarks were in view of an observation, already used, and which were seen.

        Parameters
        ----------
        event : ObservationEvent
            The observation; some of its points came without an id.
        some_have_ids : bool
            Whether other points come with an id: these tell better where the robot is.

        Returns
        -------
        cost : float
            −2 ln of the probability that settled landmarks in view were not seen, those that were
            not.
        is_strange : bool
            Whether the place has become strange, if there are no ids at all: points were seen for
            so long, and of the landmarks that should have been among them not one, that it is no
            chance any more.

        """
        landmarks, is_numbered = self._landmarks, is_automatic(self._landmarks.ids)
        everything = np.arange(len(landmarks))
        seen = landmarks.last_seen_ns == event.stamp_ns
        in_view = seen | self._field_of_view.contains(self._observer.body_points(everything))
        is_strange = not some_have_ids and self._add_surprise(event, in_view, seen)
        rows = np.flatnonzero(is_numbered & in_view)
        cost = self._cost(rows[~seen[rows] & ~landmarks.tentative[rows]])
        landmarks.note_in_view(rows, seen[rows])
        self._field_of_view.include(event.points)
        return cost, is_strange

    def _cost(self, unseen: IntArray) -> float:
        """Return what it costs that these settled landmarks (u,) in view were not seen once more.

        The rate at which one in view is seen differs from one to the other and from place to
        place. Where it is exponentially distributed about its mean p, one is not seen k times in
        a row with the probability 1/(1 + k p): one that is hidden soon costs little more.
        """
        if not self._field_of_view.is_known:
            return 0.0
        p, missed = self._seen_share, self._landmarks.missed[unseen]
        return 2.0 * float(np.sum(np.log1p(p / (1.0 + missed * p))))

    @property
    def _seen_share(self) -> float:
        """How often a landmark in view is seen, as far as it is known."""
        return min(max(self._landmarks.seen_share, MIN_SHARE), MOST_SHARE)

    def _add_surprise(self, event: ObservationEvent, in_view: BoolArray, seen: BoolArray) -> bool:
        """Count those in view and not seen (n,); return whether they are too many, too long."""
        landmarks = self._landmarks
        numbers = np.where(is_automatic(landmarks.ids), landmarks.ids, 0)
        old = in_view & ~landmarks.tentative & (numbers <= self._newest_number)
        if (old & seen).any():
            self._surprise = 0.0
        elif len(event.points) and self._field_of_view.is_known:
            surprise = -math.log1p(-self._seen_share) * int(np.sum(old))
            self._surprise += min(surprise, MAX_SURPRISE)
        is_strange = self._surprise > IMPROBABLE
        if is_strange or self._surprise == 0.0:
            self._surprise = 0.0
            self._newest_number = int(np.max(numbers, initial=0))
        return is_strange
