"""Variance-scheduled gains: work for what is seen alone, and the other designs beside them."""

from __future__ import annotations

from dataclasses import replace
import tracemalloc

from gain_worlds import configuration_error_m, drive, estimate, START_NS, STEP_NS
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
from strategies import generators

from slam_observer_ros.cli.simulate import run_simulation
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.geometry import se3
from slam_observer_ros.geometry.axes import PLANAR, SPATIAL
from slam_observer_ros.geometry.matrices import block_diagonal
from slam_observer_ros.observer.designs import DESIGNS
from slam_observer_ros.observer.scheduled import ScheduledGains
from slam_observer_ros.observer.scheduled_core import CAPACITY, PostponedLandmarks
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.simulation import Scenario, Simulation

VELOCITY = np.array([0.0, 0.0, 0.1, 0.3, 0.0, 0.0])


def peak_bytes_of_one_cycle(landmarks):
    """Most memory that a velocity and an observation of two out of n landmarks take."""
    estimator = Estimator(Settings(gains='scheduled', reorder_window=0.0))
    rng = np.random.default_rng(0)
    points = rng.normal(scale=20.0, size=(landmarks, 3))
    estimator.add(VelocityEvent(START_NS, VELOCITY))
    estimator.add(ObservationEvent(START_NS, np.arange(landmarks), points))
    peaks = []
    for step in range(1, 6):
        stamp_ns = START_NS + step * STEP_NS
        velocity = VelocityEvent(stamp_ns, VELOCITY)
        observation = ObservationEvent(stamp_ns, np.array([3, 7]), points[[3, 7]])
        tracemalloc.start()
        estimator.add(velocity)
        estimator.add(observation)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return max(peaks)


def test_work_does_not_depend_on_the_size_of_the_map():
    assert peak_bytes_of_one_cycle(50_000) < 2 * peak_bytes_of_one_cycle(50)


def peak_bytes_of_reading_the_map(landmarks):
    """Most memory that it takes to have a map of n landmarks as it is saved."""
    estimator = Estimator(Settings(gains='scheduled', reorder_window=0.0, confirmations=1))
    points = np.random.default_rng(0).normal(scale=20.0, size=(landmarks, 3))
    estimator.add(ObservationEvent(START_NS, np.arange(landmarks), points))
    tracemalloc.start()
    saved = estimator.landmark_map
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(saved.ids) == landmarks
    return peak


def test_a_large_map_can_be_saved():
    assert peak_bytes_of_reading_the_map(1000) < 1000 * 2000


def test_reading_the_map_changes_no_bit_of_it():
    settings = Settings(gains='scheduled', reorder_window=0.0)
    world = drive(settings, 20.0, landmarks=30, seen=3)
    read = Estimator(settings)
    for event in world.events:
        read.add(event)
        assert np.isfinite(read.world_points).all()
    unread = estimate(world, settings)
    np.testing.assert_array_equal(read.world_points, unread.world_points)
    np.testing.assert_array_equal(read.pose, unread.pose)


def landmarks_about_a_robot(rng, n):
    """Filter that has seen n landmarks twice, on a motion that left it unsure of its pose."""
    scheduled = ScheduledGains(PLAIN, np.eye(4))
    scheduled.set_pose(np.eye(4), 1e-4 * random_covariances(rng, 1, 6)[0])
    scheduled.add(rng.normal(scale=4.0, size=(n, 3)), 1e-4 * random_covariances(rng, n, 3))
    for _ in range(3):
        random_step(scheduled, rng, 1e-4, 1e-2)
    V, Q = rng.normal(size=(1, 6)), 1e-3 * random_covariances(rng, 1, 6)
    propagate(scheduled, V, np.ones(1), Q)
    return scheduled


def bring_up_to_date(scheduled):
    scheduled.prepare(np.arange(len(scheduled.observer)))


def of_pose_and_each_landmark(n):
    """Mask of a joint covariance without what two landmarks have to do with each other."""
    own = np.kron(np.eye(n + 2), np.ones((3, 3))) > 0
    own[:6] = own[:, :6] = True
    return own


