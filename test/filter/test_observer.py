"""The observer: error (29), innovation (30)-(31) and Lyapunov function (34)-(35)."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_runs import propagate
import slam_group
from slam_group import SlamElement, TotalState
from strategies import generators, poses, rotations

from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.filter.constant import (
    centroid_step,
    paper_step,
    safe_step,
)
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.observer import innovation, lyapunov, lyapunov_rate, Observer
from slam_observer_ros.lie import se3
from slam_observer_ros.settings.estimator_settings import Settings

PAPER_LANDMARKS = np.array([[4.0, 0, 0], [-4, 0, 0], [0, 4, 0], [0, -4, 0]])
PAPER_VELOCITY = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])
NO_NOISE = np.zeros((4, 3, 3))


def paper_truth(time_s):
    """True pose on the paper's circle."""
    start = np.eye(4)
    start[:3, 3] = [0.0, -5.0, 2.0]
    return start @ se3.exp(PAPER_VELOCITY * time_s)


def paper_observation(time_s):
    return se3.transform(se3.inverse(paper_truth(time_s)), PAPER_LANDMARKS)


def biased_filter(reference_pose=None, bias_m=0.5):
    """Constant gains whose reference landmarks carry a bias, as in section VI."""
    biased = make_gains(
        Settings(gains='constant'), np.eye(4) if reference_pose is None else reference_pose
    )
    directions = np.random.default_rng(3).normal(size=(4, 3))
    biases = bias_m * directions / np.linalg.norm(directions, axis=1)[:, None]
    biased.add(paper_observation(0.0) + biases, NO_NOISE)
    return biased


def observe(filter_, rows, points, dt_s):
    """Correct a filter by landmarks that were seen ``dt_s`` before."""
    filter_.correct(rows, points, np.broadcast_to(dt_s, len(rows)))


def integrate_paper_ode(sign_of_landmarks, sign_of_pose, duration_s, dt_s=1e-3):
    """Explicit Euler on (28) with chosen signs of (30) and (31); return L at the end."""
    observer = biased_filter().observer
    gain_k, gain_l = np.full(4, 4.0), np.full(4, 1.0)
    level = np.inf
    for step in range(round(duration_s / dt_s)):
        e, r = observer.errors(slice(None), paper_observation(step * dt_s))
        level = lyapunov(4.0, r)
        if level > 1e6:
            break
        Delta, _ = innovation(gain_k, gain_l, e, r, observer.a)
        Delta = sign_of_pose * Delta
        delta = observer.a @ Delta[:3, :3].T + sign_of_landmarks * 0.25 * r
        observer.A[...] = observer.A @ se3.exp(PAPER_VELOCITY * dt_s)
        observer.A[...] = se3.exp(se3.vee(Delta) * dt_s) @ observer.A
        observer.a[...] = observer.a + delta * dt_s
    return level


def test_errors_are_rho_of_the_inverse_state_29():
    rng = np.random.default_rng(0)
    observer = Observer(np.eye(4))
    observer.add_reference_landmarks(rng.normal(size=(5, 3)))
    observer.A[...] = se3.exp(rng.normal(size=6))
    observer.a[...] = rng.normal(size=(5, 3))
    y = rng.normal(size=(5, 3))
    X_hat = SlamElement(observer.A, observer.a)
    e, r = observer.errors(np.arange(5), y)
    np.testing.assert_allclose(e, slam_group.rho(slam_group.inverse(X_hat), y), atol=1e-12)
    np.testing.assert_allclose(r, e - observer.y_ref, atol=1e-12)


@given(poses(), generators())
def test_estimate_is_phi_of_state_and_reference_23(reference_pose, rng):
    estimated = make_gains(Settings(gains='constant'), reference_pose)
    observer = estimated.observer
    observer.add_reference_landmarks(rng.normal(size=(4, 3)))
    observer.A[...] = se3.exp(rng.normal(size=6))
    observer.a[...] = rng.normal(size=(4, 3))
    reference = TotalState(reference_pose, se3.transform(reference_pose, observer.y_ref))
    estimate = slam_group.phi_total(SlamElement(observer.A, observer.a), reference)
    np.testing.assert_allclose(observer.pose, estimate.P, atol=1e-9)
    np.testing.assert_allclose(estimated.observer.world_points, estimate.p, atol=1e-9)


