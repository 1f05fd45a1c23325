"""A simulated robot among tags, localised over DDS by the node as the launch file sets it up."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import hall
from hall_robot import error_of, Estimated, Seen
import numpy as np
from numpy.testing import assert_allclose
import pytest
import robot
from robot_report import Interruption

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.nodes.ros_node import TFMessage
from slam_observer_ros.runs.health import of_mounting
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.mark.ros
@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built')
@pytest.mark.parametrize(
    'options',
    [[], ['--reflectors', '--carried'], ['--floor-codes', '--keep-pose'], ['--uwb']],
    ids=' '.join,
)
def test_the_robot_is_localised_before_and_after_what_happens_half_way(
    monkeypatch, capsys, options
):
    monkeypatch.chdir(CHECKOUT)
    duration = '30' if '--uwb' in options else '14'  # by distances a robot is found as it turns
    for factor in ('1', '0.5', '0.25'):
        exit_code = robot.main(['--duration', duration, '--real-time-factor', factor, *options])
        output = capsys.readouterr().out
        if 'too slow' not in output:  # else what it says is done: other tests run beside this one
            break
    assert exit_code == 0, output
    assert 'The robot was localised.' in output
    if '--carried' in options:  # what was published before is not judged by where it is now
        assert float(output.partition('ANEES of amcl_pose')[2].split()[1]) < 10.0
    assert '1 code' not in output  # but 'the first code', 'one code in view at a time'


def test_the_page_on_nav2_has_the_command_that_is_run():
    page = (CHECKOUT / 'docs' / 'nav2.md').read_text()
    words = [f'params_file:={robot.PARAMS_FILE}']
    words += [f'{name}:={value}' for name, value in robot.LAUNCH_ARGUMENTS.items()]
    assert f'ros2 launch slam_observer_ros localization.launch.py {" ".join(words)}' in page


def test_what_the_camera_sees_is_in_front_of_it_and_faces_it():
    random = np.random.default_rng(0)
    tags = hall.tag_poses()
    errors = random.standard_normal((len(tags), 7))
    seen = [hall.sightings(hall.true_pose(t), tags, errors) for t in np.arange(0.0, hall.LAP_S)]
    assert {len(each) for each in seen} == {0, 1, 2, 3}
    for each in seen:
        for pose in each.values():
            assert 0.0 < pose[2, 3] < hall.MAX_RANGE_M
            assert pose[:3, 2] @ pose[:3, 3] < 0.0


def test_a_sighting_is_where_the_tag_is_within_its_noise():
    random = np.random.default_rng(0)
    tags = hall.tag_poses()
    for time_s in np.arange(0.0, hall.LAP_S):
        pose = hall.true_pose(time_s)
        errors = random.standard_normal((len(tags), 7))
        for tag_id, seen in hall.sightings(pose, tags, errors).items():
            in_map = pose @ hall.CAMERA @ seen
            assert_allclose(in_map[:3, 3], tags[tag_id][:3, 3], atol=0.8)


def test_a_scan_is_of_reflectors_near_the_robot_within_its_noise():
    random = np.random.default_rng(0)
    reflectors = hall.reflectors(random)
    assert len(reflectors) == hall.REFLECTORS
    for time_s in np.arange(0.0, hall.LAP_S):
        pose = hall.true_pose(time_s)
        points = hall.scan(pose, reflectors, random.standard_normal((hall.REFLECTORS, 7)), random)
        assert len(points) > 2
        assert np.linalg.norm(points, axis=1).max() < hall.SCAN_RANGE_M + 0.2
        in_map = points @ pose[:3, :3].T + pose[:3, 3]
        off_m = np.linalg.norm(in_map[:, None] - reflectors, axis=2).min(axis=1)
        assert off_m.max() < 0.3


class Drive:
    """A lap of the robot at ten images a second, without ROS, by a shipped parameter file."""

    def __init__(self, file, seed=0, mount=None, **changes):
        names = {row.name for row in table(Settings)}
        given = read_parameter_file(CHECKOUT / 'config' / f'{file}.yaml')
        chosen = {key: value for key, value in given.items() if key in names}
        others = {'floor_codes': False, 'uwb': False}
        options = SimpleNamespace(reflectors=file == 'reflectors', seed=seed, **others)
        self.world = robot.world_of(options)
        self.estimator = Estimator(from_parameters(Settings, chosen | changes))
        self.mount = np.eye(4) if mount is None else mount
        self.random = np.random.default_rng(seed)

    def run(self, seconds):
        """Go on; return errors (n, 3), and their normalised squares, once a second."""
        estimator, world, random, off = self.estimator, self.world, self.random, []
        odometry = hall.WheelOdometry(random)
        errors = hall.SightErrors(random, len(world.landmarks))
        for step in range(1, 10 * seconds):
            before, truth = hall.true_pose((step - 1) / 10.0), hall.true_pose(step / 10.0)
            odometry.advance(before, truth, 0.1)
            V = np.array([0.0, 0.0, odometry.turn_rad_s, odometry.forward_m_s, 0.0, 0.0])
            estimator.add(VelocityEvent(step * 100_000_000, V))
            errors.go_on(0.1)
            for event in self.seen(truth, errors.values, step * 100_000_000):
                estimator.add(event)
            if step > 50 and step % 10 == 0 and estimator.is_localised:
                pose, P = estimator.uncertain_pose
                error = error_of(hall.true_pose(estimator.stamp_ns * 1e-9), pose)
                P = P[np.ix_([3, 4, 2], [3, 4, 2])]
                off.append((*error, error @ np.linalg.solve(P, error) / 3.0))
        return np.array(off)

    def seen(self, truth, errors, stamp_ns):
        """Yield what the sensor sees, which is mounted otherwise than stated."""
        world, pose = self.world, truth @ self.mount
        if world.scan:
            points = world.scan(pose, world.landmarks, errors, self.random)
            yield ObservationEvent(stamp_ns, np.full(len(points), UNKNOWN_ID), points)
        elif seen := world.sightings(pose, world.landmarks, errors):
            poses, ids = np.array(list(seen.values())), np.array(list(seen))
            R = poses[:, :3, :3]
            event = ObservationEvent(stamp_ns, ids, poses[:, :3, 3], orientations=R)
            yield event.moved(hall.CAMERA)


def test_among_reflectors_the_shipped_file_is_as_sure_as_it_may_be():
    """Or its noise, or the hall's, would be misstated."""
    nees = []
    for seed in range(2):
        drive = Drive('reflectors', seed)
        drive.estimator.load_map(robot.surveyed(drive.world, seed))
        nees.append(drive.run(25)[:, 3])
    assert 0.4 < np.mean(nees) < 2.0


