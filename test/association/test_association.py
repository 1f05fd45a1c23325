"""Points without an id: which landmark each is, what is new, and where that can't be known yet."""

from __future__ import annotations

from dataclasses import replace
import itertools
from pathlib import Path
from unittest.mock import Mock

import gain_worlds
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.association.costs import NewLandmarks
from slam_observer_ros.association.hypotheses import are_one, Hypotheses
from slam_observer_ros.association.hypothesis import FieldOfView, LandmarkIndex, Visibility
from slam_observer_ros.association.interpretations import interpretations
from slam_observer_ros.association.joint_compatibility import (
    columns_of,
    huber_loss,
    joint_cost,
    JointSearch,
    MAX_PARTIAL,
    Pairs,
    PRUNING_COST,
)
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.evaluation.metrics import ConfigurationError
from slam_observer_ros.evaluation.trajectory import interpolate, Trajectory
from slam_observer_ros.events import (
    FIRST_AUTOMATIC_ID,
    is_automatic,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.geometry import axes, se3, so3
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.observer.designs import make_gains
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.recording.mrclam import load_mrclam
from slam_observer_ros.sensor_models.velocity_history import VelocityHistory
from slam_observer_ros.settings.estimator_settings import LiveSettings, Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table
from slam_observer_ros.state.landmark_table import LandmarkTable, PATIENCE, TOO_SELDOM
from slam_observer_ros.state.matching import match
from slam_observer_ros.state.state import State

CONFIG = Path(__file__).resolve().parents[2] / 'config' / 'wheeled_bearing_range.yaml'
PLANAR = Settings(two_d_mode=True, reorder_window=0.0)
SPATIAL = Settings(reorder_window=0.0)


def nameless(event):
    return replace(event, ids=np.full_like(event.ids, UNKNOWN_ID))


def without_ids(world):
    return world.with_observations(lambda _, event: nameless(event))


@pytest.mark.parametrize('settings', [PLANAR, SPATIAL], ids=['planar', 'spatial'])
@pytest.mark.parametrize('seed', range(3))
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


def observe(estimator, time_s, points, ids=None):
    """Add an observation of body points with ids, by default none."""
    ids = np.full(len(points), UNKNOWN_ID) if ids is None else np.array(ids)
    event = ObservationEvent(round(time_s * 1e9), ids, np.array(points, dtype=float))
    assert estimator.add(event)


def stand(estimator, time_s, body_velocity=(0, 0, 0, 0, 0, 0)):
    assert estimator.add(VelocityEvent(round(time_s * 1e9), np.array(body_velocity, dtype=float)))


def test_what_is_seen_once_or_twice_is_never_in_the_map_and_soon_forgotten():
    estimator = Estimator(SPATIAL)
    for step in range(150):
        stand(estimator, 0.1 * step)
        stray = [[0.0, 4.0, 1.0]] if step in (20, 21) else []
        observe(estimator, 0.1 * step, [[3.0, 0.0, 0.0], *stray])
        assert len(estimator.landmark_ids) == (1 if step >= 4 else 0)
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


@pytest.mark.parametrize('seed', range(3))
def test_false_points_among_those_without_ids_leave_few_landmarks_behind(seed):
    world = gain_worlds.drive(PLANAR, 200.0, seed, landmarks=8)
    named = gain_worlds.estimate(world, PLANAR)
    estimator = gain_worlds.estimate(with_false_points(world, 0.05, seed), PLANAR)
    assert estimator.counts['unsupported_landmark'] > 20
    assert len(estimator.landmark_ids) <= len(named.landmark_ids) + 3
    assert estimator.counts['doubled_landmark'] == 0
    assert_allclose(estimator.pose, named.pose, atol=0.1)


@pytest.mark.parametrize('seed', range(3))
def test_a_sensor_that_seldom_sees_what_is_in_view_maps_it_all_the_same(seed):
    rng = np.random.default_rng(seed)
    world = gain_worlds.drive(PLANAR, 200.0, seed, landmarks=8, seen=8)
    seldom = world.with_observations(lambda _, e: e.select(rng.random(len(e.ids)) < 0.1))
    estimator = gain_worlds.estimate(without_ids(seldom), PLANAR)
    named = gain_worlds.estimate(seldom, PLANAR)
    assert len(estimator.landmark_ids) == len(named.landmark_ids) == 8
    assert_allclose(estimator.pose, named.pose, atol=0.05)


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
        stand(estimator, 0.1 * step)  # at rest, it says; the robot turns to the left by 0.6 rad
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


def test_of_two_places_the_one_is_given_up_where_more_should_have_been_seen():
    """A lone post, and one as far with another behind it; odometry says that it is that one."""
    settings = replace(PLANAR, angular_velocity_noise=(0.0, 0.0, 0.1), confirmations=1)
    posts = np.array([[5.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.6, 4.8, 0.0]])
    estimator, turn_rad = Estimator(settings), -np.arctan2(4.0, 3.0)
    for step in range(20):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, posts)
    for step in range(20, 120):
        stand(estimator, 0.1 * step)  # at rest, it says; the robot turns to the right
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


