"""Robot and tags: the lemmas of SLAM_n(3) with orientations, and the constant output matrix."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import slam_group
from slam_group import SlamElement, TotalState
from strategies import elements, generators, LANDMARK_COUNTS, points, poses, states
import tag_group
from tag_group import (
    alpha,
    compose,
    inverse,
    output,
    phi_total,
    rho,
    TagElement,
    TagOutput,
    TagState,
)

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3, so3

ROUNDING = 1e-11
STEP = 1e-6
BY_DIFFERENCES = 1e-7

with_tags = pytest.mark.parametrize('n', LANDMARK_COUNTS)


def random_rotations(n: int) -> st.SearchStrategy[FloatArray]:
    return generators().map(lambda random: so3.exp(random.normal(size=(n, 3))))


def tag_elements(n: int) -> st.SearchStrategy[TagElement]:
    return st.builds(TagElement, elements(n), random_rotations(n))


def tag_states(n: int) -> st.SearchStrategy[TagState]:
    return st.builds(TagState, states(n), random_rotations(n))


def outputs(n: int) -> st.SearchStrategy[TagOutput]:
    return st.builds(TagOutput, points(n), random_rotations(n))


def identity(n: int) -> TagElement:
    return TagElement(slam_group.identity(n), np.tile(np.eye(3), (n, 1, 1)))


def assert_close(found: FloatArray, expected: FloatArray, atol: float = ROUNDING) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def assert_same_element(X: TagElement, Y: TagElement) -> None:
    assert_close(X.X.A, Y.X.A)
    assert_close(X.X.a, Y.X.a)
    assert_close(X.B, Y.B)


def assert_same_state(one: TagState, other: TagState) -> None:
    assert_close(one.Xi.P, other.Xi.P)
    assert_close(one.Xi.p, other.Xi.p)
    assert_close(one.R, other.R)


def assert_same_output(one: TagOutput, other: TagOutput) -> None:
    assert_close(one.y, other.y)
    assert_close(one.Z, other.Z)


@with_tags
@given(data=st.data())
def test_lemma_4_1_it_is_a_group(n: int, data: st.DataObject) -> None:
    X, Y, Z = (data.draw(tag_elements(n)) for _ in range(3))
    assert_same_element(compose(compose(X, Y), Z), compose(X, compose(Y, Z)))
    assert_same_element(compose(X, identity(n)), X)
    assert_same_element(compose(X, inverse(X)), identity(n))
    assert_same_element(compose(inverse(X), X), identity(n))


@with_tags
@given(data=st.data())
def test_lemma_4_1_exp_traces_one_parameter_subgroups(n: int, data: st.DataObject) -> None:
    rng = data.draw(generators())
    Delta, d, omega = rng.normal(size=6), rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    s, t = rng.uniform(-1.0, 1.0, size=2)

    def along(t: float) -> TagElement:
        return tag_group.exp(t * Delta, t * d, t * omega)

    assert_same_element(compose(along(s), along(t)), along(s + t))


@with_tags
@given(data=st.data())
def test_lemma_4_2_phi_is_a_right_action_well_defined_on_the_quotient(
    n: int, data: st.DataObject
) -> None:
    X, Y, state = (data.draw(each) for each in (tag_elements(n), tag_elements(n), tag_states(n)))
    S = data.draw(poses())
    assert_same_state(phi_total(identity(n), state), state)
    assert_same_state(phi_total(X, phi_total(Y, state)), phi_total(compose(Y, X), state))
    assert_same_state(phi_total(X, alpha(S, state)), alpha(S, phi_total(X, state)))
    assert_same_output(output(alpha(S, state)), output(state))


@with_tags
@given(data=st.data())
def test_lemma_4_2_phi_is_transitive(n: int, data: st.DataObject) -> None:
    state, goal = data.draw(tag_states(n)), data.draw(tag_states(n))
    back = se3.inverse(state.Xi.P)
    moves = SlamElement(back @ goal.Xi.P, se3.rotate(back, goal.Xi.p - state.Xi.p))
    X = TagElement(moves, state.R.swapaxes(-1, -2) @ goal.R)
    assert_same_state(phi_total(X, state), goal)


@with_tags
@given(data=st.data())
def test_lemma_4_4_kinematics_are_equivariant(n: int, data: st.DataObject) -> None:
    """Tags at rest stay where they are, whichever element has moved them before."""
    X, state, rng = data.draw(tag_elements(n)), data.draw(tag_states(n)), data.draw(generators())
    V = rng.normal(size=6)

    def after(state: TagState, V: FloatArray) -> TagState:
        return TagState(TotalState(state.Xi.P @ se3.exp(V), state.Xi.p), state.R)

    # Moved by X, the robot goes along Ad_A⁻¹ V, and the positions by what (26) says of them.
    turned = se3.adjoint(se3.inverse(X.X.A)) @ V
    moved_after, after_moved = phi_total(X, after(state, V)), after(phi_total(X, state), turned)
    assert_close(moved_after.Xi.P, after_moved.Xi.P)
    assert_close(moved_after.R, after_moved.R)


@with_tags
@given(data=st.data())
def test_lemma_4_5_rho_is_a_right_action_and_the_output_equivariant(
    n: int, data: st.DataObject
) -> None:
    X, Y, seen = (data.draw(each) for each in (tag_elements(n), tag_elements(n), outputs(n)))
    state = data.draw(tag_states(n))
    assert_same_output(rho(identity(n), seen), seen)
    assert_same_output(rho(X, rho(Y, seen)), rho(compose(Y, X), seen))
    assert_same_output(rho(X, output(state)), output(phi_total(X, state)))


def residuals(X_hat: TagElement, X: TagElement, origin: TagState) -> FloatArray:
    """What tags (n,) say: positions r_i and rotations log(R_Â Z_i B̂_iᵀ Z_i°ᵀ), (n, 6)."""
    e = rho(inverse(X_hat), output(phi_total(X, origin)))
    at_reference = output(origin)
    turns = so3.log(e.Z @ at_reference.Z.swapaxes(-1, -2))
    return np.concatenate([turns, e.y - at_reference.y], axis=-1)


@with_tags
@given(data=st.data())
def test_residuals_depend_on_the_error_alone(n: int, data: st.DataObject) -> None:
    E, X, Y = (data.draw(tag_elements(n)) for _ in range(3))
    origin = data.draw(tag_states(n))
    assert_close(
        residuals(compose(E, X), X, origin), residuals(compose(E, Y), Y, origin), atol=1e-8
    )


def output_matrix(n: int) -> FloatArray:
    """C (n, 6, 6 + 6 n) of x = (ε, ξ_1, ω_1, …): turns [I 0 … −I], positions [0 I … −I]."""
    C = np.zeros((n, 6, 6 + 6 * n))
    C[:, :, :6] = np.eye(6)
    for i in range(n):
        C[i, :3, 9 + 6 * i : 12 + 6 * i] = C[i, 3:, 6 + 6 * i : 9 + 6 * i] = -np.eye(3)
    return C


def error(x: FloatArray, n: int) -> TagElement:
    parts = x[6:].reshape(n, 2, 3)
    return tag_group.exp(x[:6], parts[:, 0], parts[:, 1])


@given(rng=generators())
def test_the_output_matrix_is_constant(rng: np.random.Generator) -> None:
    """With poses of the frame P° for a reference, as the filter has it, whatever the state is."""
    n = 3
    X = TagElement(
        SlamElement(se3.exp(rng.normal(size=6)), rng.normal(size=(n, 3))),
        so3.exp(rng.normal(size=(n, 3))),
    )
    origin = TagState(TotalState(np.eye(4), np.zeros((n, 3))), identity(n).B)
    columns = [
        (
            residuals(compose(error(h, n), X), X, origin)
            - residuals(compose(error(-h, n), X), X, origin)
        )
        / (2 * STEP)
        for h in STEP * np.eye(6 + 6 * n)
    ]
    assert_close(np.moveaxis(np.array(columns), 0, -1), output_matrix(n), BY_DIFFERENCES)


@given(rng=generators())
def test_it_is_se3_for_each_tag_in_other_coordinates(rng: np.random.Generator) -> None:
    """SE(3)ⁿ⁺¹, with η_i of T̂_i = exp(η_i) T_i, has C = [I −I] too: the same to first order.

    (ξ_i, ω_i) are η_i = (ω_i, ξ_i + [ŷ_i]× (ω_i − ε_Ω)), and its residual is ours, the position's
    seen about the origin: both are the same filter until their second order.
    """
    A = se3.exp(rng.normal(size=6))
    T = se3.exp(rng.normal(size=(1, 6)))
    eta, epsilon = STEP * rng.normal(size=(2, 6))
    A_hat, T_hat = se3.exp(epsilon) @ A, se3.exp(eta) @ T
    Z = se3.inverse(A) @ T
    of_pose = se3.log(A_hat @ Z @ se3.inverse(T_hat))[0]
    assert_close(of_pose, epsilon - eta, STEP * 1e-4)
    omega, y = eta[:3], T_hat[0, :3, 3]
    xi = eta[3:] - np.cross(y, omega - epsilon[:3])
    turn = so3.log(A_hat[:3, :3] @ Z[0, :3, :3] @ T_hat[0, :3, :3].T)
    r = se3.transform(A_hat, Z[:, :3, 3])[0] - y
    assert_close(turn, epsilon[:3] - omega, STEP * 1e-4)
    assert_close(r, epsilon[3:] - xi, STEP * 1e-4)
    assert_close(of_pose[3:], r + np.cross(y, turn), STEP * 1e-4)
