"""Localisation in a known map: the pose in the map's frame, with an honest covariance."""

from __future__ import annotations

from dataclasses import replace
import logging
from types import SimpleNamespace

from mapped_worlds import add, GAINS, MODES, World
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.special import chdtri

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.mapping import localiser
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.localiser import is_lost
from slam_observer_ros.mapping.map_alignment import _contradictions, find_transform
from slam_observer_ros.settings.estimator_settings import Settings


@pytest.mark.parametrize(('is_planar', 'count'), [(False, 3), (False, 5), (True, 3), (True, 2)])
@pytest.mark.parametrize('mode', ['off', 'fixed'])
def test_after_one_view_of_known_landmarks_the_pose_is_right_within_its_covariance(
    is_planar, count, mode
):
    dof = 3 if is_planar else 6
    nees = []
    for seed in range(40):
        world = World(seed, is_planar)
        estimator = Estimator(world.settings(localization_mode=mode))
        estimator.load_map(world.map())
        ids = world.random.choice(world.near(0.0, 12), count, replace=False)
        add(estimator, [world.see(0.0, ids)])
        if estimator.is_localised:  # else they are almost in a line
            nees.append(world.nees(estimator, 0.0))
    assert len(nees) > 30
    assert np.mean(nees) / dof == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dof / len(nees)))
    within_three_sigma = np.array(nees) <= chdtri(dof, 0.0027)
    assert within_three_sigma.mean() > 0.98


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('gains', GAINS)
@pytest.mark.parametrize('is_planar', [False, True])
def test_every_gain_design_tracks_in_every_mode(gains, mode, is_planar):
    world = World(0, is_planar)
    known = world.map(range(0, 50, 2))
    estimator = Estimator(world.settings(gains=gains, localization_mode=mode))
    estimator.load_map(known)
    add(estimator, world.drive(0.0, 20.0))
    assert estimator.is_localised
    error = world.error(estimator, 19.9)
    assert np.linalg.norm(error[3:]) < 0.12
    assert np.linalg.norm(error[:3]) < 0.02
    rows = [list(estimator.landmark_ids).index(i) for i in known.ids]
    off = estimator.world_points[rows] - world.points[known.ids]
    assert np.std(off) < 1.05 * np.std(known.world_points - world.points[known.ids])
    added = set(estimator.landmark_ids) - set(known.ids)
    assert bool(added) == (mode == 'off')
    moved = not np.allclose(estimator.world_points[rows], known.world_points, atol=1e-9, rtol=0)
    assert moved == (mode != 'fixed')


@pytest.mark.parametrize('mode', ['off', 'uncertain'])
def test_tracking_in_an_uncertain_map_stays_honest(mode):
    nees = []
    for seed in range(12):
        world = World(seed, is_planar=True)
        settings = world.settings(
            localization_mode=mode,
            angular_velocity_noise=(0.02 * 0.1**0.5,) * 3,
            linear_velocity_noise=(0.02 * 0.1**0.5,) * 3,
            huber_threshold=0.0,
            relinearization_interval=20,
            relinearization_angle=0.0,
        )
        estimator = Estimator(settings)
        estimator.load_map(world.map())
        add(estimator, world.drive(0.0, 8.0, count=3))
        nees.append(world.nees(estimator, 7.9))
    assert 0.5 < np.mean(nees) / 3 < 1.7


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
def test_the_velocitys_scale_is_estimated_in_a_map_that_is_known(mode):
    """As without one; in a fixed map, too."""
    world = World(3, is_planar=True)
    settings = world.settings(
        localization_mode=mode,
        linear_scale_stddev=(0.2, 0.0, 0.0),
        angular_bias_stddev=(0.0, 0.0, 0.0),
        velocity_delay_stddev=0.0,
        relinearization_interval=0,
    )
    estimator = Estimator(settings)
    estimator.load_map(world.map(sigma_m=0.001), world.pose(0.0))
    for event in world.drive(0.0, 20.0):
        if isinstance(event, VelocityEvent):
            event = replace(event, body_velocity=event.body_velocity * [1, 1, 1, 0.9, 1, 1])
        estimator.add(event)
    (scale,) = estimator.calibration
    assert scale.name == 'linear_scale_x'
    assert scale.value == pytest.approx(1.0 / 0.9, abs=4.0 * scale.deviation)
    assert scale.deviation < 0.02


