"""Localisation in a known map: the pose in the map's frame, with an honest covariance."""

from __future__ import annotations

from dataclasses import replace
import logging
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.stats import chi2

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    FIRST_AUTOMATIC_ID,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.geometry.axes import PLANAR, SPATIAL
from slam_observer_ros.geometry.se3 import rigid_alignment
from slam_observer_ros.known_map import localiser
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.localiser import CONFIRMING_VOTES, is_lost, PoseTrial
from slam_observer_ros.known_map.map_alignment import _contradictions, find_transform
from slam_observer_ros.observer.gauge import anchor
from slam_observer_ros.observer.known_landmarks import KnownLandmarks
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.state.step import Outcome

POINT_NOISE_M = 0.05
MAP_NOISE_M = 0.03
BODY_VELOCITY = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.1])
PLANAR_VELOCITY = BODY_VELOCITY * [0, 0, 1, 1, 1, 0]
GAINS = ('constant', 'scheduled', 'riccati')
MODES = ('off', 'uncertain', 'fixed')


class World:
    """50 landmarks, a robot that starts anywhere, and a map with errors of 3 cm."""

    def __init__(self, seed=0, is_planar=False):
        self.random = np.random.default_rng(seed)
        self.flat = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
        self.points = self.random.uniform([-12, -12, -1], [12, 12, 4], (50, 3)) * self.flat
        self.velocity = PLANAR_VELOCITY if is_planar else BODY_VELOCITY
        start = self.random.normal(size=6) * [1, 1, 2, 3, 3, 1]
        self.start = se3.exp(start * [0, 0, 1, 1, 1, 0] if is_planar else start)
        self.is_planar = is_planar

    def settings(self, **changes):
        return Settings(
            two_d_mode=self.is_planar,
            observation_model='cartesian',
            point_noise=POINT_NOISE_M,
            reorder_window=0.0,
            **changes,
        )

    def map(self, ids=range(50), sigma_m=MAP_NOISE_M):
        ids = np.array(list(ids), dtype=np.int64)
        noise = self.random.normal(scale=sigma_m, size=(len(ids), 3)) if sigma_m else 0.0
        covariances = np.tile(sigma_m**2 * np.eye(3), (len(ids), 1, 1))
        points = self.points[ids] + noise * self.flat
        return LandmarkMap(ids, points, covariances, np.full(len(ids), 9))

    def pose(self, time_s):
        return self.start @ se3.exp(self.velocity * time_s)

    def near(self, time_s, count):
        distance = np.linalg.norm(self.points - self.pose(time_s)[:3, 3], axis=1)
        return np.sort(np.argsort(distance)[:count])

    def see(self, time_s, ids, pose=None):
        ids = np.array(ids, dtype=np.int64)
        pose = self.pose(time_s) if pose is None else pose
        noise = self.random.normal(scale=POINT_NOISE_M, size=(len(ids), 3))
        points = se3.transform(se3.inverse(pose), self.points[ids]) + noise * self.flat
        return ObservationEvent(round(time_s * 1e9), ids, points)

    def drive(self, first_s, last_s, count=6, offset=None):
        """Velocities and views of the nearest landmarks at 10 Hz, the robot moved by offset."""
        events = []
        for time_s in np.arange(first_s, last_s, 0.1):
            noise = self.random.normal(scale=0.02, size=6) * (self.velocity != 0.0)
            events.append(VelocityEvent(round(time_s * 1e9), self.velocity + noise))
            pose = self.pose(time_s) if offset is None else offset @ self.pose(time_s)
            events.append(self.see(time_s, self.near(time_s, count), pose))
        return events

    def error(self, estimator, time_s):
        """Rotation vector and position of the pose's error, along the map's axes."""
        true, pose = self.pose(time_s), estimator.pose
        turn = so3.log(pose[:3, :3] @ true[:3, :3].T)
        return np.concatenate([turn, pose[:3, 3] - true[:3, 3]])

    def nees(self, estimator, time_s):
        axes = [2, 3, 4] if self.is_planar else list(range(6))
        error = self.error(estimator, time_s)[axes]
        covariance = estimator.pose_covariance[np.ix_(axes, axes)]
        return error @ np.linalg.solve(covariance, error)


def add(estimator, events):
    for event in events:
        assert estimator.add(event)
    return estimator


@pytest.mark.parametrize(('is_planar', 'count'), [(False, 3), (False, 5), (True, 3), (True, 2)])
@pytest.mark.parametrize('mode', ['off', 'fixed'])
def test_after_one_view_of_known_landmarks_the_pose_is_right_within_its_covariance(
    is_planar, count, mode
):
    dof = 3 if is_planar else 6
    nees = []
    for seed in range(150):
        world = World(seed, is_planar)
        estimator = Estimator(world.settings(localization_mode=mode))
        estimator.load_map(world.map())
        ids = world.random.choice(world.near(0.0, 12), count, replace=False)
        add(estimator, [world.see(0.0, ids)])
        if estimator.is_localised:  # else they are almost in a line
            nees.append(world.nees(estimator, 0.0))
    assert len(nees) > 120
    assert np.mean(nees) / dof == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dof / len(nees)))
    within_three_sigma = np.array(nees) <= chi2.ppf(0.9973, dof)
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
    for seed in range(20):
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
    assert world.nees(estimator, 2.9) < chi2.ppf(0.9973, 6)


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
    assert world.nees(estimator, 0.0) < chi2.ppf(0.9973, 6)
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
def test_a_known_start_counts_with_its_covariance(mode):
    nees = []
    for seed in range(40):
        world = World(seed)
        estimator = Estimator(world.settings(localization_mode=mode))
        covariance = np.diag([0.02, 0.02, 0.05, 0.2, 0.2, 0.1]) ** 2
        error = world.random.normal(size=6) * np.sqrt(np.diag(covariance))
        start = se3.pose(so3.exp(error[:3]) @ world.start[:3, :3], world.start[:3, 3] + error[3:])
        estimator.load_map(world.map(), start, covariance)
        assert estimator.is_localised
        assert_allclose(estimator.pose, start, atol=1e-12)
        assert_allclose(estimator.pose_covariance, covariance, atol=1e-12)
        add(estimator, [world.see(0.0, world.near(0.0, 1))])
        nees.append(world.nees(estimator, 0.0))
    assert np.mean(nees) / 6 == pytest.approx(1.0, abs=0.4)


