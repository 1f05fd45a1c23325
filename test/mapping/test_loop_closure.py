"""Landmarks without ids that are one: at the end of a loop, and side by side."""

from dataclasses import replace

from helpers import gain_worlds
import numpy as np
from numpy.testing import assert_allclose
import pytest

from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.filter.known_landmarks import KnownLandmarks
from slam_observer_ros.filter.landmark_table import ERROR, SURE
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.loop_closure import LoopClosure
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking import hypotheses as hypotheses_module
from slam_observer_ros.tracking import step as step_module
from slam_observer_ros.tracking.costs import pairing_cost
from slam_observer_ros.tracking.hypotheses import Hypotheses
from slam_observer_ros.tracking.hypothesis import Hypothesis
from slam_observer_ros.tracking.matching import match
from slam_observer_ros.tracking.state import State
from slam_observer_ros.tracking.step import observe, step

PLANAR = Settings(two_d_mode=True, reorder_window=0.0)
LOOP_NS = 100 * 10**9
"""When the robot comes back."""

SIGMA_M = 0.02
TURN_RAD, SHIFT_M = 0.15, 1.0
"""By how much the pose may be off by then."""


def points_in_a_hall(seed, count=16):
    flat = np.random.default_rng(seed).uniform(0.0, 12.0, (count, 2))
    return np.pad(flat, ((0, 0), (0, 1)))


def grid():
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    return 3.0 * np.column_stack([x.ravel(), y.ravel(), np.zeros(16)])


def after_a_loop(points, seen, seed=0, stated=1.0):
    """A state with old landmarks, of which it has mapped ``seen`` again after drifting.

    Of the drift's standard deviation only a part is ``stated``.
    """
    rng = np.random.default_rng(seed)
    state = State(make_gains(PLANAR, np.eye(4)), PLANAR)
    old = np.arange(len(points))
    state.gains.add_known(KnownLandmarks(points, np.tile(1e-4 * np.eye(3), (len(points), 1, 1))))
    state.landmarks.add(FIRST_AUTOMATIC_ID + old, 0)
    true_pose = se3.from_rpy((6.0, 6.0, 0.0, 0.0, 0.0, 0.5))
    drift = rng.normal(size=3) * [TURN_RAD, SHIFT_M, SHIFT_M]
    pose = se3.exp(np.array([0.0, 0.0, drift[0], drift[1], drift[2], 0.0])) @ true_pose
    deviations = stated * np.array([0.0, 0.0, TURN_RAD, SHIFT_M, SHIFT_M, 0.0])
    covariance = np.diag(deviations**2)
    state.set_pose(pose, covariance)
    noise = SIGMA_M * np.pad(rng.normal(size=(len(seen), 2)), ((0, 0), (0, 1)))
    body = se3.transform(se3.inverse(true_pose), points[seen]) + noise
    state.gains.add(body, np.tile(SIGMA_M**2 * np.eye(3), (len(seen), 1, 1)))
    state.landmarks.add(FIRST_AUTOMATIC_ID + len(points) + np.arange(len(seen)), LOOP_NS)
    state.landmarks.counts[:] = 9
    state.landmarks.evidence[:] = np.inf
    return state, true_pose


def after_a_search(state, closure):
    """All that is followed after a search of the map for landmarks that are one."""
    hypotheses = Hypotheses(state)
    hypotheses.fork(closure.twins)
    return hypotheses


@pytest.mark.parametrize(('seed', 'seen'), [(0, 3), (1, 3), (2, 5), (3, 9), (4, 9), (5, 9)])
def test_a_loop_closes_where_new_landmarks_lie_to_each_other_as_old_ones(seed, seen):
    """However many they are: few do where the drift is small."""
    points, seen = points_in_a_hall(seed), np.arange(3, 3 + seen)
    state, true_pose = after_a_loop(points, seen, seed)
    before = np.abs(state.observer.pose - true_pose).max()
    closed = after_a_search(state, LoopClosure()).best
    assert before > 0.1
    assert_allclose(closed.observer.pose, true_pose, atol=0.03)
    assert closed.landmarks.ids.tolist() == (FIRST_AUTOMATIC_ID + np.arange(16)).tolist()
    assert closed.landmarks.counts[seen].tolist() == [18] * len(seen)
    assert_allclose(closed.observer.points, points, atol=0.02)
    assert closed.counts['merged_landmark'] == len(seen)


