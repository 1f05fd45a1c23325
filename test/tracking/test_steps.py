"""Each step of every world by the compiled core is the same as by numpy, to rounding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rounding import off_by

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import (
    AZIMUTH_RANGE,
    ObservationEvent,
    POINT,
    RANGE,
    VelocityEvent,
)
from slam_observer_ros.filter import core
from slam_observer_ros.filter.riccati.active_landmarks import BlockSize
from slam_observer_ros.filter.riccati.riccati import RiccatiGains
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking import step
from slam_observer_ros.tracking.state import Association, State

BENCHMARK = Path(__file__).resolve().parents[2] / 'benchmark'
WORLDS = (
    'Starry Night',
    'MRCLAM 6, robot 1',
    'Victoria Park',
    'cityTrees10000',
    "the paper's circle with noise",
    'simulated loop, 3D stereo',
    'simulated loop, wheeled',
)
OBSERVATIONS = 60
ROUNDING = 1e-12


@pytest.fixture(name='worlds')
def fixture_worlds(monkeypatch):
    if not BENCHMARK.is_dir():
        pytest.skip('the benchmark is not installed')
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import worlds

    return worlds


def parts(state):
    """All that a step changes of a state, by name."""
    history, factors, table = (
        state.relinearisation.history,
        state.motion_noise.factors,
        state.landmarks,
    )
    latest = history._new[-1] if history._new else None
    noise, sensitivity, drift = history._motion or history._at_rest()
    return {
        'A': state.observer.A,
        'P': state.errors.joint.P,
        'map': state.observer.points,  # y° + â: what has hardly moved has no size of its own
        'calibration': state.calibration.values,
        'factors': np.concatenate([factors._logs, factors._information.ravel(), factors.applied]),
        'shares': np.zeros(()) if factors._shares is None else factors._shares,
        'noise': noise,
        'sensitivity': sensitivity,
        'drift': drift,
        'end velocity': np.zeros(0) if state.end_velocity is None else state.end_velocity,
        'table': np.concatenate(
            [table.counts, table.rejections, table.last_seen_ns, table.seen_before_ns]
        ),
        'turned': np.array([state.relinearisation._turn_squared]),
        'lines of sight': np.zeros(0) if latest is None else latest.lines_of_sight,
        'stated': np.zeros(0)
        if latest is None or latest.covariances is None
        else latest.covariances,
        'points': np.zeros(0) if latest is None else latest.points,
        'since': np.zeros(0) if latest is None else np.nan_to_num(latest.repeated, posinf=1e6),
    }


def assert_same(state, other, what):
    for (name, value), expected in zip(parts(state).items(), parts(other).values(), strict=True):
        assert value.shape == expected.shape, (what, name)
        off = off_by(value, expected, 1e-9)
        assert off <= ROUNDING, f'{what}: {name} is off by {off:.1e}'


class BothWays:
    """Lets hypotheses take each step by the core and by numpy, and counts what they saw."""

    def __init__(self, monkeypatch):
        self._monkeypatch = monkeypatch
        self.observed = self.moved = self.asked = 0
        self.entered = self.rejected = self.refused = 0
        self._advance, self._poses, self._observe = State.advance, State.poses_until, step.observe
        monkeypatch.setattr(State, 'advance', lambda *args: self.advance(*args))
        monkeypatch.setattr(State, 'poses_until', lambda *args: self.poses(*args))
        monkeypatch.setattr(step, 'observe', self.observe)
        self._finish = step.follow_moved
        monkeypatch.setattr(step, 'follow_moved', self.finish)

    def by_numpy(self, way, *args):
        with self._monkeypatch.context() as without_core:
            without_core.setattr(core, 'COMPILED', None)
            return way(*args)

    def advance(self, state, *args):
        other = state.copy()
        variances = self._advance(state, *args)
        expected = self.by_numpy(self._advance, other, *args)
        assert_same(state, other, f'the motion to {args[-1]}')
        np.testing.assert_allclose(variances, expected)
        self.moved += 1
        return variances

    def poses(self, state, *args):
        other = state.copy()
        found = self._poses(state, *args)
        assert_same(state, other, f'the question for the poses at {args[-1]}')
        for one, two in zip(found, self.by_numpy(self._poses, other, *args), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * np.abs(two).max())
        self.asked += 1
        return found

    def observe(self, one):
        state, before = one.state, one.state.copy()
        self._other = other = Association(state.copy(), one.event, one.rows, one.may_refuse)
        self.observed += 1
        is_used = self._observe(one)
        assert self.by_numpy(self._observe, other) == is_used
        assert_same(state, other.state, f'the observation at {one.event.stamp_ns}')
        if not is_used:
            assert_same(state, before, 'a refused observation')
            self.refused += 1
        return is_used

    def finish(self, one):
        state, other, event = one.state, self._other, one.event
        update = self._finish(one)
        self.by_numpy(step.update_landmarks, other)
        self.by_numpy(step.append, other)
        expected = self.by_numpy(self._finish, other)
        assert_same(state, other.state, f'the landmarks at {event.stamp_ns}')
        assert state.counts == other.state.counts
        np.testing.assert_array_equal(update.ids, expected.ids)
        np.testing.assert_allclose(update.residuals, expected.residuals, atol=1e-12)
        np.testing.assert_array_equal(update.rejected, expected.rejected)
        self.entered += len(update.ids) < len(event.ids)
        self.rejected += bool(expected.rejected.any())
        for name in ('distances', 'weights', 'log_densities', 'shares'):
            one, two = (getattr(o.innovation, name) for o in (update, expected))
            np.testing.assert_allclose(one, two, rtol=1e-8, atol=1e-9, err_msg=name)
        assert update.innovation.nis == pytest.approx(expected.innovation.nis)
        assert update.innovation.degrees_of_freedom == expected.innovation.degrees_of_freedom
        return update


def ask_for_poses(estimator):
    """Ask for the pose now, and sometimes for those at all stamps since the last observation."""
    assert estimator.pose_covariance.shape == (6, 6)
    velocities, state_ns = estimator._timeline.velocities, estimator._timeline.state_ns
    stamps_ns = velocities.flat().stamps_ns
    is_since = (stamps_ns > state_ns) & (stamps_ns <= estimator.stamp_ns)
    stamps_ns = np.unique(stamps_ns[is_since])
    if len(stamps_ns) % 16 == 3:
        poses, covariances = estimator._hypotheses.poses_until(
            velocities, state_ns, stamps_ns, with_covariances=True
        )
        assert len(poses) == len(covariances) == len(stamps_ns)


@pytest.mark.parametrize('name', WORLDS)
def test_a_step_of_the_core_is_the_same_as_by_numpy(worlds, monkeypatch, name):
    if name not in worlds.names():
        pytest.skip('the recordings are not there')
    world = worlds.load(name)
    both = BothWays(monkeypatch)
    # Relinearising would multiply rounding, and has no part in the step.
    settings = replace(world.settings, relinearization_angle=1e3)
    estimator = Estimator(settings, judges_innovations=True)
    for event in world.events:
        estimator.add(event)
        ask_for_poses(estimator)
        if isinstance(event, ObservationEvent) and both.observed >= OBSERVATIONS:
            break
    assert both.entered >= 1
    assert both.moved >= 0.5 * both.observed
    assert both.asked >= OBSERVATIONS // 3


@pytest.mark.parametrize('name', ['simulated loop, 3D stereo', 'simulated loop, wheeled'])
def test_so_it_is_where_few_landmarks_of_a_large_map_are_active(worlds, monkeypatch, name):
    monkeypatch.setattr(RiccatiGains, 'block', BlockSize(8, 10, kept=4, kept_per_seen=1))
    world, both = worlds.load(name), BothWays(monkeypatch)
    estimator = Estimator(world.settings, judges_innovations=True)
    for event in world.events:
        estimator.add(event)
        if isinstance(event, ObservationEvent) and both.observed >= 2 * OBSERVATIONS:
            break
    joint = estimator._state.errors.joint
    assert not joint.is_dense and len(joint.active) < len(estimator.world_points)
    assert both.entered >= 5
    assert both.moved >= 0.5 * both.observed


@pytest.mark.parametrize('is_planar', [False, True])
@pytest.mark.parametrize('is_large', [False, True])
def test_so_it_is_among_tags_with_orientations(monkeypatch, is_planar, is_large):
    if is_large:
        monkeypatch.setattr(RiccatiGains, 'block', BlockSize(8, 10, kept=4, kept_per_seen=1))
    both, rng = BothWays(monkeypatch), np.random.default_rng(0)
    settings = Settings(use_tag_orientation=True, two_d_mode=is_planar, reorder_window=0.0)
    estimator = Estimator(settings, judges_innovations=True)
    V = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])
    tags = rng.uniform(-8.0, 8.0, (24, 3)) * (1.0, 1.0, 1.0 - is_planar)
    for step_number in range(60):
        stamp_ns, pose = step_number * 10**8, se3.exp(0.1 * step_number * V)
        noisy = V + 0.02 * rng.standard_normal(6)
        estimator.add(VelocityEvent(stamp_ns, noisy))
        seen = se3.transform(se3.inverse(pose), tags)
        ids = np.sort(np.argsort(np.linalg.norm(seen, axis=1))[:3])
        turns = so3.exp(
            0.02 * rng.standard_normal((3, 3)) * (1.0 - is_planar, 1.0 - is_planar, 1.0)
        )
        estimator.add(
            ObservationEvent(stamp_ns, ids, seen[ids], orientations=pose[:3, :3].T @ turns)
        )
    joint = estimator._state.errors.joint
    assert joint.is_dense != is_large
    assert both.moved >= 50 and both.observed == 60


@pytest.mark.parametrize('is_planar', [False, True])
def test_so_it_is_where_some_of_what_is_seen_are_half_points(monkeypatch, is_planar):
    both, rng = BothWays(monkeypatch), np.random.default_rng(0)
    settings = Settings(
        two_d_mode=is_planar, reorder_window=0.0, range_scale_stddev=0.05, bearing_noise=0.02
    )
    estimator = Estimator(settings, judges_innovations=True)
    flat, V = (1.0, 1.0, 1.0 - is_planar), np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])
    landmarks = rng.uniform(-8.0, 8.0, (8, 3)) * flat
    for step_number in range(OBSERVATIONS):
        stamp_ns, pose = step_number * 10**8, se3.exp(0.1 * step_number * V)
        estimator.add(VelocityEvent(stamp_ns, V + 0.02 * rng.standard_normal(6)))
        lines = se3.transform(se3.inverse(pose), landmarks)
        lines += 0.02 * rng.standard_normal((8, 3)) * flat
        ranges_m = np.linalg.norm(lines, axis=1, keepdims=True)
        # Until all are known, points; then any of what there is, some of it stated.
        kinds = np.full(8, POINT) if step_number < 5 else rng.integers(0, 5, 8)
        is_range = (kinds == RANGE)[:, None]
        has_range = np.isin(kinds, (POINT, RANGE, AZIMUTH_RANGE))[:, None]
        shown = np.where(is_range, ranges_m * [1.0, 0.0, 0.0], lines)
        shown = np.where(has_range, shown, lines / ranges_m)
        stated = np.tile(0.02**2 * np.eye(3), (8, 1, 1)) if step_number % 2 else None
        estimator.add(ObservationEvent(stamp_ns, np.arange(8), shown, stated, kinds=kinds))
    assert both.observed == OBSERVATIONS and both.moved >= 50
    assert len(estimator.world_points) == 8


@pytest.mark.parametrize('name', ['simulated loop, 3D stereo', 'simulated loop, wheeled'])
def test_so_it_is_with_false_points_and_of_several_hypotheses(worlds, monkeypatch, name):
    import outliers

    world = outliers.with_outliers(worlds.load(name), seed=0)
    both = BothWays(monkeypatch)
    # A slip would leave P so wide that rounding grows with it.
    never = {'unknown_linear_motion': 0.0, 'unknown_angular_motion': 0.0}
    settings = replace(world.settings, relinearization_angle=1e3, **never)
    estimator = Estimator(settings, judges_innovations=True)
    for event in world.events:
        estimator.add(event)
        if isinstance(event, ObservationEvent) and both.observed >= OBSERVATIONS:
            break
    assert both.entered >= 5 and both.rejected >= 3


@pytest.mark.parametrize('parts', [6, 3])
def test_velocities_may_state_their_covariances(worlds, monkeypatch, parts):
    """Of both parts, or of the angular one alone: every other one does."""
    rng = np.random.default_rng(0)
    world = worlds.load('simulated loop, wheeled')
    stated = np.zeros((6, 6))
    M = 0.05 * rng.standard_normal((parts, 2 * parts))
    stated[:parts, :parts] = M @ M.T
    both = BothWays(monkeypatch)
    settings = replace(world.settings, relinearization_angle=1e3)
    estimator = Estimator(settings, judges_innovations=True)
    for number, event in enumerate(world.events):
        if isinstance(event, VelocityEvent) and number % 2:
            event = replace(event, covariance=stated)
        estimator.add(event)
        ask_for_poses(estimator)
        if both.observed >= OBSERVATIONS // 3:
            break
    assert both.moved >= 15
    assert both.asked >= OBSERVATIONS // 3


def test_points_of_any_precision_and_order_are_taken(worlds):
    """As the checks let them pass, from whatever library they come."""
    world = worlds.load('simulated loop, wheeled')
    poses = []
    for make in (lambda array: array, lambda array: np.asfortranarray(array.astype(np.float32))):
        estimator = Estimator(world.settings)
        for event in world.events[:600]:
            if isinstance(event, ObservationEvent):
                ids = np.repeat(event.ids.astype(np.int32), 2)[::2]
                points, stated = make(event.points), make(event.covariances)
                event = replace(event, ids=ids, points=points, covariances=stated)
            assert estimator.add(event)
        poses.append(estimator.pose)
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-4)
