"""A robot that is not where odometry has it, and not outliers or landmarks that moved."""

from __future__ import annotations

from dataclasses import replace

import gain_worlds
from gain_worlds import START_NS
import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.event_warnings import UNEXPECTED_POSES
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import match
from slam_observer_ros.tracking.slip import Shown, slip

PLANAR = Settings(two_d_mode=True, reorder_window=0.0)
SPATIAL = Settings(reorder_window=0.0)
modes = pytest.mark.parametrize('settings', [PLANAR, SPATIAL], ids=['planar', 'spatial'])
seeds = pytest.mark.parametrize('seed', range(2))
worlds = pytest.mark.parametrize(
    ('settings', 'seed'), [(PLANAR, 0), (PLANAR, 1), (SPATIAL, 2), (SPATIAL, 3)]
)


def seconds(event):
    return (event.stamp_ns - START_NS) * 1e-9


def run(world, settings):
    """Return the estimator and how far the position is off after each observation, by time."""
    estimator, errors_m = Estimator(settings), {}
    for event in world.events:
        assert estimator.add(event)
        if isinstance(event, ObservationEvent):
            shift = estimator.pose[:3, 3] - world.true_pose(event.stamp_ns)[:3, 3]
            errors_m[seconds(event)] = np.linalg.norm(shift)
    return estimator, errors_m


def with_slip(world, turn_rad):
    """Let odometry miss a turn at 30 s; nothing is seen for 4 s, then one landmark at a time."""
    events = []
    for event in world.events:
        if isinstance(event, VelocityEvent) and 30.0 <= seconds(event) < 32.0:
            turned = np.array([0.0, 0.0, turn_rad / 2.0, 0.0, 0.0, 0.0])
            event = replace(event, body_velocity=event.body_velocity + turned)
        if isinstance(event, ObservationEvent) and seconds(event) >= 30.0:
            if seconds(event) < 34.0:
                continue
            event = event.select(np.arange(len(event.ids)) == 0)
        events.append(event)
    return replace(world, events=events)


@seeds
@pytest.mark.parametrize('turn_rad', [0.5, -0.8])
def test_a_slip_is_found_out_by_the_second_landmark_that_contradicts_odometry(seed, turn_rad):
    world = with_slip(gain_worlds.drive(PLANAR, 60.0, seed, noise=0.5), turn_rad)
    estimator, errors_m = run(world, PLANAR)
    assert estimator.counts['slip'] == 1
    assert estimator.counts['moved_landmark'] == 0
    assert max(error_m for time_s, error_m in errors_m.items() if time_s > 50.0) < 0.25
    _, lost_m = run(world, replace(PLANAR, max_hypotheses=1))
    assert max(lost_m.values()) > 3.0


def test_ways_that_covariances_drown_in_rounding_end_no_run(monkeypatch):
    """As of a position that is known to 10⁸ m, beside points that are known to a millimetre."""

    class Drowned(Shown):
        def __init__(self, *args):
            super().__init__(*args)
            self.way = np.zeros(len(self.ids))

    monkeypatch.setattr('slam_observer_ros.tracking.slip.Shown', Drowned)
    world = gain_worlds.drive(PLANAR, 10.0, 0, noise=0.5)
    estimator, _ = run(world, PLANAR)
    assert estimator.counts['slip'] == 0


@modes
def test_after_a_slip_the_pose_is_as_uncertain_as_the_slip_was_large_up_to_a_limit(settings):
    settings = replace(settings, unknown_angular_motion=0.0)

    def variance_m2(shift_m):
        estimator, ids, point = Estimator(settings), np.array([1]), np.array([[2.0, 0.0, 0.0]])
        for step in range(5):
            estimator.add(VelocityEvent(step * 10**8, np.zeros(6)))
            estimator.add(ObservationEvent(step * 10**8, ids, point))
        state, seen = estimator._hypotheses.best, point + [[shift_m, 0.0, 0.0]]
        slip(state, match(state, ObservationEvent(4 * 10**8, ids, seen)))
        return np.trace(state.errors.pose_covariance()[3:, 3:])

    assert 2.0 * variance_m2(0.3) < variance_m2(0.6) < 0.5 * variance_m2(2.0)
    assert variance_m2(3.0) == pytest.approx(variance_m2(2.0), rel=0.01)