def test_in_a_fixed_map_a_late_message_with_velocities_moves_no_landmark_either():
    world = World(3)
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(world.map(), world.pose(0.0))
    seen = world.see(0.0, world.near(0.0, 5))
    for later_ns, velocities in [
        (0, None),
        (200_000_000, None),
        (100_000_000, np.full((5, 3), 3.0)),
    ]:
        stamp_ns = seen.stamp_ns + later_ns
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(replace(seen, stamp_ns=stamp_ns, velocities=velocities))
    assert estimator.counts['late_observation'] == 1
    assert np.linalg.norm(world.error(estimator, 0.0)[3:]) < 0.05


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
@pytest.mark.parametrize('is_given', [False, True])
def test_of_a_map_with_heights_a_planar_estimate_takes_the_plan(mode, is_given):
    world = World(3, is_planar=True)
    known = world.map(sigma_m=0.001)
    raised = replace(known, world_points=known.world_points + [0.0, 0.0, 1.7])
    estimator = Estimator(world.settings(localization_mode=mode))
    estimator.load_map(raised, world.start if is_given else None)
    add(estimator, world.drive(0.0, 1.0))
    assert estimator.is_localised
    assert_array_equal(estimator.world_points[:, 2], 0.0)
    assert_array_equal(estimator.pose[2], [0.0, 0.0, 1.0, 0.0])


def test_landmarks_may_be_seen_one_after_another():
    world = World(4)
    estimator = Estimator(world.settings(localization_mode='uncertain'))
    estimator.load_map(world.map())
    events = world.drive(0.0, 3.0, count=0)
    for step, landmark_id in enumerate(world.near(1.0, 8)):
        events += [world.see(0.05 + 0.3 * step, [landmark_id])]
    add(estimator, sorted(events, key=lambda event: event.stamp_ns))
    assert estimator.is_localised
    assert estimator.counts['not_localised'] >= 2
    assert world.nees(estimator, 2.9) < chdtri(6, 0.0027)


def test_a_place_that_is_not_found_is_looked_for_again_when_there_is_news(monkeypatch):
    tries = []
    monkeypatch.setattr(localiser, 'enter_map', lambda *_: tries.append(1))
    world = World(4)
    estimator = Estimator(world.settings())
    estimator.load_map(world.map())
    add(estimator, [world.see(0.1 * step, range(3)) for step in range(200)])
    once = len(tries)
    assert 20 < once < 60
    add(estimator, [world.see(20.0 + 0.1 * step, range(4 + step)) for step in range(3)])
    assert len(tries) == once + 3
    assert estimator.counts['not_localised'] == 203


@pytest.mark.parametrize('axes', [SPATIAL, PLANAR])
def test_a_frame_that_lies_anyhow_to_robot_and_landmarks_alike_is_no_obstacle(axes):
    p, k = axes.p, axes.point
    source = np.random.default_rng(0).uniform(-5, 5, (6, 3)) * ([1, 1, 1] if k == 3 else [1, 1, 0])
    G = np.vstack([np.eye(p), axes.output_matrix(source).reshape(6 * k, p)])
    tilted = G @ G.T + 1e-4 * np.eye(p + 6 * k)  # by 1 rad, in common
    true = se3.exp(np.array([0.0, 0.0, 1.0, 2.0, 3.0, 0.0]))
    known = KnownLandmarks(se3.transform(true, source), np.tile(1e-4 * np.eye(3), (6, 1, 1)))
    transform, agree = find_transform(source, tilted, known, axes)
    assert_allclose(transform, true, atol=1e-9)
    assert agree.all()


def test_a_landmark_counts_for_the_frame_along_the_directions_in_which_its_map_knows_it():
    """Some are off by 1 σ where the map says 1 m: that contradicts nothing and moves nothing."""
    source = np.random.default_rng(0).uniform(-5.0, 5.0, (8, 3))
    true = se3.exp(np.array([0.3, -0.2, 1.6, 20.0, 3.0, 0.0]))
    covariances = np.tile(1e-6 * np.eye(3), (8, 1, 1))
    covariances[5:, 0, 0] = 1.0
    target = se3.transform(true, source) + np.sqrt(covariances[:, 0]) * (np.arange(8) > 4)[:, None]
    own = 1e-8 * np.eye(6 + 24)
    transform, agree = find_transform(source, own, KnownLandmarks(target, covariances), SPATIAL)
    assert agree.all()
    assert_allclose(transform, true, atol=1e-3)


