"""Life cycle of landmarks: which are added, placed again, disbelieved and forgotten."""

from __future__ import annotations

import numpy as np

from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.state.matching import (
    mapped,
    MatchedObservation,
    positions,
    residuals_of,
)
from slam_observer_ros.state.state import State


def make_room(state: State, matched: MatchedObservation) -> None:
    """Choose landmarks out of view to be forgotten for new ones, and stop relying on their past.

    A history without them would lose what they have said of the pose.
    """
    if len(_rows_to_forget(state, matched)):
        state.forget_past('landmarks had to make room (max_landmarks)')


def add_new(state: State, matched: MatchedObservation) -> tuple[ObservationEvent, IntArray]:
    """Add the landmarks of an observation that are new, in the place of others if need be.

    Return the part of it that is of landmarks which are known now, and their rows.
    """
    event, rows = matched.event, matched.rows
    if len(matched.known.ids) == len(rows):
        return event, rows
    is_new = rows < 0
    state.forget(_rows_to_forget(state, matched), 'forgotten_landmark')
    _initialise(state, event.select(is_new), matched.covariances[is_new])
    return mapped(state, event)


def _initialise(state: State, event: ObservationEvent, noise: FloatArray) -> None:
    """Add landmarks where they were seen, as many as ``max_landmarks`` allows."""
    limit, new = state.settings.max_landmarks, len(event.ids)
    m = min(new, max(limit - len(state.landmarks), 0)) if limit else new
    state.counts['unmapped_landmark'] += new - m
    if m:
        event = event.select(np.arange(new) < m)
        state.filter.add(event.points, noise[:m])
        state.landmarks.add(event.ids, event.stamp_ns)


def relocate_moved(state: State, event: ObservationEvent, rows: IntArray) -> IntArray:
    """Take landmarks in doubt for new ones if they are still far from where they were expected.

    Return the ids of those that were seen often enough to say that they have moved.
    """
    noise = state.observation_noise.covariances(event)
    residuals = residuals_of(state, event, rows, noise)
    far = state.filter.distances(residuals) > state.settings.rejection_distance
    moved = far & (state.landmarks.counts[rows] >= state.settings.confirmations)
    state.counts['moved_landmark'] += int(np.sum(moved))
    if far.any():
        state.relocate(rows[far], event.points[far], noise[far])
        state.landmarks.take_for_new(rows[far], event.stamp_ns)
    return event.ids[moved]


def note_velocities(state: State, event: ObservationEvent, rows: IntArray) -> None:
    """Let landmarks move as the sensor says; by one that says nothing they are static."""
    velocities = event.velocities
    if velocities is None and state.observer.have_moved:
        velocities = np.zeros((len(rows), 3))
    if velocities is None or state.landmark_velocity_error or state.is_fixed:
        return
    used = state.landmarks.rejections[rows] == 0
    state.observer.set_landmark_velocities(rows[used], velocities[used])


def disbelieve(state: State, event: ObservationEvent) -> None:
    """Count points as rejected although the gate lets them pass.

    Landmarks that are in doubt by then are forgotten, and are new when they are seen next.
    """
    event, rows = mapped(state, event)  # one may have made room
    state.landmarks.reject(rows, *positions(state, event))
    in_doubt = state.landmarks.in_doubt(rows, state.settings.max_rejections) & state.is_mapping
    if in_doubt.any():
        state.remove(rows[in_doubt])


def _rows_to_forget(state: State, matched: MatchedObservation) -> IntArray:
    """Return which landmarks out of view are to make room for the new ones of ``matched``.

    The least often seen go first.
    """
    limit, new = state.settings.max_landmarks, len(matched.rows) - len(matched.residuals.rows)
    excess = len(state.landmarks) + new - limit
    if limit == 0 or new == 0 or excess <= 0:
        return np.empty(0, dtype=np.int64)
    unseen = state.landmarks.unseen_since(matched.event.stamp_ns)
    return np.sort(unseen[~np.isin(unseen, matched.rows)][:excess])