@seeds
@pytest.mark.parametrize('axis', range(3))
def test_a_gyroscope_that_is_wrong_once_by_a_radian_costs_one_observation(seed, axis):
    """Also where landmarks near its axis are seen where they should be."""
    world = gain_worlds.drive(SPATIAL, 30.0, seed, noise=0.5, landmarks=20, seen=7)
    wrong = np.eye(6)[axis] / gain_worlds.STEP_S

    def with_outlier(event):
        is_wrong = isinstance(event, VelocityEvent) and abs(seconds(event) - 20.05) < 0.01
        return replace(event, body_velocity=event.body_velocity + wrong) if is_wrong else event

    events = [with_outlier(event) for event in world.events]
    estimator, errors_m = run(replace(world, events=events), SPATIAL)
    assert estimator.counts['slip'] == 1
    assert estimator.counts['moved_landmark'] == 0
    assert max(error_m for time_s, error_m in errors_m.items() if time_s > 20.3) < 0.25


def carried(settings, seed, landmarks=12):
    """A world in which someone carries the robot after 20 s; and where to, as a motion before."""
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5, landmarks=landmarks)
    start = world.true_pose(START_NS + 20_000_000_000)
    moved = start @ se3.exp(np.array([0.0, 0.0, 0.8, 1.5, -1.0, 0.0])) @ se3.inverse(start)

    def seen_from_there(_, event):
        if seconds(event) < 20.0:
            return event
        pose = world.true_pose(event.stamp_ns)
        points = se3.transform(se3.inverse(moved @ pose) @ pose, event.points)
        return replace(event, points=points)

    return world.with_observations(seen_from_there), moved


@worlds
def test_a_robot_that_is_carried_is_found_again_at_once(settings, seed):
    world, moved = carried(settings, seed)
    estimator, _ = run(world, settings)
    pose = moved @ world.true_pose(world.events[-1].stamp_ns)
    assert estimator.counts['slip'] >= 1
    assert np.linalg.norm(estimator.pose[:3, 3] - pose[:3, 3]) < 0.3


@seeds
def test_a_landmark_without_id_keeps_no_robot_from_being_found_again(seed):
    """Seen before it was carried, while a landmark with a new id is seen from then on."""
    world, moved = carried(PLANAR, seed)

    def with_others(_, event):
        pose, is_before = world.true_pose(event.stamp_ns), seconds(event) < 20.0
        body = pose if is_before else moved @ pose
        point = np.array([[-2.0, 3.0, 0.0]] if is_before else [[2.0, 1.0, 0.0]])
        return replace(
            event,
            ids=np.append(event.ids, UNKNOWN_ID if is_before else 500),
            points=np.vstack([event.points, se3.transform(se3.inverse(body), point)]),
        )

    estimator, _ = run(world.with_observations(with_others), PLANAR)
    pose = moved @ world.true_pose(world.events[-1].stamp_ns)
    assert estimator.counts['slip'] == 1
    assert np.linalg.norm(estimator.pose[:3, 3] - pose[:3, 3]) < 0.1


ELSEWHERE = LandmarkMap(
    np.array([91, 92]), np.array([[100.0, 0.0, 0.0], [105.0, 0.0, 0.0]]), None, np.array([9, 9])
)


