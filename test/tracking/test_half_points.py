"""Bearings and ranges alone: a half point is a point once something completes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AZIMUTH,
    AZIMUTH_RANGE,
    BEARING,
    ObservationEvent,
    POINT,
    RANGE,
    UNKNOWN_ID,
    VelocityEvent,
)
from slam_observer_ros.filter import core
from slam_observer_ros.filter import step as numpy_step
from slam_observer_ros.filter.robust import straight_odds, straight_share
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.runs.health import of_estimate
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing import bordered_chain, gauss_newton

STEP_NS, N = 100_000_000, 8
SETTINGS = Settings(
    two_d_mode=True,
    observation_model='range_bearing',
    range_noise=0.1,
    bearing_noise=0.02,
    angular_velocity_noise=(0.02, 0.02, 0.02),
    linear_velocity_noise=(0.03, 0.01, 0.01),
    reorder_window=0.0,
    max_rejections=1_000_000,
)
SPATIAL = replace(SETTINGS, two_d_mode=False)


class World:
    """A robot that drives circles, or straight on, past anchors whose ids are their numbers."""

    def __init__(self, settings, seed=0, known=True, turn=0.3, scale=1.0, biases=0.0):
        self.rng, self.settings, self.scale = np.random.default_rng(seed), settings, scale
        self.biases = np.broadcast_to(biases, N)  # by which ranges from each are too long, metres
        flat = [1.0, 1.0, 0.0 if settings.two_d_mode else 1.0]
        self.points = self.rng.uniform([-8.0, -8.0, 0.5], [8.0, 8.0, 3.0], (N, 3)) * flat
        self.estimator = Estimator(settings, judges_innovations=True)
        if known:
            covariances = np.tile(1e-6 * np.eye(3), (N, 1, 1))
            survey = LandmarkMap(np.arange(N), self.points, covariances, np.zeros(N, np.int64))
            start = np.diag([1e-6, 1e-6, 0.01, 0.04, 0.04, 1e-6])
            self.estimator.load_map(survey, np.eye(4), start)
        climb = 0.0 if settings.two_d_mode else 0.1
        self.V = np.array([0.0, climb, turn, 1.0, 0.0, climb])
        self.A, self.stamp_ns, self.errors = np.eye(4), 0, []
        self.track = {}  # true and estimated poses by stamps

    def drive(self, seconds, kinds, rows=(0, 1, 2, 3)):
        """Drive on; at each step landmarks ``rows`` are seen, each by all ``kinds`` in turn."""
        for step in range(round(seconds * 1e9 / STEP_NS)):
            noise = np.array([0.0, 0.0, 0.02, 0.03, 0.0, 0.0]) * self.rng.normal(size=6)
            self.estimator.add(VelocityEvent(self.stamp_ns, self.V + noise / np.sqrt(0.1)))
            self.A = self.A @ se3.exp(0.1 * self.V)
            self.stamp_ns += STEP_NS
            if step % 4 == 0:
                for event in self.seen(np.array(rows), kinds):
                    self.estimator.add(event)
                self.track[self.stamp_ns] = self.A, self.estimator.pose
                error = se3.inverse(self.A) @ self.estimator.pose
                self.errors.append(np.linalg.norm(error[:3, 3]))
        self.estimator.flush()

    def seen(self, rows, kinds):
        lines = se3.transform(se3.inverse(self.A), self.points[rows])
        ranges = np.linalg.norm(lines, axis=1, keepdims=True) / self.scale
        ranges = ranges + self.biases[rows, None] + 0.1 * self.rng.normal(size=ranges.shape)
        units = lines / np.linalg.norm(lines, axis=1, keepdims=True)
        flat = [1.0, 1.0, 0.0 if self.settings.two_d_mode else 1.0]
        units = units + 0.02 * self.rng.normal(size=units.shape) * flat
        units /= np.linalg.norm(units, axis=1, keepdims=True)
        for kind in kinds:
            shown = {
                POINT: ranges * units,
                BEARING: units,
                AZIMUTH: units,
                RANGE: ranges * [1.0, 0.0, 0.0],
                AZIMUTH_RANGE: ranges * units,
            }[kind]
            whole = None if kind == POINT else np.full(len(rows), kind)
            yield ObservationEvent(self.stamp_ns, rows, shown, kinds=whole)


@pytest.mark.parametrize('settings', [SETTINGS, SPATIAL], ids=['plane', 'space'])
@pytest.mark.parametrize('kind', [BEARING, RANGE, AZIMUTH, AZIMUTH_RANGE])
def test_half_points_of_a_surveyed_map_say_where_the_robot_is(settings, kind):
    world = World(settings)
    world.drive(60.0, [kind], rows=range(N))
    estimator = world.estimator
    assert np.sqrt(np.mean(np.square(world.errors[20:]))) < 0.15
    sigma_m = np.sqrt(np.trace(estimator.pose_covariance[3:, 3:]))
    assert world.errors[-1] < 4.0 * sigma_m < 0.8
    assert estimator.counts['rejected_landmark'] < 0.02 * estimator.counts['observed_point']


@pytest.mark.parametrize('settings', [SETTINGS, SPATIAL], ids=['plane', 'space'])
def test_a_bearing_and_a_range_are_the_point_of_both(settings):
    # Without weights, which judge a point by both of its parts together.
    settings = replace(
        settings, huber_threshold=0.0, rejection_threshold=100.0, motion_noise_factor='stated'
    )
    whole, halves = World(settings, seed=1), World(settings, seed=1)
    for _ in range(20):
        # The same noise: of the same numbers that are drawn.
        state = whole.rng.bit_generator.state
        whole.drive(0.4, [POINT])
        halves.rng.bit_generator.state = state
        halves.drive(0.4, [BEARING, RANGE])
    P, Q = whole.estimator.pose_covariance, halves.estimator.pose_covariance
    sigmas = np.sqrt(np.diagonal(P))
    assert np.allclose(np.sqrt(np.diagonal(Q)), sigmas, rtol=0.01, atol=1e-6)
    apart = se3.inverse(whole.estimator.pose) @ halves.estimator.pose
    assert np.linalg.norm(apart[:3, 3]) < 0.1 * np.linalg.norm(sigmas[3:])


def test_degrees_of_freedom_are_those_that_were_measured():
    for settings, kind, expected in (
        (SETTINGS, RANGE, 4),
        (SPATIAL, RANGE, 4),
        (SPATIAL, BEARING, 8),
    ):
        world = World(settings)
        world.drive(0.1, [kind])
        innovation = world.estimator.last_update.innovation
        assert innovation.degrees_of_freedom == expected
        assert np.abs(innovation.log_densities).max() < 10.0


@pytest.mark.parametrize('kind', [RANGE, BEARING])
def test_a_start_known_to_metres_is_honest_although_half_points_are_not_linear(kind):
    nees = []
    for seed in range(8):
        world = World(SETTINGS, seed=seed)
        sigmas = np.array([0.0, 0.0, 0.3, 2.0, 2.0, 0.0])
        start = world.A @ se3.exp(sigmas * world.rng.normal(size=6))
        world.estimator.load_map(world.estimator.loaded_maps[0], start, np.diag(sigmas**2))
        for _ in range(20):
            world.drive(0.1, [kind], rows=(0, 1, 2))
            off = (world.estimator.pose - world.A)[:2, 3]
            P = world.estimator.pose_covariance[3:5, 3:5]
            nees.append(off @ np.linalg.solve(P, off) / 2.0)
    assert 0.5 < np.mean(nees) < 2.0


def test_wheels_that_spin_leave_the_pose_less_sure_by_bearings_alone():
    nees = []
    for seed in range(4):
        world = World(SETTINGS, seed=seed)
        world.drive(16.0, [BEARING], rows=(0, 1))
        for step in range(20):
            stands = world.A
            world.drive(0.4, [BEARING], rows=(0, 1))
            if step < 3:  # only the odometry goes on
                world.A = stands
            world.drive(0.1, [BEARING], rows=(0, 1))
            off = (world.estimator.pose - world.A)[:2, 3]
            P = world.estimator.pose_covariance[3:5, 3:5]
            nees.append(off @ np.linalg.solve(P, off) / 2.0)
    assert np.mean(nees) < 15.0


@pytest.mark.parametrize('settings', [SETTINGS, SPATIAL])
@pytest.mark.parametrize('kind', [RANGE, BEARING])
def test_a_map_that_is_turned_as_a_whole_leaves_half_points_linear(settings, kind):
    maps = []
    for heading_rad in (1e-3, 0.3):  # of the robot, and with it of all that it maps
        world = World(settings, known=False)
        turned = np.diag([0.0, 0.0, heading_rad**2, 0.0, 0.0, 0.0])
        world.estimator.set_pose(np.eye(4), turned)
        lines = world.points / np.linalg.norm(world.points, axis=1, keepdims=True)
        ranges = np.linalg.norm(world.points, axis=1, keepdims=True) * [1.0, 0.0, 0.0]
        world.estimator.add(VelocityEvent(0, np.zeros(6)))
        world.estimator.add(ObservationEvent(0, np.arange(N), world.points))
        for step in range(1, 11):
            shown, kinds = ranges if kind == RANGE else lines, np.full(N, kind)
            world.estimator.add(VelocityEvent(step * STEP_NS, np.zeros(6)))
            world.estimator.add(ObservationEvent(step * STEP_NS, np.arange(N), shown, kinds=kinds))
        maps.append(world.estimator.world_points)
    assert maps[1] == pytest.approx(maps[0], abs=0.01)


def test_bearings_show_how_noisy_the_motion_is_as_points_do():
    stated = (0.0, 0.0, 0.005)
    settings = replace(SETTINGS, motion_noise_factor='auto', angular_velocity_noise=stated)
    factors = []
    for kind in (POINT, BEARING):
        world = World(settings)
        world.drive(40.0, [kind], rows=range(N))
        (turning,) = (e for e in world.estimator.motion_factors if e.name == 'turning')
        factors.append(turning.factor)
    assert factors[1] == pytest.approx(factors[0], rel=0.1)
    assert factors[1] == pytest.approx(4.0, rel=0.3)


def test_a_scale_of_the_ranges_is_found():
    world = World(replace(SETTINGS, range_scale_stddev=0.1), scale=1.07)
    world.drive(60.0, [RANGE])
    (scale,) = (each for each in world.estimator.calibration if each.name == 'range_scale')
    assert scale.value == pytest.approx(1.07, abs=0.01)
    assert world.errors[-1] < 0.2


BIASES_M = np.array([0.3, -0.2, 0.1, -0.3, 0.2, -0.1, 0.25, -0.15])


@pytest.mark.parametrize('known', [True, False], ids=['surveyed', 'unknown'])
@pytest.mark.parametrize('settings', [SETTINGS, SPATIAL], ids=['plane', 'space'])
def test_ranges_that_are_too_long_by_a_bias_of_each_anchor_mislead_nobody(settings, known):
    errors_m, nees, k = [], [], 2 if settings.two_d_mode else 3
    for stddev in (0.0, 0.2):
        world = World(replace(settings, range_bias_stddev=stddev), known=known, biases=BIASES_M)
        world.drive(30.0 if known else 60.0, [RANGE], rows=range(N))
        ids, P = world.estimator.landmark_ids, world.estimator.landmark_covariances[:, :k, :k]
        off = (world.estimator.world_points - world.points[ids])[:, :k]
        z = np.linalg.solve(np.linalg.cholesky(P + 1e-6 * np.eye(k)), off[:, :, None])
        errors_m.append(np.sqrt(np.mean(np.square(world.errors[-30:]))))
        nees.append(np.mean(z**2))
    assert set(ids) == set(range(N))
    found = {each.name: each for each in world.estimator.calibration}
    biases = [found[f'range_bias/{i}'] for i in range(N)]
    z = [(each.value - b) / each.deviation for each, b in zip(biases, BIASES_M, strict=True)]
    assert np.mean(np.square(z)) < 2.5
    if known:
        assert errors_m[1] < 0.5 * errors_m[0]
        assert max(each.deviation for each in biases) < 0.05
    else:
        assert nees[1] < min(3.0, 0.25 * nees[0])


@pytest.mark.parametrize('kind', [RANGE, BEARING])
@pytest.mark.parametrize('seed', range(2))
def test_new_landmarks_enter_when_a_curve_has_decided_where_they_are(kind, seed):
    world = World(SETTINGS, seed=seed, known=False)
    world.drive(60.0, [kind], rows=range(N))
    estimator = world.estimator
    assert set(estimator.landmark_ids) == set(range(N))
    assert estimator.counts['waiting_point'] > 0
    off_m = np.linalg.norm(estimator.world_points - world.points[estimator.landmark_ids], axis=1)
    sigmas_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
    assert (off_m < np.minimum(4.0 * sigmas_m, 1.0)).all()


def test_a_map_by_bearings_keeps_its_size():
    # Each direction's noise would draw the landmarks to the robot, and the way with them.
    settings = replace(SETTINGS, bearing_noise=0.05, linear_scale_stddev=(0.03, 0.0, 0.0))
    world = World(settings, known=False)
    world.drive(60.0, [BEARING], rows=range(N))
    (scale,) = (e for e in world.estimator.calibration if e.name == 'linear_scale_x')
    assert scale.value == pytest.approx(1.0, abs=0.1)
    assert world.errors[-1] < 1.0


def test_a_straight_way_leaves_open_on_which_side_an_anchor_is():
    world = World(SETTINGS, known=False, turn=0.0)
    world.drive(30.0, [RANGE], rows=range(N))
    assert not len(world.estimator.landmark_ids)
    assert world.estimator.counts['waiting_point'] == world.estimator.counts['observed_point']


def test_an_azimuth_alone_places_no_new_landmark_in_space():
    world = World(SPATIAL, known=False)
    world.drive(20.0, [AZIMUTH], rows=range(N))
    assert not len(world.estimator.landmark_ids)
    assert world.errors[-1] < 2.0


def test_half_points_without_ids_are_left_out_counted_and_named(caplog):
    world = World(SETTINGS)
    for event in world.seen(np.arange(4), [RANGE]):
        world.estimator.add(replace(event, ids=np.full(4, UNKNOWN_ID)))
    world.estimator.flush()
    assert world.estimator.counts['unknown_id'] == 4
    assert 'Not used: 4 bearings or ranges alone' in caplog.text


@pytest.mark.parametrize('kind', [RANGE, AZIMUTH_RANGE])
def test_an_anchor_above_the_plane_is_as_far_as_it_is_on_the_floor(kind):
    world = World(SETTINGS)
    world.points[:, 2] = 2.5
    covariances = np.tile(1e-6 * np.eye(3), (N, 1, 1))
    survey = LandmarkMap(np.arange(N), world.points, covariances, np.zeros(N, np.int64))
    world.estimator.load_map(survey, np.eye(4), np.diag([1e-6, 1e-6, 0.01, 0.04, 0.04, 1e-6]))
    seen = world.seen

    def seen_level(rows, kinds):
        for event in seen(rows, kinds):
            ranges = np.linalg.norm(event.points, axis=1)
            level = np.linalg.norm(event.points[:, :2], axis=1)
            flat = event.points / level[:, None] * ranges[:, None] * [1.0, 1.0, 0.0]
            yield replace(event, points=flat)  # an azimuth says nothing of the height

    world.seen = seen_level
    world.drive(60.0, [kind], rows=range(N))
    assert np.sqrt(np.mean(np.square(world.errors[20:]))) < 0.1
    # An error of the distance is longer on the floor, and its noise as much larger.
    off = np.array(world.errors[20:])
    sigma_m = np.sqrt(np.trace(world.estimator.pose_covariance[3:, 3:]))
    assert 0.4 * sigma_m < np.sqrt(np.mean(off**2)) < 2.0 * sigma_m


@pytest.mark.parametrize(
    'wrong', [np.array([7]), np.array([-1]), np.array([0.0]), np.array([1, 1])]
)
def test_a_kind_that_is_none_is_refused(wrong):
    world = World(SETTINGS)
    event = ObservationEvent(1, np.array([0]), np.array([[1.0, 0.0, 0.0]]), kinds=wrong)
    assert not world.estimator.add(event)
    assert world.estimator.dropped.total() == 1


def test_a_bearing_with_a_depth_that_may_be_anything_keeps_its_own_noise():
    stated = np.diag([1e6, 0.0175**2, 0.0175**2])
    event = ObservationEvent(0, np.array([1]), np.array([[10.0, 0.0, 0.0]]), stated[None])
    used = ObservationNoise(SETTINGS).covariances(event)[0]
    assert np.sqrt(used[1, 1]) == pytest.approx(0.0175, rel=0.01)


def drive_past_walls(shares, bias_m=0.0, seed=0, stddev=0.0):
    """Return a world whose ranges take detours of a metre in the mean, in so many of all."""
    settings = replace(SETTINGS, localization_mode='uncertain', range_bias_stddev=stddev)
    world = World(settings, seed=seed)
    seen, rng = world.seen, np.random.default_rng(seed)

    def seen_past_walls(rows, kinds):
        for event in seen(rows, kinds):
            more = (rng.random(len(rows)) < shares) * rng.exponential(1.0, len(rows))
            more = more + np.where(rows == 2, bias_m, 0.0)
            lines = event.points * (1.0 + more / np.linalg.norm(event.points, axis=1))[:, None]
            yield replace(event, points=lines)

    world.seen = seen_past_walls
    world.drive(100.0, [RANGE], rows=range(N))
    return world


def test_ranges_through_walls_count_less_than_short_ones():
    off = np.linspace(0.0, 5.0, 50)
    odds = straight_odds(np.full(50, 0.1), np.full(50, 10.0))
    share = straight_share(off, odds)
    assert (straight_share(-off, odds) == 1.0).all()
    assert (np.diff(share) < 0.0).all()
    assert share[0] > 0.99 and share[-1] < 0.01
    # What is one in five of all is never more likely than not where a straight one is right.
    assert (straight_share(np.zeros(50), odds) > 0.9).all()


@pytest.mark.parametrize('seed', range(2))
def test_two_ranges_in_five_through_walls_leave_the_robot_where_it_is(seed):
    world = drive_past_walls(0.4, seed=seed)
    assert np.sqrt(np.mean(np.square(world.errors[20:]))) < 0.25


@pytest.mark.parametrize(('bias_m', 'stddev'), [(-0.3, 0.0), (0.3, 0.0), (1.0, 0.0), (0.3, 0.1)])
def test_an_anchor_whose_ranges_are_off_everywhere_is_named(bias_m, stddev):
    world = drive_past_walls(0.1, bias_m, stddev=stddev)
    assert list(world.estimator.anchor_biases) == [2]
    assert world.estimator.anchor_biases[2] == pytest.approx(bias_m, rel=0.4)
    findings = [each for each in of_estimate(world.estimator) if each.kind == 'anchor_biased']
    towards = 'short' if bias_m < 0.0 else 'long'
    assert len(findings) == 1
    assert f'landmark 2 are {abs(world.estimator.anchor_biases[2]):.2f} m too {towards}' in str(
        findings[0].what
    )


@pytest.mark.parametrize('shares', [0.0, 0.2])
def test_no_anchor_is_named_whose_ranges_are_right_or_long_at_times(shares):
    assert not drive_past_walls(shares).estimator.anchor_biases
    alone = np.where(np.arange(N) == 2, 0.3, 0.0)
    assert not drive_past_walls(alone).estimator.anchor_biases


def test_a_straight_way_leaves_the_side_open_and_says_to_drive_a_curve():
    world = World(SETTINGS, known=False, turn=0.0)
    world.drive(20.0, [RANGE])
    assert world.estimator.open_sides == [0, 1, 2, 3]
    (finding,) = of_estimate(world.estimator)
    assert finding.kind == 'side_undecided' and finding.remedy == 'drive a curve'
    world.V[2] = 0.4
    world.drive(40.0, [RANGE])
    entered = world.estimator.landmark_ids.tolist()
    assert entered
    assert not set(entered) & set(world.estimator.open_sides)


@pytest.mark.parametrize('settings', [SETTINGS, SPATIAL], ids=['plane', 'space'])
@pytest.mark.parametrize('known', [True, False], ids=['surveyed', 'unknown'])
def test_numpy_does_with_half_points_what_the_compiled_core_does(settings, known, monkeypatch):
    settings = replace(settings, range_scale_stddev=0.05, range_bias_stddev=0.1)
    worlds = []
    for is_compiled in (True, False):
        if not is_compiled:
            for module in (core, bordered_chain, gauss_newton):
                monkeypatch.setattr(module, 'COMPILED', None)
            monkeypatch.setattr(core, 'advance', numpy_step.advance)
            monkeypatch.setattr(core, 'observe', numpy_step.observe)
        worlds.append(World(settings, known=known))
        worlds[-1].drive(0.8 if known else 60.0, [RANGE, BEARING], rows=range(N))
    poses = [world.estimator.pose for world in worlds]
    assert set(worlds[0].estimator.landmark_ids) == set(range(N))
    assert np.abs(poses[0] - poses[1]).max() < (1e-12 if known else 1e-7)


@pytest.mark.parametrize('kind', [RANGE, BEARING])
def test_smoothing_uses_views_from_before_a_landmark_entered(kind):
    of_smoothed, of_filter = [], []
    for seed in range(3):
        world = World(SETTINGS, seed=seed, known=False)
        while not len(world.estimator.landmark_ids):
            world.drive(0.4, [kind], rows=range(N))
        then_ns = world.stamp_ns
        world.drive(60.0, [kind], rows=range(N))
        smoothed = world.estimator.smooth()
        for stamp_ns, again in zip(smoothed.stamps_ns.tolist(), smoothed.poses, strict=True):
            A, pose = world.track[stamp_ns]
            true = measured(world.points[smoothed.ids], A, kind)
            for P, off in ((again, of_smoothed), (pose, of_filter)) if stamp_ns < then_ns else ():
                off.append(measured(smoothed.world_points, P, kind) - true)
    assert np.std(np.concatenate(of_smoothed)) < 0.7 * np.std(np.concatenate(of_filter))


def measured(points, pose, kind):
    """Return how far points are from a pose, or their directions."""
    lines = se3.transform(se3.inverse(pose), points)
    ranges = np.linalg.norm(lines, axis=1, keepdims=True)
    return ranges if kind == RANGE else lines / ranges


def test_a_lost_robot_that_is_found_has_the_scale_of_its_ranges_from_the_search():
    world = World(replace(SETTINGS, range_scale_stddev=0.1), scale=1.07)
    survey = world.estimator.loaded_maps[0]
    world.estimator = Estimator(world.settings)
    world.estimator.load_map(survey)
    while not world.estimator.is_localised:
        world.drive(0.4, [RANGE], rows=range(N))
        assert world.stamp_ns < 60e9
    (scale,) = (e for e in world.estimator.calibration if e.name == 'range_scale')
    assert scale.value == pytest.approx(1.07, abs=0.02)
    # It is as sure as the search has found it, not as it was stated before.
    assert scale.deviation < 0.02 and abs(scale.value - 1.07) < 3.0 * scale.deviation