@given(poses(), generators())
def test_residual_vanishes_exactly_where_the_output_fits_for_any_reference_pose(
    reference_pose, rng
):
    estimated = make_gains(Settings(gains='constant'), reference_pose)
    observer = estimated.observer
    observer.A[...] = se3.exp(rng.normal(size=6))
    points = rng.normal(size=(3, 3))
    observer.add_landmarks(points)
    observer.A[...] = se3.path(observer.A, 0.4 * rng.normal(size=(2, 6)))[-1]
    predicted = se3.transform(se3.inverse(observer.pose), estimated.observer.world_points)
    np.testing.assert_allclose(estimated.observer.body_points(np.arange(3)), predicted, atol=1e-10)
    _, r = observer.errors(slice(None), predicted)
    np.testing.assert_allclose(r, 0.0, atol=1e-10)


def test_a_path_that_was_moved_along_stays_as_it_was():
    gains = make_gains(Settings(gains='constant'), np.eye(4))
    V = np.array([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0]])
    path = propagate(gains, V, np.array([0.5]), np.zeros((1, 6, 6))).A
    before = path.copy()
    np.testing.assert_array_equal(gains.observer.A, before)
    gains.observer.A[:3, 3] += 1.0
    np.testing.assert_array_equal(path, before)


@given(generators(), st.integers(0, 6))
def test_lyapunov_rate_35_is_the_derivative_of_34_under_the_innovation(rng, n):
    observer = Observer(np.eye(4))
    observer.add_reference_landmarks(rng.normal(size=(n, 3)))
    observer.A[...] = se3.exp(rng.normal(size=6))
    observer.a[...] = rng.normal(size=(n, 3))
    y = rng.normal(size=(n, 3))
    gain_k, gain_l = rng.uniform(0.1, 5.0, n), rng.uniform(0.1, 5.0, n)
    e, r = observer.errors(slice(None), y)
    Delta, delta = innovation(gain_k, gain_l, e, r, observer.a)

    def level_after(dt_s):
        A = se3.exp(se3.vee(Delta) * dt_s) @ observer.A
        moved = se3.transform(A, y) - (observer.a + delta * dt_s)
        return lyapunov(gain_k, moved - observer.y_ref)

    h = 1e-6
    slope = (level_after(h) - level_after(-h)) / (2 * h)
    rate = lyapunov_rate(gain_k, gain_l, e, r)
    assert slope == pytest.approx(rate, rel=1e-5, abs=1e-6)
    assert rate <= 0.0


@pytest.mark.parametrize(
    ('sign_of_landmarks', 'sign_of_pose', 'converges'),
    [(1.0, 1.0, True), (-1.0, 1.0, False), (1.0, -1.0, False), (-1.0, -1.0, False)],
)
def test_only_the_corrected_signs_of_30_and_31_converge(
    sign_of_landmarks, sign_of_pose, converges
):
    r = biased_filter().observer.errors(slice(None), paper_observation(0.0))[1]
    start = lyapunov(4.0, r)
    end = integrate_paper_ode(sign_of_landmarks, sign_of_pose, duration_s=8.0)
    assert (end < 0.1 * start) if converges else (end > 10.0 * start)


@given(poses())
def test_any_reference_pose_gives_the_same_configuration(reference_pose):
    def final_output(P):
        biased = biased_filter(P)
        observer = biased.observer
        for step in range(40):
            observe(biased, np.arange(4), paper_observation(0.1 * step), 0.1)
            observer.A[...] = observer.A @ se3.exp(0.1 * PAPER_VELOCITY)
        return se3.transform(se3.inverse(observer.pose), biased.observer.world_points)

    np.testing.assert_allclose(final_output(reference_pose), final_output(np.eye(4)), atol=1e-8)


