"""Points without an id: which landmark each is, what is new, and where that can't be known yet."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import Mock, patch

import gain_worlds
from hypothesis import given
from hypothesis import strategies as st
from nameless_points import creep, observe, PLANAR, SPATIAL, stand
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID, is_automatic
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import axes, se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.velocity_history import VelocityHistory
from slam_observer_ros.recordings.data_sets import load_mrclam
from slam_observer_ros.recordings.trajectory import interpolate, Trajectory
from slam_observer_ros.runs.health import of_map_without_ids
from slam_observer_ros.runs.metrics import ConfigurationError
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table
from slam_observer_ros.tracking import assignments
from slam_observer_ros.tracking.hypotheses import (
    are_one,
    have_one_map,
    Hypotheses,
    KnownMap,
)
from slam_observer_ros.tracking.joint_compatibility import (
    huber_loss,
    JointSearch,
    Pairs,
    PRUNING_COST,
)
from slam_observer_ros.tracking.state import State

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'mrclam.yaml'


def nameless(event):
    return replace(event, ids=np.full_like(event.ids, UNKNOWN_ID))


def without_ids(world):
    return world.with_observations(lambda _, event: nameless(event))


@cache
def mapped(settings):
    world = gain_worlds.drive(settings, 20.0, 2, landmarks=40, seen=8)
    return gain_worlds.estimate(world, settings)._hypotheses.best


@pytest.mark.parametrize('settings', [PLANAR, replace(SPATIAL, sensor_rotation_stddev=(0.1,) * 3)])
@given(seed=st.integers(0, 10_000), spread=st.floats(-3.0, 1.0))
def test_where_there_are_many_pairs_none_that_passes_the_gate_is_left_out(settings, seed, spread):
    state, rng = mapped(settings), np.random.default_rng(seed)
    axes, landmarks = np.array([1.0, 1.0, not settings.two_d_mode]), state.observer.points
    points = landmarks[rng.integers(len(landmarks), size=8)]
    points = points + 10.0**spread * rng.normal(size=(8, 3)) * axes
    seen = se3.transform(se3.inverse(state.observer.A), points)
    event = ObservationEvent(1, np.full(8, UNKNOWN_ID), seen)
    pairs = []
    for few in (0, len(points) * len(landmarks)):
        with patch.object(assignments, 'FEW_PAIRS', few):
            found = assignments._candidates(state, assignments._Points(state, event))
            pairs.append(sorted(np.column_stack(found[:2]).tolist()))
    assert pairs[0] == pairs[1]


@pytest.mark.parametrize(('settings', 'seed'), [(PLANAR, 0), (PLANAR, 1), (SPATIAL, 2)])
def test_without_ids_the_estimate_is_the_same_where_landmarks_are_well_apart(settings, seed):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5, landmarks=8)
    named = gain_worlds.estimate(world, settings)
    estimator = gain_worlds.estimate(without_ids(world), settings)
    assert_allclose(estimator.pose, named.pose, atol=1e-6)
    assert len(estimator.landmark_ids) == len(named.landmark_ids)
    assert is_automatic(estimator.landmark_ids).all()
    assert_allclose(estimator.world_points, named.world_points, atol=1e-6)


def test_the_same_events_give_the_same_bits():
    world = without_ids(gain_worlds.drive(PLANAR, 20.0, landmarks=40))
    first, second = (gain_worlds.estimate(world, PLANAR) for _ in range(2))
    assert_array_equal(first.pose, second.pose)
    assert_array_equal(first.landmark_ids, second.landmark_ids)
    assert_array_equal(first.world_points, second.world_points)


def test_what_is_seen_once_is_never_in_the_map_and_by_and_by_forgotten():
    estimator, speed = Estimator(SPATIAL), (0.0, 0.0, 0.0, 0.5, 0.0, 0.0)
    for step in range(150):
        stand(estimator, 0.1 * step, speed)
        stray = [[0.0, 4.0, 1.0]] if step == 20 else []
        observe(estimator, 0.1 * step, [[3.0 - 0.05 * step, 0.0, 0.0], *stray])
        assert len(estimator.landmark_ids) == (1 if step >= 2 else 0)
    assert estimator.counts['unsupported_landmark'] == 1


def with_false_points(world, share, seed=0):
    """Add points where any landmark might be seen, as many as ``share`` of the true ones."""
    rng = np.random.default_rng(seed)
    seen = np.concatenate([event.points for event in world.observations()])

    def change(_, event):
        m = rng.binomial(len(event.ids), share)
        turns = se3.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) * rng.uniform(-0.5, 0.5, (m, 1)))
        false = rng.uniform(0.5, 1.5, (m, 1)) * seen[rng.integers(len(seen), size=m)]
        points = np.concatenate([event.points, se3.rotate(turns, false[:, None])[:, 0]])
        return replace(event, ids=np.full(len(points), UNKNOWN_ID), points=points)

    return world.with_observations(change)


@pytest.mark.parametrize('seed', range(2))
def test_false_points_among_those_without_ids_leave_few_landmarks_behind(seed):
    world = gain_worlds.drive(PLANAR, 100.0, seed, landmarks=8)
    named = gain_worlds.estimate(world, PLANAR)
    estimator = gain_worlds.estimate(with_false_points(world, 0.05, seed), PLANAR)
    assert estimator.counts['unsupported_landmark'] > 10
    assert len(estimator.landmark_ids) <= len(named.landmark_ids) + 3
    assert estimator.counts['doubled_landmark'] == 0
    assert_allclose(estimator.pose, named.pose, atol=0.01)


@pytest.mark.parametrize('seed', range(2))
def test_a_sensor_that_seldom_sees_what_is_in_view_maps_it_all_the_same(seed):
    rng = np.random.default_rng(seed)
    world = gain_worlds.drive(PLANAR, 120.0, seed, landmarks=8, seen=8)
    seldom = world.with_observations(lambda _, e: e.select(rng.random(len(e.ids)) < 0.1))
    estimator = gain_worlds.estimate(without_ids(seldom), PLANAR)
    named = gain_worlds.estimate(seldom, PLANAR)
    assert len(estimator.landmark_ids) == len(named.landmark_ids) == 8
    assert_allclose(estimator.pose, named.pose, atol=0.07)


def test_what_was_seen_once_is_known_again_after_looking_elsewhere():
    """The robot turns round with its back to it, for 300 observations."""
    front = np.array([[3.0, 0.0, 0.0], [3.0, 1.5, 0.0], [3.0, -1.5, 0.0]])
    back = np.array([[-3.0, 0.5, 0.0], [-3.0, -1.0, 0.0]])
    once = np.array([[2.5, -0.8, 0.0]])
    estimator = Estimator(replace(PLANAR, angular_scale_noise=(0.0, 0.0, 0.0)))
    turns = np.concatenate([np.zeros(10), np.full(30, np.pi / 3), np.zeros(300)])
    turns = np.concatenate([turns, np.full(30, -np.pi / 3), np.zeros(5)])
    heading = 0.0
    for step, turn in enumerate(turns):
        stand(estimator, 0.1 * step, (0, 0, turn, 0, 0, 0))
        here = se3.inverse(se3.exp(np.array([0.0, 0.0, heading, 0.0, 0.0, 0.0])))
        is_last = step >= len(turns) - 5
        seen = {step < 5: front, step == 5: once, 40 <= step < 340: back, is_last: once}
        if True in seen:
            observe(estimator, 0.1 * step, se3.transform(here, seen[True]))
        heading += 0.1 * turn
    assert estimator.counts['unsupported_landmark'] == 0
    assert estimator.landmark_ids.tolist() == [FIRST_AUTOMATIC_ID + i for i in range(6)]
    assert estimator.landmark_counts.tolist() == [5, 5, 5, 6, 300, 300]


def test_points_with_and_without_id_are_distinguished_in_one_observation():
    estimator = Estimator(SPATIAL)
    for step in range(10):
        stand(estimator, 0.1 * step)
        # The second lies beside the first, well within the sensor's noise.
        points = [[3.0, 0.0, 0.0], [3.0, 0.02, 0.0], [0.0, 3.0, 0.0]]
        observe(estimator, 0.1 * step, points, [7, UNKNOWN_ID, UNKNOWN_ID])
    ids = estimator.landmark_ids
    assert ids.tolist() == [7, FIRST_AUTOMATIC_ID + 1, FIRST_AUTOMATIC_ID + 2]
    assert_allclose(estimator.world_points, points, atol=0.01)


def test_an_ambiguous_post_is_followed_both_ways_until_another_one_decides():
    """Two posts 3 m apart; after a blind turn of unknown size only one of them is in view.

    The odometry says that it is the first, but it is the second. A third landmark decides.
    """
    settings = replace(PLANAR, angular_velocity_noise=(0.0, 0.0, 0.1), confirmations=1)
    posts = np.array([[5.0, 0.0, 0.0], [4.0, 3.0, 0.0], [1.0, 6.0, 0.0]])
    estimator = Estimator(settings)
    for step in range(20):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, posts)
    known = estimator.landmark_ids
    for step in range(20, 100):
        creep(estimator, 0.1 * step)  # so it says; the robot turns to the left by 0.6 rad
    turned = se3.exp(np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0]))
    seen = se3.transform(se3.inverse(turned), posts)
    for step in range(100, 105):
        observe(estimator, 0.1 * step, seen[1:2])
    followed = len(estimator._hypotheses)
    error_rad = np.linalg.norm(so3.log(estimator.pose[:3, :3].T @ turned[:3, :3]))
    in_doubt_rad = np.sqrt(estimator.pose_covariance[2, 2])
    assert error_rad < 4.0 * in_doubt_rad
    observe(estimator, 10.45, np.empty((0, 3)))  # says nothing, and so decides nothing
    assert len(estimator._hypotheses) == followed
    for step in range(105, 110):
        observe(estimator, 0.1 * step, seen[1:])
    assert followed > 1
    assert_allclose(estimator.pose, turned, atol=0.1)
    assert np.sqrt(estimator.pose_covariance[2, 2]) < 0.2 * in_doubt_rad
    assert_array_equal(estimator.landmark_ids, known)
    assert_allclose(estimator.world_points, posts, atol=0.1)


def test_it_says_since_when_and_where_what_is_seen_fits_several_maps(caplog):
    """Of two posts 3 m apart one is in view for ten seconds, then a third landmark decides."""
    settings = replace(PLANAR, angular_velocity_noise=(0.0, 0.0, 0.1), confirmations=1)
    posts = np.array([[5.0, 0.0, 0.0], [4.0, 3.0, 0.0], [1.0, 6.0, 0.0]])
    estimator = Estimator(settings)
    for step in range(20):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, posts)
    for step in range(20, 100):
        creep(estimator, 0.1 * step)
    seen = se3.transform(se3.inverse(se3.exp(np.array([0.0, 0.0, 0.7, 0.0, 0.0, 0.0]))), posts)
    for step in range(10, 14):
        stand(estimator, float(step))
        observe(estimator, float(step), seen[1:2])
    assert estimator.ambiguity is None, 'the next view may decide it'
    for step in range(14, 20):
        stand(estimator, float(step))
        observe(estimator, float(step), seen[1:2])
    ambiguity = estimator.ambiguity
    assert ambiguity is not None
    assert 5 * 10**9 <= ambiguity.lasts_ns <= 10**10
    assert 0.0 < ambiguity.probability < 0.95
    (finding,) = of_map_without_ids(estimator, ambiguity)
    assert finding.kind == 'ambiguous_map'
    assert f'for {ambiguity.lasts_ns * 1e-9:.0f} s, from (0.0 m, ' in finding.what
    posts_ids = ', '.join(map(str, estimator.landmark_ids.tolist()))
    assert f'others differ in landmarks {posts_ids}' in finding.what, 'as the robot sees them'
    assert_array_equal(estimator.doubted_ids, estimator.landmark_ids)
    for step in range(20, 26):
        stand(estimator, float(step))
        observe(estimator, float(step), seen[1:])
    assert estimator.ambiguity is None
    assert not len(estimator.doubted_ids)
    longest = estimator.longest_ambiguity
    assert len(longest.ids)
    assert longest.since_ns <= ambiguity.since_ns, 'when the other one parted from it'
    assert longest.until_ns == 20 * 10**9, 'when the other one was shown in its place'
    assert longest.probability < 0.1
    lasts_s = longest.lasts_ns * 1e-9
    assert f'several maps for {lasts_s:.0f} s' in caplog.text, 'said where nobody looks, too'


def test_it_says_that_landmarks_are_seen_too_seldom_for_a_map():
    """A new one in each view, as from a camera that takes one image in a while."""
    estimator = Estimator(PLANAR)
    for step in range(12):
        creep(estimator, float(step))
        observe(estimator, float(step), np.array([[3.0, 4.0 * step, 0.0]]))
    (finding,) = of_map_without_ids(estimator, None)
    assert finding.kind == 'unconfirmed_map'
    assert 'only 0 are in the map' in finding.what
    for step in range(12, 60):
        stand(estimator, float(step), (0.0, 0.0, 0.0, 0.1, 0.0, 0.0))
        ahead_m = 3.0 - 0.1 * (step - 12)
        observe(estimator, float(step), np.array([[ahead_m, 44.0, 0.0], [ahead_m, 40.0, 0.0]]))
    assert len(estimator.landmark_ids) == 2
    assert not of_map_without_ids(estimator, None)


def test_of_two_places_the_one_is_given_up_where_more_should_have_been_seen():
    """A lone post, and one as far with another behind it; odometry says that it is that one."""
    settings = replace(PLANAR, angular_velocity_noise=(0.0, 0.0, 0.1), confirmations=1)
    posts = np.array([[5.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.6, 4.8, 0.0]])
    estimator, turn_rad = Estimator(settings), -np.arctan2(4.0, 3.0)
    for step in range(20):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, posts)
    for step in range(20, 120):
        creep(estimator, 0.1 * step)  # so it says; the robot turns to the right
    turned = se3.exp(np.array([0.0, 0.0, turn_rad, 0.0, 0.0, 0.0]))
    seen = se3.transform(se3.inverse(turned), posts)[:1]
    stand(estimator, 12.0)
    observe(estimator, 12.0, seen)
    assert_allclose(estimator.pose, np.eye(4), atol=0.1)
    for step in range(121, 150):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, seen)
    assert_allclose(estimator.pose, turned, atol=0.1)


def test_states_that_took_two_look_alikes_for_each_other_are_one_where_their_maps_agree():
    estimator = Estimator(replace(SPATIAL, confirmations=1))
    stand(estimator, 0.0)
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    observe(estimator, 0.0, points, [4, 5])
    state = estimator._hypotheses.best
    event = ObservationEvent(0, np.array([4, 5]), points)
    swapped = replace(event, ids=event.ids[::-1])
    other, elsewhere = state.copy(), state.copy()
    assert are_one(state, event, other, swapped)
    other.observer.relocate_landmarks(np.array([1]), points[1:] + 1.0)
    assert not are_one(state, event, other, swapped), 'each has a point where the other has none'
    elsewhere.observer.A[...] = elsewhere.observer.A @ se3.exp(np.array([0, 0, 0, 1.0, 0, 0]))
    assert not are_one(state, event, elsewhere, swapped), 'the robot is 1 m off'


def test_hypotheses_are_one_where_no_view_to_come_can_show_which_is_right():
    estimator = Estimator(replace(SPATIAL, confirmations=1))
    stand(estimator, 0.0)
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]])
    observe(estimator, 0.0, points)
    state = estimator._hypotheses.best
    deviation_m = np.sqrt(
        state.observation_noise.covariances(ObservationEvent(0, [7], points[:1]))[0, 0, 0]
    )
    other, more, elsewhere = (state.copy() for _ in range(3))
    other.observer.relocate_landmarks(np.array([0]), points[:1] + [deviation_m, 0.0, 0.0])

    def are_one_map(one, another, is_unlikely=False):
        return have_one_map(KnownMap(one), KnownMap(another), is_unlikely)

    assert are_one_map(state, other) and are_one_map(other, state)
    other.observer.relocate_landmarks(np.array([0]), points[:1] + [0.5, 0.0, 0.0])
    assert not are_one_map(state, other), 'a landmark is elsewhere'
    elsewhere.observer.A[...] = elsewhere.observer.A @ se3.exp(np.array([0, 0, 0, 0.5, 0, 0]))
    assert not are_one_map(state, elsewhere), 'the robot is elsewhere'
    more.remove(np.array([2]))
    assert are_one_map(state, more) and are_one_map(more, state)
    state.landmarks.evidence[2] = np.inf
    assert not are_one_map(state, more), 'a landmark that is sure is in one of them'
    assert not are_one_map(more, state)
    for shift_m, is_doubled in ((deviation_m, True), (0.5, False)):
        doubled = state.copy()
        noise = state.observation_noise.at(points[:1])
        doubled.gains.add(points[:1] + [shift_m, 0.0, 0.0], noise)
        doubled.landmarks.add(FIRST_AUTOMATIC_ID + np.array([50]), 0)
        doubled.landmarks.evidence[-1] = np.inf
        assert not are_one_map(doubled, state), 'that there are two is yet to be decided'
        assert are_one_map(doubled, state, is_unlikely=True) == is_doubled


def test_the_covariance_of_a_map_is_that_of_all_hypotheses():
    estimator = Estimator(replace(PLANAR, confirmations=1))
    stand(estimator, 0.0)
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    observe(estimator, 0.0, points)
    hypotheses = estimator._hypotheses
    hypotheses.best.landmarks.evidence[:] = np.inf
    own = estimator.configuration_covariance(np.arange(2))
    other = hypotheses._all[0].copy()
    other.cost = 2.0 * np.log(3.0)  # one in four
    hypotheses._all.append(other)
    assert_allclose(hypotheses.weights, [0.75, 0.25])
    assert_allclose(estimator.configuration_covariance(np.arange(2)), own)
    other.state.observer.relocate_landmarks(np.array([0]), points[:1] + [1.0, 0.0, 0.0])
    mixed = estimator.configuration_covariance(np.arange(2))
    assert_allclose(mixed[0, 0], own[0, 0] + 0.25)
    other.state.remove(np.array([0]))
    assert_allclose(np.diag(estimator.configuration_covariance(np.arange(2))), np.diag(own))


def test_one_hypothesis_at_most_if_no_more_are_wanted():
    world = without_ids(gain_worlds.drive(replace(PLANAR, max_hypotheses=1), 30.0, landmarks=60))
    estimator = Estimator(replace(PLANAR, max_hypotheses=1))
    for event in world.events:
        estimator.add(event)
        assert len(estimator._hypotheses) == 1


def test_gains_without_a_joint_covariance_leave_points_without_id_out():
    estimator = Estimator(replace(SPATIAL, gains='constant', confirmations=1))
    stand(estimator, 0.0)
    observe(estimator, 0.0, [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]], [4, UNKNOWN_ID])
    assert estimator.landmark_ids.tolist() == [4]
    assert estimator.counts['unknown_id'] == 1


def test_points_that_gains_leave_out_say_nothing_of_the_pose():
    known = np.random.default_rng(0).uniform(-5.0, 5.0, (12, 3))
    estimator = Estimator(replace(SPATIAL, gains='constant', localization_mode='uncertain'))
    unseen = np.zeros(len(known), dtype=np.int64)
    estimator.load_map(LandmarkMap(np.arange(12), known, None, unseen), pose=np.eye(4))
    for second in range(40):
        stand(estimator, float(second))
        observe(estimator, float(second), known, np.full(12, UNKNOWN_ID))
    assert estimator.counts['unknown_id'] == 12 * 40
    assert estimator.counts['unexpected_place'] == 0


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
def test_a_robot_finds_its_way_in_a_map_by_reflectors_that_all_look_alike(mode):
    rng = np.random.default_rng(1)
    points = rng.uniform([-9.0, -9.0, 0.0], [9.0, 9.0, 0.0], (25, 3))
    reflectors = LandmarkMap(np.arange(25), points, None, np.full(25, 5))
    settings = replace(PLANAR, localization_mode=mode, map_noise=0.02)
    velocity = np.array([0.0, 0.0, 0.3, 0.8, 0.0, 0.0])
    start = se3.exp(np.array([0.0, 0.0, 0.5, 1.0, 2.0, 0.0]))
    estimator = Estimator(settings)
    estimator.load_map(reflectors, start, np.diag([0, 0, 0.03, 0.1, 0.1, 0]) ** 2)
    true_start = start @ se3.exp(np.array([0.0, 0.0, 0.02, 0.07, -0.05, 0.0]))
    for step in range(200):
        pose = true_start @ se3.exp(velocity * 0.1 * step)
        stand(estimator, 0.1 * step, velocity)
        seen = se3.transform(se3.inverse(pose), points)
        observe(estimator, 0.1 * step, seen[np.argsort(np.linalg.norm(seen, axis=1))[:4]])
    assert_allclose(estimator.pose, pose, atol=0.03)
    assert len(estimator.landmark_ids) == 25


def test_numbers_given_to_landmarks_in_two_runs_say_nothing_of_which_is_which():
    estimator = Estimator(replace(SPATIAL, confirmations=1))
    tags = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
    nameless_point = np.array([[3.0, 3.0, 0.0]])
    for step in range(3):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, np.concatenate([tags, nameless_point]), [1, 2, 3, -1])
    own = estimator.landmark_ids[-1]
    ids = np.array([1, 2, 3, own])
    elsewhere = np.concatenate([tags, [[-5.0, 1.0, 0.0]]])
    estimator.load_map(LandmarkMap(ids, elsewhere, None, np.full(4, 9)))
    assert estimator.is_localised
    places = dict(zip(estimator.landmark_ids.tolist(), estimator.world_points, strict=True))
    assert len(places) == 5
    assert_allclose(places.pop(own), elsewhere[3], atol=1e-6)
    assert_allclose(places[max(places)], nameless_point[0], atol=0.05)


def test_without_ids_a_real_robot_is_hardly_worse_off(data_dir):
    """Commands as odometry, blind for a minute at a time, posts of two or three barcodes."""
    run = first_third(load_mrclam(data_dir / 'mrclam' / 'MRCLAM_Dataset6', 3))
    assert _configuration_rmse_m(run, nameless) < 1.35 * _configuration_rmse_m(run)


def first_third(run):
    velocities = len(run.velocity_stamps_ns) // 3
    end_ns = run.velocity_stamps_ns[velocities]
    return replace(
        run,
        velocity_stamps_ns=run.velocity_stamps_ns[:velocities],
        body_velocities=run.body_velocities[:velocities],
        observations=[event for event in run.observations if event.stamp_ns < end_ns],
    )


def _configuration_rmse_m(run, change=None):
    values = read_parameter_file(CONFIG)
    names = {row.name for row in table(Settings)}
    settings = from_parameters(Settings, {k: v for k, v in values.items() if k in names})
    truth, error = (
        Trajectory.from_samples(run.truth_stamps_ns, run.true_poses),
        ConfigurationError(),
    )

    def compare(update):
        (pose,), (covered,) = interpolate(truth, np.array([update.stamp_ns]))
        if covered:
            known, points = estimator.landmark_ids, estimator.world_points
            error.add(update.stamp_ns, update.pose, known, points, pose, run.landmarks)

    estimator = Estimator(settings, on_update=compare)
    velocities = zip(run.velocity_stamps_ns.tolist(), run.body_velocities, strict=True)
    events = [VelocityEvent(stamp_ns, V) for stamp_ns, V in velocities]
    for event in sorted([*events, *run.observations], key=lambda event: event.stamp_ns):
        is_observation = isinstance(event, ObservationEvent)
        estimator.add(change(event) if change and is_observation else event)
    estimator.flush()
    return error.rmse_m


def test_a_point_with_a_new_id_takes_no_landmark_from_a_point_without():
    estimator = Estimator(replace(SPATIAL, confirmations=1))
    for step in range(20):
        stand(estimator, 0.1 * step)
        tag = [[3.0, 0.05, 0.0]] if step >= 10 else []
        points = [*tag, [3.0, 0.0, 0.0], [0.0, 3.0, 0.0]]
        observe(estimator, 0.1 * step, points, [*[7] * len(tag), UNKNOWN_ID, UNKNOWN_ID])
    assert estimator.landmark_ids.tolist() == [FIRST_AUTOMATIC_ID, FIRST_AUTOMATIC_ID + 1, 7]
    assert estimator.landmark_counts.tolist() == [20, 20, 10]


@pytest.mark.parametrize('settings', [PLANAR, SPATIAL], ids=['planar', 'spatial'])
@pytest.mark.parametrize('max_hypotheses', [1, 8])
def test_a_landmark_first_seen_without_its_id_takes_it_when_it_is_given(settings, max_hypotheses):
    settings = replace(settings, max_hypotheses=max_hypotheses)
    world = gain_worlds.drive(settings, 40.0, noise=0.5, landmarks=8)
    rng = np.random.default_rng(0)

    def now_and_then_named(_, event):
        is_read = rng.random(len(event.ids)) < 0.3
        return replace(event, ids=np.where(is_read, event.ids, UNKNOWN_ID))

    named = gain_worlds.estimate(world, settings)
    estimator = gain_worlds.estimate(world.with_observations(now_and_then_named), settings)
    assert sorted(estimator.landmark_ids) == sorted(named.landmark_ids)
    order = np.argsort(estimator.landmark_ids)
    expected = named.world_points[np.argsort(named.landmark_ids)]
    assert_allclose(estimator.world_points[order], expected, atol=1e-6)
    assert_allclose(estimator.pose, named.pose, atol=1e-6)


def test_ids_name_the_landmarks_of_a_fixed_map_that_has_none():
    estimator = Estimator(replace(SPATIAL, localization_mode='fixed'))
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    counts = np.full(2, 9)
    nameless_map = LandmarkMap(FIRST_AUTOMATIC_ID + np.arange(2), points, None, counts)
    estimator.load_map(nameless_map, pose=np.eye(4))
    stand(estimator, 0.0)
    observe(estimator, 0.0, [*points, [0.0, -3.0, 0.0]], [7, 4, 9])
    assert estimator.landmark_ids.tolist() == [7, 4]
    assert_array_equal(estimator.world_points, points)
    assert estimator.counts['unmapped_landmark'] == 1


@pytest.mark.parametrize('seed', range(30))
def test_many_points_seen_after_a_blind_stretch_are_distinguished_together(seed):
    """Each of them alone could be any landmark within metres."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.mgrid[:4, :4], axis=-1).reshape(16, 2)
    landmarks = grid + rng.uniform(-0.3, 0.3, (16, 2))
    C = axes.PLANAR.output_matrix(np.pad(landmarks, ((0, 0), (0, 1))))
    deviations, sigma_m = np.array([0.2, 1.0, 1.0]), 0.1
    noise_m = rng.normal(scale=sigma_m, size=(16, 2))
    points = landmarks + C @ (deviations * rng.uniform(-1.0, 1.0, 3)) + noise_m
    at, rows = np.nonzero(np.linalg.norm(points[:, None] - landmarks, axis=2) < 3.0)
    joint, own = C[rows].reshape(-1, 3) * deviations, sigma_m**2 * np.eye(2)
    S = joint @ joint.T + np.kron(np.eye(len(at)), own)
    pairs = Pairs(at, rows, points[at] - landmarks[rows], S, np.tile(own, (len(at), 1, 1)))
    certain, unpaired_costs = np.zeros(len(at), dtype=bool), np.full(len(at), huber_loss(6.0))
    found = JointSearch(pairs, certain, unpaired_costs, PRUNING_COST).pairings()
    assert len(found[0].chosen) == 16
    assert_array_equal(at[found[0].chosen], rows[found[0].chosen])


