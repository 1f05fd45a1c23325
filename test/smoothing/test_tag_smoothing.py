"""Smoothing and relinearising what is seen of tags' orientations, against a batch solution."""

from __future__ import annotations

from dataclasses import replace

from gain_worlds import drive, estimate
from hypothesis import given
import numpy as np
import pytest
from scipy.optimize import least_squares
from smoothing_problems import Problem
from strategies import generators

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Smoother
from slam_observer_ros.smoothing.keyframes import no_keyframes, SeenTurns, Solution
from slam_observer_ros.smoothing.observations import Observations
from slam_observer_ros.tracking.matching import flipped

SIGMA_RAD, SIGMA_M = 0.05, 0.05
TURN_NOISE, SPEED_NOISE = 0.1, 0.1  # rad/√s, m/√s
SETTINGS = Settings(
    use_tag_orientation=True,
    orientation_noise=SIGMA_RAD,
    observation_model='cartesian',
    point_noise=SIGMA_M,
    angular_velocity_noise=(TURN_NOISE,) * 3,
    linear_velocity_noise=(SPEED_NOISE,) * 3,
    huber_threshold=0.0,
    rejection_threshold=100.0,
    angular_bias_stddev=(0.0, 0.0, 0.0),
    velocity_delay_stddev=0.0,
    motion_noise_factor='stated',  # the batch has it so
    max_hypotheses=1,
    confirmations=1,
    reorder_window=0.0,
)
OFTEN = replace(SETTINGS, relinearization_interval=5, relinearization_angle=0.0)


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
@given(rng=generators())
def test_derivatives_of_an_orientation_seen_are_those_of_its_error(axes, rng):
    d, k, q = axes.p, axes.point, axes.turn

    def turned(vector):
        return so3.exp(axes.full_turns(vector.reshape(1, q)))

    def moved(solution, x):
        return replace(
            solution,
            poses=solution.poses @ se3.exp(axes.full_pose(x[:d])),
            orientations=turned(x[d + k :]) @ solution.orientations,
        )

    def error(solution):
        predicted = solution.poses[1, :3, :3].T @ solution.orientations
        return axes.turns(so3.log(predicted @ Z.swapaxes(1, 2)))[0]

    pose = se3.exp(axes.full_pose(rng.normal(size=d)))
    B, root = turned(rng.normal(size=q)), rng.normal(size=(q, q)) + 3.0 * np.eye(q)
    Z = pose[:3, :3].T @ B @ turned(rng.normal(size=q))
    W, point = root @ root.T, np.zeros((1, 3))
    keyframes = replace(
        no_keyframes(d, 0, k, q),
        keyframes=np.zeros(1, dtype=np.int64),
        landmarks=np.zeros(1, dtype=np.int64),
        points=point,
        information=np.zeros((1, k, k)),
        shares=np.ones(1),
        turns=SeenTurns(np.arange(1), Z, Z, W[None]),
    )
    solution = Solution(np.array([np.eye(4), pose]), np.empty((2, 0)), point, B)
    H, gradient = Observations(axes, keyframes, SETTINGS).normal_equations(solution, 0)
    steps = 1e-6 * np.eye(d + k + q)
    columns = [error(moved(solution, x)) - error(moved(solution, -x)) for x in steps]
    J = np.array(columns).T / 2e-6
    np.testing.assert_allclose(H[0], J.T @ W @ J, atol=1e-5 * np.trace(W))
    np.testing.assert_allclose(gradient[0], J.T @ W @ error(solution), atol=1e-5 * np.trace(W))


V = np.array([0.02, 0.01, 0.3, 0.5, 0.05, 0.02])
SECONDS, TAGS = 12, 4