def test_a_pose_that_is_set_moves_the_robot_and_keeps_the_map():
    world = World(8)
    estimator = add(Estimator(world.settings()), world.drive(0.0, 3.0))
    points, covariances = estimator.world_points, estimator.landmark_covariances
    pose = se3.exp(np.array([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]))
    covariance = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    estimator.set_pose(pose, covariance)
    assert_allclose(estimator.pose, pose, atol=1e-12)
    # The delay of the velocity moves the pose by as little as rounding has left since then.
    assert_allclose(estimator.pose_covariance, covariance, atol=1e-10)
    assert_allclose(estimator.world_points, points, atol=1e-12)
    assert_allclose(estimator.landmark_covariances, covariances, atol=1e-12)


def votes(known, often):
    """A function that takes the vote of an observation on a pose in a map that was given."""
    trial, ids = PoseTrial(known), known.ids

    def is_contradicted(by_all, seen=ids):
        rejected = np.full(len(seen), by_all)
        outcome = Outcome(seen, np.zeros((len(seen), 3)), rejected, ids[:0])
        return trial.vote(outcome, often)

    return is_contradicted


@pytest.mark.parametrize('confirming', [CONFIRMING_VOTES - 1, CONFIRMING_VOTES])
def test_a_pose_that_was_given_is_on_trial_until_so_many_observations_confirm_it(confirming):
    is_contradicted = votes(World().map(range(4)), often=3)
    assert not any(is_contradicted(by_all=False) for _ in range(confirming))
    is_given_up = any(is_contradicted(by_all=True) for _ in range(2 * CONFIRMING_VOTES))
    assert is_given_up == (confirming < CONFIRMING_VOTES)


def test_what_sees_none_of_a_maps_landmarks_confirms_no_place_in_it():
    known = World().map(range(4))
    is_contradicted = votes(known, often=3)
    for seen in (known.ids[:0], known.ids + 100):
        assert not any(is_contradicted(by_all=False, seen=seen) for _ in range(CONFIRMING_VOTES))
    assert any(is_contradicted(by_all=True) for _ in range(3))


def test_a_place_that_as_many_observations_contradict_as_confirm_stays_on_trial():
    often = 2 * CONFIRMING_VOTES
    is_contradicted = votes(World().map(range(4)), often)
    assert not any(is_contradicted(by_all) for by_all in [True, False] * CONFIRMING_VOTES)
    assert any(is_contradicted(by_all=True) for _ in range(often))


def test_a_place_that_as_many_observations_confirm_as_contradict_is_kept():
    is_contradicted = votes(World().map(range(4)), often=3)
    assert not any(is_contradicted(by_all) for by_all in [False, True] * (CONFIRMING_VOTES - 1))
    assert is_contradicted(by_all=True)


class TestRightPoseThatIsTold:
    """Neither outliers nor moved landmarks nor one bad observation speak against it."""

    @staticmethod
    def placed(world, known, mode='off', **changes):
        estimator = Estimator(world.settings(localization_mode=mode, **changes))
        estimator.load_map(known, world.start, np.diag([0.05, 0.05, 0.1, 0.2, 0.2, 0.2]) ** 2)
        return estimator

    def test_outliers_of_landmarks_that_are_not_in_the_map(self):
        world = World(4)
        estimator = self.placed(world, world.map(range(40, 50)))
        for step in range(100):
            event = world.see(0.1 * step, range(6), pose=world.start)
            is_off = world.random.random((6, 1)) < 0.2
            away = world.random.normal(scale=5.0, size=(6, 3))
            estimator.add(VelocityEvent(event.stamp_ns, np.zeros(6)))
            estimator.add(replace(event, points=event.points + is_off * away))
        assert estimator.counts['rejected_landmark'] > 20
        assert estimator.counts['lost'] == 0

    @pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
    def test_one_of_three_landmarks_that_were_seen_often_has_moved(self, gains):
        world = World(4)
        known = replace(world.map(), counts=np.full(50, 500))
        estimator = self.placed(world, known, gains=gains)
        seen = world.near(0.0, 3)
        world.points[seen[0]] += [0.0, 3.0, 0.0]
        for step in range(30):
            estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
            estimator.add(world.see(0.1 * step, seen, pose=world.start))
        assert estimator.counts['moved_landmark'] == 1
        assert estimator.counts['lost'] == 0

    @pytest.mark.parametrize('mode', MODES)
    def test_the_first_observation_is_garbled(self, mode):
        world = World(4)
        estimator = self.placed(world, world.map(), mode)
        garbled = world.see(0.0, world.near(0.0, 6))
        estimator.add(replace(garbled, points=garbled.points[::-1] * 2.0))
        add(estimator, world.drive(0.1, 3.0, count=2))
        assert estimator.counts['lost'] == 0
        assert np.linalg.norm(world.error(estimator, 2.9)[3:]) < 0.3


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
def test_a_pose_that_is_set_wrong_by_mistake_does_the_map_no_harm(gains, mode):
    world = World(8)
    estimator = Estimator(world.settings(gains=gains, localization_mode=mode))
    known = world.map()
    estimator.load_map(known)
    add(estimator, world.drive(0.0, 3.0))
    estimator.set_pose(
        world.pose(2.9) @ se3.exp(np.array([0.0, 0.0, 0.8, 6.0, 2.0, 0.0])),
        np.diag([0.26, 0.26, 0.26, 0.5, 0.5, 0.5]) ** 2,
    )
    add(estimator, world.drive(3.0, 6.0))
    assert estimator.counts['lost'] + estimator.counts['slip'] >= 1
    assert np.linalg.norm(world.error(estimator, 5.9)[3:]) < 0.15
    rows = [list(estimator.landmark_ids).index(i) for i in known.ids]
    assert_allclose(estimator.world_points[rows], known.world_points, atol=0.3)