@given(
    generators(),
    st.integers(1, 11),
    st.floats(-1, 4),
    st.floats(-2, 2),
    st.floats(-4, 1),
    rotations(),
    st.sampled_from(['exponential', 'paper']),
)
def test_lyapunov_never_increases_at_any_step_gain_distance_and_rotation(
    rng, n, log_distance, log_gain, log_dt, turn, step_mode
):
    distance_m, k = 10.0**log_distance, 10.0**log_gain
    dt_s = 10.0**log_dt * rng.uniform(0.0, 1.0, n) ** rng.integers(0, 2)
    y_ref = distance_m * rng.normal(size=(n, 3))
    points = y_ref @ turn.T + 0.3 * distance_m * rng.normal(size=(n, 3))
    gain_l = k * rng.uniform(0.01, 10.0)
    settings = Settings(gains='constant', gain_k=k, gain_l=gain_l, step_mode=step_mode)
    constant = make_gains(settings, np.eye(4))
    constant.add_known(KnownLandmarks(y_ref, np.zeros((n, 3, 3))))
    observe(constant, np.arange(n), points, dt_s)
    _, remaining = constant.observer.errors(slice(None), points)
    before = lyapunov(k, points - y_ref)
    assert lyapunov(k, remaining) <= before * (1.0 + 1e-9) + 1e-18 * k * distance_m**2


def test_paper_step_converges_to_the_paper_ode_with_first_order():
    rng = np.random.default_rng(5)
    e, k = rng.normal(size=(4, 3)), np.full(4, 2.0)
    r = 0.3 * rng.normal(size=(4, 3))
    Delta, _ = innovation(k, k, e, r, np.zeros((4, 3)))
    errors = []
    for dt_s in (1e-2, 1e-3, 1e-4):
        rate = se3.log(paper_step(k, e, r, dt_s)) / dt_s
        errors.append(np.linalg.norm(rate - se3.vee(Delta)))
    orders = np.log10(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.15)


@given(generators(), st.integers(1, 6))
def test_the_paper_step_mode_moves_the_state_by_the_innovation_30_31(rng, n):
    settings = Settings(gains='constant', gain_k=2.0, gain_l=3.0, step_mode='paper')
    constant, dt_s = make_gains(settings, np.eye(4)), 1e-7
    observer = constant.observer
    observer.add_reference_landmarks(rng.normal(size=(n, 3)))
    observer.A[...], observer.a[...] = se3.exp(rng.normal(size=6)), rng.normal(size=(n, 3))
    before, a, y = observer.A.copy(), observer.a.copy(), rng.normal(size=(n, 3))
    e, r = observer.errors(slice(None), y)
    Delta, delta = innovation(np.full(n, 2.0), np.full(n, 3.0), e, r, a)
    observe(constant, np.arange(n), y, dt_s)
    rate = se3.log(observer.A @ se3.inverse(before)) / dt_s
    np.testing.assert_allclose(rate, se3.vee(Delta), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose((observer.a - a) / dt_s, delta, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize('step_mode', ['exponential', 'paper'])
@pytest.mark.parametrize('n', [0, 1, 2])
def test_steps_with_few_or_coinciding_landmarks_stay_finite(step_mode, n):
    step = paper_step if step_mode == 'paper' else centroid_step
    e = np.ones((n, 3))
    D = safe_step(step, np.full(n, 4.0), e, 0.5 * e, 10.0)
    assert np.all(np.isfinite(D))


def test_far_landmarks_that_overflow_the_explicit_step_converge():
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(100, 3))
    y_ref = 50.0 * directions / np.linalg.norm(directions, axis=1)[:, None]
    constant, levels = make_gains(Settings(gains='constant'), np.eye(4)), []
    known = y_ref + 0.5 * rng.normal(size=y_ref.shape)
    constant.add_known(KnownLandmarks(known, np.zeros((100, 3, 3))))
    for _ in range(500):
        levels.append(lyapunov(4.0, constant.observer.errors(slice(None), y_ref)[1]))
        observe(constant, np.arange(100), y_ref, 0.02)
    assert levels[-1] < 0.02 * levels[0]
    assert np.all(np.diff(levels) <= 0.0)


def test_unseen_landmarks_stay_where_they_are_in_the_world():
    biased = biased_filter()
    biased.observer.a[...] = 0.1 * np.ones((4, 3))
    before = biased.observer.world_points
    observe(biased, np.array([0, 1]), paper_observation(0.0)[:2], 0.1)
    np.testing.assert_array_equal(biased.observer.world_points[2:], before[2:])
    assert (biased.observer.world_points[:2] != before[:2]).any()