def small_run(seed, turn_noise=TURN_NOISE):
    """One tag in view at a time, from a robot on a wavy round: events once a second."""
    rng = np.random.default_rng(seed)
    positions = np.array([[3.0, 2, 0], [0.0, 3, 1], [-1.0, -2, 0], [2.0, -2, -1]])
    tags = se3.pose(so3.exp(rng.normal(size=(TAGS, 3))), positions)
    noise = np.repeat([turn_noise, SPEED_NOISE], 3)
    pose, events = np.eye(4), []
    for second in range(SECONDS):
        measured = V + noise * rng.normal(size=6)
        events.append(VelocityEvent(second * 10**9, measured))
        number = (second // 2) % TAGS
        seen = se3.inverse(pose) @ tags[number]
        Z = seen[:3, :3] @ so3.exp(SIGMA_RAD * rng.normal(size=3))
        y = seen[:3, 3] + SIGMA_M * rng.normal(size=3)
        orientations = {'orientations': Z[None]}
        events.append(
            ObservationEvent(second * 10**9, np.array([number]), y[None], **orientations)
        )
        pose = pose @ se3.exp(V)
    return events


def batch_solution(events, poses, tags):
    """Least squares over the poses and tags (…, 4, 4), from those given; the first stays."""
    velocities = [event.body_velocity for event in events if isinstance(event, VelocityEvent)]
    seen = [event for event in events if isinstance(event, ObservationEvent)]
    Q = np.diag(np.repeat([TURN_NOISE, SPEED_NOISE], 3) ** 2)

    def moved(x):
        eta = np.concatenate([np.zeros((1, 6)), x[: 6 * (len(seen) - 1)].reshape(-1, 6)])
        xi = x[6 * (len(seen) - 1) :].reshape(-1, 6)
        return poses @ se3.exp(eta), tags @ se3.exp(xi)

    def residuals(x):
        P, T = moved(x)
        found = []
        for k, V_k in enumerate(velocities[: len(seen) - 1]):
            # The noise of a motion is the mean of that at its two ends.
            Ad = se3.adjoint(se3.exp(-V_k))
            covariance = 0.5 * (Q + Ad @ Q @ Ad.T)
            error = se3.log(se3.inverse(P[k] @ se3.exp(V_k)) @ P[k + 1])
            found.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
        for k, event in enumerate(seen):
            relative = se3.inverse(P[k]) @ T[event.ids[0]]
            turn = so3.log(relative[:3, :3] @ event.orientations[0].T)
            shift = relative[:3, 3] - event.points[0]
            found += [turn / SIGMA_RAD, shift / SIGMA_M]
        return np.concatenate(found)

    size = 6 * (len(seen) - 1 + len(tags))
    return moved(least_squares(residuals, np.zeros(size), '3-point', method='lm').x)


def run(events, settings):
    estimator = Estimator(settings)
    for event in events:
        assert estimator.add(event)
    estimator.flush()
    return estimator


@pytest.mark.parametrize('seed', range(2))
def test_the_smoothed_run_is_the_batch_solution(seed):
    events = small_run(seed)
    smoothed = run(events, SETTINGS).smooth()
    start = se3.pose(smoothed.orientations, smoothed.world_points)
    order = np.argsort(smoothed.ids)
    poses, tags = batch_solution(events, smoothed.poses, start[order])
    np.testing.assert_allclose(smoothed.poses, poses, atol=1e-5)
    np.testing.assert_allclose(smoothed.orientations[order], tags[:, :3, :3], atol=1e-5)
    np.testing.assert_allclose(smoothed.world_points[order], tags[:, :3, 3], atol=1e-5)


def test_relinearising_comes_much_closer_to_the_batch_solution():
    """Whose smoothed poses are it, as the test before shows."""
    misses_sigma = {0: [], 1: []}
    shaky = replace(OFTEN, angular_velocity_noise=(0.3,) * 3)
    for seed in range(5):
        events = small_run(seed, turn_noise=0.3)
        batch = run(events, shaky).smooth().poses[-1]
        for interval, misses in misses_sigma.items():
            estimator = run(events, replace(shaky, relinearization_interval=interval))
            miss = se3.log(se3.inverse(batch) @ estimator.pose_at(events[-1].stamp_ns))
            sigmas = np.sqrt(np.diagonal(estimator.pose_covariance))
            misses.append(np.max(np.abs(miss) / sigmas))
    plain, relinearised = (np.sqrt(np.mean(np.square(found))) for found in misses_sigma.values())
    assert relinearised < 0.5
    assert relinearised < 0.5 * plain


def tag_world(settings, duration_s, seed=0, sigma_rad=SIGMA_RAD, seen=2):
    """A run among tags; in the plane they turn about z."""
    world, rng = drive(settings, duration_s, seed, seen=seen), np.random.default_rng(seed + 1)
    upright = np.array([0.0, 0.0, 1.0]) if settings.two_d_mode else np.ones(3)
    tags = so3.exp(rng.normal(size=(len(world.world_points), 3)) * upright)

    def with_orientations(_, event):
        noise = so3.exp(sigma_rad * upright * rng.normal(size=(len(event.ids), 3)))
        R = world.true_pose(event.stamp_ns)[:3, :3]
        return replace(event, orientations=R.T @ tags[event.ids] @ noise)

    return world.with_observations(with_orientations), tags


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_where_all_is_linear_relinearising_changes_nothing(two_d_mode):
    exact = replace(
        SETTINGS,
        two_d_mode=two_d_mode,
        angular_velocity_noise=(3e-4,) * 3,
        linear_velocity_noise=(2e-4,) * 3,
        point_noise=1e-3,
        orientation_noise=1e-3,
    )
    world, _ = tag_world(exact, 20.0, sigma_rad=1e-3)
    plain = estimate(world, replace(exact, relinearization_interval=0))
    often = estimate(world, replace(exact, relinearization_interval=4, relinearization_angle=0.0))
    sigmas = np.sqrt(plain.pose_covariance.diagonal())
    sigma_m = np.max(sigmas[3:])
    np.testing.assert_allclose(often.pose, plain.pose, atol=0.05 * sigma_m)
    np.testing.assert_allclose(often.world_points, plain.world_points, atol=0.1 * sigma_m)
    np.testing.assert_allclose(
        often.pose_covariance,
        plain.pose_covariance,
        rtol=0.05,
        atol=0.02 * np.abs(plain.pose_covariance).max(),
    )
    before, after = plain.landmark_map, often.landmark_map
    np.testing.assert_allclose(after.orientations, before.orientations, atol=2e-4)
    np.testing.assert_allclose(after.orientation_sigmas, before.orientation_sigmas, rtol=0.05)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_relinearising_a_piece_at_a_time_comes_to_what_all_of_it_says(two_d_mode):
    settings = replace(OFTEN, two_d_mode=two_d_mode)
    for seed in range(2):
        world, _ = tag_world(settings, 20.0, seed)
        estimator = estimate(world, settings)
        smoothed, online = estimator.smooth(), estimator.landmark_map
        deviations_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
        shifts = estimator.world_points - smoothed.world_points
        assert np.all(np.linalg.norm(shifts, axis=1) < 0.2 * deviations_m)
        turns = so3.log(online.orientations @ smoothed.orientations.swapaxes(1, 2))
        assert np.all(np.linalg.norm(turns, axis=1) < 0.3 * online.orientation_sigmas)


def test_a_flipped_orientation_counts_for_nothing():
    world, tags = tag_world(SETTINGS, 15.0)

    def with_flips(index, event):
        is_flipped = (index % 10 == 7) & (np.arange(len(event.ids)) == 0)
        twins = flipped(event.orientations, event.points)
        Z = np.where(is_flipped[:, None, None], twins, event.orientations)
        return replace(event, orientations=Z)

    def without(index, event):
        is_left_out = (index % 10 == 7) & (np.arange(len(event.ids)) == 0)
        Z = np.where(is_left_out[:, None, None], 0.0, event.orientations)
        return replace(event, orientations=Z)

    thrown = estimate(world.with_observations(with_flips), SETTINGS).smooth()
    omitted = estimate(world.with_observations(without), SETTINGS).smooth()
    np.testing.assert_allclose(thrown.poses, omitted.poses, atol=1e-4)
    np.testing.assert_allclose(thrown.orientations, omitted.orientations, atol=1e-4)
    turns = so3.log(thrown.orientations @ tags[thrown.ids].swapaxes(1, 2))
    assert np.max(np.abs(turns)) < 0.3


def test_an_orientation_that_was_wrong_at_first_is_forgotten_by_the_history():
    world, tags = tag_world(OFTEN, 15.0)

    def with_flips(index, event):
        is_flipped = (index == 0) & (event.ids == event.ids[0])
        twins = flipped(event.orientations, event.points)
        Z = np.where(is_flipped[:, None, None], twins, event.orientations)
        return replace(event, orientations=Z)

    estimator = estimate(world.with_observations(with_flips), OFTEN)
    assert estimator.counts['rejected_orientation'] > 0
    smoothed = estimator.smooth()
    for found, ids in (
        (smoothed.orientations, smoothed.ids),
        (estimator.landmark_map.orientations, estimator.landmark_map.ids),
    ):
        turns = so3.log(found @ tags[ids].swapaxes(1, 2))
        assert np.max(np.abs(turns)) < 0.3


def test_points_and_tags_are_smoothed_together():
    world, tags = tag_world(OFTEN, 15.0)

    def some_are_points(_, event):
        Z = np.where((event.ids % 2 == 0)[:, None, None], event.orientations, 0.0)
        return replace(event, orientations=Z)

    smoothed = estimate(world.with_observations(some_are_points), OFTEN).smooth()
    are_tags = smoothed.ids % 2 == 0
    assert not smoothed.orientations[~are_tags].any()
    turns = so3.log(smoothed.orientations[are_tags] @ tags[smoothed.ids[are_tags]].swapaxes(1, 2))
    assert np.max(np.abs(turns)) < 0.3
    misses_m = np.linalg.norm(smoothed.world_points - world.world_points[smoothed.ids], axis=1)
    assert np.max(misses_m) < 1.0


def test_a_tag_that_is_seen_turned_only_later_has_its_orientation_then():
    """As a point it is in summaries that know nothing of how it is turned."""
    world, tags = tag_world(OFTEN, 15.0)

    def turned_later(index, event):
        return event if index >= 30 else replace(event, orientations=None)

    estimator = estimate(world.with_observations(turned_later), OFTEN)
    known = estimator.landmark_map
    are_tags = known.orientations.any(axis=(1, 2))
    turns = so3.log(known.orientations[are_tags] @ tags[known.ids[are_tags]].swapaxes(1, 2))
    assert np.all(np.linalg.norm(turns, axis=1) < 5.0 * known.orientation_sigmas[are_tags])
    assert np.max(known.orientation_sigmas) < 0.5


@pytest.mark.parametrize('axes', [PLANAR, SPATIAL])
def test_what_is_off_since_the_map_has_moved_is_not_taken_for_outliers(axes):
    """As after a loop was closed: the poses are those before, the map is that since."""
    problem = Problem(axes, 0, seed=3, tags=True)
    gated = replace(problem.settings, huber_threshold=1.345, rejection_threshold=6.0)
    smoother = Smoother(axes, problem.prior, problem.keyframes, gated)
    solution = smoother.smooth(problem.start, 100, 1e-9).end
    moved = axes.full_points(np.full(axes.point, 5.0))
    start = replace(problem.start, poses=problem.start.poses.copy())
    start.poses[2:, :3, 3] += moved

    def miss_m(begin):
        return np.max(np.abs(smoother.smooth(begin, 2, 0.0).end.poses - solution.poses))

    assert miss_m(smoother.ungated(start)) < 0.5 * miss_m(start)
    np.testing.assert_array_equal(smoother.ungated(solution).poses, solution.poses)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_camera_that_is_askew_is_found_by_how_tags_are_turned_too(two_d_mode):
    stated = np.array([0.0, 0.0, 0.05]) if two_d_mode else np.full(3, 0.05)
    settings = replace(
        OFTEN,
        two_d_mode=two_d_mode,
        sensor_rotation_stddev=tuple(stated),
        orientation_noise=0.01,
        point_noise=0.01,
        angular_velocity_noise=(0.02,) * 3,
        linear_velocity_noise=(0.02,) * 3,
    )
    world, _ = tag_world(settings, 30.0, sigma_rad=0.01)
    askew = so3.exp(np.where(stated > 0.0, [0.02, -0.03, 0.04], 0.0))

    def shown(_, event):
        orientations = askew.T @ event.orientations
        return replace(event, points=event.points @ askew, orientations=orientations)

    estimator = estimate(world.with_observations(shown), settings)
    truth = so3.log(askew)[stated > 0.0]
    for part, turned in zip(estimator.calibration, truth, strict=True):
        assert abs(part.value - turned) < 3.5 * part.deviation
        assert part.deviation < 0.2 * part.stated
    deviations_m = np.sqrt(np.trace(estimator.landmark_covariances, axis1=1, axis2=2))
    shifts = estimator.world_points - estimator.smooth().world_points
    assert np.all(np.linalg.norm(shifts, axis=1) < 0.5 * deviations_m)