@given(generators(), st.integers(2, 15))
def test_an_observation_acts_on_all_landmarks_as_in_a_kalman_filter(rng, n):
    """Given what the filter holds, nothing is left out: what is shared, or what is not seen."""
    scheduled = landmarks_about_a_robot(rng, n)
    seen = np.sort(rng.permutation(n)[: rng.integers(1, n)])
    bring_up_to_date(scheduled)
    prior, points, A = (
        covariance_of_all(scheduled),
        scheduled.observer.points,
        scheduled.observer.A.copy(),
    )
    R = 1e-3 * random_covariances(rng, len(seen), 3)
    residuals = residuals_of(scheduled, seen, scheduled.observer.body_points(seen) + 0.03, R)
    C = np.zeros((3 * len(seen), len(prior)))
    C[:, :6] = SPATIAL.output_matrix(points[seen]).reshape(-1, 6)
    C[np.arange(len(C)), (6 + 3 * seen[:, None] + np.arange(3)).ravel()] = -1.0
    S = C @ prior @ C.T + block_diagonal(residuals.covariances)
    K = prior @ C.T @ np.linalg.inv(S)
    x = -K @ residuals.r.ravel()
    # In the covariance, turning everything now turns landmarks where they have been moved to.
    turn = np.eye(len(prior))
    turn[6:, :6] = SPATIAL.turn_matrix(x[6:].reshape(n, 3)).reshape(-1, 6)
    posterior = turn @ (prior - K @ C @ prior) @ turn.T

    weights = scheduled.observe(residuals)
    np.testing.assert_array_equal(weights, 1.0)
    D = scheduled.observer.A @ se3.inverse(A)
    np.testing.assert_allclose(D, se3.exp(x[:6]), atol=1e-8)
    np.testing.assert_allclose(scheduled.observer.points, points + x[6:].reshape(n, 3), atol=1e-8)
    tolerance = 1e-7 * np.abs(prior).max()
    own = of_pose_and_each_landmark(n)
    found = covariance_of_all(scheduled)
    np.testing.assert_allclose(found[own], posterior[own], atol=tolerance)


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_few_landmarks_are_estimated_as_with_riccati_gains(two_d_mode):
    """A map that fits into the core has its full covariance."""
    settings = Settings(
        two_d_mode=two_d_mode, relinearization_interval=0, motion_noise_factor='stated'
    )
    world = drive(settings, 20.0, landmarks=CAPACITY, seen=4)
    riccati, scheduled = (
        estimate(world, replace(settings, gains=gains)) for gains in ('riccati', 'scheduled')
    )
    apart = configuration_error_m(riccati, world)
    assert abs(configuration_error_m(scheduled, world) - apart) < 0.05 * apart
    np.testing.assert_allclose(scheduled.pose, riccati.pose, atol=0.03)


