"""Which point is of which landmark: the search for the cheapest pairing, and what each costs."""

from __future__ import annotations

from dataclasses import replace
import itertools

from hypothesis import given
from hypothesis import strategies as st
from nameless_points import creep, observe, SPATIAL, stand
import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.robust import huber_loss
from slam_observer_ros.tracking.assignments import Assignment
from slam_observer_ros.tracking.costs import NewLandmarks
from slam_observer_ros.tracking.interpretations import _slips_without_ids, interpretations
from slam_observer_ros.tracking.joint_compatibility import (
    columns_of,
    joint_cost,
    JointSearch,
    MAX_PARTIAL,
    NewCosts,
    Pairs,
)


@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(1, 3), st.sampled_from([2, 3]))
def test_where_few_pairings_are_possible_the_search_finds_the_cheapest(seed, points, landmarks, k):
    rng = np.random.default_rng(seed)
    at, rows = np.nonzero(rng.random((points, landmarks)) < 0.8)
    q, gate = len(at), 3.0
    root = rng.normal(size=(q * k, q * k))
    noise = np.tile(0.3 * np.eye(k), (q, 1, 1))
    S = 0.2 * root @ root.T + np.kron(np.eye(q), 0.3 * np.eye(k))
    r = rng.normal(scale=1.5, size=(q, k))
    options = np.bincount(at, minlength=points)

    def cost(chosen):
        in_order = sorted(chosen, key=lambda i: (options[at[i]], at[i]))
        columns = columns_of(in_order, k)
        root = np.linalg.cholesky(S[np.ix_(columns, columns)])
        whitened = np.linalg.solve(root, r[in_order].ravel()).reshape(-1, k)
        log_ratio = 2 * np.sum(np.log(np.diag(root))) - len(chosen) * k * np.log(0.3)
        unpaired = len(np.unique(at)) - len(chosen)
        return (
            np.sum(huber_loss(np.linalg.norm(whitened, axis=1)))
            + log_ratio
            + unpaired * huber_loss(gate)
        )

    possible = [
        chosen
        for count in range(q + 1)
        for chosen in itertools.combinations(range(q), count)
        if len({at[i] for i in chosen}) == len({rows[i] for i in chosen}) == count
    ]
    pairs = Pairs(at, rows, r, S, noise)
    certain, unpaired_costs = np.zeros(q, dtype=bool), np.full(q, huber_loss(gate))
    found = JointSearch(pairs, certain, unpaired_costs, np.inf).pairings()
    least = min(cost(chosen) for chosen in possible)
    assert found[0].cost == pytest.approx(least)
    assert found[0].cost == pytest.approx(cost(found[0].chosen))
    assert len(found) == min(len(possible), MAX_PARTIAL)
    costs = [
        pairing.cost for pairing in JointSearch(pairs, certain, unpaired_costs, 10.0).pairings()
    ]
    assert costs == sorted(costs)
    assert costs[-1] <= costs[0] + 10.0


@given(st.integers(0, 10_000), st.integers(1, 4), st.sampled_from([2, 3]))
def test_where_each_point_may_be_of_one_landmark_all_pairs_are_what_the_search_finds(seed, q, k):
    rng = np.random.default_rng(seed)
    noise, root = np.tile(0.3 * np.eye(k), (q, 1, 1)), rng.normal(size=(q * k, q * k))
    S = 0.2 * root @ root.T + np.kron(np.eye(q), 0.3 * np.eye(k))
    PC, r = rng.normal(size=(3, q * k)), rng.normal(size=(q, k))
    pairs = Pairs(np.arange(q), np.arange(q), r, S, noise, PC)
    search = JointSearch(pairs, np.zeros(q, dtype=bool), np.full(q, huber_loss(2.5)), np.inf)
    together, found = search.all_pairs(), search.pairings()
    (same,) = [pairing for pairing in found if len(pairing.chosen) == q]
    assert_allclose(same.move, PC @ np.linalg.solve(S, r.ravel()))
    if together is None:  # one of them is better left out
        L = np.linalg.cholesky(S)
        z, log_diagonal = np.linalg.solve(L, r.ravel()), np.log(np.diag(L)).reshape(q, k)
        distances = np.linalg.norm(z.reshape(q, k), axis=1)
        rises = huber_loss(distances) + 2.0 * log_diagonal.sum(axis=1)
        assert max(rises - k * np.log(0.3)) > huber_loss(2.5)
        return
    assert together.cost == pytest.approx(same.cost)
    assert_allclose(together.move, same.move)


