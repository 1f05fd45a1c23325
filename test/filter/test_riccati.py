"""Riccati gains: honest covariances, an unobservable gauge, planar exactness, long runs."""

from __future__ import annotations

from dataclasses import replace
import tracemalloc

from gain_worlds import drive, estimate
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_runs import (
    covariance_of_all,
    observe,
    PLAIN,
    propagate,
    random_covariances,
    random_step,
    residuals_of,
)
import slam_group
from strategies import generators, poses

from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.filter import core
from slam_observer_ros.filter import step as filter_step
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.observer import Observer
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.axes import PLANAR, SPATIAL
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.smoothing.gauss_newton import Smoother
from slam_observer_ros.tracking.state import Association, State
from slam_observer_ros.tracking.step import observe as observe_by_state

CALIBRATED = replace(PLAIN, angular_bias_stddev=(0.02,) * 3, linear_scale_stddev=(0.1,) * 3)


def started(rng, settings=PLAIN, n=4):
    """A filter that has seen n landmarks, then moved and seen some of them again."""
    riccati = make_gains(settings, np.eye(4))
    riccati.add(rng.normal(scale=4.0, size=(n, 3)), 0.01 * random_covariances(rng, n, 3))
    for _ in range(5):
        random_step(riccati, rng, 1e-4, 1e-2)
    return riccati


def predicted_covariance(riccati, residuals):
    """S (3, 3) of the only residual, from the Mahalanobis distances of small residuals."""
    scale = 1e-6  # what a residual is judged by depends a little on where it leads to

    def squared(r):
        y_ref, r = residuals.e - residuals.r, scale * r
        return (riccati.distances(replace(residuals, e=y_ref + r, r=r))[0] / scale) ** 2

    axes = np.eye(3)[:, None]
    information = [[0.5 * (squared(i + j) - squared(i) - squared(j)) for j in axes] for i in axes]
    return np.linalg.inv(information)


def constant_output_matrix(n):
    """H_i = [0 I 0 … −I … 0] of n landmarks that are all seen, (3 n, 6 + 3 n)."""
    return np.hstack([np.kron(np.ones((n, 1)), np.eye(3, 6, 3)), -np.eye(3 * n)])


def output_matrix_of(riccati, rows):
    """The H by which a filter corrects for landmarks at ``rows``: H P where P is I."""
    residuals = residuals_of(riccati, rows, riccati.observer.body_points(rows), np.eye(3))
    riccati.joint.P = np.eye(len(riccati.joint.P))
    return riccati.joint.project(riccati.joint.output_matrix(residuals), rows)[0]


def residual_after(truth, x):
    """Residuals (3 n,) of what is seen from ``truth``, by an estimate that is off by exp(x)."""
    n = len(truth.points)
    error = slam_group.exp(x[:6], x[6:].reshape(n, 3))
    estimate = Observer(np.eye(4))
    estimate.add_reference_landmarks(se3.rotate(error.A, truth.points) + error.a)
    estimate.A[...] = error.A @ truth.A
    return estimate.errors(slice(None), truth.body_points(np.arange(n)))[1].ravel()


@given(generators())
def test_residual_is_linear_in_the_error_with_the_constant_output_matrix(rng):
    riccati, n, h = started(rng), 4, 1e-6
    H, truth = constant_output_matrix(n), riccati.observer
    columns = [
        (residual_after(truth, h * x) - residual_after(truth, -h * x)) / (2 * h)
        for x in np.eye(6 + 3 * n)
    ]
    np.testing.assert_allclose(np.array(columns).T, H, atol=1e-7)
    np.testing.assert_array_equal(output_matrix_of(riccati, np.arange(n)), H)


@given(generators())
def test_residual_of_any_error_is_linear_but_for_the_left_jacobian(rng):
    """r_i = J(ε_Ω) (ε_v − ξ_i): the output matrix misses nothing but the left Jacobian."""
    truth, n = started(rng).observer, 4
    x = rng.normal(size=6 + 3 * n)
    expected = (constant_output_matrix(n) @ x).reshape(n, 3) @ so3.left_jacobian(x[:3]).T
    np.testing.assert_allclose(residual_after(truth, x), expected.ravel(), atol=1e-11)


