"""Smoothing: least squares over prior, motions and observations, and relinearising by it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import Mock

from gain_worlds import (
    configuration_error_m,
    drive,
    estimate,
    OBSERVED_EVERY,
    START_NS,
    STEP_NS,
)
from hypothesis import given
import numpy as np
import pytest
from random_runs import held
from smoothing_problems import POSES, Problem, random_covariances
from strategies import generators

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter.arrays import FilterArrays
from slam_observer_ros.filter.flat_arrays import Interval
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.models.calibration import Calibration
from slam_observer_ros.models.observation_noise import ObservationNoise
from slam_observer_ros.recordings.trajectory import Trajectory
from slam_observer_ros.runs.metrics import trajectory_errors
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Smoother
from slam_observer_ros.smoothing.history import History, Keyframe
from slam_observer_ros.smoothing.prior import Prior
from slam_observer_ros.smoothing.relinearisation import Relinearisation

NOTHING_KNOWN = np.empty((0, 3)), np.empty((0, 3, 3))
NOTHING = np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)), None, np.empty(0)
"""What a keyframe holds of an observation in which no landmark was seen."""


problems = pytest.mark.parametrize(
    'problem',
    [
        Problem(axes, c, seed, is_relative, drifts=drifts, tags=tags)
        for axes in (PLANAR, SPATIAL)
        for c, drifts in ((0, False), (2, False), (2, True))
        for seed, tags, is_relative in (
            (0, False, False),
            (1, False, True),
            (2, True, False),
            (2, True, True),
        )
    ],
)


@problems
def test_one_iteration_is_the_dense_gauss_newton_step(problem):
    J, r = problem.jacobian(problem.start), problem.residuals(problem.start)
    expected = problem.moved(problem.start, -np.linalg.solve(J.T @ J, J.T @ r))
    smoother = Smoother(problem.axes, problem.prior, problem.keyframes, problem.settings)
    solution = smoother.smooth(problem.start, 1, 0.0).end
    # A turn of which nothing is known is unknown to 100 rad only.
    atol = 1e-5 if problem.q else 1e-6
    np.testing.assert_allclose(solution.poses, expected.poses, atol=atol)
    np.testing.assert_allclose(solution.calibrations, expected.calibrations, atol=atol)
    np.testing.assert_allclose(solution.points, expected.points, atol=atol)
    if problem.q:
        np.testing.assert_allclose(solution.orientations, expected.orientations, atol=atol)


@problems
def test_the_solution_is_where_the_gradient_of_the_cost_vanishes(problem):
    smoother = Smoother(problem.axes, problem.prior, problem.keyframes, problem.settings)
    solution = smoother.smooth(problem.start, 200, 1e-10).end
    gradient = problem.jacobian(solution).T @ problem.residuals(solution)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-5)


@problems
def test_marginal_is_that_of_the_dense_inverse(problem):
    smoother = Smoother(problem.axes, problem.prior, problem.keyframes, problem.settings)
    J = problem.jacobian(problem.start)
    first = POSES * (problem.d + (problem.c if problem.drifts else 0))
    np.testing.assert_allclose(
        smoother.smooth(problem.start, 1, 0.0).factors.marginal(),
        np.linalg.inv(J.T @ J)[first:, first:],
        rtol=1e-4,
        atol=1e-7,
    )


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
@pytest.mark.parametrize('forgotten', [[], [0], [0, 1]])
@pytest.mark.parametrize('tags', [False, True])
def test_what_is_known_as_seen_from_the_pose_says_the_same_there(axes, forgotten, tags):
    problem = Problem(axes, 2, seed=5, tags=tags)
    axes, prior = problem.axes, problem.prior
    rows = np.array(forgotten, dtype=np.int64)
    absolute = prior.without(axes, rows)
    relative = prior.relative(axes).without(axes, rows)
    at_it = absolute.pose, absolute.calibration, absolute.points, absolute.orientations
    expected, _ = absolute.normal_equations(axes, np.linalg.inv(absolute.covariance), *at_it)
    found, gradient = relative.normal_equations(axes, np.linalg.inv(relative.covariance), *at_it)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(gradient, 0.0, atol=1e-6)


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
@pytest.mark.parametrize('turns_together', [True, False])
def test_a_map_turns_with_the_pose_unless_it_is_known_better(axes, turns_together):
    axes = axes.of_points()
    d, points = axes.p, axes.full_points(np.arange(4.0 * axes.point))
    together = np.concatenate([np.eye(d), axes.output_matrix(points).reshape(-1, d)])
    turn, own = (
        np.diag(0.1 * (np.arange(d) < d - axes.point)),
        np.diag(np.full(len(together), 1e-3)),
    )
    covariance = together @ turn @ together.T + own
    if not turns_together:
        covariance[:d, d:] = covariance[d:, :d] = 0.0
    prior, angle_rad = Prior(
        np.eye(4), np.empty(0), points, np.zeros((4, 3, 3)), covariance
    ).least_nonlinear(axes)
    assert prior.is_relative == turns_together
    assert angle_rad < 0.1


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
def test_a_keyframes_motion_is_the_same_in_one_piece_or_several(axes):
    """A stretch without observations reaches the history in pieces."""
    rng, d, k = np.random.default_rng(0), axes.p, 6
    settings = Settings(
        linear_scale_stddev=(0.1, 0.1, 0.1),
        angular_bias_stddev=(0.0, 0.0, 0.1),
        velocity_delay_stddev=0.0,
    )
    V, dt_s = np.zeros((k, 6)), np.full(k, 0.2)
    V[:, axes.pose] = rng.normal(size=(k, d))
    gains = make_gains(replace(settings, two_d_mode=axes is PLANAR), np.eye(4))
    velocities = held(V, dt_s, random_covariances(rng, k, 6, 0.1))

    def keyframes(*cuts):
        calibration, pose = gains.calibration, np.eye(4)
        count = d + calibration.count
        start = Prior(np.eye(4), calibration.values, *NOTHING_KNOWN, np.eye(count))
        history = History(axes, ObservationNoise(settings), start, 'the start')
        for a, b in pairwise((0, *cuts, k)):
            interval = Interval(a * 2 * 10**8, b * 2 * 10**8, 0, 0, None)
            motion = gains.effect(pose, velocities, interval)
            history.move(pose, motion, np.zeros((calibration.count,) * 2), calibration)
            pose = motion.A
        history.add(Keyframe(0, *NOTHING), pose, calibration.values)
        return history.keyframes()

    whole, parts = keyframes(), keyframes(1, 3)
    np.testing.assert_allclose(parts.links.motions, whole.links.motions, atol=1e-12)
    np.testing.assert_allclose(parts.links.covariances, whole.links.covariances, atol=1e-12)
    np.testing.assert_allclose(parts.links.sensitivities, whole.links.sensitivities, atol=1e-12)
    assert (np.abs(whole.links.sensitivities).max(axis=(0, 1)) > 0.01).all()


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
@given(rng=generators())
def test_a_keyframe_has_all_that_the_calibration_does_to_its_motions(axes, rng):
    d = axes.p
    settings = Settings(linear_scale_stddev=(0.1, 0.1, 0.1), angular_bias_stddev=(0.0, 0.0, 0.1))
    calibration = Calibration(FilterArrays(np.eye(4)), settings, axes)
    c = calibration.count
    start = Prior(np.eye(4), calibration.values, *NOTHING_KNOWN, np.eye(d + c))
    history = History(axes, ObservationNoise(settings), start, 'the start')
    turn = np.zeros((3, 6))
    turn[:, axes.pose] = rng.normal(size=(3, d))
    poses = se3.exp(np.cumsum(turn, axis=0))
    noises = random_covariances(rng, 3, d, 0.1)
    sensitivities = rng.normal(size=(3, d, c))
    path = np.concatenate([np.eye(4)[None], poses])
    for part in range(3):
        motion = SimpleNamespace(
            A=path[part + 1], noise=noises[part], sensitivity=sensitivities[part]
        )
        history.move(path[part], motion, 0.1 * np.eye(c), calibration)
    history.add(Keyframe(0, *NOTHING), path[-1], calibration.values)
    history.add(Keyframe(1, *NOTHING), path[-1], calibration.values)  # nothing has moved since
    keyframes = history.keyframes()
    to_body = se3.adjoint(se3.inverse(path[-1]))[axes.pose, axes.pose]
    np.testing.assert_allclose(
        keyframes.links.sensitivities,
        [to_body @ sensitivities.sum(axis=0), np.zeros((d, c))],
        atol=1e-9,
    )
    expected = to_body @ noises.sum(axis=0) @ to_body.T
    np.testing.assert_allclose(keyframes.links.covariances[0], expected, atol=1e-9)
    np.testing.assert_array_equal(keyframes.links.covariances[1], 0.0)
    np.testing.assert_allclose(keyframes.drift_covariances, [0.3 * np.eye(c), np.zeros((c, c))])


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_smoothing_a_run_without_noise_returns_the_truth(two_d_mode):
    settings = Settings(two_d_mode=two_d_mode)
    world = drive(settings, 15.0, noise=0.0)
    smoothed = estimate(world, settings).smooth()
    assert len(smoothed.stamps_ns) == len(world.observations())
    np.testing.assert_allclose(smoothed.poses, world.poses[::OBSERVED_EVERY], atol=1e-6)
    np.testing.assert_allclose(smoothed.world_points, world.world_points[smoothed.ids], atol=1e-6)


def test_in_smoothing_too_a_point_counts_as_its_message_says():
    """Every second observation is a foot off, and says so."""
    still = (1e-4,) * 3
    settings = Settings(angular_velocity_noise=still, linear_velocity_noise=still)
    estimator, points = Estimator(settings), 4.0 * np.vstack([np.eye(3), -np.eye(3)])
    for step in range(20):
        estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
        off_m, sigma_m = (0.3, 0.5) if step % 2 else (0.0, 0.01)
        covariances = np.tile(sigma_m**2 * np.eye(3), (6, 1, 1))
        seen = points + off_m * points / 4.0
        estimator.add(ObservationEvent(step * 10**8, np.arange(6), seen, covariances))
    estimator.flush()
    np.testing.assert_allclose(estimator.smooth().world_points, points, atol=2e-3)


def test_relinearising_takes_the_noise_of_where_a_landmark_was_found_to_be(monkeypatch):
    """A stereo camera that has turned further than it knew errs along where it looks now."""
    noted, add = [], History.add

    def note(history, keyframe, *rest):
        noted.append(keyframe)
        add(history, keyframe, *rest)

    monkeypatch.setattr(History, 'add', note)
    settings = Settings(observation_model='stereo', reorder_window=0.0)
    settings = replace(settings, angular_velocity_noise=(0.3,) * 3)
    estimator = Estimator(settings)
    points = np.array([[4.0, 0.0, 0.0], [3.2, 2.4, 0.0], [3.2, 0.0, 2.4]])
    turned = points @ so3.exp(np.array([0.0, 0.0, 0.2]))
    creeps = np.array([0.0, 0.0, 0.0, 1e-9, 0.0, 0.0])  # exactly zero, it would stand
    for step, seen in enumerate([points, points, points, turned]):
        estimator.add(VelocityEvent(step * 10**9, creeps))
        estimator.add(ObservationEvent(step * 10**9, np.arange(3), seen))
    there = ObservationNoise(settings).covariances(ObservationEvent(0, np.arange(3), turned))
    taken = ObservationNoise(settings).at(noted[-1].lines_of_sight)
    np.testing.assert_allclose(taken, there, atol=0.1 * np.max(there))


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_in_smoothing_a_gross_outlier_counts_for_nothing(two_d_mode):
    settings = Settings(two_d_mode=two_d_mode)
    world = drive(settings, 10.0)

    def throw(index, event):
        is_off = (np.arange(len(event.ids)) == 1) & (index == 20)
        return replace(event, points=event.points + is_off[:, None] * [30.0, -20.0, 0.0])

    def omit(index, event):
        kept = (np.arange(len(event.ids)) != 1) | (index != 20)
        return replace(event, ids=event.ids[kept], points=event.points[kept])

    thrown = estimate(world.with_observations(throw), settings).smooth()
    omitted = estimate(world.with_observations(omit), settings).smooth()
    np.testing.assert_allclose(thrown.poses, omitted.poses, atol=1e-3)
    np.testing.assert_allclose(thrown.world_points, omitted.world_points, atol=1e-3)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_the_smoothed_estimate_beats_the_online_one(two_d_mode):
    settings = Settings(two_d_mode=two_d_mode)
    online_m, smoothed_m = [], []
    for seed in range(4):
        world = drive(settings, 20.0, seed)
        poses = {}
        estimator = estimate(
            world,
            settings,
            lambda update, poses=poses: poses.update({update.stamp_ns: update.pose}),
        )
        smoothed = estimator.smooth()
        stamps_ns = START_NS + STEP_NS * np.arange(len(world.poses))
        truth = Trajectory(stamps_ns, world.poses)
        online_run = Trajectory(np.array(list(poses)), np.array(list(poses.values())))
        smoothed_run = Trajectory(smoothed.stamps_ns, smoothed.poses)
        online_m.append(trajectory_errors(online_run, truth).ate_rmse_m)
        smoothed_m.append(trajectory_errors(smoothed_run, truth).ate_rmse_m)
    assert np.mean(smoothed_m) < 0.8 * np.mean(online_m)


@pytest.mark.parametrize('two_d_mode', [False, True])
@pytest.mark.parametrize('calibrated', [False, True])
def test_relinearising_a_piece_at_a_time_comes_to_what_all_of_it_says(two_d_mode, calibrated):
    settings = Settings(
        two_d_mode=two_d_mode,
        relinearization_interval=5,
        relinearization_angle=0.0,
        huber_threshold=0.0,
        linear_scale_stddev=(0.3 * calibrated,) * 3,
        angular_bias_stddev=(0.1 * calibrated,) * 3,
    )
    for seed in range(3):
        world = drive(settings, 30.0, seed, scale=1.0 + 0.2 * calibrated)
        estimator = estimate(world, settings)
        deviations_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
        shifts = estimator.world_points - estimator.smooth().world_points
        assert np.all(np.linalg.norm(shifts, axis=1) < 0.2 * deviations_m)


@pytest.mark.parametrize('max_landmarks', [0, 7])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_where_all_is_linear_relinearising_changes_nothing(two_d_mode, max_landmarks):
    exact = Settings(
        two_d_mode=two_d_mode,
        angular_velocity_noise=(3e-4,) * 3,
        linear_velocity_noise=(2e-4,) * 3,
        range_noise=1e-3,
        bearing_noise=3e-4,
        huber_threshold=0.0,
        relinearization_interval=0,
        max_landmarks=max_landmarks,
    )
    world = drive(exact, 20.0)
    plain = estimate(world, exact)
    assert (plain.counts['forgotten_landmark'] > 0) == (max_landmarks > 0)
    often = estimate(world, replace(exact, relinearization_interval=4, relinearization_angle=0.0))
    sigma_m = np.sqrt(plain.pose_covariance.diagonal()[3:].max())
    np.testing.assert_allclose(often.pose, plain.pose, atol=0.05 * sigma_m)
    np.testing.assert_allclose(often.world_points, plain.world_points, atol=0.1 * sigma_m)
    np.testing.assert_allclose(
        often.pose_covariance,
        plain.pose_covariance,
        rtol=0.05,
        atol=0.02 * np.abs(plain.pose_covariance).max(),
    )


@pytest.mark.parametrize(
    ('turns_rad', 'due_after'),
    [
        ([0.0] * 40, None),
        ([0.15] + [0.0] * 39, None),  # not far
        ([0.15, 0.15] + [0.0] * 38, 20),  # far enough together
        ([0.25] + [0.0] * 39, 2),  # all that follows would be linearised in the wrong place
    ],
)
def test_it_relinearises_after_turning_far_and_soon_after_one_large_turn(turns_rad, due_after):
    settings = Settings(relinearization_interval=20, relinearization_angle=0.2)
    riccati, before = make_gains(settings, np.eye(4)), se3.exp(np.arange(6.0))
    riccati.add_known(KnownLandmarks(np.eye(3), np.tile(np.eye(3), (3, 1, 1))))
    relinearisation = Relinearisation(riccati.errors, riccati.calibration, settings)
    one_point = np.array([0]), np.eye(3)[:1], np.eye(3)[:1], np.eye(3)[None], np.array([np.inf])
    summarised = []
    for turn_rad in turns_rad:
        turned = se3.exp(np.array([0.0, 0.0, turn_rad, 0.0, 0.0, 0.0])) @ before
        relinearisation.note_correction(before, turned)
        relinearisation.add(Keyframe(0, *one_point), in_doubt=False)
        summarised.append(relinearisation.history.summarised)
    assert max(summarised) == (due_after or 0)


def test_what_observations_leave_open_is_said_once_with_what_to_do(caplog, monkeypatch):
    monkeypatch.setattr(Smoother, 'smooth', Mock(side_effect=np.linalg.LinAlgError))
    settings = Settings(relinearization_angle=0.0)
    estimate(drive(settings, 10.0), settings)
    (warning,) = [text for text in caplog.messages if 'relinearise' in text]
    assert warning.startswith('Could not relinearise')
    assert warning.endswith('set two_d_mode: true for a robot on a floor.')


def test_odometry_that_knows_nothing_of_height_roll_and_pitch_can_be_relinearised(caplog):
    world = drive(Settings(two_d_mode=True), 10.0, seen=1)
    covariance = np.diag([1e12, 1e12, 1e-3, 1e-3, 1e-3, 1e12])
    estimator = Estimator(Settings(relinearization_angle=0.01))
    for event in world.events:
        is_velocity = isinstance(event, VelocityEvent)
        estimator.add(replace(event, covariance=covariance) if is_velocity else event)
    assert not caplog.messages
    assert np.isfinite(estimator.pose_covariance).all()


def test_observations_of_nothing_take_no_room_in_the_window_and_say_nothing():
    settings = Settings(relinearization_interval=10, relinearization_angle=0.0, smoothing_window=0)
    world = drive(settings, 15.0)
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 3))
    stamps_ns = range(START_NS + STEP_NS // 2, START_NS + 300 * STEP_NS, STEP_NS)
    events = world.events + [ObservationEvent(stamp_ns, *nothing) for stamp_ns in stamps_ns]
    events.sort(key=lambda event: event.stamp_ns)
    without = estimate(world, settings)
    estimator = estimate(replace(world, events=events), settings)
    smoothed, expected = estimator.smooth(), without.smooth()
    np.testing.assert_array_equal(smoothed.stamps_ns, expected.stamps_ns)
    np.testing.assert_allclose(smoothed.poses, expected.poses, atol=5e-3)
    np.testing.assert_allclose(estimator.pose, without.pose_at(estimator.stamp_ns), atol=5e-3)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_short_window_stays_close_to_an_unlimited_one(two_d_mode):
    settings = Settings(
        two_d_mode=two_d_mode,
        relinearization_interval=10,
        relinearization_angle=0.0,
        smoothing_window=0,
    )
    world = drive(settings, 30.0)
    unlimited = estimate(world, settings)
    short = estimate(world, replace(settings, smoothing_window=20))
    assert len(unlimited.smooth().stamps_ns) == len(world.observations())
    assert len(short.smooth().stamps_ns) < 20
    sigma_m = np.sqrt(unlimited.pose_covariance.diagonal()[3:])
    shift_m = np.abs(short.pose[:3, 3] - unlimited.pose[:3, 3])
    assert np.all(shift_m <= 0.5 * sigma_m)
    assert configuration_error_m(short, world) < 1.2 * configuration_error_m(unlimited, world)


def test_the_window_bounds_the_history_even_if_nothing_ever_turns():
    settings = Settings(smoothing_window=20, relinearization_angle=1e9)
    estimator = Estimator(settings)
    longest = 0
    for event in drive(settings, 15.0, noise=0.0).events:
        estimator.add(event)
        longest = max(longest, len(estimator.smooth().stamps_ns))
    assert 10 < longest < 20


@pytest.mark.parametrize('window', range(41, 48))
def test_a_landmark_that_moves_as_the_window_closes_stays_where_it_went(window):
    settings = Settings(
        smoothing_window=window,
        relinearization_interval=5,
        relinearization_angle=0.0,
        confirmations=1,
    )
    world = drive(settings, 15.0, landmarks=4)

    def move(index, event):
        """The landmark moves 6 m at observation 40 and is out of view from 46 on."""
        if index < 40:
            return event
        is_mover = event.ids == 2
        away = world.true_pose(event.stamp_ns)[:3, :3].T @ np.array([6.0, 0.0, 0.0])
        points = event.points + is_mover[:, None] * away
        kept = ~is_mover | (index < 45)
        return replace(event, ids=event.ids[kept], points=points[kept])

    estimator = estimate(world.with_observations(move), settings)
    assert estimator.counts['moved_landmark'] == 1
    point = estimator.world_points[list(estimator.landmark_ids).index(2)]
    expected = world.world_points[2] + [6.0, 0.0, 0.0]
    np.testing.assert_allclose(point, expected, atol=1.0)


def test_an_estimator_that_has_seen_nothing_has_nothing_to_smooth():
    smoothed = Estimator(Settings()).smooth()
    assert smoothed.poses.shape == (0, 4, 4)
    assert smoothed.world_points.shape == (0, 3)


@pytest.mark.parametrize(
    'changes',
    [
        {'gains': 'constant'},
        {'relinearization_interval': 0},
        {'landmark_velocity_stddev': 0.1},
    ],
)
def test_designs_that_keep_no_history_say_that_they_cannot_smooth(changes):
    settings = Settings(**changes)
    estimator = estimate(drive(settings, 2.0), settings)
    with pytest.raises(ParameterError, match='smooth'):
        estimator.smooth()


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_bias_that_drifts_is_followed_online_and_smoothed(two_d_mode):
    """Taken for constant, it bends the smoothed path; relinearising goes on, and helps."""
    drifting = Settings(
        two_d_mode=two_d_mode,
        angular_bias_stddev=(0.0, 0.0, 0.05),
        velocity_delay_stddev=0.0,
        calibration_drift=0.3,
        relinearization_interval=3,
        relinearization_angle=0.0,
    )
    world = drive(drifting, 60.0, noise=0.2, landmarks=20, seen=3)
    start_ns, end_ns = world.events[0].stamp_ns, world.events[-1].stamp_ns

    def biased(event):
        if not isinstance(event, VelocityEvent):
            return event
        bias = 0.1 * (event.stamp_ns - start_ns) / (end_ns - start_ns) - 0.05
        return replace(event, body_velocity=event.body_velocity - bias * np.eye(6)[2])

    world = replace(world, events=[biased(event) for event in world.events])
    estimator = estimate(world, drifting)
    constant = estimate(world, replace(drifting, calibration_drift=0.0))
    (bias,) = estimator.calibration
    assert abs(bias.value - 0.05) < 3.0 * bias.deviation < 0.09

    def error_m(estimator):
        smoothed = estimator.smooth()
        return np.abs(smoothed.poses - world.poses[::OBSERVED_EVERY])[:, :3, 3].max()

    assert error_m(estimator) < 0.5 * error_m(constant)


def test_forgotten_landmarks_leave_the_history_too():
    settings = Settings(
        relinearization_interval=10, relinearization_angle=0.0, smoothing_window=30
    )
    world = drive(settings, 15.0)
    estimator = Estimator(settings)
    for index, event in enumerate(world.events):
        estimator.add(event)
        if index in (100, 200, 250):
            assert estimator.forget(int(estimator.landmark_ids[1]))
    estimator.flush()
    assert configuration_error_m(estimator, world) < 0.5
    np.testing.assert_array_equal(estimator.smooth().ids, estimator.landmark_ids)
