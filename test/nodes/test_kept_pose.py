"""The last pose is there after a restart, unless it is too old."""

from __future__ import annotations

import os
from types import SimpleNamespace
from unittest.mock import Mock

from node_processes import running
import numpy as np
from numpy.testing import assert_allclose
import pytest
from robots import Robot

from slam_observer_ros import Estimator, Settings
from slam_observer_ros.common.errors import MapError
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.nodes import initial_pose
from slam_observer_ros.nodes.initial_pose import (
    KeptPose,
    read_pose,
    StoredPose,
    write_pose,
)
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.simulation import Scenario

POSE = se3.from_rpy((1.0, -2.0, 0.0, 0.0, 0.0, 0.7))
COVARIANCE = np.diag([0.0, 0.0, 0.01, 0.04, 0.04, 0.0])


NO_ODOMETRY = SimpleNamespace(newest_ns=None, pose_until=lambda stamp_ns: None)


@pytest.fixture(name='kept')
def fixture_kept(tmp_path, monkeypatch):
    """A kept pose in a file, the estimator that it is for, and what the clock says."""
    clock = SimpleNamespace(now_s=1e9)
    monkeypatch.setattr(initial_pose.time, 'time', lambda: clock.now_s)
    path = tmp_path / 'deep' / 'pose.yaml'
    node, estimator = Mock(), Estimator(Settings(two_d_mode=True))
    settings = ObserverNodeSettings(pose_file=str(path))
    odometry = SimpleNamespace(
        newest_ns=None, pose_until=lambda stamp_ns: odometry.pose, pose=None
    )
    part = KeptPose(node, settings, estimator, odometry)
    return SimpleNamespace(
        part=part, path=path, clock=clock, estimator=estimator, log=node.get_logger(),
        odometry=odometry,
    )  # fmt: skip


def stored(frame_id='map', time_s=1e9):
    return StoredPose(POSE, COVARIANCE, frame_id, time_s)


THEN = se3.from_rpy((7.0, 1.0, 0.0, 0.0, 0.0, -0.4))
MOTION = se3.from_rpy((1.5, 0.2, 0.0, 0.0, 0.0, 0.9))


@pytest.mark.parametrize(
    ('odometry', 'moved'),
    [
        (THEN @ MOTION, MOTION),
        (np.eye(4), np.eye(4)),  # it began anew
        (se3.from_rpy((90.0, 1.0, 0.0, 0.0, 0.0, 0.0)), np.eye(4)),  # it is another
    ],
    ids=['went on', 'began anew', 'another'],
)
def test_a_kept_pose_moves_on_as_odometry_has(kept, odometry, moved):
    write_pose(kept.path, StoredPose(POSE, COVARIANCE, 'map', 1e9, THEN))
    assert_allclose(read_pose(kept.path).odometry, THEN, atol=1e-12)
    kept.clock.now_s += 4.0
    kept.part.restore()
    kept.part.follow_odometry()  # it is not heard yet
    assert_allclose(kept.estimator.pose, POSE, atol=1e-9)
    kept.odometry.newest_ns, kept.odometry.pose = 10**9, odometry
    kept.part.follow_odometry()
    assert_allclose(kept.estimator.pose, POSE @ moved, atol=1e-9)
    deviation = np.sqrt(kept.estimator.pose_covariance[3, 3])
    assert (deviation > 0.45) == (moved is not MOTION)
    kept.odometry.pose = odometry @ MOTION
    kept.part.follow_odometry()  # once is enough
    assert_allclose(kept.estimator.pose, POSE @ moved, atol=1e-9)


def halls(*names):
    ids, points = np.arange(4), np.array([[3, 0, 0], [4, 2, 0], [0, 3, 0], [-2, 1, 0]], float)
    covariances = np.tile(1e-4 * np.eye(3), (4, 1, 1))
    return [LandmarkMap(ids, points, covariances, 0 * ids, name=name) for name in names]


def test_of_several_maps_the_robot_is_in_that_where_it_was(kept):
    kept.estimator.load_map(halls('north', 'south'))
    kept.estimator.set_pose(POSE, COVARIANCE, map_name='south')
    kept.estimator.add(VelocityEvent(1, np.zeros(6)))
    kept.estimator.release()
    kept.part.keep()
    assert read_pose(kept.path).map_name == 'south'
    kept.estimator.load_map(halls('north', 'south'))
    assert not kept.estimator.is_localised
    kept.part.restore()
    assert kept.estimator.is_localised
    assert kept.estimator.map_name == 'south'
    assert_allclose(kept.estimator.pose, POSE, atol=1e-9)


def test_a_pose_in_a_map_that_is_not_there_any_more_is_not_used(kept):
    write_pose(kept.path, StoredPose(POSE, COVARIANCE, 'map', 1e9, map_name='west'))
    kept.estimator.load_map(halls('north', 'south'))
    kept.part.restore()
    assert not kept.estimator.is_localised
    assert "it is in the map 'west', which is not loaded" in kept.log.warning.call_args.args[0]