def test_reflectors_that_come_one_a_message_are_all_kept():
    random = np.random.default_rng(0)
    points = random.uniform([-8.0, -8.0, 0.0], [8.0, 8.0, 0.0], (24, 3))
    estimator = Estimator(PLANAR)
    for step in range(1000):
        stand(estimator, 0.02 * step)
        point = points[[step % 24]] + random.normal(scale=0.02, size=(1, 3)) * [1.0, 1.0, 0.0]
        observe(estimator, 0.02 * step, point)
    assert estimator.counts['unsupported_landmark'] == 0


@pytest.mark.parametrize('loaded', [False, True], ids=['mapped', 'loaded'])
@pytest.mark.parametrize('shift_m', [0.0, 0.8])
def test_a_landmark_added_where_a_known_one_should_be_seen_is_said(shift_m, loaded, caplog):
    """The robot is moved on its stand, which nobody told it."""
    random, estimator = np.random.default_rng(0), Estimator(PLANAR)
    post = np.array([[3.0, 0.0, 0.0]])
    if loaded:
        surveyed = np.array([1e-4 * np.eye(3)])
        estimator.load_map(LandmarkMap(np.array([7]), post, surveyed, np.array([0])), np.eye(4))
    for step in range(120):
        stand(estimator, 0.1 * step)
        noise = random.normal(scale=0.02, size=3) * [1.0, 1.0, 0.0]
        observe(estimator, 0.1 * step, post + noise - [shift_m * (step > 40), 0.0, 0.0])
    is_said = shift_m > 0.0
    assert estimator.counts['doubled_landmark'] == is_said
    assert ('added where a known one should be seen' in caplog.text) == is_said