def test_one_hypothesis_at_most_if_no_more_are_wanted():
    world = without_ids(gain_worlds.drive(replace(PLANAR, max_hypotheses=1), 30.0, landmarks=60))
    estimator = Estimator(replace(PLANAR, max_hypotheses=1))
    for event in world.events:
        estimator.add(event)
        assert len(estimator._hypotheses) == 1


@pytest.mark.parametrize('gains', ['constant', 'scheduled'])
def test_gains_without_a_joint_covariance_leave_points_without_id_out(gains):
    estimator = Estimator(replace(SPATIAL, gains=gains, confirmations=1))
    stand(estimator, 0.0)
    observe(estimator, 0.0, [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]], [4, UNKNOWN_ID])
    assert estimator.landmark_ids.tolist() == [4]
    assert estimator.counts['unknown_id'] == 1


@pytest.mark.parametrize('gains', ['constant', 'scheduled'])
def test_points_that_gains_leave_out_say_nothing_of_the_pose(gains):
    known = np.random.default_rng(0).uniform(-5.0, 5.0, (12, 3))
    estimator = Estimator(replace(SPATIAL, gains=gains, localization_mode='uncertain'))
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
    estimator = Estimator(replace(SPATIAL, confirmations=1, min_support=1))
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


@pytest.mark.parametrize(('robot', 'limit'), [(2, 1.25), (3, 1.35)])
def test_without_ids_real_robots_are_hardly_worse_off(data_dir, robot, limit):
    """Commands as odometry, blind for a minute at a time, posts of two or three barcodes."""
    run = first_half(load_mrclam(data_dir / 'mrclam' / 'MRCLAM_Dataset6', robot))
    assert _configuration_rmse_m(run, nameless) < limit * _configuration_rmse_m(run)


def first_half(run):
    velocities = len(run.velocity_stamps_ns) // 2
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


@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(1, 3), st.sampled_from([2, 3]))
def test_where_few_pairings_are_possible_the_search_finds_the_cheapest(seed, points, landmarks, k):
    rng = np.random.default_rng(seed)
    at, rows = np.nonzero(rng.random((points, landmarks)) < 0.8)
    q, gate = len(at), 3.0
    root = rng.normal(size=(q * k, q * k))
    noise = np.tile(0.3 * np.eye(k), (q, 1, 1))
    S = 0.2 * root @ root.T + np.kron(np.eye(q), 0.3 * np.eye(k))
    r = rng.normal(scale=1.5, size=(q, k))
    options = np.bincount(at, minlength=points)

    def cost(chosen):
        in_order = sorted(chosen, key=lambda i: (options[at[i]], at[i]))
        columns = columns_of(in_order, k)
        root = np.linalg.cholesky(S[np.ix_(columns, columns)])
        whitened = np.linalg.solve(root, r[in_order].ravel()).reshape(-1, k)
        log_ratio = 2 * np.sum(np.log(np.diag(root))) - len(chosen) * k * np.log(0.3)
        unpaired = len(np.unique(at)) - len(chosen)
        return (
            np.sum(huber_loss(np.linalg.norm(whitened, axis=1)))
            + log_ratio
            + unpaired * huber_loss(gate)
        )

    possible = [
        chosen
        for count in range(q + 1)
        for chosen in itertools.combinations(range(q), count)
        if len({at[i] for i in chosen}) == len({rows[i] for i in chosen}) == count
    ]
    pairs = Pairs(at, rows, r, S, noise)
    certain, unpaired_costs = np.zeros(q, dtype=bool), np.full(q, huber_loss(gate))
    found = JointSearch(pairs, certain, unpaired_costs, np.inf).pairings()
    least = min(cost(chosen) for chosen in possible)
    assert found[0].cost == pytest.approx(least)
    assert found[0].cost == pytest.approx(cost(found[0].chosen))
    assert len(found) == min(len(possible), MAX_PARTIAL)
    costs = [
        pairing.cost for pairing in JointSearch(pairs, certain, unpaired_costs, 10.0).pairings()
    ]
    assert costs == sorted(costs)
    assert costs[-1] <= costs[0] + 10.0