@pytest.mark.parametrize('is_given', [False, True])
def test_once_the_robot_is_placed_no_other_state_is_followed(is_given):
    world = World(3)
    estimator = add(Estimator(world.settings()), [world.see(0.0, world.near(0.0, 8))])
    hypotheses = estimator._hypotheses
    hypotheses._all.append(hypotheses._all[0].copy())
    if is_given:
        estimator.set_pose(world.start)
    else:
        estimator.load_map(world.map())
        assert estimator.is_localised
    assert len(estimator._hypotheses) == 1


def test_a_robot_set_down_elsewhere_finds_back_once_its_pose_is_set():
    world = World(9)
    estimator = add(Estimator(world.settings(), world.start), world.drive(0.0, 4.0))
    offset = se3.exp(np.array([0.0, 0.0, 0.5, 2.0, -1.0, 0.0]))
    wrong = se3.exp(np.array([0.0, 0.0, 0.02, 0.1, 0.1, 0.0]))
    estimator.set_pose(wrong @ offset @ world.pose(4.0), np.diag([0.03, 0.03, 0.1, 0.2, 0.2, 0.1]))
    add(estimator, world.drive(4.1, 8.0, offset=offset))
    error = se3.log(estimator.pose @ se3.inverse(offset @ world.pose(7.9)))
    assert np.linalg.norm(error) < 0.2
    assert estimator.counts['moved_landmark'] == 0


@pytest.mark.parametrize('gains', GAINS)
def test_a_map_loaded_while_running_is_merged_with_what_was_mapped(gains):
    world = World(10)
    settings = world.settings(gains=gains, relinearization_interval=10, relinearization_angle=0.0)
    estimator = add(Estimator(settings), world.drive(0.0, 5.0))
    mapped = set(estimator.landmark_ids)
    known = world.map(range(0, 50, 2))
    estimator.load_map(known)
    assert estimator.is_localised
    assert set(estimator.landmark_ids) == mapped | set(known.ids)
    assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.15
    add(estimator, world.drive(5.0, 10.0))
    assert np.linalg.norm(world.error(estimator, 9.9)[3:]) < 0.1
    errors = estimator.world_points - world.points[estimator.landmark_ids]
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.15


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('gains', GAINS)
def test_a_map_may_take_the_place_of_another_one(gains, mode):
    world = World()
    estimator = Estimator(world.settings(gains=gains, localization_mode=mode))
    estimator.load_map(world.map(range(25)))
    add(estimator, world.drive(0.0, 3.0, count=12))
    assert estimator.is_localised
    estimator.load_map(world.map(range(20, 50), sigma_m=0.0))
    add(estimator, world.drive(3.0, 6.0, count=12))
    assert estimator.is_localised
    assert np.linalg.norm(world.error(estimator, 5.9)[3:]) < 0.3


@pytest.mark.parametrize('gains', GAINS)
def test_a_map_larger_than_is_to_be_kept_gives_way_to_what_is_seen(gains):
    world = World()
    estimator = Estimator(world.settings(gains=gains, max_landmarks=5))
    estimator.load_map(world.map(range(12)), world.pose(1.0))
    add(estimator, [world.see(1.0, range(2, 13))])
    assert estimator.counts['unmapped_landmark'] == 1
    assert estimator.counts['forgotten_landmark'] == 2
    assert_array_equal(estimator.landmark_ids, range(2, 12))


def test_counts_of_both_maps_add_up():
    world = World(11)
    estimator = Estimator(world.settings())
    estimator.load_map(world.map())
    seen = world.near(0.0, 5)
    add(estimator, [world.see(0.0, seen), world.see(0.1, seen)])
    counts = dict(zip(estimator.landmark_ids, estimator.landmark_counts, strict=True))
    assert {counts[i] for i in seen} == {11}
    assert {counts[i] for i in counts if i not in seen} == {9}


def test_what_is_saved_can_be_loaded_and_gives_the_same_frame():
    world = World(12)
    first = add(Estimator(world.settings(), world.start), world.drive(0.0, 10.0))
    second = Estimator(world.settings(localization_mode='uncertain'))
    second.load_map(first.landmark_map)
    add(second, world.drive(30.0, 31.0))
    assert np.linalg.norm(world.error(second, 30.9)[3:]) < 0.15


@pytest.mark.parametrize('is_planar', [False, True])
def test_in_a_map_that_an_earlier_run_has_saved_the_pose_is_honest(is_planar):
    dof = 3 if is_planar else 6
    nees = []
    for seed in range(25):
        world = World(seed, is_planar)
        settings = world.settings(
            angular_velocity_noise=(0.02 * 0.1**0.5,) * 3,
            linear_velocity_noise=(0.02 * 0.1**0.5,) * 3,
            huber_threshold=0.0,
        )
        first = add(Estimator(settings, world.start), world.drive(0.0, 6.0, count=5))
        saved = first.landmark_map
        second = Estimator(world.settings(localization_mode='uncertain'))
        second.load_map(saved)
        add(second, [world.see(3.0, world.random.choice(saved.ids, 4, replace=False))])
        if second.is_localised:
            weights = 1.0 / np.trace(saved.covariances, axis1=1, axis2=2)
            frame = rigid_alignment(world.points[saved.ids], saved.world_points, weights)
            world.start = frame @ world.start  # the map's frame is what its landmarks say
            nees.append(world.nees(second, 3.0))
    assert len(nees) > 20
    assert 0.6 < np.mean(nees) / dof < 1.6
    assert np.mean(np.array(nees) <= chi2.ppf(0.9973, dof)) > 0.9