@pytest.mark.parametrize('seed', [6, 8, 9])
def test_a_loop_closes_though_odometry_drifts_four_times_as_far_as_it_states(seed):
    points, seen = points_in_a_hall(seed), np.arange(3, 12)
    state, true_pose = after_a_loop(points, seen, seed, stated=0.25)
    closed = after_a_search(state, LoopClosure()).best
    assert_allclose(closed.observer.pose, true_pose, atol=0.03)
    assert closed.counts['merged_landmark'] == len(seen)


def test_where_new_landmarks_lie_as_many_old_ones_do_a_loop_stays_open():
    state, _ = after_a_loop(grid(), np.array([0, 1, 2, 4, 5, 6, 8, 9, 10]))
    hypotheses = after_a_search(state, LoopClosure())
    assert [len(one.landmarks) for one in hypotheses.states] == [16, 16]  # at two places
    assert (hypotheses.weights > ERROR).all()


@pytest.mark.parametrize('seed', range(3))
def test_a_loop_closes_on_landmarks_that_are_others_only_beside_one_that_stays_open(seed):
    state, _ = after_a_loop(points_in_a_hall(seed), np.arange(7), seed)
    rng = np.random.default_rng(seed)
    state.observer.y_ref[16:, :2] = state.observer.y_ref[16:, :2].mean(axis=0) + rng.uniform(
        -5.0, 5.0, (7, 2)
    )
    hypotheses = after_a_search(state, LoopClosure())
    counts = [len(one.landmarks) for one in hypotheses.states]
    assert min(counts) < 23
    assert hypotheses.weights[counts.index(23)] > ERROR


def test_pairs_that_were_asked_for_alone_are_asked_for_again_beside_others():
    """Else a loop that odometry leaves open, and that closes bit by bit, would never close."""
    points, seen = points_in_a_hall(6), np.arange(3, 12)
    state, _ = after_a_loop(points, seen, 6, stated=0.25)
    likeliest = LoopClosure().twins(state, frozenset())[0]
    pairs = likeliest.pairs(state.landmarks.ids)
    alone = frozenset(frozenset([pair]) for pair in pairs)
    assert LoopClosure().twins(state, alone)[0].pairs(state.landmarks.ids) == pairs
    again = LoopClosure().twins(state, alone | {pairs})
    assert pairs not in [one.pairs(state.landmarks.ids) for one in again]


def test_only_covariances_of_landmarks_that_may_be_one_are_asked_for(monkeypatch):
    """Of all together they would take gigabytes in a large map."""
    state, asked = twins(0.02), []
    whole = state.gains.joint_covariance

    def joint_covariance(rows):
        asked.append(rows.tolist())
        return whole(rows)

    monkeypatch.setattr(state.gains, 'joint_covariance', joint_covariance)
    found = LoopClosure().twins(state, frozenset())
    assert [one.rows.tolist() for one in found] == [[16]]
    (rows,) = asked
    assert {16, 17} <= set(rows)
    assert len(rows) < 10


def twins(apart_m):
    """A state with landmarks all around, and two that are ``apart_m`` from each other."""
    points = np.concatenate(
        [points_in_a_hall(3), [[15.0, 15.0, 0.0], [15.0 + apart_m, 15.0, 0.0]]]
    )
    state = State(make_gains(PLANAR, np.eye(4)), PLANAR)
    covariances = np.tile(SIGMA_M**2 * np.eye(3), (len(points), 1, 1))
    state.gains.add_known(KnownLandmarks(points, covariances))
    state.landmarks.add(FIRST_AUTOMATIC_ID + np.arange(len(points)), 0)
    state.landmarks.counts[:] = 9
    state.landmarks.evidence[:] = np.inf
    state.landmarks.last_seen_ns[-1] = 5
    return state


