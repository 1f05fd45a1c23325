"""Decides when the estimate enters a loaded map, and when it is lost there."""

from __future__ import annotations

from collections import Counter
import logging

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.merging import enter_map, start_in_map
from slam_observer_ros.state.state import State
from slam_observer_ros.state.step import Outcome

logger = logging.getLogger(__name__)

NEWS = 0.1
"""Share of the observations that is new when the same landmarks are compared with a map again:
with many of them that takes long, and a single further observation seldom decides it.
"""

CONFIRMING_VOTES = 10
"""Observations that confirm a pose that was given."""


class Localiser:
    """Follows whether the estimate is in the frame of a map that was loaded."""

    def __init__(self) -> None:
        self.loaded: LandmarkMap | None = None
        self.is_localised = True  # in the final frame: always, unless a map was loaded
        self.counts: Counter[str] = Counter()  # 'not_localised' observations, poses 'lost'
        self._trial: PoseTrial | None = None
        self._comparisons = Comparisons()

    def load(self, landmark_map: LandmarkMap, two_d_mode: bool) -> None:
        """Take a map instead of one loaded before; the pose in it is yet to be found."""
        self.loaded = landmark_map.flattened() if two_d_mode else landmark_map
        if landmark_map.is_planar and not two_d_mode:
            logger.warning(
                'The map was made with two_d_mode, which is off: in space its heights of zero are '
                'taken for exact (use two_d_mode: true for a robot on a floor).'
            )
        self.is_localised = False
        self._trial = None
        self._comparisons = Comparisons()

    def start(self, state: State, pose_is_given: bool, covariance: FloatArray | None) -> None:
        """Take a state at its start, in the loaded map if its pose there is given.

        ``covariance`` (6, 6) is that of the given pose; None for an exact one.
        """
        self._comparisons = Comparisons()
        self.is_localised = self.loaded is None or pose_is_given
        self._trial = None
        if self.loaded is not None and pose_is_given:
            start_in_map(state, self.loaded, covariance)
            self._trial = PoseTrial(self.loaded)

    def doubt_pose(self) -> None:
        """Put a pose that was given on trial."""
        self._trial = None if self.loaded is None else PoseTrial(self.loaded)

    def reason_to_reset(self, state: State, outcome: Outcome) -> str | None:
        """Return why the pose in the map must be wrong after an observation, or None."""
        if self.loaded is None:
            return None
        reason = None
        if self._trial is not None and self._trial.vote(outcome, state.settings.max_rejections):
            reason = 'Most landmarks contradict the pose that was given'
        elif self.is_localised and is_lost(state):
            reason = 'All landmarks are far from where they should be'
        self.counts['lost'] += reason is not None
        return reason

    def search(self, state: State) -> bool:
        """Enter the map after an observation, if it is time to compare; return whether it did."""
        if self.loaded is None or self.is_localised:
            return False
        shared = int(np.sum(state.landmarks.rows_of(self.loaded.ids) >= 0))
        if self._comparisons.is_due(shared):
            self.enter(state)
        self.counts['not_localised'] += not self.is_localised
        return self.is_localised

    def enter(self, state: State) -> bool:
        """Move an estimate into the frame of the loaded map, if the landmarks suffice."""
        if self.loaded is not None and enter_map(state, self.loaded):
            self.is_localised = True
            logger.info('Found the pose in the map of %d landmarks.', len(self.loaded.ids))
        return self.is_localised


def is_lost(state: State) -> bool:
    """Return whether the pose in a map has been wrong for some time, or the robot was carried.

    All landmarks seen of late were rejected then, and as many as would do to find the pose again
    so often that elsewhere they would be taken to have moved.
    """
    often = state.settings.max_rejections
    moved = np.sum(state.landmarks.rejections >= often)
    needed = state.axes.point
    return bool(not state.is_mapping and state.rejected_in_a_row >= often and moved >= needed)


class Comparisons:
    """When a map is worth comparing with what was seen: that takes long, and seldom says more."""

    def __init__(self) -> None:
        self._observations = self._compared_at = self._shared = 0

    def is_due(self, shared: int) -> bool:
        """Count an observation; return whether to compare, now that ``shared`` landmarks are."""
        self._observations += 1
        if shared == self._shared and self._observations < (1.0 + NEWS) * self._compared_at:
            return False
        self._shared, self._compared_at = shared, self._observations
        return True


class PoseTrial:
    """A pose in a map that someone has given, on trial until landmarks of the map confirm it.

    With a wrong one the map's landmarks would be rejected, and where mapping goes on be taken to
    have moved, all of them. Observations vote: against it, if more of the map's landmarks in them
    were rejected than accepted. One alone may be garbled, and some landmarks have moved.
    """

    def __init__(self, known: LandmarkMap) -> None:
        self._ids = known.ids
        self._for = self._against = 0

    def vote(self, outcome: Outcome, often: int) -> bool:
        """Count the vote of an observation; return whether ``often`` ones say it is wrong."""
        if self._for >= CONFIRMING_VOTES and self._for > self._against:
            return False
        rejected = int(np.isin(outcome.ids[outcome.rejected], self._ids).sum())
        accepted = int(np.isin(outcome.ids, self._ids).sum()) - rejected
        self._for += int(accepted > 0 and accepted >= rejected)
        self._against += int(rejected > accepted)
        return self._against >= often and self._against > self._for
