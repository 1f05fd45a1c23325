"""Tags with orientations: a constant output matrix, an unobservable gauge, honest covariances."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
import numpy as np
import pytest
from random_runs import as_stated, observe, PLAIN, propagate, random_covariances
from strategies import generators

from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.filter.arrays import SeenOrientations
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.tracking.matching import flipped

TAGS = replace(PLAIN, use_tag_orientation=True)
PLANAR_TAGS = replace(TAGS, two_d_mode=True)


def tag_filter(rng, n=3, settings=TAGS):
    """A filter with n tags, which then has moved."""
    tags = make_gains(settings, np.eye(4))
    points = rng.normal(scale=4.0, size=(n, 3)) * [1.0, 1.0, not settings.two_d_mode]
    tags.add(points, 0.01 * random_covariances(rng, n, 3))
    tags.add_orientations(seen(np.arange(n), so3.exp(rng.normal(size=(n, 3))), 0.05))
    move(tags, rng)
    return tags


def move(tags, rng):
    V = rng.normal(size=(2, 6))
    V[:, : tags.axes.pose.start] = V[:, tags.axes.pose.stop :] = 0.0
    propagate(tags, V, np.array([0.1, 0.1]), 1e-3 * random_covariances(rng, 2, 6))


def seen(rows, Z, sigma_rad):
    """Orientations as they are seen, none of which looks like another."""
    return SeenOrientations(
        rows, Z, Z, np.tile(sigma_rad**2 * np.eye(3), (len(rows), 1, 1)), np.ones(len(rows))
    )


def predicted_orientations(tags, rows):
    return tags.observer.A[:3, :3].T @ tags.observer.orientations.B[rows]


@pytest.mark.parametrize('settings', [TAGS, PLANAR_TAGS])
@given(rng=generators())
def test_output_matrix_of_orientations_is_constant_and_the_gauge_in_its_null_space(settings, rng):
    tags, n = tag_filter(rng, settings=settings), 3
    q, p, k = tags.axes.turn, tags.axes.p, tags.axes.point
    G = tags.joint.chart.gauge(n)
    tags.joint.P = np.eye(len(tags.joint.P))
    H, _ = tags.joint.project_turns(np.arange(n))
    expected = np.zeros((n, q, p + n * (k + q)))
    expected[:, :, :q] = np.eye(q)
    for i in range(n):
        expected[i, :, p + i * (k + q) + k : p + (i + 1) * (k + q)] = -np.eye(q)
    np.testing.assert_array_equal(H, expected.reshape(n * q, -1))
    np.testing.assert_array_equal(H @ G, 0.0)


@given(generators())
def test_orientations_that_are_never_seen_leave_the_filter_of_points(rng):
    seed = rng.integers(2**32)

    def run(filter_):
        random = np.random.default_rng(seed)
        filter_.add(random.normal(scale=4.0, size=(4, 3)), random_covariances(random, 4, 3))
        for _ in range(5):
            move(filter_, random)
            rows = np.sort(random.permutation(4)[:2])
            points = filter_.observer.body_points(rows) + 0.1 * random.normal(size=(2, 3))
            observe(filter_, rows, points, random_covariances(random, 2, 3))
        return filter_

    points, tags = run(make_gains(PLAIN, np.eye(4))), run(make_gains(TAGS, np.eye(4)))
    rows = np.arange(4)
    np.testing.assert_allclose(tags.observer.A, points.observer.A, atol=1e-12)
    np.testing.assert_allclose(tags.observer.points, points.observer.points, atol=1e-11)
    np.testing.assert_allclose(
        tags.joint_covariance(rows), points.joint_covariance(rows), atol=1e-11
    )


@given(generators())
def test_orientations_then_points_are_both_at_once(rng):
    tags, rows = tag_filter(rng), np.array([0, 2])
    P, sigma_rad, R = tags.joint.P.copy(), 0.1, random_covariances(rng, 2, 3)
    H_turns = output_of(tags, rows, tags.joint.project_turns)
    C = tags.axes.output_matrix(np.zeros((2, 3)))
    H_points = output_of(tags, rows, lambda rows: tags.joint.project(C, rows))
    H = np.vstack([H_turns, H_points])
    noise = np.zeros((12, 12))
    noise[:6, :6] = sigma_rad**2 * np.eye(6)
    points = tags.observer.body_points(rows)
    turned = tags.observer.turned(as_stated(points, R))
    noise[6:9, 6:9], noise[9:, 9:] = turned
    at_once = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + noise, H @ P)
    tags.correct_by_orientations(seen(rows, predicted_orientations(tags, rows), sigma_rad))
    observe(tags, rows, points, R)
    np.testing.assert_allclose(tags.joint.P, at_once, atol=1e-10)


def output_of(tags, rows, project):
    """H by which something is projected: H P where P is I."""
    P, tags.joint.P = tags.joint.P, np.eye(len(tags.joint.P))
    H, _ = project(rows)
    tags.joint.P = P
    return H


@given(generators())
def test_no_orientation_tells_where_the_worlds_frame_is(rng):
    seed, rows = rng.integers(2**32), np.arange(3)

    def covariance(is_frame_unsure):
        tags = tag_filter(np.random.default_rng(seed))
        GG = tags.joint.chart.gauge(3) @ tags.joint.chart.gauge(3).T
        tags.joint.P += is_frame_unsure * GG
        for _ in range(5):
            tags.correct_by_orientations(seen(rows, predicted_orientations(tags, rows), 0.05))
        return tags.joint.P, GG

    sure, GG = covariance(is_frame_unsure=False)
    unsure, _ = covariance(is_frame_unsure=True)
    np.testing.assert_allclose(unsure, sure + GG, atol=1e-9)


def test_one_tag_in_view_tells_the_heading_which_its_position_does_not():
    def heading_variance(with_orientation):
        tags = make_gains(TAGS, np.eye(4))
        tags.add(np.array([[3.0, 0.0, 0.0]]), 1e-4 * np.eye(3)[None])
        tags.add_orientations(seen(np.array([0]), np.eye(3)[None], 0.02))
        Q = np.diag([0.1, 0.1, 0.1, 0.3, 0.3, 0.3])[None]
        propagate(tags, np.zeros((1, 6)), np.array([1.0]), Q)
        rows = np.array([0])
        if with_orientation:
            tags.correct_by_orientations(seen(rows, predicted_orientations(tags, rows), 0.02))
        observe(tags, rows, tags.observer.body_points(rows), 1e-4 * np.eye(3)[None])
        return tags.errors.pose_covariance()[2, 2]

    assert heading_variance(with_orientation=False) > 0.02
    assert heading_variance(with_orientation=True) < 2.1 * 0.02**2


@pytest.mark.parametrize('settings', [TAGS, PLANAR_TAGS])
def test_covariances_are_honest_with_one_tag_in_view_at_a_time(settings):
    runs, n = 60, 4
    squared = np.array([one_drive(settings, n, seed) for seed in range(runs)])
    freedom = 3 if settings.two_d_mode else 6
    # Mean of runs · freedom squares: four standard deviations of it.
    assert abs(squared.mean() / freedom - 1.0) < 4.0 * np.sqrt(2.0 / (runs * freedom))


def one_drive(settings, n, seed):
    """NEES of the pose after a drive past n tags and back, with one of them in view at a time."""
    rng = np.random.default_rng(seed)
    is_flat = settings.two_d_mode
    only = np.array([0, 0, 1, 1, 1, 0]) if is_flat else np.ones(6)
    tags, A = make_gains(settings, np.eye(4)), np.eye(4)
    points = np.array([[2.0 * i, 1.0, 0.0] for i in range(n)])
    turns = np.zeros((n, 3)) if is_flat else rng.normal(size=(n, 3))
    B, Q, sigma_m, sigma_rad = so3.exp(turns), 1e-4 * np.diag(only), 0.03, 0.03
    order = []
    for tag in (*range(n), *reversed(range(n))):
        for _ in range(3):
            V = only * np.array([0.0, 0.1, 0.2, 1.0, 0.0, 0.0]) * (1 if tag else -1)
            propagate(tags, V[None], np.array([0.5]), Q[None])
            A = A @ se3.exp(0.5 * V + 1e-2 * only * rng.normal(size=6))
            y = se3.transform(se3.inverse(A), points[tag : tag + 1])
            y = y + sigma_m * rng.normal(size=(1, 3)) * [1.0, 1.0, not is_flat]
            noise = sigma_rad * rng.normal(size=3) * (only[:3] if is_flat else 1.0)
            Z = so3.exp(noise) @ A[:3, :3].T @ B[tag : tag + 1]
            look(tags, order, tag, y, Z, sigma_m, sigma_rad)
    P = tags.joint.pose
    error = se3.log(tags.observer.A @ se3.inverse(A))[tags.axes.pose]
    return error @ np.linalg.solve(P, error)


def look(tags, order, tag, y, Z, sigma_m, sigma_rad):
    """See a tag; a new one is taken over, and appended to the ``order`` of landmarks."""
    R = np.array([sigma_m**2 * np.eye(3)])
    if tag not in order:
        order.append(tag)
        tags.add(y, R)
        tags.add_orientations(seen(np.array([len(order) - 1]), Z, sigma_rad))
        return
    row = np.array([order.index(tag)])
    tags.correct_by_orientations(seen(row, Z, sigma_rad))
    observe(tags, row, y, R)


@given(generators())
def test_a_flipped_tag_looks_the_same_from_afar_and_flips_back(rng):
    Z, far = so3.exp(rng.normal(size=(1, 3))), np.array([[0.0, 0.0, 1e6]])
    twin = flipped(Z, far)
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    np.testing.assert_allclose((corners @ twin[0].T)[:, :2], (corners @ Z[0].T)[:, :2], atol=1e-12)
    np.testing.assert_allclose(flipped(twin, far), Z, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(twin), 1.0, atol=1e-12)


@pytest.mark.parametrize('sigma_rad', [0.02, 0.3])
def test_of_an_orientation_and_its_twin_the_likelier_one_is_used_and_none_if_both_are(sigma_rad):
    """With a heading known to 0.02 rad it is clear which of the two it is, to 0.3 rad it isn't."""
    tags, rows = make_gains(TAGS, np.eye(4)), np.array([0])
    away, tilted = np.array([[4.0, 0.0, 0.0]]), so3.exp(np.array([[0.0, np.pi / 2 + 0.3, 0.0]]))
    tags.add(away, 1e-4 * np.eye(3)[None])
    tags.add_orientations(seen(rows, tilted, 0.02))
    Q = np.zeros((1, 6, 6))
    Q[0, :3, :3] = sigma_rad**2 * np.eye(3)
    propagate(tags, np.zeros((1, 6)), np.array([1.0]), Q)
    twin = flipped(tilted, away)
    before = tags.observer.A.copy()
    noise = np.tile(0.02**2 * np.eye(3), (1, 1, 1))
    flip = SeenOrientations(rows, twin, tilted, noise, np.ones(1))
    assert tags.correct_by_orientations(flip)[0] == 0.0  # never by the one less likely
    np.testing.assert_array_equal(tags.observer.A, before)
    weights, are_unclear = tags.correct_by_orientations(
        SeenOrientations(rows, tilted, twin, noise, np.ones(1))
    )
    is_clear = sigma_rad == 0.02
    assert (weights[0] > 0.0, are_unclear[0]) == (is_clear, not is_clear)


@given(generators())
def test_removed_tags_leave_the_marginal_of_the_others(rng):
    tags = tag_filter(rng)
    B, P = tags.observer.orientations.B.copy(), tags.joint.P.copy()
    tags.remove(np.array([1]))
    kept = np.r_[0:12, 18:24]
    np.testing.assert_array_equal(tags.observer.orientations.B, B[[0, 2]])
    np.testing.assert_array_equal(tags.joint.P, P[np.ix_(kept, kept)])