@given(generators())
def test_the_gauge_is_exactly_in_the_null_space_of_the_output_matrix(rng):
    riccati, n = started(rng), 4
    truth, G = riccati.observer, riccati.joint.chart.gauge(n)
    everything_moved = G @ rng.normal(size=6)
    np.testing.assert_allclose(residual_after(truth, everything_moved), 0.0, atol=1e-12)
    rows = np.sort(rng.permutation(n)[: rng.integers(1, n + 1)])
    np.testing.assert_array_equal(output_matrix_of(riccati, rows) @ G, 0.0)


@given(generators())
def test_prediction_is_the_covariance_of_noisy_motions_composed(rng):
    pieces, dt_s = 20, 0.01
    V = rng.normal(size=(pieces, 6))
    Q = 1e-2 * random_covariances(rng, pieces, 6)
    riccati = make_gains(PLAIN, np.eye(4))
    riccati.observer.A[...] = start = se3.exp(rng.normal(size=6))
    propagate(riccati, V, np.full(pieces, dt_s), Q)

    def error(piece, w):
        twists = V * dt_s
        twists[piece] += w
        pose = start
        for motion in se3.exp(twists):
            pose = pose @ motion
        return se3.log(pose @ se3.inverse(riccati.observer.A))

    expected = np.zeros((6, 6))
    for piece in range(pieces):
        F = np.array([error(piece, 1e-6 * w) / 1e-6 for w in np.eye(6)]).T
        expected += F @ Q[piece] @ F.T
    # A rate's noise is taken to act at the piece's beginning, not throughout: hence 2 %.
    difference = np.linalg.norm(riccati.errors.pose_covariance() - expected)
    assert difference < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_a_velocity_known_in_the_world_stays_known_while_the_robot_turns_unsurely(two_d_mode):
    velocity = np.array([[1.0, -2.0, 0.0 if two_d_mode else 0.5]])
    start = np.array([[3.0, 1.0, 0.0]])
    dt_s, V, Q = np.full(2, 0.5), np.zeros((2, 6)), np.tile(1e-3 * np.eye(6), (2, 1, 1))

    def predicted(point, velocity):
        """The covariances of the residual after two blind motions of a second each."""
        settings = replace(PLAIN, two_d_mode=two_d_mode, landmark_velocity_stddev=1e-9)
        riccati = make_gains(settings, np.eye(4))
        riccati.add(point, np.zeros((1, 3, 3)))
        riccati.observer.set_landmark_velocities(np.array([0]), velocity)
        propagate(riccati, V, dt_s, Q)
        propagate(riccati, V, dt_s, Q)
        rows = np.array([0])
        points = riccati.observer.body_points(rows)
        return riccati.errors.predicted(residuals_of(riccati, rows, points, np.zeros((1, 3, 3))))

    with_pose, own = predicted(start, velocity)
    with_pose_at_rest, own_at_rest = predicted(start + 2.0 * velocity, np.zeros((1, 3)))
    np.testing.assert_allclose(own, own_at_rest, atol=1e-12)
    np.testing.assert_allclose(with_pose, with_pose_at_rest, atol=1e-12)


