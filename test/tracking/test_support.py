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
from slam_observer_ros.filter.landmark_table import (
    ERROR,
    LandmarkTable,
    SURE,
)
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


def table(counts, looks=0, seen=0):
    """Landmarks without ids: row 0 of a map, seen so often of so many looks, and further ones."""
    landmarks = LandmarkTable()
    landmarks.append_zeros(1)
    landmarks.add_known(np.array([FIRST_AUTOMATIC_ID]), np.array([100]))
    landmarks.append_zeros(len(counts))
    landmarks.add(FIRST_AUTOMATIC_ID + 1 + np.arange(len(counts)), 0)
    landmarks.counts[1:] = counts
    for look in range(looks):
        landmarks.note_in_view(np.array([0]), np.array([look < seen]))
    return landmarks


def miss(landmarks, row, times, has_moved=False):
    """Let a landmark in view be missed so many times in a row."""
    for _ in range(times):
        landmarks.weigh(np.array([row]), np.log(landmarks.hidden(np.array([row]), has_moved)))
        landmarks.note_in_view(np.array([row]), np.array([False]), has_moved)


@pytest.mark.parametrize('share', [0.1, 0.5, 0.9])
def test_a_landmark_exists_less_surely_with_each_look_that_misses_it(share):
    """By 1/(1 − k ln(1 − p)) after k of them: from one place it may be hidden in all."""
    landmarks = table([1], 100, round(100 * share))
    odds = np.exp(landmarks.prior)
    for misses in (1, 4, 15):
        miss(landmarks, 1, misses - landmarks.missed[1])
        left = odds / (1.0 - misses * np.log(1.0 - share))
        assert_allclose(landmarks.existence(np.array([1]))[0], left / (1.0 + left))


def test_a_landmark_enters_the_map_once_it_surely_exists_and_stays_while_it_may_be_hidden():
    landmarks = table([3], 10, 9)
    assert landmarks.tentative.tolist() == [False, True]
    assert landmarks.weigh(np.array([1]), np.array([9.0])) == 1
    assert landmarks.existence(np.array([1]))[0] > 1.0 - ERROR
    assert landmarks.weigh(np.array([1]), np.array([9.0])) == 0
    miss(landmarks, 1, 200)
    assert landmarks.tentative.tolist() == [False, False]
    assert landmarks.unlikely().tolist() == []


def test_each_landmark_counts_as_new_once_also_where_nothing_was_ever_false():
    """Else it costs ever more to take a point for a new one."""
    landmarks, row = table([3] * 150), np.array([1])
    landmarks.evidence[2:] = 3.0 * SURE
    assert landmarks.unlikely().tolist() == []
    assert landmarks.prior > SURE
    assert [landmarks.weigh(row, np.zeros(1)) for _ in range(3)] == [1, 0, 0]


def test_where_many_points_are_false_a_new_one_is_sooner_forgotten():
    looks = []
    for others in (0, 40):
        landmarks = table([1] * (1 + others), 100, 90)
        landmarks.evidence[2:] = -9.0
        while 1 not in landmarks.unlikely():
            miss(landmarks, 1, 1)
        looks.append(landmarks.missed[1])
    assert looks[1] < looks[0] / 10


def test_nothing_is_taken_for_false_before_it_was_missed():
    landmarks = table([1] * 200)
    for _ in range(20):
        assert landmarks.unlikely().tolist() == []
    assert (landmarks.existence(np.arange(201)) > 0.9).all()


def test_what_surely_existed_stays_if_it_is_hidden_from_one_place_and_goes_if_from_many():
    landmarks = table([20], 100, 90)
    landmarks.weigh(np.array([1]), np.array([99.0]))
    miss(landmarks, 1, 1000)
    assert landmarks.unlikely().tolist() == []
    miss(landmarks, 1, 1000, has_moved=True)
    assert landmarks.unlikely().tolist() == [1]


@pytest.mark.parametrize('places', [1, 3, 10])
def test_misses_from_places_alike_count_as_of_each_of_them(places):
    landmarks, row = table([1], 10, 9), np.array([1])
    before = landmarks.evidence[1]
    for place in range(places):
        miss(landmarks, 1, 1, has_moved=place > 0)
        miss(landmarks, 1, 4)
    lost = before - landmarks.evidence[1]
    assert_allclose(lost, places * np.log1p(5 * landmarks.rate), rtol=0.3)
    landmarks.note_in_view(row, np.array([True]))
    assert landmarks.missed[1] == landmarks.passed[1] == 0


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
        visibility.field_of_view.include(straight_ahead.points)
    assert state.counts['unexpected_place'] == 0


@pytest.mark.parametrize('misses', [1, 5, 40])
def test_a_place_costs_what_should_have_been_seen_there_and_a_hidden_landmark_soon_no_more(misses):
    """After k looks that miss it 2 ln(1 − k ln(1 − p)): for the first much, by and by little."""
    landmarks, share, visibility = table([], 10, 5), 0.5, Visibility(2)
    state = state_of(landmarks, np.array([[2.0, 0.0, 0.0]]))
    ahead = 4.0 * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])
    others = ObservationEvent(10, np.full(2, UNKNOWN_ID), ahead)
    landmarks.note_in_view = lambda rows, seen, has_moved: None  # so that the share stays
    landmarks.passed[:] = 0
    costs = [visibility.note(state, others, some_have_ids=False)]
    visibility.field_of_view.include(others.points)
    for landmarks.missed[0] in range(misses):
        costs.append(visibility.note(state, others, some_have_ids=False))
    assert costs[0] == 0.0, 'before anything was seen it is not known where the sensor looks'
    assert_allclose(sum(costs), 2.0 * np.log1p(-misses * np.log(1.0 - share)))
    landmarks.last_seen_ns[0] = others.stamp_ns
    assert visibility.note(state, others, some_have_ids=False) == 0.0


def test_a_landmark_that_was_given_an_id_exists():
    landmarks = table([1, 1])
    landmarks.evidence[1:] = -20.0
    landmarks.renumber(np.array([1]), np.array([7]))
    assert landmarks.unlikely().tolist() == [2]


def test_a_landmark_that_was_placed_again_is_as_likely_as_a_new_one():
    landmarks = table([4])
    landmarks.evidence[1] = -20.0
    landmarks.take_for_new(np.array([1]), 0)
    assert landmarks.unlikely().tolist() == []
