"""What a map is worth without ids: where one look finds the robot, and whether it looks alike."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.lie.axes import PLANAR
from slam_observer_ros.mapping.finder import look_around, warn_of_symmetry
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_alignment import place_for_another, symmetries
from slam_observer_ros.mapping.map_file import write_map


def hall(points):
    n = len(points)
    covariances = np.tile(1e-4 * np.eye(3), (n, 1, 1))
    return LandmarkMap(np.arange(n), points, covariances, np.zeros(n, dtype=np.int64))


def random_points(count, seed=0):
    return np.random.default_rng(seed).uniform(0, [60, 40, 0], (count, 3))


def turned_by_half():
    half = random_points(30)
    return np.concatenate([half, [60, 40, 0] - half])


def with_one_more(known, point):
    return hall(np.concatenate([known.world_points, point[None]]))


def looks(known):
    return look_around(known, PLANAR, 12.0, 1.5 * np.pi, 0.02, 0.05, 1e-3)


def test_a_hall_that_is_itself_when_turned_by_half_is_recognised_also_with_one_more():
    known = hall(turned_by_half())
    (symmetry,) = symmetries(known)
    assert symmetry.turn_deg == pytest.approx(180, abs=0.1)
    assert symmetry.is_same.all()
    (symmetry,) = symmetries(with_one_more(known, np.array([20.0, 15, 0])))
    assert symmetry.turn_deg == pytest.approx(180, abs=0.5)
    assert np.flatnonzero(~symmetry.is_same).tolist() == [60]


@pytest.mark.parametrize('seed', range(3))
def test_random_halls_do_not_look_the_same(seed):
    assert symmetries(hall(random_points(60, seed))) == []


def test_a_square_of_four_looks_the_same_three_times():
    square = np.array([[0.0, 0, 0], [8, 0, 0], [8, 8, 0], [0, 8, 0]])
    assert [round(s.turn_deg) for s in symmetries(hall(square))] == [90, 90, 180]


@pytest.mark.parametrize('count', [5, 8, 12, 24])
def test_of_a_ring_the_smallest_turn_is_named(count):
    angles = 2.0 * np.pi * np.random.default_rng(0).permutation(count) / count
    ring = 5.0 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    assert symmetries(hall(ring))[0].turn_deg == pytest.approx(360 / count, abs=0.1)


def test_one_look_finds_a_robot_in_a_random_hall_and_never_in_one_that_looks_the_same():
    random, same = looks(hall(random_points(80))), looks(hall(turned_by_half()))
    assert random.is_found[random.seen >= 5].mean() > 0.98
    assert not random.is_found[random.seen < 3].any()
    assert not same.is_found.any()
    assert (same.fitting[same.seen >= 5] >= 2).all()


def test_one_more_landmark_where_it_is_advised_makes_the_difference_where_it_is_seen():
    known = hall(turned_by_half())
    (symmetry,) = symmetries(known)
    point = place_for_another(known, symmetry)
    after = looks(with_one_more(known, point))
    near = np.linalg.norm(after.poses[:, :2, 3] - point[:2], axis=1) < 6.0
    assert after.is_found[near].mean() > 0.3
    assert np.linalg.norm(known.world_points - point, axis=1).min() > 2.0


def test_what_looks_the_same_is_logged_with_what_would_help(caplog):
    warn_of_symmetry(hall(random_points(60)), 'hall')
    assert not caplog.text
    warn_of_symmetry(hall(turned_by_half()), 'hall')
    assert (
        'The map hall is the same turned by 180°: without ids or a start pose the robot '
        "can't be found" in caplog.text
    )
    assert 'add one more landmark: at (' in caplog.text


def test_the_command_says_it_and_draws_it(slam_observer, tmp_path):
    path, picture = tmp_path / 'hall.yaml', tmp_path / 'hall.png'
    write_map(path, hall(turned_by_half()), None)
    output = slam_observer('map', 'check', path, '--view', '8m', '--fov', 270, '--plot', picture)
    for text in ('found by one look', '0%', 'when turned by 180°', 'one more landmark'):
        assert text in output.output
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert 'is no length in metres' in slam_observer.fail('map', 'check', path, '--view', '-3')
    write_map(tmp_path / 'few.yaml', hall(random_points(2)), None)
    assert 'too few in view' in slam_observer('map', 'check', tmp_path / 'few.yaml').output