def test_landmarks_that_follow_late_have_not_missed_anything():
    """Composed changes, whenever they are taken over, are the changes one by one."""
    rng, q, n = np.random.default_rng(0), 12, 40
    late, at_once = PostponedLandmarks(SPATIAL, q), PostponedLandmarks(SPATIAL, q)
    everything, moved = np.arange(n), np.zeros((n, 3))
    F, N = rng.normal(size=(n, 3, q)), random_covariances(rng, n, 3)
    late.add(F, N)
    at_once.add(F, N)
    moved_late = np.zeros((n, 3))
    for _ in range(200):
        G, x = np.eye(q) + 0.01 * rng.normal(size=(q, q)), 1e-7 * rng.normal(size=q)
        V = 0.01 * random_covariances(rng, 1, q)[0]
        for postponed in (late, at_once):
            postponed.change_core(G, V)
            postponed.shift(x)
        F, N, shifts = at_once.now(everything)
        at_once.update(everything, F, N)
        moved += shifts
        rows = np.union1d(rng.choice(n, 2), late.due())
        F, N, shifts = late.now(rows)
        late.update(rows, F, N)
        moved_late[rows] += shifts
    for now, then in zip(late.now(everything)[:2], at_once.now(everything)[:2], strict=True):
        np.testing.assert_allclose(now, then, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(moved_late + late.now(everything)[2], moved, rtol=1e-4, atol=1e-9)


def test_landmarks_wait_in_few_groups():
    """What has to be kept up to date for those out of view grows with the logarithm of them."""
    rng, n = np.random.default_rng(0), 1000
    postponed = PostponedLandmarks(PLANAR, 5)
    postponed.add(rng.normal(size=(n, 2, 5)), np.tile(np.eye(2), (n, 1, 1)))
    touched = 0
    for _ in range(3000):
        rows = np.union1d(rng.choice(n, 3), postponed.due())
        F, N, _ = postponed.now(rows)
        postponed.update(rows, F, N)
        assert len(postponed._sizes) <= 2 + np.log2(n)
        touched += len(rows)
    assert touched < 3 * 3000 * np.log2(n)


@pytest.mark.parametrize('point_variance_exponents', [(-8.0, 2.0), (-8.0, -8.0), (2.0, 2.0)])
def test_covariances_stay_positive_over_many_steps_of_any_noise(point_variance_exponents):
    rng, n = np.random.default_rng(4), 20
    scheduled = ScheduledGains(PLAIN, np.eye(4))
    scheduled.add(rng.normal(scale=4.0, size=(n, 3)), np.tile(1e-2 * np.eye(3), (n, 1, 1)))
    steps, dt_s = 1_500, np.ones(1)
    V = rng.normal(size=(steps, 1, 6)) * [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]
    Q = 10.0 ** rng.uniform(-10.0, -2.0, (steps, 1, 6, 1)) * np.eye(6)
    R = 10.0 ** rng.uniform(*point_variance_exponents, (steps, 1, 1, 1)) * np.eye(3)
    for step in range(steps):
        propagate(scheduled, V[step], dt_s, Q[step])
        seen = np.array([step // 7 % n])
        off = np.sqrt(R[step, :, 0, 0]) * rng.normal(size=(1, 3))
        observe(scheduled, seen, scheduled.observer.body_points(seen) + off, R[step])
        if step % 200 == 0:
            P = covariance_of_all(scheduled)
            deviations = np.sqrt(np.diag(P))
            assert np.linalg.eigvalsh(P / np.outer(deviations, deviations))[0] > -1e-6


def test_removed_landmarks_leave_the_others_as_they_were():
    rng, n = np.random.default_rng(1), 14
    scheduled = landmarks_about_a_robot(rng, n)
    bring_up_to_date(scheduled)
    removed, kept = np.array([0, 3, 12]), np.setdiff1d(np.arange(n), [0, 3, 12])
    before, points = scheduled.joint_covariance(kept), scheduled.observer.points[kept]
    scheduled.remove(removed)
    np.testing.assert_allclose(scheduled.observer.points, points, atol=1e-12)
    own, after = of_pose_and_each_landmark(len(kept)), covariance_of_all(scheduled)
    np.testing.assert_allclose(after[own], before[own], atol=1e-6 * before.max())
    for _ in range(5):
        random_step(scheduled, rng, 1e-4, 1e-2)
    assert np.isfinite(covariance_of_all(scheduled)).all()


def test_after_landmarks_of_the_core_were_removed_what_says_nothing_changes_nothing():
    """Else some would be taken for others that were in the core."""
    rng, n = np.random.default_rng(1), 14
    scheduled = landmarks_about_a_robot(rng, n)
    bring_up_to_date(scheduled)
    last_seen = scheduled._core.rows
    removed = np.sort(last_seen[last_seen >= 0][:3])
    scheduled.remove(removed)
    n -= 3
    before, points = covariance_of_all(scheduled), scheduled.observer.points
    for row in range(n):
        seen = np.array([row])
        observe(scheduled, seen, scheduled.observer.body_points(seen), 1e9 * np.eye(3)[None])
    np.testing.assert_allclose(scheduled.observer.points, points, atol=1e-9)
    own, after = of_pose_and_each_landmark(n), covariance_of_all(scheduled)
    np.testing.assert_allclose(after[own], before[own], atol=1e-6 * before.max())


def test_a_landmark_that_is_relocated_is_as_uncertain_as_a_new_one():
    rng, n = np.random.default_rng(2), 5
    relocated, added = (landmarks_about_a_robot(np.random.default_rng(3), n) for _ in range(2))
    point, R = rng.normal(size=(1, 3)), random_covariances(rng, 1, 3)
    relocated.relocate(np.array([1]), point, R)
    added.add(point, R)
    np.testing.assert_allclose(relocated.observer.points[1], added.observer.points[n], atol=1e-12)
    of_one = np.append(np.arange(6), np.arange(9, 12))
    of_last = np.append(np.arange(6), 6 + 3 * n + np.arange(3))
    np.testing.assert_allclose(
        covariance_of_all(relocated)[np.ix_(of_one, of_one)],
        covariance_of_all(added)[np.ix_(of_last, of_last)],
        atol=1e-12,
    )


@pytest.mark.parametrize('gains', DESIGNS)
def test_each_design_converges_on_the_circle_of_the_paper(gains):
    simulation = Simulation(Scenario(duration=40.0, observation_rate=10.0))
    events = [delivery.event for delivery in simulation.deliveries()]
    settings = Settings(
        gains=gains, observation_model='cartesian', point_noise=0.5, reorder_window=0.0
    )
    run = run_simulation(simulation, events, settings)
    assert run.lyapunov[-1] < 1e-4 * run.lyapunov.max()


@pytest.mark.parametrize('step_mode', ['paper', 'exponential'])
@pytest.mark.parametrize('gains', DESIGNS)
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_each_design_tracks_a_noisy_drive_through_the_estimator(gains, step_mode, two_d_mode):
    settings = Settings(gains=gains, step_mode=step_mode, two_d_mode=two_d_mode)
    world = drive(settings, 20.0)
    estimator = estimate(world, settings)
    assert configuration_error_m(estimator, world) < 0.8
    blind = replace(
        world, events=[event for event in world.events if isinstance(event, VelocityEvent)]
    )
    assert estimate(blind, settings).counts['observation'] == 0


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_known_noise_makes_scheduled_gains_better_than_constant_ones(two_d_mode):
    def mean_error_m(gains):
        settings = Settings(gains=gains, two_d_mode=two_d_mode)
        errors = []
        for seed in range(4):
            world = drive(settings, 20.0, seed, seen=2)
            errors.append(configuration_error_m(estimate(world, settings), world))
        return np.sqrt(np.mean(np.square(errors)))

    constant, scheduled, riccati = map(mean_error_m, ('constant', 'scheduled', 'riccati'))
    assert scheduled < 1.2 * riccati < constant


def test_covariances_that_may_be_too_small_are_not_published():
    settings = Settings(gains='scheduled')
    estimator = estimate(drive(settings, 2.0), settings)
    assert estimator.pose_covariance is None
    assert estimator.landmark_covariances is None
