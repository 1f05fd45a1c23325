"""The simulated run: section VI of the paper by default, and each option's promise."""

from __future__ import annotations

import dataclasses
import itertools

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import PoseTruth
from slam_observer_ros.settings.parameter_table import from_parameters
from slam_observer_ros.simulation import Delivery, LAP_S, Scenario, SimulatedEvent, Simulation

EXACT = Scenario(initial_bias=0.0, duration=1.0)


def _events(scenario: Scenario, kind: type[SimulatedEvent]) -> list[SimulatedEvent]:
    deliveries = Simulation(scenario).deliveries()
    return [delivery.event for delivery in deliveries if isinstance(delivery.event, kind)]


def _observations(scenario: Scenario) -> list[ObservationEvent]:
    return _events(scenario, ObservationEvent)


def test_default_scenario_is_section_six_of_the_paper() -> None:
    simulation = Simulation(Scenario())
    stamps = np.arange(0, 80, dtype=np.int64) * 1_000_000_000

    positions = simulation.pose(stamps)[:, :3, 3]

    assert_allclose(np.hypot(positions[:, 0], positions[:, 1]), 5.0, rtol=1e-12)
    assert_allclose(positions[:, 2], 2.0)
    assert_array_equal(simulation.world_points(0), [[4, 0, 0], [-4, 0, 0], [0, 4, 0], [0, -4, 0]])
    velocity = _events(Scenario(duration=0.1), VelocityEvent)[0]
    assert_array_equal(velocity.body_velocity, [0, 0, 0.2, 1, 0, 0])


def test_one_lap_returns_to_the_start() -> None:
    simulation = Simulation(Scenario())
    assert_allclose(simulation.pose(round(LAP_S * 1e9)), simulation.pose(0), atol=1e-8)


def test_integrated_velocities_give_the_true_poses() -> None:
    velocities = _events(EXACT, VelocityEvent)
    truths = _events(EXACT, PoseTruth)

    pose = truths[0].pose
    for velocity, truth, later in zip(velocities, truths, truths[1:], strict=False):
        assert velocity.stamp_ns == truth.stamp_ns
        pose = pose @ se3.exp(velocity.body_velocity * (later.stamp_ns - truth.stamp_ns) * 1e-9)
        assert_allclose(pose, later.pose, atol=1e-12)


def test_observations_are_the_landmarks_seen_from_the_true_pose() -> None:
    simulation = Simulation(EXACT)
    for observation in _observations(EXACT):
        seen = se3.transform(simulation.pose(observation.stamp_ns), observation.points)
        assert_allclose(seen, simulation.world_points(observation.stamp_ns), atol=1e-12)


def test_bias_corrupts_the_first_sighting_of_each_landmark_only() -> None:
    scenario = Scenario(initial_bias=0.5, duration=LAP_S, field_of_view=180.0)
    simulation = Simulation(scenario)
    errors: dict[int, list[float]] = {}
    for observation in _observations(scenario):
        pose = simulation.pose(observation.stamp_ns)
        truth = simulation.world_points(observation.stamp_ns)[observation.ids]
        distances = np.linalg.norm(se3.transform(pose, observation.points) - truth, axis=-1)
        for landmark_id, distance in zip(observation.ids.tolist(), distances, strict=True):
            errors.setdefault(landmark_id, []).append(distance)

    assert sorted(errors) == [0, 1, 2, 3]
    for first, *rest in errors.values():
        assert first == pytest.approx(0.5)
        assert_allclose(rest, 0.0, atol=1e-12)


def test_same_seed_same_run_and_other_seed_other_run() -> None:
    scenario = Scenario(
        duration=2.0,
        point_noise=0.1,
        linear_velocity_noise=0.1,
        late_fraction=0.3,
        drop_fraction=0.2,
        landmark_count=5,
    )

    def fingerprint(run: Scenario) -> list[tuple[int, int, float]]:
        return [
            (delivery.arrival_ns, delivery.event.stamp_ns, float(_numbers(delivery).sum()))
            for delivery in Simulation(run).deliveries()
        ]

    assert fingerprint(scenario) == fingerprint(scenario)
    assert fingerprint(scenario) != fingerprint(dataclasses.replace(scenario, seed=1))


def _numbers(delivery: Delivery) -> np.ndarray:
    match delivery.event:
        case VelocityEvent(body_velocity=numbers) | ObservationEvent(points=numbers):
            return numbers
        case PoseTruth(pose=numbers):
            return numbers


def test_noise_options_leave_the_landmarks_where_they_are() -> None:
    quiet = Simulation(Scenario(landmark_count=20))
    noisy = Simulation(Scenario(landmark_count=20, point_noise=1.0, late_fraction=0.5))
    assert_array_equal(quiet.world_points(0), noisy.world_points(0))


@pytest.mark.parametrize(
    'option', ['point_noise', 'linear_velocity_noise', 'angular_velocity_noise']
)
def test_noise_has_the_deviation_asked_for(option: str) -> None:
    scenario = dataclasses.replace(EXACT, duration=20.0, **{option: 0.3})
    exact = list(Simulation(dataclasses.replace(scenario, **{option: 0.0})).deliveries())
    noisy = list(Simulation(scenario).deliveries())

    errors = np.concatenate(
        [
            (_numbers(with_noise) - _numbers(without)).ravel()
            for with_noise, without in zip(noisy, exact, strict=True)
        ]
    )
    errors = errors[errors != 0.0]

    assert errors.size >= 3000
    assert np.std(errors) == pytest.approx(0.3, rel=0.05)