@given(st.integers(0, 10_000), st.integers(1, 4), st.sampled_from([2, 3]))
def test_where_each_point_may_be_of_one_landmark_all_pairs_are_what_the_search_finds(seed, q, k):
    rng = np.random.default_rng(seed)
    noise, root = np.tile(0.3 * np.eye(k), (q, 1, 1)), rng.normal(size=(q * k, q * k))
    S = 0.2 * root @ root.T + np.kron(np.eye(q), 0.3 * np.eye(k))
    pairs = Pairs(np.arange(q), np.arange(q), rng.normal(size=(q, k)), S, noise)
    search = JointSearch(pairs, np.zeros(q, dtype=bool), np.full(q, huber_loss(2.5)), np.inf)
    together, found = search.all_pairs(), search.pairings()
    (same,) = [pairing for pairing in found if len(pairing.chosen) == q]
    if together is None:  # one of them is better left out
        z, log_diagonal = same.z.reshape(q, k), np.log(np.diag(same.L)).reshape(q, k)
        rises = huber_loss(np.linalg.norm(z, axis=1)) - 2.0 * log_diagonal.sum(axis=1)
        assert max(rises - k * np.log(0.3)) > huber_loss(2.5)
        return
    assert together.cost == pytest.approx(same.cost)
    assert_allclose(together.z, same.z)
    assert_allclose(together.L, same.L)


@given(st.integers(0, 10_000), st.integers(0, 5), st.sampled_from([2, 3]))
def test_what_ids_cost_does_not_depend_on_the_order_of_points(seed, m, k):
    rng = np.random.default_rng(seed)
    root, noise = rng.normal(size=(m * k, m * k)), np.tile(0.3 * np.eye(k), (m, 1, 1))
    S = root @ root.T + np.kron(np.eye(m), 0.3 * np.eye(k))
    r = rng.normal(scale=5.0, size=(m, k))
    order = rng.permutation(m)
    columns = columns_of(order.tolist(), k)
    turned = joint_cost(r[order], S[np.ix_(columns, columns)], noise)
    assert joint_cost(r, S, noise) == pytest.approx(turned)
    near = 0.1 * r / (1.0 + np.linalg.norm(np.linalg.solve(S, r.ravel())))
    plain = near.ravel() @ np.linalg.solve(S, near.ravel())
    log_ratio = np.linalg.slogdet(S)[1] - m * k * np.log(0.3)
    assert joint_cost(near, S, noise) == pytest.approx(plain + log_ratio)


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


def test_what_new_landmarks_cost_does_not_depend_on_what_else_is_in_the_map():
    """Else states with other maps could not be compared."""
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    costs = []
    for some_have_no_id in (False, True):
        estimator = Estimator(SPATIAL)
        for step in range(10):
            stand(estimator, 0.1 * step)
            far = [[30.0, 30.0, 0.0]] if some_have_no_id else []
            observe(estimator, 0.1 * step, [*points, *far], [1, 2, *[UNKNOWN_ID] * len(far)])
        new = np.array([*points, [-2.0, 2.0, 0.0]])
        event = ObservationEvent(estimator.stamp_ns, np.array([1, 2, 77]), new)
        state, index = estimator._hypotheses.best, LandmarkIndex()
        matched = match(state, event)
        (only,) = interpretations(state, index, event, matched, np.arange(3), 20.0, np.inf)
        costs.append(only.cost)
    assert costs[0] == pytest.approx(costs[1], abs=0.5)


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