def carried_and(do_then):
    """Run a world in which the robot is carried, and do something as soon as that is weighed.

    Returns how far the position is off at the end, and the estimator.
    """
    world, moved = carried(PLANAR, 0)
    estimator, is_done = Estimator(PLANAR), False
    for event in world.events:
        assert estimator.add(event)
        if len(estimator._hypotheses) > 1 and not is_done:
            is_done = True
            do_then(estimator)
    assert is_done
    pose = moved @ world.true_pose(world.events[-1].stamp_ns)
    return np.linalg.norm(estimator.pose[:3, 3] - pose[:3, 3]), estimator


@pytest.mark.parametrize(
    'do_then',
    [
        lambda estimator: estimator.change_settings(replace(estimator.settings, gain_k=2.0)),
        lambda estimator: estimator.forget(77),
        lambda estimator: estimator.load_map(ELSEWHERE),
    ],
    ids=['change_settings', 'forget', 'load_map'],
)
def test_what_says_nothing_of_the_pose_leaves_open_which_state_is_right(do_then):
    error_m, estimator = carried_and(do_then)
    assert error_m < 0.3
    assert estimator.counts['slip'] >= 1


def test_a_landmark_is_forgotten_in_all_states_that_are_followed():
    def forget(estimator):
        nearest = estimator.landmark_ids[0]
        assert estimator.forget(nearest)
        for hypothesis in estimator._hypotheses._all:
            assert nearest not in hypothesis.state.landmarks.ids

    error_m, _ = carried_and(forget)
    assert error_m < 0.3


def without_ids(_, event):
    return replace(event, ids=np.full(len(event.ids), UNKNOWN_ID))


@seeds
def test_without_ids_a_robot_that_is_carried_is_found_again_where_it_sees_what_it_knows(seed):
    world, moved = carried(PLANAR, seed)
    estimator, _ = run(world.with_observations(without_ids), PLANAR)
    pose = moved @ world.true_pose(world.events[-1].stamp_ns)
    assert estimator.counts['slip'] >= 1
    assert np.linalg.norm(estimator.pose[:3, 3] - pose[:3, 3]) < 0.3


@seeds
def test_without_ids_it_is_said_where_nothing_is_as_it_was(seed):
    world = gain_worlds.drive(PLANAR, 40.0, seed, noise=0.5, landmarks=6)
    elsewhere = gain_worlds.drive(PLANAR, 40.0, seed + 10, noise=0.5, landmarks=6)
    events = [one for one in world.events if seconds(one) < 20.0]
    events += [one for one in elsewhere.events if seconds(one) >= 20.0]
    world = replace(world, events=events)
    estimator, _ = run(world.with_observations(without_ids), PLANAR)
    assert any(estimator.counts[kind] for kind in UNEXPECTED_POSES)


@seeds
def test_landmarks_with_ids_are_another_sensors_to_see(seed):
    """A robot stands among tags, and a sensor without ids sees a passer-by."""
    rng, estimator = np.random.default_rng(seed), Estimator(PLANAR)
    tags = rng.uniform([-5.0, -5.0, 0.0], [5.0, 5.0, 0.0], (20, 3))
    for step in range(80):
        stamp_ns = START_NS + step * 100_000_000
        assert estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        seen = tags + rng.normal(0.0, 0.02, (20, 3)) * [1.0, 1.0, 0.0]
        assert estimator.add(ObservationEvent(stamp_ns, np.arange(20), seen))
        passer_by = np.array([[0.1 * step - 4.0, 2.0, 0.0]])
        nobody = np.array([UNKNOWN_ID])
        assert estimator.add(ObservationEvent(stamp_ns + 50_000_000, nobody, passer_by))
    assert estimator.counts['unexpected_place'] == 0


@worlds
def test_a_robot_that_is_where_it_should_be_is_not_warned_of(settings, seed):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5, landmarks=30)
    estimator, _ = run(world.with_observations(without_ids), settings)
    assert estimator.counts['unexpected_place'] == 0


