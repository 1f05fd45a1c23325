"""A robot found by landmarks without ids, and in one of several maps."""

from __future__ import annotations

from dataclasses import replace
import logging

from mapped_worlds import add, MODES, World
import numpy as np
import pytest

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings


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

    @pytest.mark.parametrize('are_known', [True, False])
    def test_a_map_that_is_the_same_turned_matters_only_to_points_without_ids(
        self, are_known, caplog
    ):
        world = World(0, is_planar=True)
        angles = np.arange(50) * np.pi / 25
        world.points = 8.0 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
        estimator = Estimator(world.settings(localization_mode='uncertain'))
        estimator.load_map(world.map())
        views = [world.see(0.1 * i, world.near(0.0, 1 if i < 9 else 8)) for i in range(20)]
        add(estimator, views if are_known else map(without_ids, views))
        assert estimator.is_localised == are_known
        assert caplog.text.count('is the same turned by 7°') == (not are_known)

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
        pose, turn = np.eye(4), np.diag([0.0, 0.0, 2.0**2, 0.0, 0.0, 0.0])
        pose[:3, 3] = world.start[:3, 3]
        estimator = Estimator(world.settings())
        estimator.load_map(world.map(), pose, turn)
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
        """Three worlds, and their maps; ``ids`` are added to the ids of each."""
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
        assert 'of the maps hall_0 and its_twin, 50 landmarks are the same: a robot' in problem
        assert len(estimator.possible_poses) == 2

    @pytest.mark.parametrize(
        'motion', [(0.0, 0.0), (np.pi / 2, 0.0), (0.0, 30.0), (-2.0, 7.0)], ids=str
    )
    @pytest.mark.parametrize('ids', ['same', 'other', 'none'])
    def test_a_map_that_is_another_one_moved_is_named_with_what_helps(self, motion, ids, caplog):
        worlds, (known, another, _) = self.halls()
        turn, shift = motion
        T = se3.exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))
        T[0, 3] = shift
        # One of its landmarks has been moved, and one is not there any more.
        points = se3.transform(T, known.world_points)
        points[7] += [9.0, 0.0, 0.0]
        later = replace(known, world_points=points, name='later').select(np.arange(1, 50))
        later = later if ids == 'same' else replace(later, ids=later.ids + 500)
        estimator = Estimator(worlds[0].settings())
        another = replace(another, ids=another.ids + 1000)
        estimator.load_map([known, later, another])
        seen = [17, 4, 30, 41, 22]
        is_known_to_ids = ids == 'same'
        assert (caplog.text.count('andmarks are the same') == 1) == is_known_to_ids
        for time_s in np.arange(0.0, 2.0, 0.1):
            view = worlds[0].see(time_s, seen, np.eye(4))
            estimator.add(without_ids(view) if ids == 'none' else view)
        if ids == 'other':
            assert estimator.map_name == 'hall_0'
            assert 'andmarks are the same' not in caplog.text
            return
        assert not estimator.is_localised
        problem = estimator.localisation_problem
        assert 'of the maps hall_0 and later, 48 landmarks are the same' in problem.what
        assert ('turned by' in problem.what) == (turn != 0.0)
        assert ('shifted by' in problem.what) == (shift != 0.0)
        assert problem.remedy.startswith('take one of the two out of the folder')
        assert caplog.text.count('andmarks are the same') == 1

    @pytest.mark.parametrize('hall', ['hall_0', 'twin'])
    @pytest.mark.parametrize('has_ids', [False, True])
    def test_of_two_halls_that_differ_by_one_landmark_it_decides_once_it_is_seen(
        self, hall, has_ids
    ):
        worlds, (known, *_) = self.halls()
        world = worlds[0]
        other = world.near(8.0, 3)[0]
        assert other not in world.near(0.0, 8)
        points = known.world_points.copy()
        points[other] += [3.0, 0.0, 0.0]
        if hall == 'twin':
            world.points[other] += [3.0, 0.0, 0.0]
        estimator = Estimator(world.settings(localization_mode='uncertain'))
        estimator.load_map([known, replace(known, world_points=points, name='twin')])
        was_seen = False
        for event in world.drive(0.0, 15.0, count=8):
            estimator.add(event if has_ids else without_ids(event))
            was_seen |= isinstance(event, ObservationEvent) and other in event.ids
            if not was_seen:
                assert not estimator.is_localised
                problem = estimator.localisation_problem
        assert was_seen
        assert '49 landmarks are the same' in problem.what
        assert estimator.map_name == hall

    @pytest.mark.parametrize('mode', ['fixed', 'uncertain'])
    @pytest.mark.parametrize('has_ids', [False, True])
    @pytest.mark.parametrize('given', ['hall_0', 'twin'])
    def test_a_pose_in_the_wrong_one_of_two_halls_is_put_right_by_what_differs(
        self, given, has_ids, mode
    ):
        worlds, (known, *_) = self.halls()
        world = worlds[0]
        other = world.near(8.0, 3)[0]
        points = known.world_points.copy()
        points[other] += [3.0, 0.0, 0.0]
        world.points[other] += [3.0, 0.0, 0.0]
        estimator = Estimator(world.settings(localization_mode=mode))
        estimator.load_map([known, replace(known, world_points=points, name='twin')])
        estimator.set_pose(world.start, 1e-4 * np.eye(6), map_name=given)
        assert estimator.map_name == given
        for event in world.drive(0.0, 15.0, count=8):
            estimator.add(event if has_ids else without_ids(event))
        assert estimator.map_name == 'twin'
        assert estimator.counts['lost'] == (given == 'hall_0')
        assert np.linalg.norm(world.error(estimator, 14.9)) < 0.2

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
