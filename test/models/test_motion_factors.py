"""The noise of the odometry over what is stated is found while driving, and made up for."""

from dataclasses import replace
from functools import cache
import math

from gain_worlds import configuration_error_m, drive, estimate
import numpy as np
import pytest
from random_runs import held, propagate

from slam_observer_ros.estimates import MotionFactor
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.filter.flat_arrays import Interval
from slam_observer_ros.models.held_velocities import HeldVelocities
from slam_observer_ros.models.motion_noise import gated_score, MotionFactors, MotionNoise
from slam_observer_ros.runs.health import of_noise
from slam_observer_ros.runs.recorders import NisTally
from slam_observer_ros.settings.estimator_settings import Settings

RIGHT = Settings(
    two_d_mode=True,
    reorder_window=0.0,
    angular_velocity_noise=(0.0, 0.0, 0.06),
    linear_velocity_noise=(0.06, 0.03, 0.0),
    angular_bias_stddev=(0.0,) * 3,
    range_noise=0.05,
    bearing_noise=0.02,
)
RANDOM = np.random.default_rng(5)


def stating(factor: float, **changed) -> Settings:
    """Settings that state the noise of the velocity so many times as large as it is."""
    kinds = ('angular_velocity_noise', 'linear_velocity_noise')
    noise = {kind: tuple(factor * value for value in getattr(RIGHT, kind)) for kind in kinds}
    return replace(RIGHT, **noise, **changed)


@cache
def world():
    return drive(RIGHT, 120.0)


@cache
def run(stated: float, motion_noise_factor: str):
    """The estimator after two minutes, told noise that is so many times as large as it is."""
    return estimate(world(), stating(stated, motion_noise_factor=motion_noise_factor))


def found(estimator) -> list[float]:
    return [part.factor for part in estimator.motion_factors]


@pytest.mark.parametrize('stated', [3.0, 1.0, 1.0 / 3.0])
def test_factors_of_the_variance_of_nine_are_found_in_two_minutes(stated):
    variances = np.square(found(run(stated, 'auto')))
    np.testing.assert_array_less(np.abs(np.log(variances * stated**2)), math.log(1.6))


@pytest.mark.parametrize('stated', [3.0, 1.0 / 3.0])
def test_what_is_applied_is_what_was_asked_for(stated):
    is_noisier = stated < 1.0
    for mode in ('stated', 'at_least_stated'):
        is_applied = is_noisier and mode != 'stated'
        for part in run(stated, mode).motion_factors:
            assert (part.factor > 1.0) == is_noisier
            assert part.applied == pytest.approx(part.factor if is_applied else 1.0)


def test_noise_that_is_stated_too_small_is_made_up_for():
    right, small = run(1.0, 'auto'), run(1.0 / 3.0, 'at_least_stated')
    error_m = configuration_error_m(right, world())
    assert configuration_error_m(small, world()) < 1.2 * error_m
    assert mean_nis('stated') > 1.5
    assert mean_nis('at_least_stated') < 1.2


def mean_nis(mode: str) -> float:
    """Innovations over what is expected of them, with a third of the noise stated."""
    tally, settings = NisTally(), stating(1.0 / 3.0, motion_noise_factor=mode)
    estimator = Estimator(settings, on_update=tally.note_update, judges_innovations=True)
    for event in world().events:
        estimator.add(event)
    return tally.mean_nis


def test_as_stated_changes_no_bit_of_the_estimate(monkeypatch):
    looked_at = run(1.0 / 3.0, 'stated')
    monkeypatch.setattr(MotionFactors, 'learn', lambda *_: None)
    monkeypatch.setattr(MotionFactors, 'flat', lambda *_: None)
    plain = estimate(world(), stating(1.0 / 3.0))  # nothing learnt, so nothing applied
    np.testing.assert_array_equal(plain.pose, looked_at.pose)
    np.testing.assert_array_equal(plain.pose_covariance, looked_at.pose_covariance)
    assert plain.motion_factors == []


def test_swapped_landmarks_and_a_carried_robot_are_no_noise_of_the_odometry():
    def disturbed(index, event):
        if 100 <= index < 105:  # by 5 m, and back again
            return replace(event, points=event.points + np.array([5.0, 0.0, 0.0]))
        if index % 10 == 9:
            return replace(event, ids=np.roll(event.ids, 1))
        if index % 3 == 1:
            points = event.points.copy()
            points[0] += np.array([1.0, -1.0, 0.0])
            return replace(event, points=points)
        return event

    estimator = estimate(drive(RIGHT, 60.0).with_observations(disturbed), RIGHT)
    assert max(found(estimator)) < 1.6


def test_gaps_and_a_robot_that_stands_say_nothing():
    factors, seen = MotionFactors(Settings()), (np.ones((1, 2)), np.eye(2), np.eye(3)[None, :2])
    shares = np.array([np.eye(3)] * 2)
    factors.learn(*seen)  # no motion at all
    factors.move(shares)
    factors.move(None)
    factors.learn(*seen)
    assert factors.estimates == []
    factors.move(shares)
    factors.learn(*seen)
    assert [part.name for part in factors.estimates] == ['turning', 'driving']