def test_distances_are_3_percent_long_and_one_in_five_is_through_a_wall():
    random = np.random.default_rng(0)
    anchors = np.array(hall.ANCHOR_SPOTS)
    pose = hall.true_pose(5.0)
    true_m = np.linalg.norm(anchors - pose[:3, 3], axis=1)
    off_m = np.array([hall.ranges(pose, anchors, random) for _ in range(2000)]) - 1.03 * true_m
    assert abs(np.median(off_m)) < 0.06
    assert 0.1 < np.mean(off_m > 4.0 * hall.RANGE_NOISE_M) < 0.2
    assert np.mean(off_m < -4.0 * hall.RANGE_NOISE_M) < 1e-3


@pytest.mark.parametrize('file', ['tags_on_tf', 'reflectors', 'wheeled_robot'])
def test_a_mount_that_is_five_degrees_off_is_named_and_estimated(file):
    mount = se3.from_rpy((0.0, 0.0, 0.0, 0.0, 0.0, np.radians(5.0)))
    drive = Drive(file, mount=mount, localization_mode='uncertain')
    drive.estimator.load_map(robot.surveyed(drive.world, 0))
    off = drive.run(40)
    (finding,) = of_mounting(drive.estimator.calibration)
    assert 'further to the left than /tf says' in finding.what
    (turn,) = (part for part in drive.estimator.calibration if part.name == 'sensor_rotation_z')
    assert turn.value == pytest.approx(np.radians(5.0), abs=0.02)
    assert np.sqrt(np.mean(np.sum(off[10:, :2] ** 2, axis=1))) < 0.15


def test_wheels_drift_from_the_truth():
    odometry = hall.WheelOdometry(np.random.default_rng(0))
    steps = [hall.true_pose(step / 50.0) for step in range(50 * int(hall.LAP_S))]
    for before, after in pairwise(steps):
        odometry.advance(before, after, 0.02)
    moved = np.linalg.inv(steps[0]) @ steps[-1]
    assert 0.2 < np.linalg.norm(odometry.pose[:2, 3] - moved[:2, 3]) < 5.0


def test_the_time_to_be_localised_again_counts_from_the_tags():
    sight = [hall_seen(10.5, 1), hall_seen(11.0, 2), hall_seen(12.0, 2)]

    def back_after_s(localised_s, *stamps_s):
        poses = [Estimated(time_s, np.eye(4), np.eye(4), np.eye(6)) for time_s in (9.9, *stamps_s)]
        return Interruption(10.0, False, 10.0, localised_s).back_after_s(sight, poses, 2)

    assert back_after_s(13.0, 11.4, 11.6) == pytest.approx(0.4), 'however late it was heard of'
    assert back_after_s(10.4, 10.2) == 0.0
    assert back_after_s(None) is None


def test_a_carried_robot_is_localised_again_once_it_is_where_it_was_put():
    carried = Interruption(10.0, is_carried=True, began_s=10.0)
    there = np.eye(4)
    elsewhere = there + np.eye(4, k=3) * 3.0
    for time_s, by_tf in ((10.5, elsewhere), (11.0, None), (12.0, there), (13.0, there)):
        assert carried.is_lost(time_s) == (time_s < 13.0)
        carried.note(Seen(time_s, there, by_tf, 9))
    assert carried.localised_s == 12.0


def hall_seen(time_s, tags):
    return Seen(time_s, np.eye(4), None, tags)