def line_of_landmarks(count):
    points = np.arange(count)[:, None] * np.array([1.0, 0.5, 0.0])
    return LandmarkMap(np.arange(count), points, None, np.zeros(count, dtype=np.int64))


@pytest.mark.parametrize(
    ('known', 'is_planar', 'is_enough'),
    [
        (line_of_landmarks(1), True, False),
        (line_of_landmarks(2), True, True),
        (line_of_landmarks(2), False, False),
        (line_of_landmarks(9), False, False),
    ],
)
def test_what_leaves_the_pose_open_does_not_place_the_robot(known, is_planar, is_enough):
    estimator = Estimator(Settings(two_d_mode=is_planar, reorder_window=0.0))
    estimator.load_map(known)
    add(estimator, [ObservationEvent(10**9, known.ids, known.world_points + np.eye(3)[0])])
    assert estimator.is_localised == is_enough
    assert estimator.counts['not_localised'] == (not is_enough)


@pytest.mark.parametrize('mode', MODES)
def test_landmarks_that_have_moved_since_do_not_mislead_and_are_taken_as_the_map_has_them(mode):
    world = World(5)
    known = world.map()
    seen = world.near(0.0, 8)
    moved = seen[[2, 5]]
    world.points[moved] += [[0.0, 2.0, 0.0], [3.0, 0.0, 1.0]]
    estimator = Estimator(world.settings(localization_mode=mode))
    estimator.load_map(known)
    add(estimator, [world.see(0.0, seen)])
    assert world.nees(estimator, 0.0) < chdtri(6, 0.0027)
    rows = [list(estimator.landmark_ids).index(i) for i in moved]
    assert_allclose(estimator.world_points[rows], known.world_points[moved], atol=1e-9)


@pytest.mark.parametrize('map_noise', [1e-3, 0.3])
def test_of_a_map_without_covariances_as_much_may_be_wrong_as_is_asked_for(map_noise):
    world = World(6)
    known = replace(world.map(sigma_m=0.3), covariances=None)
    estimator = Estimator(world.settings(map_noise=map_noise))
    estimator.load_map(known)
    add(estimator, [world.see(0.0, world.near(0.0, 8))])
    assert estimator.is_localised == (map_noise == 0.3)


def test_in_a_map_of_another_place_the_robot_is_never_placed():
    world, other = World(6), World(7)
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(other.map())
    add(estimator, world.drive(0.0, 2.0, count=4))
    assert not estimator.is_localised
    assert estimator.counts['not_localised'] == 20


@pytest.mark.parametrize('mode', MODES)
def test_a_landmark_that_moves_is_placed_again_only_where_mapping_goes_on(mode):
    world = World(3)
    known = world.map()
    estimator = Estimator(world.settings(localization_mode=mode))
    estimator.load_map(known)
    add(estimator, world.drive(0.0, 2.0, count=12))
    moved = world.near(3.0, 3)[0]
    world.points[moved] += [0.0, 0.0, 3.0]
    add(estimator, world.drive(2.0, 4.0, count=12))
    assert estimator.counts['moved_landmark'] == (mode == 'off')
    (found,) = estimator.world_points[estimator.landmark_ids == moved]
    expected = world.points[moved] if mode == 'off' else known.world_points[moved]
    assert_allclose(found, expected, atol=0.2)


def test_a_robot_that_was_carried_away_finds_itself_again(caplog):
    world = World(14)
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 2.0))
    offset = se3.exp(np.array([0.0, 0.0, 1.5, 3.0, -4.0, 0.0]))
    with caplog.at_level(logging.WARNING):
        add(estimator, world.drive(2.0, 6.0, offset=offset))
    assert estimator.counts['lost'] + estimator.counts['slip'] >= 1
    assert 'localising again' in caplog.text or 'slipped or was carried' in caplog.text
    error = se3.log(estimator.pose @ se3.inverse(offset @ world.pose(5.9)))
    assert np.linalg.norm(error) < 0.1