def test_landmarks_that_may_be_one_are_followed_as_one_and_as_two():
    """Then later views decide; what was asked once is not asked again."""
    state, closure = twins(0.11), LoopClosure()
    hypotheses = after_a_search(state, closure)
    assert [len(one.state.landmarks) for one in hypotheses._all] == [17, 18]
    assert 0.0 < hypotheses._all[1].cost < 2.0 * SURE
    hypotheses.fork(closure.twins)
    assert [len(one.state.landmarks) for one in hypotheses._all] == [17, 18]


@pytest.mark.parametrize(('apart_m', 'left'), [(0.11, 18), (0.0, 17)])
def test_a_merger_that_later_views_contradict_is_undone(apart_m, left):
    """Both are followed; then both are seen, or one alone."""
    state = twins(0.11)
    state.set_pose(se3.from_rpy((14.0, 15.0, 0.0, 0.0, 0.0, 0.0)), np.zeros((6, 6)))
    hypotheses = after_a_search(state, LoopClosure())
    assert len(hypotheses) == 2
    points = np.array([1.055, 0.0, 0.0]) + np.outer([-0.5, 0.5], [apart_m, 0.0, 0.0])
    for stamp_ns in range(10, 30):
        seen = points if apart_m else points[:1]
        event = ObservationEvent(stamp_ns, np.full(len(seen), UNKNOWN_ID), seen)
        step(hypotheses, lambda seen: seen, event)
    assert len(hypotheses.best.landmarks) == left


@pytest.mark.parametrize(('apart_m', 'merged'), [(0.02, 1), (0.3, 0)])
def test_two_landmarks_are_one_if_they_are_as_near_each_other_as_they_are_known(apart_m, merged):
    state = twins(apart_m)
    after_a_search(state, LoopClosure())
    assert state.counts['merged_landmark'] == merged
    assert len(state.landmarks) == len(state.observer.points) == 18 - merged
    if merged:
        assert_allclose(state.observer.points[16], [15.01, 15.0, 0.0], atol=2e-3)
        assert state.landmarks.counts[16] == 18
        assert state.landmarks.last_seen_ns[16] == 5


def test_two_landmarks_that_were_seen_at_once_side_by_side_are_two():
    state, closure = twins(0.02), LoopClosure()
    state.landmarks.last_seen_ns[-2:] = 7
    for _ in range(9):
        closure.note(state, 7)
    state.landmarks.last_seen_ns[-1] = 9
    after_a_search(state, closure)
    assert state.counts['merged_landmark'] == 0


def test_a_false_point_beside_a_landmark_makes_it_no_two():
    """Of two that the sensor hardly misses one would not be seen alone, again and again."""
    state, closure = twins(0.03), LoopClosure()
    state.landmarks.note_in_view(np.arange(18), np.ones(18, dtype=bool))
    state.landmarks.last_seen_ns[-2:] = 7
    closure.note(state, 7)
    state.landmarks.last_seen_ns[-1] = 9
    after_a_search(state, closure)
    assert state.counts['merged_landmark'] == 1


def test_after_a_merger_all_that_was_seen_of_both_is_smoothed_as_of_one():
    settings = replace(PLANAR, observation_correlation_time=0.0, relinearization_interval=5)
    world = gain_worlds.drive(settings, 30.0)
    stamps_ns = [event.stamp_ns for event in world.observations()]

    def renamed(number, event):
        is_late = event.stamp_ns > np.median(stamps_ns)
        return replace(event, ids=event.ids + 100 * (is_late & (event.ids < 4)))

    estimator = Estimator(settings)
    for event in world.with_observations(renamed).events:
        assert estimator.add(event)
    estimator.flush()
    state, ids = estimator._hypotheses.best, np.arange(4)
    rows, copies = state.landmarks.rows_of(ids), state.landmarks.rows_of(ids + 100)
    both = (rows >= 0) & (copies >= 0)
    assert both.any()
    assert state.merge(rows[both], copies[both], 100.0) < 100.0
    named = gain_worlds.estimate(world, settings)
    smoothed, expected = estimator.smooth(), named.smooth()
    assert_allclose(smoothed.poses, expected.poses, atol=1e-3)
    assert_allclose(estimator.pose, named.pose, atol=0.02)