@worlds
def test_so_is_one_that_is_carried_far_without_being_turned(settings, seed):
    """As far as it sees enough landmarks at once to show where it is."""
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5, seen=8)

    def shift(_, event):
        back = world.true_pose(event.stamp_ns)[:3, :3].T @ [-9.0, 4.0, 0.0]
        return replace(event, points=event.points + (seconds(event) >= 20.0) * back)

    estimator, errors_m = run(world.with_observations(shift), settings)
    assert estimator.counts['slip'] == 1
    assert estimator.counts['moved_landmark'] == 0
    assert list(errors_m.values())[-1] == pytest.approx(np.hypot(9.0, 4.0), abs=0.3)


@worlds
@pytest.mark.parametrize('shift_m', [1.0, 4.0])
def test_one_observation_that_is_garbled_as_a_whole_does_not_move_the_robot(
    settings, seed, shift_m
):
    world = gain_worlds.drive(settings, 40.0, seed, noise=0.5)
    off = se3.exp(np.array([0.0, 0.0, 0.5, shift_m, shift_m, 0.0]))

    def garble(_, event):
        is_off = seconds(event) in (20.0, 25.0, 30.0)
        return replace(event, points=se3.transform(off, event.points)) if is_off else event

    estimator, errors_m = run(world.with_observations(garble), settings)
    _, plain_m = run(world, settings)
    assert estimator.counts['slip'] == 0
    assert max(errors_m.values()) < max(plain_m.values()) + 0.1


@seeds
@pytest.mark.parametrize('seen', [16, 40])
def test_nor_does_it_however_many_landmarks_it_is_of(seed, seen):
    world = gain_worlds.drive(PLANAR, 30.0, seed, noise=0.5, landmarks=seen, seen=seen)
    off = se3.exp(np.array([0.0, 0.0, 0.5, 2.0, 2.0, 0.0]))

    def garble(_, event):
        points = se3.transform(off, event.points) if seconds(event) == 20.0 else event.points
        return replace(event, points=points)

    estimator, errors_m = run(world.with_observations(garble), PLANAR)
    assert estimator.counts['slip'] == 0
    assert max(errors_m.values()) < 0.3


def is_thrown_by_a_moved_landmark(settings, seed):
    """Two metres are beyond the gate in most worlds; in some one can't know who has moved."""
    world = gain_worlds.drive(settings, 60.0, seed, noise=0.5, landmarks=6)
    counts = np.bincount(np.concatenate([event.ids for event in world.observations()]))
    one = int(np.argmax(counts))

    def change(_, event):
        if not 30.0 <= seconds(event) < 36.0:
            return event
        event = event.select(event.ids == one)
        back = world.true_pose(event.stamp_ns)[:3, :3].T
        return replace(event, points=event.points + back @ [2.0, 0.0, 0.0])

    estimator, errors_m = run(world.with_observations(change), settings)
    _, plain_m = run(world, settings)
    assert estimator.counts['rejected_landmark'] >= 1
    return max(errors_m.values()) > max(plain_m.values()) + 0.3


@modes
def test_a_landmark_that_moved_and_is_seen_alone_seldom_throws_the_pose(settings):
    """However long; what is seen next shows that it was the landmark."""
    assert sum(is_thrown_by_a_moved_landmark(settings, seed) for seed in range(6)) <= 1


@worlds
def test_a_landmark_that_moved_away_from_beside_the_robot_does_not_throw_the_pose(settings, seed):
    """Its noise belongs to where it is seen now, not to where it was: right at the sensor."""
    rng, estimator, points = np.random.default_rng(seed), Estimator(settings), 4.0 * np.eye(3)
    points[2] = [0.1, 0.0, 0.0]
    for step in range(40):
        stamp_ns, ids = START_NS + step * 10**8, np.arange(3) if step < 20 else np.array([2])
        if step == 20:
            points[2] = [3.0, 2.0, 0.0]
        noise = rng.normal(size=(len(ids), 3)) * ([0.1, 0.1, 0.0] if step >= 20 else 0.0)
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        estimator.add(ObservationEvent(stamp_ns, ids, points[ids] + noise))
    assert estimator.counts['slip'] == 0
    assert estimator.counts['moved_landmark'] == 1
    assert np.linalg.norm(estimator.pose[:3, 3]) < 0.1