def test_how_the_map_lies_to_the_start_is_no_error_of_the_map():
    world = World(17)
    estimator = Estimator(world.settings())
    estimator.set_pose(world.start, np.diag([0.5, 0.5, 0.5, 1.0, 1.0, 1.0]) ** 2)
    add(estimator, world.drive(0.0, 3.0, count=8))
    in_start_frame = np.trace(estimator.landmark_covariances, axis1=1, axis2=2)
    in_own_frame = np.trace(estimator.landmark_map.covariances, axis1=1, axis2=2)
    assert np.sqrt(in_start_frame.min()) > 1.0
    assert np.sqrt(np.median(in_own_frame)) < 0.1


def test_in_the_frame_of_a_loaded_map_how_it_lies_to_that_is_an_error_of_the_map():
    world = World(4)
    estimator = Estimator(world.settings(localization_mode='uncertain'))
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 1.0))
    assert estimator.is_localised
    saved, present = estimator.landmark_map.covariances, estimator.landmark_covariances
    assert_allclose(saved, present, rtol=1e-6, atol=1e-12)


def test_before_the_place_in_a_map_is_found_a_map_is_saved_as_if_there_was_none():
    world, saved = World(17), []
    known, events = world.map().select(np.arange(3)), world.drive(0.0, 3.0, count=8)
    for has_map in (False, True):
        estimator = Estimator(world.settings())
        if has_map:
            estimator.load_map(replace(known, ids=known.ids + 500))
        add(estimator, events)
        saved.append(estimator.landmark_map)
    assert not estimator.is_localised
    assert len(saved[0].covariances) > 3
    assert_array_equal(saved[0].covariances, saved[1].covariances)


def test_a_fixed_map_is_saved_as_it_was_loaded():
    world = World(13)
    known = world.map()
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(known)
    add(estimator, world.drive(0.0, 5.0))
    saved = estimator.landmark_map
    order = np.argsort(saved.ids)
    assert_array_equal(saved.ids[order], known.ids)
    assert_allclose(saved.world_points[order], known.world_points, atol=1e-9)
    assert_allclose(saved.covariances[order], known.covariances, atol=1e-12)


def test_a_landmark_of_a_fixed_map_that_is_forgotten_leaves_the_others_as_they_were():
    world = World(3)
    known = world.map()
    growing = replace(known, covariances=known.covariances * np.arange(1, 51)[:, None, None])
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(growing, world.start)
    assert estimator.forget(7)
    kept = np.array([i for i in range(50) if i != 7])
    assert estimator.landmark_ids.tolist() == kept.tolist()
    assert_allclose(estimator.world_points, known.world_points[kept], atol=1e-9)
    assert_allclose(estimator.landmark_covariances, growing.covariances[kept], atol=1e-12)
    assert_allclose(estimator.landmark_map.covariances, growing.covariances[kept], atol=1e-12)


def test_a_fixed_map_may_be_large():
    world = World(18)
    random = np.random.default_rng(0)
    world.points = random.uniform([-200, -200, -1], [200, 200, 4], (20_000, 3))
    estimator = Estimator(world.settings(localization_mode='fixed'))
    estimator.load_map(world.map(range(20_000)))
    add(estimator, world.drive(0.0, 2.0))
    assert np.linalg.norm(world.error(estimator, 1.9)[3:]) < 0.1
    assert len(estimator.landmark_ids) == 20_000


@pytest.mark.parametrize('mode', MODES)
@pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
def test_a_landmark_that_moves_is_placed_again_only_where_mapping_goes_on(gains, mode):
    world = World(3)
    known = world.map()
    estimator = Estimator(world.settings(gains=gains, localization_mode=mode))
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


def test_the_landmarks_by_which_the_place_was_found_are_in_the_map():
    landmarks = np.array([[5, 0, 0], [5, 3, 1], [5, -3, 0.5], [4, 1, 2], [3, 3, -1]])
    estimator = Estimator(Settings(reorder_window=0.0))
    estimator.load_map(LandmarkMap(np.arange(5), landmarks, None, np.zeros(5, dtype=np.int64)))
    estimator.add(ObservationEvent(0, np.arange(3), landmarks[:3]))
    assert estimator.is_localised
    assert_array_equal(np.sort(estimator.landmark_ids), np.arange(5))


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
    """What is left is that of the best fitting motion, by generalised least squares."""
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


def test_a_pose_that_is_set_stays_in_the_plane():
    estimator = Estimator(Settings(two_d_mode=True, reorder_window=0.0))
    estimator.add(ObservationEvent(0, np.arange(2), np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])))
    estimator.set_pose(se3.exp(np.array([0.1, -0.2, 0.7, 1.0, 2.0, 3.0])))
    assert_array_equal(estimator.pose[2], [0.0, 0.0, 1.0, 0.0])
    assert_array_equal(estimator.pose[:2, 2], 0.0)


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


def test_far_from_the_origin_as_in_a_national_grid_nothing_is_lost_to_rounding():
    world = World(16)
    grid = np.array([500_000.0, 5_000_000.0, 300.0])
    world.points += grid
    world.start = se3.pose(world.start[:3, :3], world.start[:3, 3] + grid)
    estimator = Estimator(world.settings())
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 5.0))
    assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.1