@pytest.mark.parametrize('mode', ['uncertain', 'fixed'])
def test_a_landmark_that_has_moved_does_not_make_the_robot_lost_when_it_is_alone_in_view(mode):
    landmarks = np.array([[5, 0, 0], [5, 3, 1], [5, -3, 0.5], [-5, 0, 0], [-5, 2, 1], [-5, -2, 1]])
    estimator = Estimator(Settings(localization_mode=mode, reorder_window=0.0))
    ids, moved = np.arange(6), landmarks + np.repeat([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]], 3, axis=0)
    estimator.load_map(LandmarkMap(ids, landmarks, None, np.zeros(6, dtype=np.int64)), np.eye(4))
    for step in range(21):
        seen = ids[3:4] if step == 20 else ids if step < 10 else ids[:3]
        estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
        estimator.add(ObservationEvent(step * 10**8, seen, moved[seen]))
    assert estimator.is_localised
    assert_allclose(estimator.pose, np.eye(4), atol=0.05)


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({}, True),
        ({'rejections': [5, 5, 4, 0]}, False),
        ({'rejections': [9, 9, 9, 0]}, True),
        ({'rejected_in_a_row': 4}, False),
        ({'is_mapping': True}, False),
    ],
)
def test_a_robot_is_lost_where_as_many_landmarks_as_place_it_were_rejected_so_often(
    changes, expected
):
    state = {'rejections': [5, 5, 5, 0], 'rejected_in_a_row': 5, 'is_mapping': False} | changes
    slam = SimpleNamespace(
        settings=Settings(max_rejections=5),
        landmarks=SimpleNamespace(rejections=np.array(state['rejections'])),
        axes=SPATIAL,
        rejected_in_a_row=state['rejected_in_a_row'],
        is_mapping=state['is_mapping'],
    )
    assert is_lost(slam) == expected


@pytest.mark.parametrize('is_planar', [False, True])
def test_of_many_landmarks_the_few_that_fit_by_chance_do_not_place_the_robot(is_planar):
    rng = np.random.default_rng(0)
    for _ in range(10):
        own, other = rng.uniform(-10.0, 10.0, (2, 20, 3)) * [1.0, 1.0, not is_planar]
        estimator = Estimator(Settings(two_d_mode=is_planar, reorder_window=0.0))
        ids = np.arange(20)
        estimator.load_map(LandmarkMap(ids, other, None, np.zeros(20, dtype=np.int64)))
        estimator.add(ObservationEvent(0, ids, own))
        assert not estimator.is_localised


def test_a_motion_of_everything_contradicts_nothing_and_one_landmark_that_moved_itself_alone():
    """What is left fits the best motion, by generalised least squares."""
    rng = np.random.default_rng(0)
    points = rng.normal(scale=5.0, size=(6, 3))
    J = SPATIAL.output_matrix(points).reshape(-1, 6)
    root = rng.normal(size=(18, 18))
    S = 0.01 * (root @ root.T + np.eye(18))
    moved = (J @ rng.normal(size=6)).reshape(6, 3)
    total, each = _contradictions(J, S, moved)
    assert_allclose(total, 0.0, atol=1e-6)
    assert_allclose(each, 0.0, atol=1e-6)
    r = rng.normal(size=(6, 3))
    inverse = np.linalg.inv(S)
    gamma = np.linalg.solve(J.T @ inverse @ J, J.T @ inverse @ r.ravel())
    left = r.ravel() - J @ gamma
    total, _ = _contradictions(J, S, r)
    assert total == pytest.approx(left @ inverse @ left, rel=1e-6)
    moved[4] += [3.0, 0.0, 0.0]
    _, each = _contradictions(J, 0.01 * np.eye(18), moved)
    assert np.argmax(each) == 4


def test_after_a_reset_the_place_in_the_map_is_found_again():
    world = World(15)
    estimator = Estimator(world.settings())
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 1.0))
    estimator.reset()
    assert not estimator.is_localised
    add(estimator, world.drive(1.0, 2.0))
    assert np.linalg.norm(world.error(estimator, 1.9)[3:]) < 0.15


def test_where_a_run_began_in_its_own_frame_it_does_not_begin_again_in_a_loaded_map():
    world = World(15)
    estimator = Estimator(world.settings(), initial_pose=se3.exp(np.full(6, 0.5)))
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 1.0))
    assert estimator.is_localised
    estimator.handle_clock_jump()
    assert not estimator.is_localised
    add(estimator, world.drive(1.0, 2.0))
    assert np.linalg.norm(world.error(estimator, 1.9)[3:]) < 0.15
