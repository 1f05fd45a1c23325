"""Life cycle of landmarks: which are added, placed anew, disbelieved and forgotten."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import BoolArray, FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.state.matching import MatchedObservation
from slam_observer_ros.state.state import Slam


def initialise(slam: Slam, event: ObservationEvent, noise: FloatArray) -> None:
    """Add landmarks where they were seen, as many as ``max_landmarks`` allows."""
    limit, new = slam.settings.max_landmarks, len(event.ids)
    m = min(new, max(limit - len(slam.landmarks), 0)) if limit else new
    slam.counts['unmapped_landmark'] += new - m
    if not m:
        return
    event = event.select(np.arange(new) < m)
    slam.observer.add_landmarks(event.points)
    slam.gains.add_landmarks(slam.observer.y_ref[-m:], slam.observer.turned(noise[:m]))
    slam.landmarks.add(event.ids, event.stamp_ns)


def relocate(slam: Slam, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Start landmarks in doubt anew that are still far from where they were expected.

    Return the ids of those that were seen often enough to say that they have moved.
    """
    noise = slam.observation_noise.covariances(event)
    residuals = slam.measurement_model.residuals(event, rows, noise)
    far = slam.gains.distances(residuals) > slam.settings.rejection_distance
    moved = far & (slam.landmarks.counts[rows] >= slam.settings.confirmations)
    slam.counts['moved_landmark'] += int(np.sum(moved))
    if far.any():
        slam.observer.relocate_landmarks(rows[far], event.points[far])
        y_ref = slam.observer.y_ref[rows[far]]
        slam.gains.relocate_landmarks(rows[far], y_ref, residuals.covariances[far])
        slam.landmarks.restart(rows[far], event.stamp_ns)
    return event.ids[moved]


def rejected_before(slam: Slam, matched: MatchedObservation) -> tuple[BoolArray, FloatArray]:
    """Return which known landmarks (m,) in it were rejected before where they are seen now.

    And how far all of them (m, 3) are from where they were rejected last, metres, reference
    frame.
    """
    rows = matched.residuals.rows
    points, tolerances_m = slam.measurement_model.places(matched.known)
    again = slam.landmarks.are_rejected_again(rows, points, tolerances_m)
    return again, points - slam.landmarks.rejected_last[rows]


def disbelieve(slam: Slam, event: ObservationEvent) -> None:
    """Count points as rejected although the gate lets them pass.

    Landmarks that are in doubt by then are forgotten, and are new when they are seen next.
    """
    event, rows = slam.mapped(event)  # one may have made room
    slam.landmarks.reject(rows, *slam.measurement_model.places(event))
    in_doubt = slam.landmarks.in_doubt(rows, slam.settings.max_rejections) & slam.is_mapping
    if in_doubt.any():
        slam.remove(rows[in_doubt])


def note_surroundings(slam: Slam, event: ObservationEvent, some_have_ids: bool) -> float:
    """Count what was in view of an observation of landmarks without an id.

    Return −2 ln of the probability that what was not seen of it was not.

    Those that were seen too seldom while they were in view are forgotten; out of view none
    is: it may be the only tie to what was mapped before. Parameters are those of
    :meth:`.Surroundings.note`.
    """
    cost, is_strange = slam.surroundings.note(event, some_have_ids)
    slam.counts['strange_place'] += is_strange
    unsupported = slam.landmarks.unsupported(slam.settings.min_support)
    forget(slam, unsupported, 'unsupported_landmark')
    return cost


def rows_to_forget(slam: Slam, matched: MatchedObservation) -> IntArray:
    """Return which landmarks out of view are to make room for the new ones of ``matched``.

    The least often seen go first.
    """
    limit, new = slam.settings.max_landmarks, len(matched.rows) - len(matched.residuals.rows)
    excess = len(slam.landmarks) + new - limit
    if limit == 0 or new == 0 or excess <= 0:
        return np.empty(0, dtype=np.int64)
    unseen = slam.landmarks.unseen_since(matched.event.stamp_ns)
    return np.sort(unseen[~np.isin(unseen, matched.rows)][:excess])


def forget(slam: Slam, rows: IntArray, why: str) -> None:
    """Forget the landmarks at ``rows``; ``why`` is the count that tells of it."""
    if len(rows):
        slam.remove(rows)
        slam.counts[why] += len(rows)