def test_a_pose_is_read_as_it_was_written(tmp_path):
    write_pose(tmp_path / 'pose.yaml', stored())
    read = read_pose(tmp_path / 'pose.yaml')
    assert_allclose(read.pose, POSE, atol=1e-12)
    assert_allclose(read.covariance, COVARIANCE)
    assert (read.frame_id, read.time_s) == ('map', 1e9)


@pytest.mark.parametrize(
    ('old', 'new', 'reason'),
    [
        ('slam_observer_ros pose', 'another', 'has no line'),
        ('- 1.0\n- -2.0', '- 1.0\n- .nan', "'position' is not 3 finite numbers"),
        ('time: 1000000000.0', 'time: yesterday', "'time' is not 1 finite numbers"),
        ('time: 1000000000.0', f'time: {10**23}', "'time' is not 1 finite numbers"),
        ('- 0.04', f'- -{10**400}', "'covariance' is not 36 finite numbers"),
        ('- 0.04', '- 1.0e+300', "'covariance' is not 36 finite numbers"),
        ('frame', '  frame', 'is not valid YAML'),
    ],
)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path, old, new, reason):
    path = tmp_path / 'pose.yaml'
    write_pose(path, stored())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(MapError, match=reason):
        read_pose(path)


@pytest.mark.timeout(20)
@pytest.mark.parametrize('name', ['pipe', 'folder', '/dev/zero', 'n' * 300])
def test_what_can_be_no_file_neither_blocks_nor_ends_the_node(tmp_path, name):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()
    node = Mock()
    settings = ObserverNodeSettings(pose_file=str(tmp_path / name))
    part = KeptPose(node, settings, Estimator(Settings()), NO_ODOMETRY)
    part.restore()
    part._estimator.add(VelocityEvent(1, np.zeros(6)))
    part._estimator.release()
    part.keep()
    node.get_logger().warning.assert_called()


def test_the_robot_starts_where_it_was(kept):
    write_pose(kept.path, stored())
    kept.part.restore()
    kept.estimator.add(VelocityEvent(1, np.zeros(6)))
    kept.estimator.release()
    assert_allclose(kept.estimator.pose, POSE, atol=1e-9)
    # and may have been moved a little
    assert_allclose(np.diag(kept.estimator.pose_covariance)[[2, 3]], [0.0776, 0.29], rtol=0.01)


@pytest.mark.parametrize(
    ('written', 'reason'),
    [
        (stored(time_s=1e9 - 601.0), 'it is 601 s old'),
        (stored(time_s=1e9 + 100.0), "by this machine's clock it was kept 100 s from now"),
        (stored(frame_id='hall'), "it is in frame 'hall'"),
    ],
)
def test_a_pose_that_may_be_wrong_is_not_used(kept, written, reason):
    write_pose(kept.path, written)
    kept.part.restore()
    assert_allclose(kept.estimator.pose, np.eye(4))
    assert reason in kept.log.warning.call_args.args[0]


def test_without_a_file_nothing_is_said(kept):
    kept.part.restore()
    kept.log.warning.assert_not_called()


def test_it_is_written_when_there_is_a_new_one(kept):
    kept.part.keep()
    assert not kept.path.exists()
    kept.estimator.add(VelocityEvent(1, np.zeros(6)))
    kept.estimator.release()
    kept.part.keep()
    assert read_pose(kept.path).time_s == 1e9
    kept.clock.now_s += 10.0
    kept.part.keep()
    assert read_pose(kept.path).time_s == 1e9, 'the robot was not observed since'


def test_a_file_that_cannot_be_written_is_a_warning(tmp_path):
    node, estimator = Mock(), Estimator(Settings())
    estimator.add(VelocityEvent(1, np.zeros(6)))
    estimator.release()
    settings = ObserverNodeSettings(pose_file=str(tmp_path))
    KeptPose(node, settings, estimator, NO_ODOMETRY).keep()
    assert "can't write the pose" in node.get_logger().warning.call_args.args[0]


@pytest.mark.ros
def test_after_a_restart_the_node_goes_on_from_there(ros, tmp_path):
    path = tmp_path / 'pose.yaml'
    parameters = {'pose_file': str(path), 'two_d_mode': True}
    with running('observer_node', tmp_path / 'one', **parameters), Robot(ros) as robot:
        robot.run(Scenario(duration=2.0))
    x, y = read_pose(path).pose[:2, 3]
    assert np.hypot(x, y) > 1.0
    with running('observer_node', tmp_path / 'two', **parameters) as node:
        node.wait_for_output(f'the robot is where it was: .{x:.2f}, {y:.2f}, 0.00')