@pytest.mark.parametrize('landmarks', [50, 200])
def test_an_observation_needs_no_more_memory_than_a_few_times_that_of_the_covariance(landmarks):
    """With the motion that leads to it: no other matrix is as large for more than a moment."""
    rng, rows = np.random.default_rng(0), np.arange(10)
    riccati = make_gains(PLAIN, np.eye(4))
    points = rng.normal(size=(landmarks, 3))
    riccati.add(points, random_covariances(rng, landmarks, 3))
    V, Q = rng.normal(size=(3, 6)), random_covariances(rng, 3, 6)
    seen = ObservationEvent(0, rows, points[rows], random_covariances(rng, len(rows), 3))
    one = Association(State(riccati, PLAIN), seen, rows)
    tracemalloc.start()
    propagate(riccati, V, np.full(3, 0.1), Q)
    assert observe_by_state(one)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * riccati.joint.P.nbytes


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_predicted_residual_covariance_matches_monte_carlo(two_d_mode):
    rng = np.random.default_rng(0)
    axes = PLANAR if two_d_mode else SPATIAL
    runs, pieces, k = 20_000, 5, axes.point
    V = np.zeros((pieces, 6))
    V[:, axes.pose] = rng.normal(size=(pieces, axes.p))
    Q = np.zeros((6, 6))
    Q[axes.pose, axes.pose] = 1e-4 * np.eye(axes.p)
    R = np.diag([1e-3, 2e-3, 3e-3])
    point = np.array([[2.0, -1.0, 0.0 if two_d_mode else 0.5]])
    riccati = make_gains(replace(PLAIN, two_d_mode=two_d_mode), np.eye(4))
    riccati.add(point, R[None])
    propagate(riccati, V, np.full(pieces, 0.1), np.tile(Q, (pieces, 1, 1)))
    seen = se3.transform(se3.inverse(riccati.observer.A), point)

    noise = np.sqrt(np.diag(Q)) * rng.normal(size=(runs, pieces, 6))
    estimated = np.tile(np.eye(4), (runs, 1, 1))
    for piece in range(pieces):
        estimated = estimated @ se3.exp(V[piece] * 0.1 + noise[:, piece])
    first, second = np.sqrt(np.diag(R)) * rng.normal(size=(2, runs, 3))
    residuals = se3.transform(estimated, (seen + second)[:, None])[:, 0] - (point + first)
    sampled = np.cov(residuals[:, :k].T)
    residuals = residuals_of(riccati, np.array([0]), seen, R[None])
    if two_d_mode:
        predicted = riccati.errors.predicted(residuals)[1] + residuals.covariances[0, :2, :2]
    else:
        predicted = predicted_covariance(riccati, residuals)
    whitening = np.linalg.inv(np.linalg.cholesky(predicted))
    np.testing.assert_allclose(whitening @ sampled @ whitening.T, np.eye(k), atol=0.05)


