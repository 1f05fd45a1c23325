"""Interpolation and TUM files keep what they are given, to the nanosecond and the last bit."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from tum_files import read_tum

from slam_observer_ros.common.errors import EvaluationError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.trajectory import (
    associate,
    interpolate,
    Trajectory,
    write_tum,
)

SEEDS = st.integers(0, 2**32 - 1)
EPOCH_NS = 1_700_000_000_123_456_789


def random_trajectory(seed: int, k: int, start_ns: int = EPOCH_NS) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps_ns = start_ns + np.cumsum(rng.integers(1, 200_000_000, k))
    return Trajectory(stamps_ns, se3.exp(rng.normal(0.0, 1.5, (k, 6))))


@given(SEEDS, st.integers(1, 20))
def test_interpolation_is_exact_at_the_knots(seed: int, k: int) -> None:
    trajectory = random_trajectory(seed, k)
    poses, covered = interpolate(trajectory, trajectory.stamps_ns)
    assert covered.all()
    np.testing.assert_array_equal(poses, trajectory.poses)


def test_interpolation_follows_a_held_velocity() -> None:
    # Straight motion while turning: the two interpolate independently, each linearly.
    stamps_ns = EPOCH_NS + np.arange(0, 1_000_000_000, 100_000_000)
    wanted_ns = np.array([EPOCH_NS + 123_456_789, EPOCH_NS + 899_999_999])

    def poses_at(stamps_ns: IntArray) -> FloatArray:
        seconds = (stamps_ns - EPOCH_NS)[:, None] / 1e9
        turn = se3.exp(seconds * [0.3, -1.0, 2.0, 0.0, 0.0, 0.0])
        turn[:, :3, 3] = seconds * [1.0, -2.0, 0.5]
        return turn

    poses, covered = interpolate(Trajectory(stamps_ns, poses_at(stamps_ns)), wanted_ns)
    assert covered.all()
    np.testing.assert_allclose(poses, poses_at(wanted_ns), atol=1e-12)


def test_nothing_is_extrapolated_or_bridged_over_a_gap() -> None:
    stamps_ns = np.array([0, 100, 1_100, 1_200])
    trajectory = Trajectory(stamps_ns, np.tile(np.eye(4), (4, 1, 1)))
    wanted_ns = np.array([-1, 0, 50, 100, 101, 1_099, 1_100, 1_200, 1_201])
    poses, covered = interpolate(trajectory, wanted_ns, max_gap_ns=999)
    np.testing.assert_array_equal(covered, [0, 1, 1, 1, 0, 0, 1, 1, 0])
    assert np.isnan(poses[~covered]).all()
    _, all_covered = interpolate(trajectory, wanted_ns, max_gap_ns=1_000)
    np.testing.assert_array_equal(all_covered, [0, 1, 1, 1, 1, 1, 1, 1, 0])


def test_an_empty_trajectory_covers_nothing() -> None:
    _, covered = interpolate(Trajectory.from_samples([], []), np.array([0, 1]))
    assert not covered.any()


@given(SEEDS)
def test_pairs_have_one_stamp(seed: int) -> None:
    estimate, truth = random_trajectory(seed, 15), random_trajectory(seed + 1, 12)
    paired, true_paired, covered = associate(estimate, truth)
    np.testing.assert_array_equal(paired.stamps_ns, estimate.stamps_ns[covered])
    np.testing.assert_array_equal(paired.stamps_ns, true_paired.stamps_ns)
    np.testing.assert_array_equal(paired.poses, estimate.poses[covered])


def test_samples_are_sorted_and_the_last_of_one_stamp_counts() -> None:
    poses = se3.exp(np.arange(18.0).reshape(3, 6))
    trajectory = Trajectory.from_samples([20, 10, 20], list(poses))
    np.testing.assert_array_equal(trajectory.stamps_ns, [10, 20])
    np.testing.assert_array_equal(trajectory.poses, poses[[1, 2]])


@pytest.mark.parametrize(
    ('first_ns', 'last_ns', 'part'),
    [
        (0, 0, slice(3, 7)),
        (-1, 1, slice(2, 8)),
        (1, -1, slice(3, 7)),
        (-(10**12), 10**12, slice(10)),
    ],
)
def test_the_part_during_another_one_spans_its_time(
    first_ns: int, last_ns: int, part: slice
) -> None:
    trajectory = random_trajectory(0, 10)
    stamps_ns = trajectory.stamps_ns[[3, 6]] + np.array([first_ns, last_ns])
    found = trajectory.during(Trajectory(stamps_ns, trajectory.poses[[3, 6]]))
    np.testing.assert_array_equal(found.stamps_ns, trajectory.stamps_ns[part])
    np.testing.assert_array_equal(found.poses, trajectory.poses[part])


@pytest.mark.parametrize(
    ('stamps_ns', 'poses'),
    [
        (np.array([1, 1]), np.tile(np.eye(4), (2, 1, 1))),
        (np.array([2, 1]), np.tile(np.eye(4), (2, 1, 1))),
        (np.array([1]), np.tile(np.eye(4), (2, 1, 1))),
        (np.array([1]), np.full((1, 4, 4), np.nan)),
    ],
)
def test_a_malformed_trajectory_is_refused(stamps_ns: IntArray, poses: FloatArray) -> None:
    with pytest.raises(EvaluationError):
        Trajectory(stamps_ns, poses)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(SEEDS, st.integers(0, 10), st.sampled_from([EPOCH_NS, 0, -(10**10), 2**62]))
def test_tum_round_trip_loses_nothing(tmp_path: Path, seed: int, k: int, start_ns: int) -> None:
    written = random_trajectory(seed, k, start_ns)
    read = read_tum(write_tum(written, tmp_path / 'poses.tum'))
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.positions, written.positions)
    np.testing.assert_allclose(read.rotations, written.rotations, atol=1e-15)


def test_tum_lines_are_what_evo_reads(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -2.0, 1e-9]
    path = write_tum(Trajectory(np.array([1_000_000_001]), pose[None]), tmp_path / 'poses.tum')
    header, line = path.read_text().splitlines()
    assert header.startswith('#')
    assert line == '1.000000001 0.1 -2.0 1e-09 0.0 0.0 0.0 1.0'


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match='absent'):
        write_tum(random_trajectory(0, 2), tmp_path / 'absent' / 'poses.tum')


def test_writing_replaces_the_whole_file_and_leaves_no_other(tmp_path: Path) -> None:
    path = write_tum(random_trajectory(0, 50), tmp_path / 'poses.tum')
    write_tum(random_trajectory(1, 2), path)
    assert len(read_tum(path)) == 2
    assert list(tmp_path.iterdir()) == [path]