@pytest.mark.parametrize('seed', [0, 1, 11, 12, 15])
def test_a_map_can_be_saved_where_some_landmarks_are_exact_and_others_hardly_known(seed):
    """Their variances differ by more than double precision can hold in one matrix."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(Settings(reorder_window=0.0, confirmations=1, unknown_linear_motion=1e3))
    points = rng.uniform(-50.0, 50.0, (8, 3))
    for step in range(12):
        seen = np.sort(rng.choice(8, 4, replace=False))
        sigmas_m = 10.0 ** rng.uniform(-6.0, 3.0, 4)
        covariances = sigmas_m[:, None, None] ** 2 * np.eye(3)
        estimator.add(ObservationEvent((step + 1) * 3 * 10**9, seen, points[seen], covariances))
        variances = np.linalg.eigvalsh(estimator.landmark_map.covariances)
        assert (variances >= -1e-9 * variances.max()).all()


class TestInitialPoseOfTheSettings:
    """``set_initial_pose``: where the robot's dock is, roughly."""

    @staticmethod
    def docked(world, offset_m=0.3, **changes):
        x, y, _ = world.start[:3, 3]
        yaw = float(np.arctan2(world.start[1, 0], world.start[0, 0]))
        return world.settings(
            set_initial_pose=True,
            initial_position=(x + offset_m, y - offset_m, 0.0),
            initial_yaw=yaw + 0.1,
            **changes,
        )

    @pytest.mark.parametrize('mode', MODES)
    def test_landmarks_without_ids_will_do_then(self, mode):
        world = World(3, is_planar=True)
        estimator = Estimator(self.docked(world, localization_mode=mode))
        estimator.load_map(world.map())
        assert estimator.is_localised
        std = np.sqrt(np.diag(estimator.pose_covariance))
        assert_allclose(std, [0.0, 0.0, 0.26, 0.5, 0.5, 0.0], atol=1e-9)
        for event in world.drive(0.0, 5.0):
            is_seen = isinstance(event, ObservationEvent)
            estimator.add(replace(event, ids=np.full(6, UNKNOWN_ID)) if is_seen else event)
        assert world.nees(estimator, 4.9) < chi2.ppf(0.9973, 3)
        assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.1

    def test_without_a_map_it_is_exact(self):
        world = World(3, is_planar=True)
        settings = self.docked(world)
        estimator = add(Estimator(settings), [world.see(0.0, range(6))])
        assert_array_equal(estimator.pose[:3, 3], settings.initial_position)
        assert_array_equal(estimator.pose_covariance, 0.0)

    def test_each_run_starts_there(self):
        world = World(3, is_planar=True)
        estimator = Estimator(self.docked(world, offset_m=0.0))
        estimator.load_map(world.map())
        start = estimator.pose
        add(estimator, world.drive(0.0, 3.0))
        assert not np.allclose(estimator.pose, start, atol=0.5)
        estimator.handle_clock_jump()  # as a recording that is looped
        assert_array_equal(estimator.pose, start)
        assert estimator.is_localised

    def test_who_is_lost_looks_elsewhere_too(self):
        world = World(14, is_planar=True)
        estimator = Estimator(self.docked(world, localization_mode='fixed'))
        estimator.load_map(world.map())
        offset = se3.exp(np.array([0.0, 0.0, 1.5, 3.0, -4.0, 0.0]))
        add(estimator, world.drive(0.0, 5.0) + world.drive(5.0, 6.0, offset=offset))
        assert estimator.counts['lost'] + estimator.counts['slip'] >= 1
        error = se3.log(estimator.pose @ se3.inverse(offset @ world.pose(5.9)))
        assert np.linalg.norm(error) < 0.1

    @pytest.mark.parametrize('mode', MODES)
    @pytest.mark.parametrize('gains', ['scheduled', 'riccati'])
    @pytest.mark.parametrize('offset_m', [4.0, 8.0])
    def test_a_wrong_one_is_noticed_and_does_no_harm(self, gains, mode, offset_m, caplog):
        for seed in range(5):
            world = World(seed, is_planar=True)
            settings = self.docked(world, offset_m, gains=gains, localization_mode=mode)
            estimator = Estimator(replace(settings, initial_yaw=settings.initial_yaw + 1.0))
            known = world.map()
            estimator.load_map(known)
            add(estimator, world.drive(0.0, 5.0))
            assert estimator.is_localised
            assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.3
            rows = [list(estimator.landmark_ids).index(i) for i in known.ids]
            assert_allclose(estimator.world_points[rows], known.world_points, atol=0.3)
        noticed = 'the pose that was given; localising again', 'the robot slipped or was carried'
        assert any(text in caplog.text for text in noticed)

    @pytest.mark.parametrize('mode', MODES)
    @pytest.mark.parametrize('is_start', [False, True])
    def test_a_pose_given_since_is_not_taken_back_by_loading_a_map(self, is_start, mode):
        world = World(3, is_planar=True)
        pose = se3.exp(np.array([0.0, 0.0, 1.0, 5.0, -1.0, 0.0]))
        settings = self.docked(world, localization_mode=mode)
        estimator = Estimator(settings, initial_pose=pose if is_start else None)
        if not is_start:
            estimator.set_pose(pose)
        estimator.load_map(world.map())
        assert not estimator.is_localised

    @pytest.mark.parametrize('mode', MODES)
    def test_after_a_reset_a_map_finds_the_robot_there(self, mode):
        world = World(3, is_planar=True)
        estimator = Estimator(self.docked(world, localization_mode=mode))
        add(estimator, world.drive(0.0, 1.0))
        estimator.reset()
        estimator.load_map(world.map())
        assert estimator.is_localised
        add(estimator, [AngularVelocityEvent(0, np.zeros(3))])
        estimator.load_map(world.map())
        assert estimator.is_localised

    @pytest.mark.parametrize('mode', MODES)
    @pytest.mark.parametrize('has_jumped', [False, True])
    def test_in_a_map_loaded_on_the_way_the_place_is_searched(self, has_jumped, mode):
        world = World(3, is_planar=True)
        settings = self.docked(world, 5.0, localization_mode=mode, on_time_jump='hold')
        estimator = add(Estimator(settings), world.drive(0.0, 3.0))
        if has_jumped:
            estimator.handle_clock_jump()
        estimator.load_map(world.map())
        assert np.linalg.norm(world.error(estimator, 2.9)[3:]) < 0.1
        add(estimator, world.drive(3.0, 4.0))
        assert estimator.is_localised
        assert np.linalg.norm(world.error(estimator, 3.9)[3:]) < 0.1

    @pytest.mark.parametrize(
        'given',
        [
            {'initial_yaw': 0.5},
            {'initial_position': (1.0, 0.0, 0.0)},
            {'initial_position': (0.0, 0.0, -1.0)},
        ],
    )
    def test_one_that_is_not_asked_for_is_given_to_have_no_effect(self, given, caplog):
        assert_array_equal(Estimator(Settings(**given)).pose, np.eye(4))
        assert 'use set_initial_pose: true' in caplog.text