@given(generators())
def test_observations_never_determine_where_the_worlds_frame_is(rng):
    seed = rng.integers(2**32)
    unsure_of_frame = random_covariances(rng, 1, 6)[0]

    def run(frame_covariance):
        random = np.random.default_rng(seed)
        riccati = make_gains(PLAIN, np.eye(4))
        riccati.set_pose(np.eye(4), frame_covariance)
        points = random.normal(scale=4.0, size=(4, 3))
        riccati.add(points, 0.01 * random_covariances(random, 4, 3))
        for _ in range(20):
            random_step(riccati, random, 1e-4, 1e-2)
        return riccati

    sure, unsure = run(np.zeros((6, 6))), run(unsure_of_frame)
    np.testing.assert_allclose(unsure.observer.A, sure.observer.A, atol=1e-9)
    np.testing.assert_allclose(unsure.observer.a, sure.observer.a, atol=1e-8)
    gauge = np.vstack([np.eye(6), SPATIAL.output_matrix(sure.observer.points).reshape(-1, 6)])
    expected = covariance_of_all(sure) + gauge @ unsure_of_frame @ gauge.T
    np.testing.assert_allclose(covariance_of_all(unsure), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('point_variance_exponents', [(-8.0, 2.0), (-8.0, -8.0), (2.0, 2.0)])
def test_covariance_stays_symmetric_and_positive_over_many_steps_of_any_noise(
    point_variance_exponents,
):
    rng = np.random.default_rng(4)
    riccati = make_gains(PLAIN, np.eye(4))
    riccati.add(rng.normal(scale=4.0, size=(3, 3)), np.tile(1e-2 * np.eye(3), (3, 1, 1)))
    steps, dt_s = 3_000, np.ones(1)
    V = rng.normal(size=(steps, 1, 6)) * [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]
    Q = 10.0 ** rng.uniform(-10.0, -2.0, (steps, 1, 6, 1)) * np.eye(6)
    R = 10.0 ** rng.uniform(*point_variance_exponents, (steps, 1, 1, 1)) * np.eye(3)
    for step in range(steps):
        propagate(riccati, V[step], dt_s, Q[step])
        seen = np.array([step // 7 % 3])
        points = riccati.observer.body_points(seen) + np.sqrt(R[step, :, 0, 0]) * rng.normal(
            size=(1, 3)
        )
        observe(riccati, seen, points, R[step])
        if step % 200 == 0:
            for P in (riccati.joint.P, covariance_of_all(riccati)):
                np.testing.assert_allclose(P, P.T, rtol=0.0, atol=1e-15 * np.abs(P).max())
                deviations = np.sqrt(np.diag(P))
                correlations = P / np.outer(deviations, deviations)
                assert np.linalg.eigvalsh(correlations)[0] > -1e-9
    R_hat = riccati.observer.A[:3, :3]
    np.testing.assert_allclose(R_hat.T @ R_hat, np.eye(3), atol=1e-14)


@given(generators())
def test_an_observation_never_adds_uncertainty(rng):
    riccati = started(rng)
    before = riccati.joint.P.copy()
    points = rng.normal(scale=4.0, size=(2, 3))
    observe(riccati, np.array([1, 3]), points, random_covariances(rng, 2, 3))
    assert np.linalg.eigvalsh(before - riccati.joint.P)[0] > -1e-12


@given(generators(), st.lists(st.integers(0, 3), min_size=1, max_size=3, unique=True))
def test_removing_landmarks_leaves_the_marginal_of_the_others(rng, removed):
    riccati = started(rng)
    kept = np.setdiff1d(np.arange(4), removed)
    pose, others = riccati.errors.pose_covariance(), riccati.joint_covariance(kept)
    points = riccati.observer.points[kept]
    riccati.remove(np.array(removed))
    np.testing.assert_array_equal(riccati.errors.pose_covariance(), pose)
    np.testing.assert_array_equal(riccati.observer.points, points)
    np.testing.assert_array_equal(covariance_of_all(riccati), others)


@given(generators())
def test_a_landmark_that_is_relocated_is_as_new_and_the_others_stay(rng):
    seed = rng.integers(2**32)
    relocated, added = (started(np.random.default_rng(seed)) for _ in range(2))
    point, R = rng.normal(size=(1, 3)), random_covariances(rng, 1, 3)
    relocated.relocate(np.array([1]), point, R)
    added.remove(np.array([1]))
    added.add(point, R)
    order = np.array([0, 3, 1, 2])  # the one added last stands where the other one stood
    np.testing.assert_allclose(
        covariance_of_all(relocated), added.joint_covariance(order), atol=1e-12
    )
    np.testing.assert_array_equal(
        relocated.errors.pose_covariance(), added.errors.pose_covariance()
    )


def test_in_an_exact_map_nothing_is_known_of_pose_and_landmarks_together():
    riccati = make_gains(PLAIN, np.eye(4))
    riccati.fix_landmarks(KnownLandmarks(np.eye(3), np.tile(0.01 * np.eye(3), (3, 1, 1))))
    assert riccati.joint_covariance(np.arange(3)) is None


def tilted(event):
    """The event with what a planar robot can't do: roll, pitch, climb, landmarks at heights."""
    if isinstance(event, VelocityEvent):
        return replace(event, body_velocity=event.body_velocity + [0.1, -0.2, 0, 0, 0, 0.3])
    heights = np.arange(len(event.ids))[:, None] * [0.0, 0.0, 1.0]
    return ObservationEvent(event.stamp_ns, event.ids, event.points + heights)


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
def test_planar_mode_is_planar_to_the_bit(gains):
    settings = Settings(
        gains=gains, two_d_mode=True, relinearization_interval=10, relinearization_angle=0.0
    )
    world = drive(settings, 15.0)
    poses_seen = []
    estimator = estimate(
        replace(world, events=[tilted(event) for event in world.events]),
        settings,
        lambda update: poses_seen.append(update.pose),
    )
    flat = np.array(poses_seen)
    np.testing.assert_array_equal(flat[:, 2], np.tile([0.0, 0.0, 1.0, 0.0], (len(flat), 1)))
    np.testing.assert_array_equal(flat[:, :2, 2], 0.0)
    np.testing.assert_array_equal(estimator.world_points[:, 2], 0.0)
    if gains == 'riccati':
        np.testing.assert_array_equal(estimator.pose_covariance[[0, 1, 5]], 0.0)
        np.testing.assert_array_equal(estimator.landmark_covariances[:, 2], 0.0)


@pytest.mark.parametrize('gains', ['constant', 'riccati'])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_the_estimate_of_a_moved_world_is_the_moved_estimate(gains, two_d_mode):
    settings = Settings(
        gains=gains, two_d_mode=two_d_mode, relinearization_interval=10, relinearization_angle=0.0
    )
    world = drive(settings, 10.0)
    twist = np.array([0.0, 0.0, 2.0, 30.0, -40.0, 0.0])
    G = se3.exp(twist if two_d_mode else twist + [0.5, -0.7, 0.0, 0.0, 0.0, 5.0])
    here, there = estimate(world, settings), estimate(world, settings, initial_pose=G)
    np.testing.assert_allclose(there.pose, G @ here.pose, atol=1e-9)
    np.testing.assert_allclose(there.world_points, se3.transform(G, here.world_points), atol=1e-9)
    if gains == 'riccati':
        R = G[:3, :3]
        turn = np.kron(np.eye(2), R)
        np.testing.assert_allclose(
            there.pose_covariance, turn @ here.pose_covariance @ turn.T, atol=1e-12
        )
        np.testing.assert_allclose(
            there.landmark_covariances, R @ here.landmark_covariances @ R.T, atol=1e-12
        )


@given(poses(), generators())
def test_pose_covariance_is_that_of_rotation_and_position_in_the_world(initial_pose, rng):
    settings = Settings(relinearization_interval=0, velocity_delay_stddev=0.0)
    world = drive(settings, 2.0, seed=int(rng.integers(1000)))
    estimator = estimate(world, settings, initial_pose=initial_pose)
    pose, filter_ = estimator.pose, estimator._state.gains

    def shift(x):
        moved = initial_pose @ se3.exp(x) @ filter_.observer.A
        turn = se3.log(moved @ se3.inverse(pose))[:3]
        return np.concatenate([turn, moved[:3, 3] - pose[:3, 3]])

    h = 1e-6
    F = np.array([(shift(h * x) - shift(-h * x)) / (2 * h) for x in np.eye(6)]).T
    expected = F @ filter_.errors.pose_covariance() @ F.T
    np.testing.assert_allclose(estimator.pose_covariance, expected, rtol=1e-6, atol=1e-9)


def test_the_order_of_landmarks_in_a_message_does_not_matter():
    settings = Settings(relinearization_interval=10, relinearization_angle=0.0)
    world = drive(settings, 10.0)

    def reversed_order(index, event):
        return replace(event, ids=event.ids[::-1], points=event.points[::-1])

    one = estimate(world, settings)
    other = estimate(world.with_observations(reversed_order), settings)
    rows = np.argsort(one.landmark_ids), np.argsort(other.landmark_ids)
    np.testing.assert_allclose(other.pose, one.pose, atol=1e-9)
    np.testing.assert_allclose(other.world_points[rows[1]], one.world_points[rows[0]], atol=1e-9)


def test_a_robot_that_turned_further_than_it_knows_does_not_reject_what_it_sees():
    riccati = make_gains(PLAIN, np.eye(4))
    riccati.add(np.array([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]]), np.tile(1e-4 * np.eye(3), (2, 1, 1)))
    # It takes itself to be at rest, but may have turned by 0.3 rad; it has turned by 0.6.
    Q = np.diag([1e-8, 1e-8, 0.3**2, 1e-4, 1e-4, 1e-4])
    propagate(riccati, np.zeros((1, 6)), np.ones(1), Q[None])
    turned = se3.exp(np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0]))
    seen = se3.transform(se3.inverse(turned), np.array([[5.0, 0.0, 0.0]]))
    residuals = residuals_of(riccati, np.array([0]), seen, 1e-4 * np.eye(3)[None])
    assert riccati.distances(residuals)[0] == pytest.approx(2.0, abs=0.1)