def test_random_field_lies_at_its_distance() -> None:
    simulation = Simulation(Scenario(landmark_count=100, landmark_distance=50.0))
    assert_allclose(np.linalg.norm(simulation.world_points(0), axis=-1), 50.0)
    assert_array_equal(simulation.landmark_ids, np.arange(100))


def test_moving_landmarks_report_their_velocity_in_the_body_frame() -> None:
    scenario = dataclasses.replace(EXACT, landmark_speed=0.7)
    simulation = Simulation(scenario)
    step_ns = 1_000
    for observation in itertools.islice(_observations(scenario), 5):
        stamp_ns = observation.stamp_ns
        moved = simulation.world_points(stamp_ns + step_ns) - simulation.world_points(stamp_ns)
        rotation = simulation.pose(stamp_ns)[:3, :3]
        assert_allclose(observation.velocities @ rotation.T, moved / (step_ns * 1e-9), atol=1e-5)
        assert_allclose(np.linalg.norm(observation.velocities, axis=-1), 0.7)


@settings(max_examples=25)
@given(st.floats(1.0, 359.0), st.floats(1.0, 12.0))
def test_only_landmarks_in_view_and_range_are_seen(angle_deg: float, range_m: float) -> None:
    scenario = dataclasses.replace(
        EXACT, duration=4.0, observation_rate=2.0, field_of_view=angle_deg, max_range=range_m
    )
    simulation = Simulation(scenario)
    for observation in _observations(scenario):
        pose = simulation.pose(observation.stamp_ns)
        points = se3.transform(se3.inverse(pose), simulation.world_points(0))
        distances = np.linalg.norm(points, axis=-1)
        angles = np.degrees(np.arccos(points[:, 0] / distances))
        assume(np.abs(angles - angle_deg / 2.0).min() > 1e-9)  # on the edge rounding decides
        expected = (distances <= range_m) & (angles <= angle_deg / 2.0)
        assert_array_equal(observation.ids, np.flatnonzero(expected))


def test_late_messages_keep_their_stamp_and_arrive_in_order_of_arrival() -> None:
    scenario = dataclasses.replace(EXACT, duration=10.0, late_fraction=0.5, max_lateness=0.2)
    deliveries = list(Simulation(scenario).deliveries())

    delays = [delivery.arrival_ns - delivery.event.stamp_ns for delivery in deliveries]
    arrivals = [delivery.arrival_ns for delivery in deliveries]

    assert arrivals == sorted(arrivals)
    assert min(delays) == 0
    assert 150_000_000 < max(delays) <= 200_000_000
    sent = [
        delay
        for delay, item in zip(delays, deliveries, strict=True)
        if not isinstance(item.event, PoseTruth)
    ]
    assert np.mean(np.asarray(sent) > 0) == pytest.approx(0.5, abs=0.07)


def test_dropped_messages_are_gone_and_the_truth_is_not() -> None:
    scenario = dataclasses.replace(EXACT, duration=10.0, drop_fraction=0.25)
    assert len(_events(scenario, PoseTruth)) == 501
    assert len(_events(scenario, VelocityEvent)) == pytest.approx(501 * 0.75, rel=0.1)
    assert len(_observations(scenario)) == pytest.approx(501 * 0.75, rel=0.1)


def test_rates_and_start_set_the_stamps() -> None:
    scenario = Scenario(velocity_rate=100.0, observation_rate=30.0, duration=1.0)
    start_ns = 1_700_000_000_000_000_000
    deliveries = list(Simulation(scenario, start_ns).deliveries())

    stamps = [d.event.stamp_ns for d in deliveries if isinstance(d.event, ObservationEvent)]

    assert stamps == [start_ns + round(step * 1e9 / 30) for step in range(31)]
    assert_allclose(Simulation(scenario, start_ns).pose(start_ns), Simulation(scenario).pose(0))


@pytest.mark.parametrize(('step_s', 'count'), [(2.01, 2), (0.67, 4)])
def test_what_is_observed_at_the_very_end_is_reported(step_s: float, count: int) -> None:
    scenario = Scenario(observation_rate=1.0 / step_s, duration=2.01)  # 2.01e9 ns is no integer
    assert len(_observations(scenario)) == count


@pytest.mark.parametrize(
    ('options', 'end_s'),
    [({'duration': 3.0}, 3.0), ({'laps': 0.1}, 0.1 * LAP_S), ({'duration': 3.0, 'laps': 2}, 3.0)],
)
def test_duration_or_laps_end_the_run_whichever_comes_first(
    options: dict[str, float], end_s: float
) -> None:
    *_, last = Simulation(Scenario(**options)).deliveries()
    assert last.event.stamp_ns * 1e-9 == pytest.approx(end_s, abs=0.02)


def test_run_without_duration_or_laps_never_ends() -> None:
    deliveries = Simulation(Scenario()).deliveries()
    *_, last = itertools.islice(deliveries, 3 * 50 * 100)
    assert last.event.stamp_ns > 99_000_000_000


def test_option_out_of_range_is_refused() -> None:
    with pytest.raises(ParameterError, match='field_of_view'):
        from_parameters(Scenario, {'field_of_view': 400.0})
