"""SLAM_n(3): every lemma of the paper, by name, with no landmark, with one and with many."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import slam_group
from slam_group import (
    compose,
    identity,
    inverse,
    SlamElement,
    SlamVelocity,
    Tangent,
    TotalState,
)
from strategies import elements, LANDMARK_COUNTS, points, poses, states, velocities

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

ROUNDING = 1e-11
# Central differences with this step: errors of about h² |u|³ and 1e-15 / h.
STEP_S = 1e-5
BY_DIFFERENCES = 2e-6

with_landmarks = pytest.mark.parametrize('n', LANDMARK_COUNTS)
with_some_landmarks = pytest.mark.parametrize('n', [n for n in LANDMARK_COUNTS if n > 0])


def assert_close(found: FloatArray, expected: FloatArray, atol: float = ROUNDING) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def assert_same_element(X: SlamElement, Y: SlamElement) -> None:
    assert_close(X.A, Y.A)
    assert_close(X.a, Y.a)


def assert_same_state(Xi: TotalState, other: TotalState) -> None:
    assert_close(Xi.P, other.P)
    assert_close(Xi.p, other.p)


def assert_same_velocity(u: SlamVelocity, w: SlamVelocity) -> None:
    assert_close(u.V, w.V)
    assert_close(u.v, w.v)


def assert_same_tangent(found: Tangent, expected: Tangent, atol: float = ROUNDING) -> None:
    assert_close(found.pose_rate, expected.pose_rate, atol)
    assert_close(found.point_rates, expected.point_rates, atol)


def increment(u: SlamVelocity, dt_s: float) -> SlamElement:
    return slam_group.exp(u.V * dt_s, u.v * dt_s)


def rate(curve: Callable[[float], TotalState]) -> Tangent:
    """Derivative at 0 of a curve in the total space."""
    after, before = curve(STEP_S), curve(-STEP_S)
    return Tangent((after.P - before.P) / (2 * STEP_S), (after.p - before.p) / (2 * STEP_S))


def along(start: TotalState, tangent: Tangent) -> Callable[[float], TotalState]:
    """Straight curve in the matrices of the total space with a given velocity at 0."""
    return lambda t: TotalState(start.P + t * tangent.pose_rate, start.p + t * tangent.point_rates)


def output_rate(curve: Callable[[float], TotalState]) -> FloatArray:
    """Derivative at 0 of the observations: they are coordinates of the quotient M_n(3)."""
    after, before = slam_group.output(curve(STEP_S)), slam_group.output(curve(-STEP_S))
    return (after - before) / (2 * STEP_S)


# --- The SLAM manifold (section III) ---------------------------------------------------------


@with_landmarks
@given(data=st.data())
def test_lemma_3_1_alpha_is_a_right_action(n: int, data: st.DataObject) -> None:
    S, T, Xi = data.draw(poses()), data.draw(poses()), data.draw(states(n))
    assert_same_state(slam_group.alpha(np.eye(4), Xi), Xi)
    twice = slam_group.alpha(S, slam_group.alpha(T, Xi))
    assert_same_state(twice, slam_group.alpha(T @ S, Xi))


@with_landmarks
@given(data=st.data())
def test_lemma_3_1_alpha_is_proper_since_two_states_determine_the_frame_change(
    n: int, data: st.DataObject
) -> None:
    S, Xi = data.draw(poses()), data.draw(states(n))
    moved = slam_group.alpha(S, Xi)
    assert_close(Xi.P @ se3.inverse(moved.P), S)


@with_some_landmarks
@given(data=st.data())
def test_lemma_3_1_alpha_is_not_transitive(n: int, data: st.DataObject) -> None:
    """No frame change joins two states whose observations differ, for it keeps observations."""
    S, Xi = data.draw(poses()), data.draw(states(n))
    other = TotalState(Xi.P, Xi.p + np.array([0.0, 0.0, 1.0]))
    moved = slam_group.alpha(S, Xi)
    assert slam_group.same_configuration(moved, Xi, tolerance_m=ROUNDING)
    assert not slam_group.same_configuration(moved, other, tolerance_m=0.1)


def test_lemma_3_1_without_landmarks_there_is_one_configuration() -> None:
    Xi = TotalState(se3.exp(np.arange(6.0)), np.empty((0, 3)))
    assert slam_group.same_configuration(Xi, TotalState(np.eye(4), Xi.p), tolerance_m=0.0)


@pytest.mark.parametrize('n', [0, 1, 2, 5])
def test_lemma_3_1_the_quotient_has_dimension_3n(n: int) -> None:
    """The differential of the quotient map has rank 3n: its kernel is the six frame changes."""
    random = np.random.default_rng(n)
    Xi = TotalState(se3.exp(random.normal(size=6)), random.normal(size=(n, 3)))

    def observed_along(direction: FloatArray) -> FloatArray:
        u = SlamVelocity(direction[:6], direction[6:].reshape(n, 3))
        return output_rate(lambda t: slam_group.phi_total(increment(u, t), Xi)).ravel()

    differential = np.array([observed_along(direction) for direction in np.eye(6 + 3 * n)])
    assert differential.shape == (6 + 3 * n, 3 * n)
    assert n == 0 or np.linalg.matrix_rank(differential, tol=1e-6) == 3 * n


@with_landmarks
@given(data=st.data())
def test_output_15_is_well_defined_on_the_quotient(n: int, data: st.DataObject) -> None:
    S, Xi = data.draw(poses()), data.draw(states(n))
    assert_close(slam_group.output(slam_group.alpha(S, Xi)), slam_group.output(Xi))


@with_landmarks
@given(data=st.data())
def test_configuration_13_picks_one_representative_of_each_class(
    n: int, data: st.DataObject
) -> None:
    S, Xi = data.draw(poses()), data.draw(states(n))
    representative = slam_group.configuration(Xi)
    assert_same_state(slam_group.configuration(slam_group.alpha(S, Xi)), representative)
    assert slam_group.same_configuration(representative, Xi, tolerance_m=ROUNDING)


@with_landmarks
@given(data=st.data())
def test_lemma_3_3_kinematics_are_well_defined_on_the_quotient(
    n: int, data: st.DataObject
) -> None:
    """In two frames, f gives one tangent vector in its two representations (17)."""
    S, Xi, u = data.draw(poses()), data.draw(states(n)), data.draw(velocities(n))
    f = slam_group.kinematics(Xi, u)
    S_inverse = se3.inverse(S)
    same_tangent = Tangent(S_inverse @ f.pose_rate, se3.rotate(S_inverse, f.point_rates))
    assert_same_tangent(slam_group.kinematics(slam_group.alpha(S, Xi), u), same_tangent)


@with_landmarks
@given(data=st.data())
def test_lemma_3_3_observations_move_the_same_way_in_every_frame(
    n: int, data: st.DataObject
) -> None:
    S, Xi, u = data.draw(poses()), data.draw(states(n)), data.draw(velocities(n))
    moved = slam_group.alpha(S, Xi)
    seen = output_rate(along(Xi, slam_group.kinematics(Xi, u)))
    seen_from_moved = output_rate(along(moved, slam_group.kinematics(moved, u)))
    assert_close(seen_from_moved, seen, BY_DIFFERENCES)


@with_landmarks
@given(data=st.data())
def test_kinematics_20_are_those_of_7_and_6(n: int, data: st.DataObject) -> None:
    Xi, u = data.draw(states(n)), data.draw(velocities(n))

    def solution(t: float) -> TotalState:
        world_velocities = u.v @ Xi.P[:3, :3].T
        return TotalState(Xi.P @ se3.exp(u.V * t), Xi.p + t * world_velocities)

    assert_same_tangent(rate(solution), slam_group.kinematics(Xi, u), BY_DIFFERENCES)


# --- The SLAM group (section IV) -------------------------------------------------------------


@with_landmarks
@given(data=st.data())
def test_lemma_4_1_slam_n_3_is_a_group(n: int, data: st.DataObject) -> None:
    X, Y, Z = (data.draw(elements(n)) for _ in range(3))
    assert_same_element(compose(compose(X, Y), Z), compose(X, compose(Y, Z)))
    assert_same_element(compose(X, identity(n)), X)
    assert_same_element(compose(identity(n), X), X)
    assert_same_element(compose(X, inverse(X)), identity(n))
    assert_same_element(compose(inverse(X), X), identity(n))


@with_landmarks
@given(data=st.data())
def test_lemma_4_1_exp_traces_one_parameter_subgroups(n: int, data: st.DataObject) -> None:
    u = data.draw(velocities(n))
    s, t = data.draw(st.floats(-1.0, 1.0)), data.draw(st.floats(-1.0, 1.0))
    assert_same_element(compose(increment(u, s), increment(u, t)), increment(u, s + t))


@with_landmarks
@given(data=st.data())
def test_lemma_4_2_phi_is_a_right_action(n: int, data: st.DataObject) -> None:
    X, Y, Xi = data.draw(elements(n)), data.draw(elements(n)), data.draw(states(n))
    assert_same_state(slam_group.phi_total(identity(n), Xi), Xi)
    twice = slam_group.phi_total(X, slam_group.phi_total(Y, Xi))
    assert_same_state(twice, slam_group.phi_total(compose(Y, X), Xi))
    twice_on_classes = slam_group.phi(X, slam_group.phi(Y, Xi))
    assert_same_state(twice_on_classes, slam_group.phi(compose(Y, X), Xi))


@with_landmarks
@given(data=st.data())
def test_lemma_4_2_phi_is_well_defined_on_the_quotient_24(n: int, data: st.DataObject) -> None:
    S, X, Xi = data.draw(poses()), data.draw(elements(n)), data.draw(states(n))
    moved = slam_group.phi(X, slam_group.alpha(S, Xi))
    assert_same_state(moved, slam_group.phi(X, Xi))
    assert_same_state(moved, slam_group.configuration(slam_group.phi_total(X, Xi)))


@with_landmarks
@given(data=st.data())
def test_lemma_4_2_phi_is_transitive(n: int, data: st.DataObject) -> None:
    Xi, goal = data.draw(states(n)), data.draw(states(n))
    P_inverse = se3.inverse(Xi.P)
    X = SlamElement(P_inverse @ goal.P, se3.rotate(P_inverse, goal.p - Xi.p))
    assert_same_state(slam_group.phi_total(X, Xi), goal)
    assert_same_state(slam_group.phi(X, Xi), slam_group.configuration(goal))


@with_landmarks
@given(data=st.data())
def test_lemma_4_3_psi_is_a_right_action(n: int, data: st.DataObject) -> None:
    X, Y, u = data.draw(elements(n)), data.draw(elements(n)), data.draw(velocities(n))
    assert_same_velocity(slam_group.psi(identity(n), u), u)
    twice = slam_group.psi(X, slam_group.psi(Y, u))
    assert_same_velocity(twice, slam_group.psi(compose(Y, X), u))


@with_landmarks
@given(data=st.data())
def test_lemma_4_3_psi_is_the_adjoint_of_the_inverse(n: int, data: st.DataObject) -> None:
    X, u = data.draw(elements(n)), data.draw(velocities(n))
    conjugated = compose(compose(inverse(X), increment(u, 0.5)), X)
    assert_same_element(increment(slam_group.psi(X, u), 0.5), conjugated)


@with_landmarks
@given(data=st.data())
def test_lemma_4_4_kinematics_are_equivariant(n: int, data: st.DataObject) -> None:
    X, Xi, u = data.draw(elements(n)), data.draw(states(n)), data.draw(velocities(n))
    f = slam_group.kinematics(Xi, u)
    moved_f = rate(lambda t: slam_group.phi_total(X, along(Xi, f)(t)))
    expected = slam_group.kinematics(slam_group.phi_total(X, Xi), slam_group.psi(X, u))
    assert_same_tangent(moved_f, expected, BY_DIFFERENCES)


@with_landmarks
@given(data=st.data())
def test_lemma_4_5_rho_is_a_right_action(n: int, data: st.DataObject) -> None:
    X, Y, y = data.draw(elements(n)), data.draw(elements(n)), data.draw(points(n))
    assert_close(slam_group.rho(identity(n), y), y)
    twice = slam_group.rho(X, slam_group.rho(Y, y))
    assert_close(twice, slam_group.rho(compose(Y, X), y))


@with_landmarks
@given(data=st.data())
def test_lemma_4_5_rho_is_transitive(n: int, data: st.DataObject) -> None:
    y, goal = data.draw(points(n)), data.draw(points(n))
    assert_close(slam_group.rho(SlamElement(np.eye(4), goal - y), y), goal)


@with_landmarks
@given(data=st.data())
def test_lemma_4_5_the_output_is_equivariant(n: int, data: st.DataObject) -> None:
    X, Xi = data.draw(elements(n)), data.draw(states(n))
    moved_output = slam_group.rho(X, slam_group.output(Xi))
    assert_close(moved_output, slam_group.output(slam_group.phi_total(X, Xi)))


# --- The lift (section V) --------------------------------------------------------------------


@with_landmarks
@given(data=st.data())
def test_lift_27_projects_onto_the_kinematics_with_moving_landmarks(
    n: int, data: st.DataObject
) -> None:
    """Along Ẋ = lift(X, u) the state Φ(X, Ξ°) moves with f(Φ(X, Ξ°), u), for any Ξ°."""
    X, origin, u = data.draw(elements(n)), data.draw(states(n)), data.draw(velocities(n))
    lifted = slam_group.lift(X, u)
    moved = Tangent(origin.P @ lifted.pose_rate, se3.rotate(origin.P, lifted.point_rates))
    assert_same_tangent(moved, slam_group.kinematics(slam_group.phi_total(X, origin), u))


@with_landmarks
@given(data=st.data())
def test_lift_27_is_solved_by_the_exponential(n: int, data: st.DataObject) -> None:
    X, u = data.draw(elements(n)), data.draw(velocities(n))

    def solution(t: float) -> TotalState:
        element = compose(X, increment(u, t))
        return TotalState(element.A, element.a)

    assert_same_tangent(rate(solution), slam_group.lift(X, u), BY_DIFFERENCES)
    later = compose(X, increment(u, 0.5))
    assert_same_element(compose(later, increment(u, 0.5)), compose(X, increment(u, 1.0)))


@with_landmarks
@given(data=st.data())
def test_static_landmarks_stay_and_the_pose_follows_the_held_velocity_27(
    n: int, data: st.DataObject
) -> None:
    X, V = data.draw(elements(n)), data.draw(velocities(n)).V
    static = SlamVelocity(V, np.zeros((n, 3)))
    later = compose(X, increment(static, 0.5))
    assert_same_element(later, SlamElement(X.A @ se3.exp(0.5 * V), X.a))


@with_landmarks
@given(data=st.data())
def test_error_29_is_the_output_seen_from_the_estimate(n: int, data: st.DataObject) -> None:
    """ρ(X̂⁻¹, y)_i = R_Â y_i + x_Â − â_i, the form used by the observer."""
    X, y = data.draw(elements(n)), data.draw(points(n))
    expected = se3.transform(X.A, y) - X.a
    assert_close(slam_group.rho(inverse(X), y), expected)


# --- Batches ---------------------------------------------------------------------------------


@with_landmarks
@pytest.mark.parametrize('batch_shape', [(0,), (4,), (2, 3)])
def test_stacks_of_elements_give_what_single_elements_give(
    n: int, batch_shape: tuple[int, ...]
) -> None:
    random = np.random.default_rng(3)
    twist = random.normal(size=(*batch_shape, 6))
    d, p = random.normal(size=(2, *batch_shape, n, 3))
    X = slam_group.exp(twist, d)
    Xi, u = TotalState(se3.exp(-twist), p), SlamVelocity(twist, d)

    moved, turned = slam_group.phi(X, Xi), slam_group.psi(X, u)
    seen, lifted = slam_group.rho(X, p), slam_group.lift(X, u)
    for index in np.ndindex(batch_shape):
        one = SlamElement(X.A[index], X.a[index])
        one_u = SlamVelocity(u.V[index], u.v[index])
        assert_same_element(slam_group.exp(twist[index], d[index]), one)
        one_moved = slam_group.phi(one, TotalState(Xi.P[index], Xi.p[index]))
        assert_same_state(one_moved, TotalState(moved.P[index], moved.p[index]))
        one_turned = SlamVelocity(turned.V[index], turned.v[index])
        assert_same_velocity(slam_group.psi(one, one_u), one_turned)
        assert_close(slam_group.rho(one, p[index]), seen[index])
        one_lifted = Tangent(lifted.pose_rate[index], lifted.point_rates[index])
        assert_same_tangent(slam_group.lift(one, one_u), one_lifted)


def test_exp_moves_each_landmark_by_the_left_jacobian_of_the_rotation() -> None:
    """A landmark moving at v in the frame of a turning robot draws an arc."""
    quarter_turn = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    X = slam_group.exp(quarter_turn, np.array([[1.0, 0.0, 0.0]]))
    radius = 2.0 / np.pi
    assert_close(X.a, np.array([[radius, radius, 0.0]]))
    assert_close(X.A[:3, :3], so3.exp(quarter_turn[:3]))