class Relinearisations:
    """How many keyframes were relinearised each time; the first ``failures`` times fail."""

    def __init__(self, monkeypatch, failures=0):
        self.keyframes = []
        smooth = Smoother.smooth

        def noted(smoother, start, *rest):
            self.keyframes.append(len(start.poses) - 1)
            if len(self.keyframes) <= failures:
                raise np.linalg.LinAlgError
            return smooth(smoother, start, *rest)

        monkeypatch.setattr(Smoother, 'smooth', noted)


def test_what_was_relinearised_once_is_not_relinearised_again(monkeypatch):
    relinearised = Relinearisations(monkeypatch)
    settings = Settings(relinearization_interval=2, relinearization_angle=0.0)
    world = drive(settings, 30.0)
    estimate(world, settings)
    assert len(relinearised.keyframes) > 10
    assert np.sum(relinearised.keyframes) <= len(world.observations())
    assert np.all(relinearised.keyframes >= np.maximum(2, 0.1 * np.cumsum(relinearised.keyframes)))


@pytest.mark.parametrize('turn_rad', [0.0, 100.0])
def test_a_landmark_that_is_often_in_doubt_does_not_keep_the_rest_from_being_summed_up(
    monkeypatch, turn_rad
):
    relinearised = Relinearisations(monkeypatch)
    settings = Settings(relinearization_interval=20, relinearization_angle=turn_rad)

    def swing(index, event):
        """Landmark 0, a door, is elsewhere in every other ten observations."""
        is_open = (event.ids == 0) & (index // 10 % 2 == 1)
        return replace(event, points=event.points + is_open[:, None] * [2.0, 2.0, 0.0])

    world = drive(settings, 60.0, landmarks=4).with_observations(swing)
    estimator = estimate(world, settings)
    assert estimator.counts['moved_landmark'] >= 5
    assert max(relinearised.keyframes) < 100
    assert np.sum(relinearised.keyframes) < 4 * len(world.observations())


def test_what_relinearising_failed_for_is_relinearised_later(monkeypatch):
    relinearised = Relinearisations(monkeypatch, failures=2)
    settings = Settings(relinearization_interval=20, relinearization_angle=0.0)
    estimate(drive(settings, 30.0), settings)
    assert relinearised.keyframes[:4] == [20, 40, 60, 20]


@pytest.mark.parametrize('is_exact', [False, True])
@pytest.mark.parametrize('settings', [CALIBRATED, replace(CALIBRATED, two_d_mode=True)])
@given(generators())
def test_many_points_in_blocks_leave_what_all_at_once_would(settings, is_exact, rng):
    filters = [started(np.random.default_rng(0), settings, n=12) for _ in range(2)]
    points = filters[0].observer.points + 0.1 * rng.standard_normal((12, 3))
    if is_exact:
        for each in filters:
            each.fix_landmarks(KnownLandmarks(points, np.zeros((12, 3, 3))))
    rows = rng.permutation(12)
    seen = filters[0].observer.body_points(rows) + 0.1 * rng.standard_normal((12, 3))
    R = 0.01 * random_covariances(rng, 12, 3)
    for each, at_once in zip(filters, (filter_step.AT_ONCE, 5), strict=True):
        with pytest.MonkeyPatch.context() as patch:
            for module in (filter_step, core):
                patch.setattr(module, 'AT_ONCE', at_once)
            observe(each, rows, seen, R)
    one, other = filters
    np.testing.assert_allclose(other.observer.A, one.observer.A, rtol=0.0, atol=3e-14)
    np.testing.assert_allclose(other.observer.points, one.observer.points, rtol=0.0, atol=3e-14)
    np.testing.assert_allclose(other.calibration.values, one.calibration.values, atol=3e-14)
    P = one.joint.P
    np.testing.assert_allclose(other.joint.P, P, rtol=0.0, atol=3e-14 * np.abs(P).max())


@given(generators())
def test_an_outlier_in_a_later_block_is_judged_by_those_before_it(rng):
    """As the earlier ones have told where the robot is, it stands out."""
    settings = replace(PLAIN, rejection_threshold=5.0)
    riccati = started(np.random.default_rng(0), settings, n=12)
    riccati.set_pose(riccati.observer.A, np.eye(6))
    rows = np.arange(12)
    seen = riccati.observer.body_points(rows) + 0.01 * rng.standard_normal((12, 3))
    seen[11] += 1.5
    with pytest.MonkeyPatch.context() as patch:
        for module in (filter_step, core):
            patch.setattr(module, 'AT_ONCE', 6)
        weights = observe(riccati, rows, seen, np.tile(1e-4 * np.eye(3), (12, 1, 1)))
    np.testing.assert_array_equal(weights > 0.0, rows < 11)
