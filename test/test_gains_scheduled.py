"""Variance-scheduled gains: work for what is seen alone, and the other designs beside them."""

from __future__ import annotations

from dataclasses import replace
import tracemalloc

from gain_worlds import configuration_error_m, drive, estimate, START_NS, STEP_NS
from hypothesis import given
import numpy as np
import pytest
from strategies import generators

from slam_observer_ros.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.gains import DESIGNS
from slam_observer_ros.gains.base import Innovation
from slam_observer_ros.gains.scheduled import ScheduledGains
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


@given(generators())
def test_the_gains_are_positive_so_a_residual_is_never_enlarged(rng):
    n = int(rng.integers(1, 6))
    gains = ScheduledGains(Settings(gains='scheduled', huber_threshold=0.0))
    observer = Observer(np.eye(4))
    roots = rng.normal(scale=0.2, size=(n, 3, 3))
    covariances = roots @ roots.swapaxes(1, 2) + 1e-4 * np.eye(3)
    points = rng.normal(scale=5.0, size=(n, 3))
    observer.add_landmarks(points)
    gains.set_pose_covariance(1e-3 * np.eye(6))
    gains.add_landmarks(observer.y_ref, covariances)
    moved = points + 1e-3 * rng.normal(size=points.shape)
    everything = np.arange(n)
    e, r = observer.errors(everything, moved)
    correction, weights = gains.correct(Innovation(everything, e, r, observer.a, covariances, 0.1))
    observer.correct(correction)
    np.testing.assert_array_equal(weights, 1.0)
    _, left = observer.errors(everything, moved)
    # In the metric of the observations' noise, which the gains minimise.
    information = np.linalg.inv(covariances)
    assert cost(left, information) <= cost(r, information) * (1.0 + 1e-6)


def cost(r, information):
    return float(np.einsum('ij,ijk,ik', r, information, r))


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