@pytest.mark.parametrize('what', ['it stands', 'a gap', 'a slip'])
def test_of_what_motion_nothing_can_be_learnt(what):
    gains, noise = make_gains(RIGHT, np.eye(4)), 0.01 * np.eye(6)[None]
    motion = propagate(gains, np.ones((1, 6)), np.array([0.1]), noise)
    of_turning, of_driving = gains.motion_noise.factors.flat().shares
    np.testing.assert_allclose(of_turning + of_driving, motion.noise)
    np.testing.assert_allclose(of_turning.diagonal(), [0.01, 0.0, 0.0], atol=1e-3)
    if what == 'it stands':
        propagate(gains, np.zeros((1, 6)), np.array([0.1]), noise)
    elif what == 'a gap':
        brief = held(np.ones((1, 6)), np.array([0.1]))._replace(timeout_ns=10**7)
        gains.advance(brief, Interval(0, 10**8, 0, 0, None))
    else:
        gains.slip(np.eye(4), noise[0])
    assert gains.motion_noise.factors.flat() is None


def test_every_hypothesis_has_its_own_and_a_reset_forgets_them():
    estimator = estimate(drive(RIGHT, 5.0), RIGHT)
    factors = estimator._state.motion_noise.factors
    copied = estimator._state.copy().motion_noise.factors
    assert copied.estimates == factors.estimates
    copied.move(np.array([np.eye(3)] * 2))
    copied.learn(np.ones((1, 2)), np.eye(2), np.eye(3)[None, :2])
    assert copied.estimates != factors.estimates
    estimator.reset()
    assert estimator.motion_factors == []


def test_score_and_information_are_those_of_the_likelihood():
    # ln p(r) = −½ (rᵀ S⁻¹ r + ln |S|), S = R + Σ e^θ_j M_j, and its mean curvature.
    settings, m, p = Settings(motion_noise_factor='auto'), 3, 6
    C = RANDOM.standard_normal((m, 3, p))
    roots = 0.3 * RANDOM.standard_normal((2, p, 2))
    N = roots @ roots.swapaxes(1, 2)
    flat = C.reshape(-1, p)
    M = flat @ N @ flat.T
    r = 0.5 * RANDOM.standard_normal((m, 3))

    def log_likelihood(theta):
        S = np.eye(3 * m) + np.einsum('j,jab->ab', np.exp(theta), M)
        return -0.5 * (r.ravel() @ np.linalg.solve(S, r.ravel()) + np.linalg.slogdet(S)[1])

    S = np.eye(3 * m) + M.sum(axis=0)
    g, F = gated_score(r, S, flat, N, np.full(m, 3), settings.rejection_threshold)
    for j, step in enumerate(1e-5 * np.eye(2)):
        slope = (log_likelihood(step) - log_likelihood(-step)) / 2e-5
        assert g[j] == pytest.approx(slope, rel=1e-6)
    A = np.linalg.solve(S, M)
    np.testing.assert_allclose(F, 0.5 * np.einsum('jab,kba->jk', A, A), rtol=1e-10)


def test_factors_multiply_covariances_of_messages_too_but_not_those_of_gaps():
    k, usual_s = 2, np.array([0.1, 0.1])
    stated = np.array([np.eye(6)] * k)
    held = HeldVelocities(
        np.ones((k, 6)), stated, np.ones((k, 2), dtype=bool),
        np.array([0.1, 0.0]), np.array([0.0, 2.0]), np.zeros((k, 2)),
        np.empty(0), np.empty((0, 6)), usual_s,
    )  # fmt: skip
    noise = MotionNoise(Settings())
    before = noise.covariances(held)
    assert (before[1].diagonal() > 0.0).all()
    noise.factors.applied = np.array([4.0, 9.0])
    of_motion, of_gap = noise.covariances(held)
    np.testing.assert_allclose(
        of_motion.diagonal() / before[0].diagonal(), np.repeat([4.0, 9.0], 3)
    )
    np.testing.assert_array_equal(of_gap, before[1])


def test_a_clearly_noisier_odometry_is_named_with_the_line_to_paste():
    turning, driving = of_noise(run(1.0 / 3.0, 'at_least_stated').motion_factors)
    assert turning.what.startswith('the odometry is 3')
    line = 'noisier in turning than stated: set angular_velocity_noise: [0, 0, 0.0'
    assert line in turning.text()
    assert 'linear_velocity_noise: [0.0' in driving.text()
    assert not of_noise([MotionFactor('turning', 2.0, 0.4, 2.0, '')])  # may be chance
    assert not of_noise(run(1.0, 'auto').motion_factors)


def test_only_riccati_gains_have_factors():
    estimator = estimate(drive(RIGHT, 5.0), replace(RIGHT, gains='constant'))
    assert estimator.motion_factors == []