@pytest.mark.parametrize(
    ('gains', 'velocity_error'), [*((gains, 0.0) for gains in GAINS), ('riccati', 0.5)]
)
def test_landmarks_of_an_exact_map_stay_where_it_has_them(gains, velocity_error):
    """Whatever they seemed to do before, and whatever velocity a sensor claims."""
    points = np.array([[5.0, 0, 0], [0, 5, 0], [0, 0, 5], [-5, 0, 1], [3, 3, 3]])
    place, random = se3.exp(np.array([0.0, 0.0, 1.0, 3.0, 2.0, 1.0])), np.random.default_rng(0)
    known = LandmarkMap(np.arange(5), se3.transform(place, points), None, np.full(5, 10))
    settings = Settings(gains=gains, localization_mode='fixed', reorder_window=0.0)
    estimator = Estimator(replace(settings, landmark_velocity_stddev=velocity_error))
    estimator.load_map(known)
    for step in range(100):
        stamp_ns = 10**9 + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        m = 2 if step < 5 else 4
        seen = points[:m] + random.normal(scale=0.02, size=(m, 3))
        speed = np.tile([0.5, 0.0, 0.0], (m, 1)) if step == 50 else None
        if step < 60:
            estimator.add(ObservationEvent(stamp_ns, np.arange(m), seen, None, speed))
    assert estimator.is_localised
    assert_allclose(estimator.world_points, known.world_points, atol=1e-12)
    assert_array_equal(estimator.landmark_velocities, 0.0)
    assert_allclose(estimator.pose, place, atol=0.1)


@pytest.mark.parametrize('mode', ['off', 'uncertain'])
@pytest.mark.parametrize('gains', GAINS)
def test_landmarks_mapped_before_an_exact_map_was_loaded_are_where_it_has_them(gains, mode):
    """Within what the map's own noise, a millimetre at least, allows."""
    world = World(10)
    settings = world.settings(gains=gains, localization_mode=mode, map_noise=1e-3)
    estimator = add(Estimator(settings), world.drive(0.0, 5.0))
    mapped = estimator.landmark_ids
    estimator.load_map(world.map(sigma_m=0.0))
    assert estimator.is_localised
    rows = [list(estimator.landmark_ids).index(i) for i in mapped]
    assert_allclose(estimator.world_points[rows], world.points[mapped], atol=5e-3)


def test_an_exact_estimate_can_be_brought_into_an_exact_map():
    """Nothing is uncertain then but where the one lies in the other."""
    points = np.random.default_rng(0).normal(size=(4, 3))
    G = np.vstack([np.eye(6), SPATIAL.output_matrix(points).reshape(-1, 6)])
    gamma = np.array([0.01, 0.02, -0.03, 1.0, 2.0, 3.0])
    rows, known = np.arange(6, 18), (np.zeros((18, 12)), np.zeros((12, 12)))
    x, P = anchor(np.zeros((18, 18)), G, *known, G[rows], G[rows] @ gamma)
    assert_allclose(x, G @ gamma, atol=1e-9)
    assert_allclose(P, 0.0, atol=1e-9)


@pytest.mark.parametrize('gains', GAINS)
def test_a_saved_map_leaves_out_what_moves_and_keeps_what_rests(gains):
    """A sensor that measures velocities has noise in those of landmarks at rest, too."""
    random = np.random.default_rng(0)
    points, speed = 5.0 * np.eye(4, 3) + [[1.0, 1.0, 0.0]], np.zeros((4, 3))
    speed[2, 0] = 0.5
    estimator = Estimator(Settings(gains=gains, reorder_window=0.0))
    for step in range(20):
        stamp_ns = 10**9 + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        seen = points + 0.1 * step * speed
        measured = speed + random.normal(scale=0.01, size=speed.shape)
        estimator.add(ObservationEvent(stamp_ns, np.arange(4), seen, None, measured))
    assert estimator.landmark_ids.tolist() == [0, 1, 2, 3]
    assert estimator.landmark_map.ids.tolist() == [0, 1, 3]


