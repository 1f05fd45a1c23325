"""Landmarks that are seen too seldom where a sensor looks, and how that is known."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from nameless_points import PLANAR
import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.landmark_table import LandmarkTable, PATIENCE, TOO_SELDOM
from slam_observer_ros.tracking.hypothesis import FieldOfView, Visibility
from slam_observer_ros.tracking.state import State


@given(st.integers(0, 10_000), st.integers(1, 40), st.sampled_from([2, 3]))
def test_a_sensor_sees_where_it_saw_something_and_in_between(seed, m, k):
    rng = np.random.default_rng(seed)
    seen = rng.normal(size=(m, 3)) * [1.0, 1.0, k == 3]
    field = FieldOfView(k)
    for point in seen:
        field.include(point[None])
    last = FieldOfView(k)
    last.include(seen)
    shares = rng.dirichlet(np.ones(m + 1), 20)[:, :m]
    assert field.contains(seen).all()
    assert field.contains(shares @ seen).all()
    beyond = 2.0 * seen[[np.argmax(np.linalg.norm(seen, axis=1))]]
    if m < k:
        assert field.contains(beyond).all()
    elif m >= 10:  # with fewer all may lie nearly in one line
        assert not field.contains(beyond).any()
    assert not (field.contains(3.0 * seen) & ~last.contains(3.0 * seen)).any()


def test_a_sensor_that_measures_exactly_has_a_field_of_view_with_few_corners():
    field, rng = FieldOfView(3), np.random.default_rng(0)
    for _ in range(3000):
        direction = rng.normal(size=3)
        field.include(3.0 * direction[None] / np.linalg.norm(direction))
    assert len(field.corners) < 300


def test_where_all_points_lie_in_one_plane_all_of_space_counts_as_in_view():
    field = FieldOfView(3)
    for step in range(100):
        field.include(np.array([[np.cos(step), np.sin(step), 0.0]]))
    assert field.contains(np.array([[0.0, 0.0, 5.0], [9.0, 0.0, 0.0]])).all()


def looked_at(counts, looks, settled_looks=0, settled_seen=0):
    """A table of landmarks without ids, after one that has settled was in view and seen so often.

    The landmark of row 0 is that one, the next have ``counts`` and ``looks``.
    """
    landmarks = LandmarkTable()
    landmarks.append_zeros(1)
    landmarks.add_known(np.array([FIRST_AUTOMATIC_ID]), np.array([100]))
    landmarks.append_zeros(len(counts))
    landmarks.add(FIRST_AUTOMATIC_ID + 1 + np.arange(len(counts)), 0)
    landmarks.counts[1:] = counts
    for look in range(settled_looks):
        landmarks.note_in_view(np.array([0]), np.array([look < settled_seen]))
    for row, times in enumerate(looks, start=1):
        for _ in range(times):
            landmarks.note_in_view(np.array([row]), np.array([False]), has_moved=False)
    return landmarks


def test_a_landmark_seen_far_more_seldom_than_others_in_view_is_unsupported():
    landmarks = looked_at([1, 4, 4, 5], [50, 50, 20, 50], settled_looks=996, settled_seen=499)
    assert landmarks.unsupported(5).tolist() == [1, 2]
    assert landmarks.unsupported(1).tolist() == []


def test_where_all_are_seen_seldom_it_takes_longer():
    landmarks = looked_at([1, 1], [199, 201], settled_looks=1000, settled_seen=100)
    assert landmarks.unsupported(5).tolist() == [2]


def test_what_has_settled_stays_however_long_it_is_hidden_from_one_place():
    landmarks = looked_at([5], [0], settled_looks=100, settled_seen=100)
    assert landmarks.unsupported(5).tolist() == []
    for _ in range(1000):
        landmarks.note_in_view(np.array([0, 1]), np.array([True, False]), has_moved=False)
    assert landmarks.unsupported(5).tolist() == []


@pytest.mark.parametrize('counts', [5, 20])
def test_what_has_settled_goes_if_it_is_seen_five_times_too_seldom_from_many_places(counts):
    landmarks = looked_at([counts], [0], settled_looks=100, settled_seen=100)
    landmarks.unsupported(5)
    for _ in range(TOO_SELDOM * counts - 1):
        landmarks.note_in_view(np.array([0, 1]), np.array([True, False]))
        landmarks._confirmed_in_view = landmarks._confirmed_seen  # others are seen each time
    assert landmarks.unsupported(5).tolist() == []
    landmarks.note_in_view(np.array([0, 1]), np.array([True, False]))
    landmarks._confirmed_in_view = landmarks._confirmed_seen
    assert landmarks.unsupported(5).tolist() == [1]


def test_nothing_is_forgotten_before_it_is_known_how_often_a_landmark_is_seen():
    landmarks = looked_at([1, 4], [1000, 1000])
    assert landmarks.unsupported(5).tolist() == []


def test_a_landmark_without_id_has_had_its_chance_after_so_many_looks_and_not_before():
    """One has settled, and was seen each time; the other one never was but once."""
    landmarks, both = LandmarkTable(), np.array([0, 1])
    landmarks.append_zeros(2)
    landmarks.add(FIRST_AUTOMATIC_ID + both, 0)
    landmarks.note_in_view(both, np.array([True, True]))
    for look in range(1, 3 * PATIENCE):
        assert landmarks.unsupported(3).tolist() == []
        landmarks.accept(both[:1], look)
        landmarks.note_in_view(both, np.array([True, False]))
    assert landmarks.counts.tolist() == [3 * PATIENCE, 1]
    assert landmarks.unsupported(3).tolist() == [1]


def state_of(landmarks, points):
    """A state with these landmarks (n, 3), of which the table says what was seen of them."""
    state = State(make_gains(PLANAR, np.eye(4)), PLANAR)
    state.gains.add_known(KnownLandmarks(points, np.tile(np.eye(3), (len(points), 1, 1))))
    state.landmarks = state.observer.landmarks = landmarks
    return state


def test_before_it_is_known_where_a_sensor_looks_no_place_is_unexpected():
    landmarks, visibility = LandmarkTable(), Visibility(2)
    landmarks.append_zeros(3)
    landmarks.add_known(FIRST_AUTOMATIC_ID + np.arange(3), np.full(3, 100))
    state = state_of(landmarks, 5.0 * np.eye(3))
    for look in range(200):
        straight_ahead = ObservationEvent(
            look, np.array([UNKNOWN_ID]), np.array([[1.0, 0.0, 0.0]])
        )
        assert visibility.note(state, straight_ahead, some_have_ids=False) == 0.0
    assert state.counts['unexpected_place'] == 0


@pytest.mark.parametrize('misses', [1, 5, 40])
def test_a_place_costs_what_should_have_been_seen_there_and_a_hidden_landmark_soon_no_more(misses):
    """After k looks that miss it 2 ln(1 + k p): for the first one much, by and by little."""
    landmarks, share, visibility = looked_at([], [], 10, 5), 0.5, Visibility(2)
    state = state_of(landmarks, np.array([[2.0, 0.0, 0.0]]))
    ahead = 4.0 * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])
    others = ObservationEvent(10, np.full(2, UNKNOWN_ID), ahead)
    landmarks.note_in_view = lambda rows, seen, has_moved: None  # so that the share stays
    costs = [visibility.note(state, others, some_have_ids=False)]
    for landmarks.missed[0] in range(misses):
        costs.append(visibility.note(state, others, some_have_ids=False))
    assert costs[0] == 0.0, 'before anything was seen it is not known where the sensor looks'
    assert_allclose(sum(costs), 2.0 * np.log1p(misses * share))
    landmarks.last_seen_ns[0] = others.stamp_ns
    assert visibility.note(state, others, some_have_ids=False) == 0.0


def test_a_landmark_that_was_given_its_id_needs_no_support_any_more():
    landmarks = looked_at([1, 1], [40, 40], settled_looks=10, settled_seen=10)
    landmarks.renumber(np.array([1]), np.array([7]))
    assert landmarks.unsupported(5).tolist() == [2]


def test_a_landmark_that_was_placed_again_has_its_chance_again():
    landmarks = looked_at([4], [39], settled_looks=996, settled_seen=499)
    landmarks.take_for_new(np.array([1]), 0)
    landmarks.note_in_view(np.array([1]), np.array([False]))
    assert landmarks.unsupported(5).tolist() == []