def test_the_covariance_does_not_depend_on_when_it_was_asked_for_before():
    def run(is_asked):
        """Two rows of look-alikes, a blind stretch, and then one of them."""
        rng, estimator = np.random.default_rng(0), Estimator(PLANAR)
        points = np.array([[2.0 * i, 2.0 * (i % 2) - 1.0, 0.0] for i in range(6)])
        time_s = 1.0
        for step in range(25):
            time_s += 6.0 if step == 20 else 0.1
            stand(estimator, time_s)
            seen = points if step < 20 else points[:1]
            observe(estimator, time_s, seen + rng.normal(scale=0.02, size=seen.shape) * [1, 1, 0])
        assert len(estimator._hypotheses) > 1
        first = estimator.pose_covariance if is_asked else None
        for step in range(1, 201):
            stand(estimator, time_s + 0.01 * step, (0, 0, 0.5, 1, 0, 0))
        return first, estimator.pose_covariance

    (before, after), (_, unasked) = run(True), run(False)
    assert_array_equal(after, unasked)
    assert before[2, 2] < after[2, 2]


def test_in_doubt_the_covariance_grows_on_the_way_as_it_will_be_once_it_is_moved_on():
    """The further the robot goes, the further apart are states that differ in their heading."""
    hypotheses = Hypotheses(State(make_gains(PLANAR, np.eye(4)), PLANAR))
    hypotheses._all.append(replace(hypotheses._all[0].copy(), cost=1.0))
    for hypothesis, yaw_rad in zip(hypotheses._all, [0.0, 0.4], strict=True):
        hypothesis.state.set_pose(se3.exp(np.array([0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0])), None)
    velocities, end_ns = VelocityHistory(10**10), 6 * 10**9
    velocities.append(VelocityEvent(0, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])))
    _, before = hypotheses.pose_after(velocities, 0, end_ns)
    hypotheses.propagate(velocities, 0, end_ns)
    assert_allclose(before, hypotheses.pose_after(velocities, end_ns, end_ns)[1], atol=1e-9)
    assert np.sqrt(before[4, 4]) > 1.0