def test_a_saved_map_leaves_out_what_is_estimated_to_move():
    points, speed = 5.0 * np.eye(4, 3) + [[1.0, 1.0, 0.0]], np.zeros((4, 3))
    speed[2, 0] = 0.5
    estimator = Estimator(Settings(landmark_velocity_stddev=0.5, reorder_window=0.0))
    for step in range(100):
        stamp_ns = 10**9 + step * 10**8
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, np.arange(4), points + 0.1 * step * speed))
    assert estimator.landmark_map.ids.tolist() == [0, 1, 3]


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_map_made_in_the_plane_says_so_in_space(two_d_mode, caplog):
    points = np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [4.0, 4.0, 0.0]])
    planar = np.diag([0.01, 0.01, 0.0])
    known = LandmarkMap(np.arange(3), points, np.tile(planar, (3, 1, 1)), np.full(3, 9))
    Estimator(Settings(two_d_mode=two_d_mode)).load_map(known)
    assert ('two_d_mode, which is off' in caplog.text) == (not two_d_mode)


def without_ids(event):
    if isinstance(event, ObservationEvent):
        return replace(event, ids=np.full(len(event.ids), UNKNOWN_ID))
    return event


class TestWithoutIds:
    """Points without ids, in a map of landmarks with ids or without."""

    @pytest.mark.parametrize('mode', MODES)
    @pytest.mark.parametrize('is_planar', [False, True])
    def test_a_robot_is_found_wherever_it_starts_and_is_as_sure_as_it_may_be(
        self, mode, is_planar
    ):
        nees = []
        for seed in range(4):
            world = World(seed, is_planar)
            known = world.map()
            if seed % 2:  # one that was mapped without ids
                known = replace(known, ids=known.ids + FIRST_AUTOMATIC_ID)
            estimator = Estimator(world.settings(localization_mode=mode))
            estimator.load_map(known)
            for event in world.drive(0.0, 3.0, count=8):
                estimator.add(without_ids(event))
            assert estimator.is_localised
            assert set(known.ids) <= set(estimator.landmark_ids)
            nees.append(world.nees(estimator, 2.9))
        assert np.mean(nees) / (3 if is_planar else 6) < 3.0

    def test_it_is_said_by_how_many_landmarks_and_how_sure(self, caplog):
        world = World(0, is_planar=True)
        estimator = Estimator(world.settings(localization_mode='uncertain'))
        estimator.load_map(world.map())
        with caplog.at_level(logging.INFO):
            for event in world.drive(0.0, 1.0, count=8):
                estimator.add(without_ids(event))
        assert 'Found the pose in the map by 8 of 8 landmarks (wrong with a prob' in caplog.text

    def test_two_places_that_fit_are_named_and_a_rough_pose_decides(self, caplog):
        world = World(0, is_planar=True)
        world.points[25:] = -world.points[:25]
        estimator = Estimator(world.settings(localization_mode='uncertain'))
        estimator.load_map(world.map(sigma_m=0.001))
        events = [without_ids(event) for event in world.drive(0.0, 3.0, count=8)]
        add(estimator, events)
        assert not estimator.is_localised
        assert len(estimator.possible_poses) == 2
        assert 'fits 2 places in the map, (' in estimator.localisation_problem.what
        assert caplog.text.count('hat was seen fits 2 places') == 1
        assert str(estimator.localisation_problem)[-50:] in caplog.text
        # Within 3 m and 40 degrees.
        rough = np.diag([0.0, 0.0, 0.7, 3.0, 3.0, 0.0]) ** 2
        estimator.reset()
        estimator.set_pose(world.start @ se3.exp(np.array([0, 0, 0.4, 1.0, 2.0, 0])), rough)
        add(estimator, events)
        assert estimator.is_localised
        assert np.linalg.norm(world.error(estimator, 2.9)) < 0.2

    def test_a_start_may_be_known_but_for_the_heading(self):
        world = World(0, is_planar=True)
        given = {'set_initial_pose': True, 'initial_position': tuple(world.start[:3, 3])}
        deviations = {'initial_position_stddev': 0.0, 'initial_angle_stddev': 2.0}
        estimator = Estimator(world.settings(**given, **deviations))
        estimator.load_map(world.map())
        add(estimator, [without_ids(event) for event in world.drive(0.0, 3.0, count=8)])
        assert estimator.is_localised
        assert np.linalg.norm(world.error(estimator, 2.9)) < 0.3

    def test_some_ids_among_others_and_a_wrong_one_do_not_hide_the_place(self):
        world = World(1, is_planar=True)
        estimator = Estimator(world.settings(localization_mode='off'))
        estimator.load_map(world.map())
        ids = np.full(50, UNKNOWN_ID)
        ids[world.near(0.0, 3)[:2]] = world.near(0.0, 3)[0], 49 - world.near(0.0, 3)[1]
        for event in world.drive(0.0, 3.0, count=8):
            if isinstance(event, ObservationEvent):
                event = replace(event, ids=ids[event.ids])
            estimator.add(event)
        assert estimator.is_localised
        assert np.linalg.norm(world.error(estimator, 2.9)) < 0.3
        assert len(np.unique(estimator.landmark_ids)) == len(estimator.landmark_ids)

    @pytest.mark.parametrize('mode', MODES)
    def test_a_carried_robot_is_noticed_and_found_again(self, mode, caplog):
        world = World(2, is_planar=True)
        estimator = Estimator(world.settings(localization_mode=mode))
        estimator.load_map(world.map(), world.start, np.diag([1e-4] * 6))
        add(estimator, [without_ids(event) for event in world.drive(0.0, 5.0)])
        assert estimator.counts['lost'] == 0
        world.start = se3.exp(np.array([0, 0, 1.5, 4.0, -5.0, 0])) @ world.start
        add(estimator, [without_ids(event) for event in world.drive(5.0, 12.0, count=8)])
        assert estimator.counts['lost'] >= 1
        assert estimator.is_localised
        assert np.linalg.norm(world.error(estimator, 11.9)) < 0.3

    @pytest.mark.parametrize('mode', MODES)
    def test_false_points_do_not_make_a_robot_lost(self, mode):
        world = World(3, is_planar=True)
        estimator = Estimator(world.settings(localization_mode=mode))
        estimator.load_map(world.map(), world.start, np.diag([1e-4] * 6))
        for event in world.drive(0.0, 30.0):
            event = without_ids(event)
            if isinstance(event, ObservationEvent):
                is_false = world.random.random(len(event.ids)) < 0.1
                shifts = world.random.uniform(-4, 4, event.points.shape) * [1, 1, 0]
                event = replace(event, points=event.points + is_false[:, None] * shifts)
            estimator.add(event)
        assert estimator.counts['lost'] == 0

    def test_a_robot_that_leaves_a_map_which_grows_is_not_lost(self):
        world = World(4, is_planar=True)
        settings = world.settings(localization_mode='off')
        estimator = Estimator(settings)
        near = np.flatnonzero(np.linalg.norm(world.points - world.start[:3, 3], axis=1) < 8.0)
        estimator.load_map(world.map(near), world.start, np.diag([1e-4] * 6))
        add(estimator, [without_ids(event) for event in world.drive(0.0, 30.0)])
        assert len(estimator.landmark_ids) > len(near)
        assert estimator.counts['lost'] == 0
        assert np.linalg.norm(world.error(estimator, 29.9)) < 0.3


