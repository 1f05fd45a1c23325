"""Maps loaded over what was mapped, and maps saved: frames, what moves, what is exact."""

from __future__ import annotations

from dataclasses import replace

from mapped_worlds import add, GAINS, MODES, World
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.special import chdtri

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.known_landmarks import anchor
from slam_observer_ros.lie import se3
from slam_observer_ros.lie.axes import SPATIAL
from slam_observer_ros.lie.se3 import rigid_alignment
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings


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
    assert np.mean(np.array(nees) <= chdtri(dof, 0.0027)) > 0.9


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


def test_the_landmarks_by_which_the_place_was_found_are_in_the_map():
    landmarks = np.array([[5, 0, 0], [5, 3, 1], [5, -3, 0.5], [4, 1, 2], [3, 3, -1]])
    estimator = Estimator(Settings(reorder_window=0.0))
    estimator.load_map(LandmarkMap(np.arange(5), landmarks, None, np.zeros(5, dtype=np.int64)))
    estimator.add(ObservationEvent(0, np.arange(3), landmarks[:3]))
    assert estimator.is_localised
    assert_array_equal(np.sort(estimator.landmark_ids), np.arange(5))


def test_far_from_the_origin_as_in_a_national_grid_nothing_is_lost_to_rounding():
    world = World(16)
    grid = np.array([500_000.0, 5_000_000.0, 300.0])
    world.points += grid
    world.start = se3.pose(world.start[:3, :3], world.start[:3, 3] + grid)
    estimator = Estimator(world.settings())
    estimator.load_map(world.map())
    add(estimator, world.drive(0.0, 5.0))
    assert np.linalg.norm(world.error(estimator, 4.9)[3:]) < 0.1


@pytest.mark.parametrize('seed', [0, 11, 15])
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
    """A sensor that measures velocities has noise in velocities of landmarks at rest, too."""
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
