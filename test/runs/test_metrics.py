"""Metrics measure what can be observed, whatever the world frame."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from strategies import generators, poses

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID, FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import LandmarkTruth, Trajectory
from slam_observer_ros.runs import metrics
from slam_observer_ros.runs.metrics import ConfigurationError, MAX_JOINT

STAMPS_NS = np.arange(40) * 100_000_000


def random_pair(rng: np.random.Generator) -> tuple[Trajectory, Trajectory]:
    true_poses = se3.exp(rng.normal(0.0, [0.3] * 3 + [5.0] * 3, (len(STAMPS_NS), 6)))
    noise = se3.exp(rng.normal(0.0, 0.1, (len(STAMPS_NS), 6)))
    return Trajectory(STAMPS_NS, true_poses @ noise), Trajectory(STAMPS_NS, true_poses)


def random_map(rng: np.random.Generator) -> LandmarkTruth:
    return LandmarkTruth(rng.permutation(100)[:12], rng.normal(0.0, 5.0, (12, 3)))


@given(generators(), poses())
def test_a_rigidly_moved_truth_has_no_error(rng: np.random.Generator, G: FloatArray) -> None:
    _, truth = random_pair(rng)
    errors = metrics.trajectory_errors(truth.moved(G), truth)
    assert errors.ate_rmse_m < 1e-11
    assert errors.rotation_rmse_rad < 1e-11


@given(generators(), poses())
def test_trajectory_errors_ignore_the_estimates_world_frame(
    rng: np.random.Generator, G: FloatArray
) -> None:
    estimate, truth = random_pair(rng)
    here = metrics.trajectory_errors(estimate, truth)
    there = metrics.trajectory_errors(estimate.moved(G), truth)
    np.testing.assert_allclose(there.errors, here.errors, atol=1e-9)
    assert there.heading_rmse_rad <= there.rotation_rmse_rad


def test_heading_error_is_the_turn_about_the_vertical() -> None:
    rng = np.random.default_rng(1)
    positions = rng.normal(0.0, 3.0, (len(STAMPS_NS), 3))
    poses = np.tile(np.eye(4), (len(STAMPS_NS), 1, 1))
    turned = se3.exp(np.tile([0.0, 0.0, 0.1, 0.0, 0.0, 0.0], (len(STAMPS_NS), 1)))
    poses[:, :3, 3] = turned[:, :3, 3] = positions
    errors = metrics.trajectory_errors(Trajectory(STAMPS_NS, turned), Trajectory(STAMPS_NS, poses))
    assert errors.ate_rmse_m < 1e-12
    assert errors.heading_rmse_rad == pytest.approx(0.1)
    assert errors.rotation_rmse_rad == pytest.approx(0.1)


@given(generators(), poses())
def test_without_alignment_an_estimate_is_compared_where_it_says_it_is(
    rng: np.random.Generator, G: FloatArray
) -> None:
    estimate, truth = random_pair(rng)
    estimate = estimate.moved(G)
    lengths_m = np.linalg.norm(estimate.positions - truth.positions, axis=1)
    found_m = metrics.trajectory_errors(estimate, truth).unaligned_rmse_m
    assert found_m == pytest.approx(np.sqrt(np.mean(lengths_m**2)))


def test_rms_errors_are_those_of_errors_that_change() -> None:
    _, truth = random_pair(np.random.default_rng(0))
    yaw = np.where(np.arange(len(truth)) % 2, 0.2, 0.0)
    turn = se3.exp(yaw[:, None] * np.array([0.0, 0, 1, 0, 0, 0]))
    turned = truth.poses.copy()
    turned[:, :3, :3] = turn[:, :3, :3] @ turned[:, :3, :3]
    errors = metrics.trajectory_errors(Trajectory(STAMPS_NS, turned), truth)
    assert errors.heading_rmse_rad == pytest.approx(0.2 / np.sqrt(2.0))
    assert errors.rotation_rmse_rad == pytest.approx(0.2 / np.sqrt(2.0))


def test_only_times_that_the_truth_covers_are_compared() -> None:
    estimate, truth = random_pair(np.random.default_rng(0))
    part = Trajectory(truth.stamps_ns[10:20], truth.poses[10:20])
    errors = metrics.trajectory_errors(estimate, part)
    np.testing.assert_array_equal(np.flatnonzero(errors.covered), np.arange(10, 20))
    elsewhere = Trajectory(truth.stamps_ns + 10**12, truth.poses)
    with pytest.raises(EvaluationError, match='covers'):
        metrics.trajectory_errors(estimate, elsewhere)


@given(generators(), poses())
def test_landmark_errors_match_ids_and_ignore_the_frame(
    rng: np.random.Generator, G: FloatArray
) -> None:
    truth = random_map(rng)
    order = rng.permutation(12)
    noisy = truth.world_points + rng.normal(0.0, 0.1, (12, 3))
    # One landmark more than the truth knows, in another order and another world.
    ids = np.append(truth.ids[order], 1_000)
    points = np.vstack([noisy[order], [9.0, 9.0, 9.0]])
    here = metrics.landmark_rmse_m(truth.ids, noisy, truth)
    there = metrics.landmark_rmse_m(ids, se3.transform(G, points), truth)
    assert there == pytest.approx(here, rel=1e-9)
    assert 0.0 < there < 0.3


def test_maps_without_a_common_landmark_cannot_be_compared() -> None:
    truth = random_map(np.random.default_rng(0))
    with pytest.raises(EvaluationError, match='no landmark'):
        metrics.landmark_rmse_m(truth.ids + 1_000, truth.world_points, truth)


@given(generators(), poses(), poses(), poses())
def test_configuration_error_is_gauge_free(
    rng: np.random.Generator, pose: FloatArray, true_pose: FloatArray, G: FloatArray
) -> None:
    truth = random_map(rng)
    points = truth.world_points + rng.normal(0.0, 1.0, (12, 3))
    here, there = ConfigurationError(), ConfigurationError()
    here.add(0, pose, truth.ids, points, true_pose, truth)
    there.add(0, G @ pose, truth.ids, se3.transform(G, points), true_pose, truth)
    assert here.rmse_m is not None
    assert there.rmse_m == pytest.approx(here.rmse_m, rel=1e-9)


def test_configuration_error_is_the_rms_over_landmarks_and_then_over_time() -> None:
    truth = LandmarkTruth(np.array([7, 3]), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    error = ConfigurationError()
    assert error.rmse_m is None
    error.add(5, np.eye(4), np.array([9]), np.zeros((1, 3)), np.eye(4), truth)
    assert error.rmse_m is None
    off = np.array([[0.0, 1.0, 0.3], [1.0, 0.0, 0.4], [5.0, 5.0, 5.0]])
    error.add(6, np.eye(4), np.array([3, 7, 9]), off, np.eye(4), truth)
    error.add(7, np.eye(4), np.array([3]), off[:1], np.eye(4), truth)
    assert error.stamps_ns == [6, 7]
    np.testing.assert_allclose(error.values_m, [np.sqrt((0.09 + 0.16) / 2), 0.3])
    assert error.rmse_m == pytest.approx(np.sqrt((0.125 + 0.09) / 2))


def test_a_landmark_without_id_stands_for_what_it_was_nearest_to_when_it_was_seen() -> None:
    truth = LandmarkTruth(np.array([7, 3]), np.array([[1.0, 0.0, 0.0], [0.0, 4.0, 0.0]]))
    ids, points = FIRST_AUTOMATIC_ID + np.arange(2), np.array([[1.5, 0.0, 0.0], [9.0, 9.0, 0.0]])
    error = ConfigurationError()
    for stamp_ns in (1, 2):
        error.add(stamp_ns, np.eye(4), ids, points, np.eye(4), truth, seen_ids=ids[:1])
    points[0] = 0.0, 3.8, 0.0
    for stamp_ns in (3, 4, 5):
        error.add(stamp_ns, np.eye(4), ids, points, np.eye(4), truth, seen_ids=ids[2:])
    far_m = np.hypot(1.0, 3.8)  # drift has put it next to another one
    assert error.values_m == pytest.approx([0.5, 0.5, far_m, far_m, far_m])


def random_covariance(rng: np.random.Generator, d: int) -> FloatArray:
    factor = rng.normal(size=(d, d))
    return factor @ factor.T + 0.1 * np.eye(d)


@given(generators(), st.floats(1e-4, 1e4))
def test_nees_does_not_depend_on_units(rng: np.random.Generator, unit: float) -> None:
    covariance, error = random_covariance(rng, 6), rng.normal(size=6)
    scale = np.array([1.0, 1.0, 1.0, unit, unit, unit])
    nees, degrees_of_freedom = metrics.normalised_squared_errors(
        scale * error, np.outer(scale, scale) * covariance
    )
    assert nees == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-6)
    assert degrees_of_freedom == 6


def test_exactly_known_directions_do_not_count() -> None:
    covariance = np.zeros((6, 6))
    covariance[2:5, 2:5] = random_covariance(np.random.default_rng(0), 3)
    error = np.arange(6.0)
    nees, degrees_of_freedom = metrics.normalised_squared_errors(error, covariance)
    assert degrees_of_freedom == 3
    assert nees == pytest.approx(error[2:5] @ np.linalg.solve(covariance[2:5, 2:5], error[2:5]))
    assert metrics.average_nees(error[None], np.zeros((1, 6, 6))) is None


@given(generators())
def test_what_is_known_exactly_need_not_lie_along_an_axis(rng: np.random.Generator) -> None:
    root, components = rng.normal(size=(6, 3)), rng.normal(size=3)
    nees, degrees_of_freedom = metrics.normalised_squared_errors(root @ components, root @ root.T)
    assert degrees_of_freedom == 3
    assert nees == pytest.approx(components @ components)


def test_an_indefinite_covariance_is_refused() -> None:
    with pytest.raises(EvaluationError, match='negative'):
        metrics.average_nees(np.ones((1, 2)), np.array([[[1.0, 2.0], [2.0, 1.0]]]))


@pytest.mark.parametrize('k', [2, 3])
def test_anees_of_the_configuration_is_by_the_joint_covariance_as_the_robot_sees_it(
    k: int,
) -> None:
    rng = np.random.default_rng(0)
    truth = LandmarkTruth(np.arange(5), rng.normal(scale=5.0, size=(5, 3)))
    pose, true_pose = se3.exp(rng.normal(size=(2, 6)))
    P = random_covariance(rng, 4 * k)
    ids, asked = np.array([3, 9, 0, 4, 1]), []

    def covariance_of(rows):
        asked.append(rows.tolist())
        return P

    error = ConfigurationError()
    assert error.anees is None
    points = rng.normal(scale=5.0, size=(5, 3))
    error.add(0, pose, ids, points, true_pose, truth, covariance_of)
    error.add(1, pose, ids, points, true_pose, truth)  # without: counts for the error alone
    error.add(2, pose, ids, points, true_pose, truth, lambda rows: None)
    assert asked == [[0, 2, 3, 4]], 'those whose truth is known, in the order of the map'
    seen = se3.transform(se3.inverse(pose), points[asked[0]])
    true_seen = se3.transform(se3.inverse(true_pose), truth.world_points[ids[asked[0]]])
    e = (seen - true_seen)[:, :k].ravel()
    assert len(error.values_m) == 3
    assert error.nees == [pytest.approx(e @ np.linalg.solve(P, e) / (4 * k))]
    assert error.anees == error.nees[0]


def test_of_very_many_landmarks_some_are_normalised_together() -> None:
    n = 3 * MAX_JOINT - 1
    truth = LandmarkTruth(np.arange(n), np.zeros((n, 3)))
    error, asked = ConfigurationError(), []

    def covariance_of(rows):
        asked.append(len(rows))
        return 4.0 * np.eye(3 * len(rows))

    error.add(0, np.eye(4), np.arange(n), np.full((n, 3), 2.0), np.eye(4), truth, covariance_of)
    assert 0 < asked[0] <= MAX_JOINT
    assert error.anees == pytest.approx(1.0)


@pytest.mark.parametrize(('inflation', 'inside'), [(1.0, True), (0.7, False), (1.4, False)])
def test_the_band_separates_honest_covariances_from_others(inflation: float, inside: bool) -> None:
    rng = np.random.default_rng(5)
    covariance = random_covariance(rng, 6)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=200)
    average = metrics.average_nees(errors, np.tile(inflation * covariance, (200, 1, 1)))
    lower, upper = metrics.average_nees_band(6, runs=200)
    assert average is not None
    assert (lower < average < upper) is inside


def test_the_band_is_that_of_the_chi_square_distribution() -> None:
    # Bar-Shalom's Estimation with Applications to Tracking, 50 runs of 2 degrees of freedom.
    lower, upper = metrics.average_nees_band(2, runs=50)
    assert (2 * lower, 2 * upper) == pytest.approx((1.5, 2.6), abs=0.02)


@given(generators(), poses())
def test_anchored_nees_ignores_the_worlds_and_starts_at_zero(
    rng: np.random.Generator, G: FloatArray
) -> None:
    estimate, truth = random_pair(rng)
    covariances = np.tile(np.eye(6), (len(STAMPS_NS), 1, 1))
    covariances[0] = 0.0
    here = metrics.anchored_average_nees(estimate, covariances, truth)
    there = metrics.anchored_average_nees(estimate, covariances, truth.moved(G))
    assert here == pytest.approx(there, rel=1e-6)
    exact = metrics.anchored_average_nees(truth.moved(G), covariances, truth)
    assert exact == pytest.approx(0.0, abs=1e-15)


def test_where_the_truth_has_a_gap_errors_are_compared_with_their_own_covariances() -> None:
    estimate, truth = random_pair(np.random.default_rng(0))
    covariances = np.arange(len(STAMPS_NS))[:, None, None] * np.eye(6)
    seen = np.r_[:5, 25 : len(STAMPS_NS)]
    gapped = Trajectory(STAMPS_NS[seen], truth.poses[seen])
    part = Trajectory(STAMPS_NS[seen], estimate.poses[seen])
    assert metrics.anchored_average_nees(estimate, covariances, gapped) == pytest.approx(
        metrics.anchored_average_nees(part, covariances[seen], gapped)
    )


def test_the_anees_is_not_reported_where_the_first_heading_is_uncertain_and_the_way_is_long() -> (
    None
):
    """The heading itself may be little of what is uncertain later; 100 m further on it is not."""
    poses = np.tile(np.eye(4), (len(STAMPS_NS), 1, 1))
    covariances = np.tile(np.eye(6), (len(STAMPS_NS), 1, 1))
    covariances[0] = np.diag([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) ** 2
    near = Trajectory(STAMPS_NS, poses.copy())
    assert metrics.anchored_average_nees(near, covariances, near) == 0.0
    poses[1:, 0, 3] = 100.0
    far = Trajectory(STAMPS_NS + 10**9, poses)
    with pytest.raises(EvaluationError, match=r'begins 0\.0 s after the estimate'):
        metrics.anchored_average_nees(far, covariances, far)


def test_the_anees_is_honest_or_not_reported_where_the_truth_begins_late() -> None:
    """What counts is not how late, but how uncertain the pose is by then."""
    rng = np.random.default_rng(0)
    steps = np.diag([0.02, 0.02, 0.02, 0.1, 0.1, 0.1])
    values = []
    for _ in range(100):
        random = rng.normal(size=(len(STAMPS_NS), 6)) @ steps
        random[:5] = 0.0  # it stands still
        walk = np.cumsum(random, axis=0)
        covariances = np.maximum(np.arange(len(STAMPS_NS)) - 4, 0)[:, None, None] * steps**2
        rest = np.tile(np.eye(4), (len(STAMPS_NS), 1, 1))
        truth = Trajectory(STAMPS_NS, rest)
        moved = se3.pose(se3.exp(walk)[:, :3, :3], walk[:, 3:])
        estimate = Trajectory(STAMPS_NS, moved)
        for start in (0, 4):
            late = Trajectory(STAMPS_NS[start:], rest[start:])
            values.append(metrics.anchored_average_nees(estimate, covariances, late))
        for start in (7, 30):
            late = Trajectory(STAMPS_NS[start:], truth.poses[start:])
            with pytest.raises(EvaluationError, match=r'begins .* s after the estimate'):
                metrics.anchored_average_nees(estimate, covariances, late)
    assert 0.7 < np.mean(values) < 1.3


@pytest.mark.parametrize('count', [0, 1, 2])
def test_so_few_poses_that_any_truth_fits_have_no_error(count: int) -> None:
    estimate, truth = random_pair(np.random.default_rng(0))
    few = Trajectory(estimate.stamps_ns[:count], estimate.poses[:count])
    with pytest.raises(EvaluationError, match=f'{count} of its {count} poses .* it takes 3'):
        metrics.trajectory_errors(few, truth)


def test_three_poses_that_the_truth_covers_are_enough() -> None:
    estimate, truth = random_pair(np.random.default_rng(0))
    three = Trajectory(estimate.stamps_ns[:3], estimate.poses[:3])
    assert metrics.trajectory_errors(three, truth).ate_rmse_m > 0.0


@pytest.mark.parametrize('period_s', [0.6, 5.0])
def test_an_estimate_is_interpolated_where_the_truth_is_sparse(period_s: float) -> None:
    """A total station's or a survey's: none of its poses is thrown away."""
    seconds = np.arange(0.0, 60.0, 0.05)
    V = np.array([0.0, 0.0, 0.1, 1.0, 0.0, 0.0])
    estimate = Trajectory(np.rint(seconds * 1e9).astype(np.int64), se3.exp(seconds[:, None] * V))
    true_s = np.arange(0.013, 58.0, period_s)
    offset_m = np.where(np.arange(len(true_s)) % 2, 0.1, -0.1)
    poses = se3.exp(true_s[:, None] * V)
    poses[:, 2, 3] = offset_m
    truth = Trajectory(np.rint(true_s * 1e9).astype(np.int64), poses)
    errors = metrics.trajectory_errors(estimate, truth)
    assert len(errors.estimate) == len(truth) == errors.covered.sum()
    assert errors.ate_rmse_m == pytest.approx(0.1, rel=0.05)
    assert errors.covered_share == pytest.approx(true_s[-1] / 60.0, abs=0.01)
    P = np.broadcast_to(np.eye(6) * 0.01, (len(estimate), 6, 6)).copy()
    P[0] = 0.0
    assert metrics.anchored_average_nees(estimate, P, truth) is not None