@worlds
@pytest.mark.parametrize('alone_s', [0.75, 2.0])
@pytest.mark.parametrize('are_swapped', [False, True])
def test_two_landmarks_that_moved_alone_in_view_throw_the_pose_for_no_longer(
    settings, seed, alone_s, are_swapped
):
    """Together, as two tags on one pallet, or in one another's place."""
    world = gain_worlds.drive(settings, 60.0, seed, noise=0.5, landmarks=6)
    counts = np.bincount(np.concatenate([event.ids for event in world.observations()]))
    pair = np.argsort(-counts)[:2]

    def change(_, event):
        if seconds(event) < 30.0:
            return event
        if seconds(event) < 30.0 + alone_s:
            event = event.select(np.isin(event.ids, pair))
        is_one = np.isin(event.ids, pair)
        if are_swapped:
            ids = np.where(is_one, pair.sum() - event.ids, event.ids)
            return replace(event, ids=ids)
        back = world.true_pose(event.stamp_ns)[:3, :3].T
        return replace(event, points=event.points + is_one[:, None] * (back @ [2.0, 0.0, 0.0]))

    _, errors_m = run(world.with_observations(change), settings)
    assert list(errors_m.values())[-1] < 0.3


@seeds
def test_landmarks_in_a_row_do_not_show_how_far_a_robot_has_rolled(seed):
    """Carried, with five tags on a wall in view: their noise would turn it about their line."""
    rng = np.random.default_rng(seed)
    row = np.column_stack([np.full(5, 4.0), np.linspace(-2.0, 2.0, 5), np.full(5, 0.5)])
    estimator, carried = Estimator(SPATIAL), se3.exp(np.array([0.0, 0.0, 0.8, 1.0, -0.5, 0.0]))
    for step in range(80):
        points = se3.transform(se3.inverse(carried), row) if step >= 40 else row
        stamp_ns = START_NS + step * 250_000_000
        estimator.add(VelocityEvent(stamp_ns, np.zeros(6)))
        noisy = points + rng.normal(scale=0.02, size=points.shape)
        estimator.add(ObservationEvent(stamp_ns, np.arange(5), noisy))
    assert estimator.counts['slip'] >= 1
    tilt_rad = np.arccos(estimator.pose[2, 2])
    assert tilt_rad < 0.2


@pytest.mark.parametrize('placed', ['by hand', 'in another time'])
def test_a_garbled_observation_after_a_robot_was_placed_is_the_first_one_again(placed):
    world = gain_worlds.drive(SPATIAL, 30.0, 0, noise=0.5, landmarks=20, seen=7)
    estimator = Estimator(replace(SPATIAL, on_time_jump='hold'))
    for event in world.events:
        if isinstance(event, ObservationEvent) and seconds(event) in (20.0, 20.25):
            off = se3.exp(np.array([0.0, 0.0, 0.5, 2.0, 20.0 * (seconds(event) - 20.1), 0.0]))
            event = replace(event, points=se3.transform(off, event.points))
            if seconds(event) == 20.25 and placed == 'by hand':
                estimator.set_pose(estimator.pose, 1e-4 * np.eye(6))
            elif seconds(event) == 20.25:
                estimator.handle_clock_jump()
        assert estimator.add(event)
    assert estimator.counts['slip'] == 0


def test_a_robot_that_never_moves_by_itself_never_slips():
    settings = replace(PLANAR, unknown_linear_motion=0.0, unknown_angular_motion=0.0)
    world = with_slip(gain_worlds.drive(settings, 50.0, 1, noise=0.5), 0.8)
    estimator, _ = run(world, settings)
    assert estimator.counts['slip'] == 0