class TestSeveralMaps:
    """Which of these halls is it? Each map is in coordinates of its own."""

    @staticmethod
    def halls(is_planar=True, ids=lambda hall: 0):
        """Three worlds, and their maps; ``ids`` are added to those of each."""
        worlds = [World(seed, is_planar) for seed in (20, 21, 22)]
        maps = [
            replace(world.map(sigma_m=0.01), ids=np.arange(50) + ids(i), name=f'hall_{i}')
            for i, world in enumerate(worlds)
        ]
        return worlds, maps

    @pytest.mark.parametrize('mode', MODES)
    @pytest.mark.parametrize('is_planar', [False, True])
    def test_the_robot_is_found_in_that_where_it_is(self, mode, is_planar, caplog):
        worlds, maps = self.halls(is_planar)
        for i, world in enumerate(worlds):
            estimator = Estimator(world.settings(localization_mode=mode))
            estimator.load_map(maps)
            with caplog.at_level(logging.INFO):
                for event in world.drive(0.0, 3.0, count=8):
                    estimator.add(without_ids(event))
            assert estimator.is_localised
            assert estimator.map_name == f'hall_{i}'
            assert np.linalg.norm(world.error(estimator, 2.9)) < 0.3
            assert f'Found the pose in the map hall_{i} by' in caplog.text

    @pytest.mark.parametrize('step', [0, 100])
    def test_ids_are_used_whether_or_not_halls_have_the_same_ones(self, step):
        worlds, maps = self.halls(ids=lambda hall: step * hall)
        world = worlds[1]
        estimator = Estimator(world.settings())
        estimator.load_map(maps)
        assert not estimator.is_localised
        for event in world.drive(0.0, 3.0, count=4):
            if isinstance(event, ObservationEvent):
                event = replace(event, ids=event.ids + step)
            estimator.add(event)
        assert estimator.map_name == 'hall_1'
        assert np.linalg.norm(world.error(estimator, 2.9)) < 0.2

    def test_halls_that_look_the_same_are_named_and_a_rough_pose_does_not_decide(self):
        worlds, maps = self.halls()
        alike = [maps[0], replace(maps[0], name='its_twin'), maps[1]]
        estimator = Estimator(worlds[0].settings())
        estimator.load_map(alike)
        add(estimator, [without_ids(event) for event in worlds[0].drive(0.0, 2.0, count=8)])
        assert not estimator.is_localised
        problem = estimator.localisation_problem.what
        for text in ('2 places in the 3 maps', 'rad) in hall_0 and (', 'rad) in its_twin'):
            assert text in problem
        assert len(estimator.possible_poses) == 2

    def test_a_pose_that_is_given_says_where_in_each_to_look(self):
        """In halls that are surveyed in one frame it says which one it is."""
        worlds, (known, *_) = self.halls()
        east = np.array([100.0, 0.0, 0.0])
        beside = replace(known, world_points=known.world_points + east, name='east')
        estimator = Estimator(worlds[0].settings())
        estimator.load_map([known, beside])
        there = worlds[0].start.copy()
        there[:3, 3] += east + [0.4, -0.3, 0.0]
        estimator.set_pose(there)
        assert not estimator.is_localised
        add(estimator, [without_ids(event) for event in worlds[0].drive(0.0, 2.0, count=8)])
        assert estimator.map_name == 'east'
        assert abs(estimator.pose[0, 3] - worlds[0].pose(1.9)[0, 3] - 100.0) < 0.1

    def test_a_robot_carried_from_one_hall_to_another_is_found_there(self):
        worlds, maps = self.halls()
        estimator = Estimator(worlds[0].settings(localization_mode='uncertain'))
        estimator.load_map(maps)
        add(estimator, [without_ids(event) for event in worlds[0].drive(0.0, 5.0, count=8)])
        assert estimator.map_name == 'hall_0'
        add(estimator, [without_ids(event) for event in worlds[2].drive(5.0, 12.0, count=8)])
        assert estimator.counts['lost'] >= 1
        assert estimator.map_name == 'hall_2'
        assert np.linalg.norm(worlds[2].error(estimator, 11.9)) < 0.3

    def test_what_can_not_be_several_maps_is_refused(self):
        _, maps = self.halls()
        estimator = Estimator(Settings())
        nothing = maps[0].select(np.zeros(0, dtype=np.int64))
        for wrong, why in (
            ([maps[0], replace(maps[1], frame_id='other')], "in frames 'map' and 'other'"),
            ([], 'there is none'),
            ([maps[0], nothing], 'is empty'),
        ):
            with pytest.raises(MapError, match=why):
                estimator.load_map(wrong)
        assert estimator.is_localised