@given(st.integers(0, 10_000), st.integers(0, 5), st.sampled_from([2, 3]))
def test_what_ids_cost_does_not_depend_on_the_order_of_points(seed, m, k):
    rng = np.random.default_rng(seed)
    root, noise = rng.normal(size=(m * k, m * k)), np.tile(0.3 * np.eye(k), (m, 1, 1))
    S = root @ root.T + np.kron(np.eye(m), 0.3 * np.eye(k))
    r = rng.normal(scale=5.0, size=(m, k))
    order = rng.permutation(m)
    columns = columns_of(order.tolist(), k)
    turned = joint_cost(r[order], S[np.ix_(columns, columns)], noise)
    assert joint_cost(r, S, noise) == pytest.approx(turned)
    near = 0.1 * r / (1.0 + np.linalg.norm(np.linalg.solve(S, r.ravel())))
    plain = near.ravel() @ np.linalg.solve(S, near.ravel())
    log_ratio = np.linalg.slogdet(S)[1] - m * k * np.log(0.3)
    assert joint_cost(near, S, noise) == pytest.approx(plain + log_ratio)


def test_what_new_landmarks_cost_does_not_depend_on_what_else_is_in_the_map():
    """Else states with other maps could not be compared."""
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    costs = []
    for some_have_no_id in (False, True):
        estimator = Estimator(SPATIAL)
        for step in range(10):
            stand(estimator, 0.1 * step)
            far = [[30.0, 30.0, 0.0]] if some_have_no_id else []
            observe(estimator, 0.1 * step, [*points, *far], [1, 2, *[UNKNOWN_ID] * len(far)])
        new = np.array([*points, [-2.0, 2.0, 0.0]])
        event = ObservationEvent(estimator.stamp_ns, np.array([1, 2, 77]), new)
        state = estimator._hypotheses.best
        new_costs = NewCosts(np.full(3, 20.0), np.zeros(3))
        (only,) = interpretations(state, event, np.arange(3), new_costs, np.inf)
        costs.append(only.cost)
    assert costs[0] == pytest.approx(costs[1], abs=0.5)


def test_a_slip_is_for_what_nothing_else_explains():
    """All points are 1 m aside: new, a slip, or within reach of the gate or a hypothesis."""
    points = np.array([[3.0, 0.0, 0.0], [0.0, 3.0, 1.0], [-3.0, 1.0, 0.0], [2.0, -3.0, 0.5]])
    estimator = Estimator(SPATIAL)
    for step in range(10):
        stand(estimator, 0.1 * step)
        observe(estimator, 0.1 * step, points)
    creep(estimator, 1.0)
    state, ids = estimator._hypotheses.best, 100 + np.arange(4)
    unknown = np.full(4, UNKNOWN_ID)
    event = ObservationEvent(estimator.stamp_ns, unknown, points + [1.0, 0.0, 0.0])
    costs, none = NewCosts(np.full(4, 20.0), np.zeros(4)), np.zeros(4)
    new = Assignment(unknown, none, 80.0, none)
    (slip,) = _slips_without_ids(state, event, ids, costs, [new])
    assert slip.slipped is not None
    assert not _slips_without_ids(state, event, ids, costs, [])
    estimator.set_pose(estimator.pose, 4.0 * np.eye(6))
    assert not _slips_without_ids(state, event, ids, costs, [new])


def test_on_new_ground_a_new_landmark_costs_less_and_where_all_is_known_as_much_as_the_gate():
    """One in each observation of 50 m², measured to 0.1 m."""
    new, gate_cost, noise = NewLandmarks(), huber_loss(6.0), 0.01 * np.eye(2)[None]
    event = ObservationEvent(0, np.full(5, UNKNOWN_ID), np.zeros((5, 3)))
    for second in range(100):
        new.note(replace(event, stamp_ns=second * 10**9), new=1)
    expected = -2.0 * np.log(2.0 * np.pi * 0.01 / 50.0)
    assert new.costs(noise, 50.0, gate_cost).each == pytest.approx(expected, abs=0.1)
    finer = new.costs(0.25 * noise, 50.0, gate_cost)
    assert finer.each == pytest.approx(expected + 2.0 * np.log(4.0), abs=0.1)
    assert new.costs(noise, 0.0, gate_cost).each == gate_cost, 'nobody knows what the sensor sees'
    for second in range(100, 600):
        new.note(replace(event, stamp_ns=second * 10**9), new=0)
    assert new.costs(noise, 50.0, gate_cost).each == gate_cost
    assert new.costs(noise, 50.0, 4.0).each == 4.0, 'no more than a point at the gate'


def test_where_some_points_are_new_it_is_less_unlikely_that_others_are():
    """A robot that comes to new ground sees much that is new, and elsewhere nearly nothing."""
    new, noise = NewLandmarks(), np.tile(0.01 * np.eye(2), (5, 1, 1))
    costs, alone = new.costs(noise, 50.0, 40.0), np.eye(5, dtype=bool)
    assert costs.of(alone[0]) == pytest.approx(costs.each[0], abs=0.2)
    for count in range(2, 6):
        some = alone[:count].any(axis=0)
        assert costs.of(some) < count * costs.each[0] - 0.5
        assert costs.of(some) > costs.of(alone[: count - 1].any(axis=0))
