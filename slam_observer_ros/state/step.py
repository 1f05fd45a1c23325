"""What an observation changes in a state: pose and landmarks are corrected, the map managed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.observer.filter import Residuals
from slam_observer_ros.state.map_management import forget, initialise, relocate, rows_to_forget
from slam_observer_ros.state.matching import MatchedObservation
from slam_observer_ros.state.state import Slam


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a state made of an observation.

    Attributes
    ----------
    ids : IntArray
        (m,) ids of the landmarks seen that were known before.
    residuals : FloatArray
        (m, 3) their residuals before the correction, metres, reference frame.
    rejected : BoolArray
        (m,) which of them were too far off to be used.
    moved_ids : IntArray
        Landmarks that it showed to have moved.

    """

    ids: IntArray
    residuals: FloatArray
    rejected: BoolArray
    moved_ids: IntArray


def is_contradiction(rejected: BoolArray) -> bool:
    """Return whether most of the known landmarks (m,) seen are rejected: the pose may be wrong."""
    return bool(2 * np.count_nonzero(rejected) > len(rejected))


def update(slam: Slam, matched: MatchedObservation) -> Outcome:
    """Use what :meth:`.Slam.match` has returned for an observation; return what came of it."""
    slam.counts['unmapped_landmark'] += matched.left_out
    event, rows, known = matched.event, matched.rows, matched.known
    forgotten = rows_to_forget(slam, matched)
    if len(forgotten):
        # A history without them would lose what they have told of the pose.
        slam.gains.restart(slam.observer, 'landmarks had to make room (max_landmarks)')
    rejected = _correct(slam, known, matched.residuals)
    if len(known.ids) < len(rows):
        is_new = rows < 0
        forget(slam, forgotten, 'forgotten_landmark')
        initialise(slam, event.select(is_new), matched.covariances[is_new])
        event, rows = slam.mapped(event)
    moved_ids = _look_back(slam, event, rows)
    _note_velocities(slam, event, rows)
    return Outcome(known.ids, matched.residuals.r, rejected, moved_ids)


def _correct(slam: Slam, event: ObservationEvent, residuals: Residuals) -> BoolArray:
    """Correct the state by the landmarks of ``event``; return which (m,) were rejected."""
    rows = residuals.rows
    if not len(rows):
        return np.empty(0, dtype=np.bool_)
    correction, weights = slam.gains.correct(residuals)
    slam.observer.correct(correction)
    slam.gains.settle(slam.observer)
    rejected: BoolArray = weights == 0.0
    count = int(np.count_nonzero(rejected))
    slam.rejected_in_a_row = slam.rejected_in_a_row + 1 if count == len(rows) else 0
    slam.was_contradicted = is_contradiction(rejected)
    slam.landmarks.accept(rows[~rejected], event.stamp_ns)
    if count:
        places = slam.measurement_model.places(event.select(rejected))
        slam.landmarks.reject(rows[rejected], *places)
        slam.counts['rejected_landmark'] += count
    return rejected


def _look_back(slam: Slam, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Let the gains look back; start landmarks in doubt anew if that doesn't explain them.

    Now that the state is corrected, it is known better than before from where they were seen.
    Return the ids of those that have moved.
    """
    in_doubt = slam.landmarks.in_doubt(rows, slam.settings.max_rejections) & slam.is_mapping
    some_are = bool(in_doubt.any())
    if slam.gains.looks_back:
        seen = slam.measurement_model.frame_observation(event, rows)
        slam.gains.look_back(slam.observer, seen, some_are)
    if some_are:
        return relocate(slam, event.select(in_doubt), rows[in_doubt])
    return np.empty(0, dtype=np.int64)


def _note_velocities(slam: Slam, event: ObservationEvent, rows: IntArray) -> None:
    """Let landmarks move as the sensor says; by one that says nothing they are static."""
    velocities = event.velocities
    if velocities is None and slam.observer.have_moved:
        velocities = np.zeros((len(rows), 3))
    if velocities is None or slam.landmark_velocity_error or slam.is_fixed:
        return
    used = slam.landmarks.rejections[rows] == 0
    slam.observer.set_landmark_velocities(rows[used], velocities[used])