def hypotheses_after_a_wrong_merger():
    """Of two hypotheses the likelier one took two landmarks a metre apart or more for one."""
    settings = replace(PLANAR, observation_correlation_time=0.0)
    right = Hypothesis.of(gain_worlds.estimate(gain_worlds.drive(settings, 20.0), settings)._state)
    wrong, hypotheses = right.copy(), Hypotheses(right.state)
    wrong.state.merge(np.array([0]), np.array([1]), np.inf)
    right.cost = 5.0
    hypotheses_module._part([wrong, right], gain_worlds.START_NS)
    hypotheses._go_on_with([wrong, right])
    return hypotheses, wrong, right


@pytest.mark.parametrize('turn_rad', [0.0, 0.5])
def test_a_merger_that_the_past_contradicts_is_undone_where_turns_may_be_large(
    monkeypatch, turn_rad
):
    """That is said. Where the heading is known what the filter knew at each time is enough."""
    monkeypatch.setattr(hypotheses_module, 'MAX_TURN_RAD', turn_rad)
    hypotheses, wrong, right = hypotheses_after_a_wrong_merger()
    hypotheses.fork(lambda *_: [])
    assert hypotheses.best is (wrong if turn_rad else right).state
    assert (hypotheses.longest_ambiguity is None) == bool(turn_rad)


def test_hypotheses_are_compared_by_their_past_where_all_of_them_have_one(monkeypatch):
    """And where they slipped alike: what a slip costs is no likelihood."""
    monkeypatch.setattr(hypotheses_module, 'MAX_TURN_RAD', 0.0)
    hypotheses, wrong, right = hypotheses_after_a_wrong_merger()
    right.state.forget_past('the pose was set')
    hypotheses.fork(lambda *_: [])
    assert hypotheses.best is wrong.state
    hypotheses, wrong, right = hypotheses_after_a_wrong_merger()
    right.state.counts['slip'] += 1
    hypotheses.fork(lambda *_: [])
    assert hypotheses.best is wrong.state


def test_what_was_seen_is_as_likely_by_the_past_as_it_was_to_the_filter(monkeypatch):
    settings = replace(PLANAR, observation_correlation_time=0.0, huber_threshold=0.0)
    world, costs = gain_worlds.drive(settings, 12.0), []

    def observed(one):
        noise = one.state.observation_noise.covariances(one.event.select(one.rows < 0))[:, :2, :2]
        first = -np.linalg.slogdet(2.0 * np.pi * noise)[1].sum()
        known = match(one.state, one.event).residuals
        costs.append(first + pairing_cost(one.state, len(known.rows), known))
        return observe(one)

    estimator = Estimator(settings)
    for event in world.events[:-40]:
        estimator.add(event)
    estimator.flush()
    before = estimator._state.relinearisation.evidence()
    monkeypatch.setattr(step_module, 'observe', observed)
    for event in world.events[-40:]:
        estimator.add(event)
    estimator.flush()
    after = estimator._state.relinearisation.evidence()
    assert_allclose(after - before, sum(costs), atol=1.0)


def test_that_a_loop_has_closed_is_logged(caplog):
    estimator = Estimator(PLANAR)
    state, _ = after_a_loop(points_in_a_hall(0), np.arange(3, 10))
    estimator._hypotheses.reset(state)
    caplog.set_level('INFO', logger='slam_observer_ros')
    estimator._judge_map(LOOP_NS + 10**9)
    (line,) = (record.getMessage() for record in caplog.records)
    assert line == 'A loop has closed: 7 landmarks were seen before.'
    estimator._judge_map(LOOP_NS + 2 * 10**9)
    assert len(caplog.records) == 1