def test_settings_and_jumps_of_the_clock_are_of_all_states_that_are_followed():
    settings = LiveSettings.of(Settings())
    hypotheses = Hypotheses(State(make_gains(settings, np.eye(4)), settings))
    hypotheses._all.append(hypotheses._all[0].copy())
    settings.follow(replace(settings, huber_threshold=3.0))
    assert [hypothesis.state.settings.huber_threshold for hypothesis in hypotheses._all] == [3, 3]
    hypotheses._all = [Mock(), Mock()]
    hypotheses.clear_time()
    for hypothesis in hypotheses._all:
        hypothesis.state.clear_time.assert_called_once_with()


def test_in_doubt_the_covariance_is_that_of_all_states_by_their_likelihoods():
    """Σ w_i (P_i + d_i d_iᵀ) about the first, of poses that differ by d_i."""
    settings, rng = Settings(), np.random.default_rng(0)
    poses = se3.exp(rng.normal(scale=[0.3] * 3 + [2.0] * 3, size=(3, 6)))
    roots = 0.1 * rng.normal(size=(3, 6, 6))
    covariances, costs = roots @ roots.swapaxes(1, 2), np.array([0.0, 1.0, 3.0])
    hypotheses = Hypotheses(State(make_gains(settings, np.eye(4)), settings))
    first = hypotheses._all[0]
    hypotheses._go_on_with([replace(first.copy(), cost=cost) for cost in costs.tolist()])
    for hypothesis, pose, covariance in zip(hypotheses._all, poses, covariances, strict=True):
        hypothesis.state.set_pose(pose, covariance)
    weights = np.exp(-costs / 2.0) / np.exp(-costs / 2.0).sum()
    turns = so3.log(poses[:, :3, :3] @ poses[0, :3, :3].T)
    d = np.column_stack([turns, poses[:, :3, 3] - poses[0, :3, 3]])
    each = covariances + d[:, :, None] * d[:, None, :]
    expected = np.einsum('i,ijk->jk', weights, each)
    velocities = VelocityHistory(10**9)
    assert_allclose(hypotheses.pose_after(velocities, 0, 0)[1], expected, atol=1e-9)
    hypotheses.prune_to_best()
    assert_allclose(hypotheses.pose_after(velocities, 0, 0)[1], covariances[0], atol=1e-9)
