"""Variance-scheduled gains: work for what is seen alone, and the other designs beside them."""

from __future__ import annotations

from dataclasses import replace
import tracemalloc

from gain_worlds import configuration_error_m, drive, estimate, START_NS, STEP_NS
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import block_diag
from strategies import generators

from slam_observer_ros.axes import SPATIAL
from slam_observer_ros.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.gains import DESIGNS
from slam_observer_ros.gains.base import Innovation
from slam_observer_ros.gains.robust import block_diagonal
from slam_observer_ros.gains.scheduled import NOISE_INFLATION, ScheduledGains
from slam_observer_ros.geometry import se3
from slam_observer_ros.observer import Observer
from slam_observer_ros.settings import Settings
from slam_observer_ros.simulated_run import run_simulation
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


@pytest.mark.parametrize('two_d_mode', [False, True])
def test_unseen_landmarks_stay_to_the_bit(two_d_mode):
    settings = Settings(gains='scheduled', two_d_mode=two_d_mode, reorder_window=0.0)
    world = drive(settings, 20.0, landmarks=20, seen=3)
    estimator = Estimator(settings)
    checked = 0
    for event in world.events:
        before = dict(zip(estimator.landmark_ids, estimator.world_points, strict=True))
        estimator.add(event)
        seen = event.ids if isinstance(event, ObservationEvent) else []
        after = dict(zip(estimator.landmark_ids, estimator.world_points, strict=True))
        for landmark in set(before) - set(seen):
            np.testing.assert_array_equal(after[landmark], before[landmark])
            checked += 1
    assert checked > 1000


@given(generators(), st.integers(1, 6))
def test_one_step_is_that_of_a_kalman_filter_without_correlations(rng, n):
    """Pose and landmarks move, and their covariances shrink, as if they had been independent."""
    settings = Settings(gains='scheduled', huber_threshold=0.0, rejection_distance=1e9)
    gains, observer = ScheduledGains(settings), Observer(np.eye(4))
    observer.A = se3.exp(rng.normal(size=6))
    observer.add_reference_landmarks(rng.normal(scale=5.0, size=(n, 3)))
    observer.a = rng.normal(size=(n, 3))
    P, L, R = covariances(rng, 1, 6)[0], covariances(rng, n, 3), covariances(rng, n, 3)
    gains.set_pose_covariance(P)
    gains.add_known_landmarks(L)
    everything, points = np.arange(n), rng.normal(scale=5.0, size=(n, 3))
    e, r = observer.errors(everything, points)
    before = observer.y_ref + observer.a

    prior = block_diag(P, *L)
    C = np.hstack([SPATIAL.output_matrix(e + observer.a).reshape(-1, 6), -np.eye(3 * n)])
    S = C @ prior @ C.T + NOISE_INFLATION**2 * block_diag(*R)
    K = prior @ C.T @ np.linalg.inv(S)
    x, posterior = K @ r.ravel(), prior - K @ C @ prior

    correction, weights = gains.correct(Innovation(everything, e, r, observer.a, R, 0.1))
    observer.correct(correction)
    np.testing.assert_array_equal(weights, 1.0)
    np.testing.assert_allclose(correction.D, se3.exp(-x[:6]), atol=1e-9)
    np.testing.assert_allclose(
        observer.y_ref + observer.a, before - x[6:].reshape(n, 3), atol=1e-9
    )
    blocks = block_diagonal(covariances_of(posterior[6:, 6:], n))
    np.testing.assert_allclose(gains.joint_covariance(everything)[6:, 6:], blocks, atol=1e-9)


def covariances(rng, count, size):
    roots = rng.normal(size=(count, size, size))
    return roots @ roots.swapaxes(1, 2) / size + 0.1 * np.eye(size)


def covariances_of(joint, n):
    """The diagonal blocks (n, 3, 3) of a joint covariance."""
    return joint.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


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
    assert scheduled < constant
    assert riccati < scheduled


def test_covariances_that_are_too_small_are_not_published():
    settings = Settings(gains='scheduled')
    estimator = estimate(drive(settings, 2.0), settings)
    assert estimator.pose_covariance is None
    assert estimator.landmark_covariances is None
