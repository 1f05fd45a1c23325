"""A pose that is given, set or stated in settings: on trial in a map, and a wrong one noticed."""

from __future__ import annotations

from dataclasses import replace

from mapped_worlds import add, MODES, World
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.special import chdtri

from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AngularVelocityEvent,
    ObservationEvent,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.localiser import CONFIRMING_VOTES, PoseTrial
from slam_observer_ros.settings.estimator_settings import Settings


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
        update = Update(0, np.eye(4), seen, np.zeros((len(seen), 3)), rejected, 0.0, ids[:0])
        return trial.vote(update, often)

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

    def test_one_of_three_landmarks_that_were_seen_often_has_moved(self):
        world = World(4)
        known = replace(world.map(), counts=np.full(50, 500))
        estimator = self.placed(world, known)
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
def test_a_pose_that_is_set_wrong_by_mistake_does_the_map_no_harm(mode):
    world = World(8)
    estimator = Estimator(world.settings(localization_mode=mode))
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


def test_a_pose_that_is_set_stays_in_the_plane():
    estimator = Estimator(Settings(two_d_mode=True, reorder_window=0.0))
    estimator.add(ObservationEvent(0, np.arange(2), np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])))
    estimator.set_pose(se3.exp(np.array([0.1, -0.2, 0.7, 1.0, 2.0, 3.0])))
    assert_array_equal(estimator.pose[2], [0.0, 0.0, 1.0, 0.0])
    assert_array_equal(estimator.pose[:2, 2], 0.0)


class TestInitialPoseOfTheSettings:
    """``set_initial_pose``: where the robot's dock is, roughly."""

    @staticmethod
    def docked(world, offset_m=0.3, **changes):
        x, y, _ = world.start[:3, 3]
        yaw = float(np.arctan2(world.start[1, 0], world.start[0, 0]))
        return world.settings(
            set_initial_pose=True,
            initial_pose=(x + offset_m, y - offset_m, 0.0, 0.0, 0.0, yaw + 0.1),
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
        assert world.nees(estimator, 4.9) < chdtri(3, 0.0027)
        assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.1

    def test_without_a_map_it_is_exact(self):
        world = World(3, is_planar=True)
        settings = self.docked(world)
        estimator = add(Estimator(settings), [world.see(0.0, range(6))])
        assert_array_equal(estimator.pose[:3, 3], settings.initial_pose[:3])
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
    @pytest.mark.parametrize('offset_m', [4.0, 8.0])
    def test_a_wrong_one_is_noticed_and_does_no_harm(self, mode, offset_m, caplog):
        for seed in range(5):
            world = World(seed, is_planar=True)
            settings = self.docked(world, offset_m, localization_mode=mode)
            *others, yaw = settings.initial_pose
            estimator = Estimator(replace(settings, initial_pose=(*others, yaw + 1.0)))
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
            {'initial_pose': (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)},
            {'initial_pose': (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)},
            {'initial_pose': (0.0, 0.0, -1.0, 0.0, 0.0, 0.0)},
        ],
    )
    def test_one_that_is_not_asked_for_is_given_to_have_no_effect(self, given, caplog):
        assert_array_equal(Estimator(Settings(**given)).pose, np.eye(4))
        assert 'use set_initial_pose: true' in caplog.text