@pytest.mark.parametrize('far_m', [1.0, 2.0])
def test_the_one_landmark_in_view_is_doubted_once_not_at_each_look(far_m):
    """After a blind drive it only passes the gate as the state is uncertain."""
    estimator, rng = Estimator(PLANAR), np.random.default_rng(0)
    followed = []
    for step in range(832):
        is_blind = 20 <= step < 820
        turn = 0.3 if step < 120 else -0.3
        stand(estimator, 0.1 * step, (0, 0, turn * is_blind, np.sign(turn) * 0.5 * is_blind, 0, 0))
        if not is_blind:
            noise_m = 0.01 * np.append(rng.standard_normal(2), 0.0)
            off_m = far_m * (step >= 820) * np.array([0.5, 0.4, 0.0])
            observe(estimator, 0.1 * step, [[3.0, 0.5, 0.0] + off_m + noise_m], [1])
            followed.append(len(estimator._hypotheses))
    assert max(followed) in {2, 3}
    assert followed[-1] == 1


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


@given(st.integers(0, 10_000), st.integers(1, 300), st.floats(0.01, 20.0))
def test_the_index_misses_no_landmark_while_they_move_and_change_in_number(seed, first, radius_m):
    rng = np.random.default_rng(seed)
    index, landmarks = LandmarkIndex(), rng.uniform(-10.0, 10.0, (first, 3))
    for _ in range(4):
        points = rng.uniform(-10.0, 10.0, (3, 3))
        radii_m = radius_m * rng.uniform(0.5, 1.0, 3)
        found = np.zeros((3, len(landmarks)), dtype=bool)
        found[index.near(landmarks, points, radii_m)] = True
        distances_m = np.linalg.norm(points[:, None] - landmarks, axis=2)
        assert found[distances_m <= radii_m[:, None]].all()
        landmarks = landmarks + rng.normal(scale=0.05, size=landmarks.shape)
        landmarks = np.concatenate([landmarks, rng.uniform(-10.0, 10.0, (rng.integers(9), 3))])
        landmarks = np.delete(landmarks, rng.integers(len(landmarks)), axis=0)


def looked_at(counts, looks, settled_looks=0, settled_seen=0):
    """A table of landmarks without ids, after one that has settled was in view and seen so often.

    The landmark of row 0 is that one, the next are those of ``counts`` and ``looks``.
    """
    landmarks = LandmarkTable()
    landmarks.add_known(np.array([FIRST_AUTOMATIC_ID]), np.array([100]))
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


def test_on_new_ground_a_new_landmark_costs_less_and_where_all_is_known_as_much_as_the_gate():
    new, gate_cost = NewLandmarks(), huber_loss(6.0)
    event = ObservationEvent(0, np.full(5, UNKNOWN_ID), np.zeros((5, 3)))
    for second in range(100):
        new.note(replace(event, stamp_ns=second * 10**9), confirmed=1)
    assert new.cost(gate_cost) == pytest.approx(gate_cost - 2.0 * np.log(0.2 / 0.0017), abs=0.1)
    for second in range(100, 600):
        new.note(replace(event, stamp_ns=second * 10**9), confirmed=0)
    assert new.cost(gate_cost) == pytest.approx(gate_cost, abs=0.6)
    assert new.cost(4.0) == 4.0, 'no more than a point at the gate'


def test_nothing_is_forgotten_before_it_is_known_how_often_a_landmark_is_seen():
    landmarks = looked_at([1, 4], [1000, 1000])
    assert landmarks.unsupported(5).tolist() == []


def test_a_landmark_without_id_has_had_its_chance_after_so_many_looks_and_not_before():
    """One has settled, and was seen each time; the other one never was but once."""
    landmarks, both = LandmarkTable(), np.array([0, 1])
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
    state.landmarks = landmarks
    return state


def test_before_it_is_known_where_a_sensor_looks_no_place_is_unexpected():
    landmarks, visibility = LandmarkTable(), Visibility(2)
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


def test_a_landmark_that_was_placed_again_has_its_chance_again():
    landmarks = looked_at([4], [39], settled_looks=996, settled_seen=499)
    landmarks.take_for_new(np.array([1]), 0)
    landmarks.note_in_view(np.array([1]), np.array([False]))
    assert landmarks.unsupported(5).tolist() == []


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
    hypotheses._all = [replace(first.copy(), cost=cost) for cost in costs.tolist()]
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
