"""A robot over codes on a floor, one in view at a time, by the parameter file that is shipped."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import floor
import hall
import numpy as np
from numpy.testing import assert_allclose

from slam_observer_ros.common.stamps import to_ns
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.parameter_file import read_parameter_file
from slam_observer_ros.settings.parameter_table import from_parameters, table

PARAMS_FILE = Path(__file__).resolve().parents[2] / 'config' / 'floor_codes.yaml'
RATE_HZ, CHECKS_HZ = 20, 10
SIGMA_M, SIGMA_RAD = 0.005, 0.02
PLANE = [3, 4, 2]  # x, y and heading of a pose's covariance


class Robot:
    """Drives on its lap, sees codes, and is localised by them."""

    def __init__(self, has_map=True, has_orientations=True):
        known = {row.name for row in table(Settings)}
        given = read_parameter_file(PARAMS_FILE)
        settings = from_parameters(Settings, {k: v for k, v in given.items() if k in known})
        if not has_map:
            settings = replace(settings, localization_mode='off')
        self.random = np.random.default_rng(1)
        self.codes = floor.code_poses(self.random)
        self.estimator, self.has_orientations = Estimator(settings), has_orientations
        if has_map:
            self.estimator.load_map(self._surveyed())
        self.odometry = hall.WheelOdometry(self.random)
        self.errors = hall.SightErrors(self.random, len(self.codes))
        self.steps, self.ahead_s, self.origin = 0, 0.0, np.eye(4)
        if not has_map:  # the frame of the map that it makes is where it begins
            self.origin = se3.inverse(floor.true_pose(0.0))

    def _surveyed(self):
        count = len(self.codes)
        points = self.codes[:, :3, 3] + self.random.normal(0.0, SIGMA_M, (count, 3))
        covariances = np.tile(SIGMA_M**2 * np.eye(3), (count, 1, 1))
        known = LandmarkMap(np.arange(count), points, covariances, np.zeros(count, np.int64))
        if not self.has_orientations:
            return known
        R, sigmas = self.codes[:, :3, :3], np.full(count, SIGMA_RAD)
        return replace(known, orientations=R, orientation_sigmas=sigmas)

    def run(self, seconds):
        """Go on; return how far the pose is off in the plane, ten times a second, as _off."""
        off = []
        for _ in range(round(seconds * RATE_HZ)):
            before = self._truth(self.steps)
            self.steps += 1
            pose, stamp_ns = self._truth(self.steps), to_ns(self.steps / RATE_HZ)
            self.odometry.advance(before, pose, 1.0 / RATE_HZ)
            V = np.array([0.0, 0.0, self.odometry.turn_rad_s, self.odometry.forward_m_s, 0.0, 0.0])
            self.estimator.add(VelocityEvent(stamp_ns, V))
            self.errors.go_on(1.0 / RATE_HZ)
            if seen := floor.sightings(pose, self.codes, self.errors.values):
                poses = np.array(list(seen.values()))
                R = poses[:, :3, :3] if self.has_orientations else None
                ids, points = np.array(list(seen)), poses[:, :3, 3]
                event = ObservationEvent(stamp_ns, ids, points, orientations=R)
                self.estimator.add(event.moved(floor.CAMERA))
            if self.steps % (RATE_HZ // CHECKS_HZ) == 0:
                off.append(self._off())
        return np.array(off)

    def _truth(self, step):
        return floor.true_pose(step / RATE_HZ + self.ahead_s)

    def _off(self):
        """Return the error of x, y, heading, and its normalised square; not a number if lost."""
        if not self.estimator.is_localised:
            return np.full(4, np.nan)
        truth = self.origin @ self._truth(self.estimator.stamp_ns * 1e-9 * RATE_HZ)
        pose, P = self.estimator.uncertain_pose
        turn = pose[:3, :3] @ truth[:3, :3].T
        error = np.array([*(pose - truth)[:2, 3], np.arctan2(turn[1, 0], turn[0, 0])])
        return np.append(error, error @ np.linalg.pinv(P[np.ix_(PLANE, PLANE)]) @ error / 3.0)


def rms(values):
    return np.sqrt(np.mean(np.sum(values**2, axis=1)))


def test_one_code_is_in_view_at_a_time_and_none_for_half_of_the_way():
    codes = floor.code_poses(np.random.default_rng(0))
    times_s = np.arange(0.0, floor.LAP_S, 0.04)
    look = partial(floor.sightings, codes=codes, errors=np.zeros((len(codes), 7)))
    seen = [look(floor.true_pose(time_s)) for time_s in times_s]
    assert {len(each) for each in seen} == {0, 1}
    assert 0.4 < np.mean([not each for each in seen]) < 0.7
    for time_s, each in zip(times_s, seen, strict=True):
        for code_id, pose in each.items():
            in_map = floor.true_pose(time_s) @ floor.MOUNT_OFF @ floor.CAMERA @ pose
            assert_allclose(in_map, codes[code_id], atol=1e-9)


def test_the_robot_drives_as_vehicles_in_a_warehouse_do():
    poses = [floor.true_pose(time_s) for time_s in np.arange(0.0, floor.LAP_S + 1.0, 0.02)]
    twists = np.array([se3.log(se3.inverse(a) @ b) / 0.02 for a, b in pairwise(poses)])
    assert np.abs(twists[:, 2]).max() < 2.0
    assert 0.9 < twists[:, 3].max() < 1.1
    assert np.abs(twists[:, 4]).max() < 0.05, 'it never goes sideways'
    assert np.abs(np.diff(twists[:, 3])).max() / 0.02 < 1.0


def test_the_pose_among_surveyed_codes_is_right_and_as_uncertain_as_it_says():
    off = Robot().run(30.0)
    assert np.flatnonzero(np.isfinite(off[:, 0]))[0] < 0.5 * CHECKS_HZ, 'one code says where it is'
    settled = off[5 * CHECKS_HZ :]
    assert rms(settled[:, :2]) < 0.03
    assert rms(settled[:, 2:3]) < 0.04
    assert 0.3 < settled[:, 3].mean() < 3.0


def test_codes_whose_orientation_nobody_states_show_where_the_robot_is_by_the_second_one():
    off = Robot(has_orientations=False).run(25.0)
    assert np.flatnonzero(np.isfinite(off[:, 0]))[0] < 4.0 * CHECKS_HZ
    settled = off[10 * CHECKS_HZ :]
    assert rms(settled[:, :2]) < 0.05
    assert rms(settled[:, 2:3]) < 0.08


def test_a_robot_that_is_carried_finds_its_place_though_each_code_is_soon_behind_it():
    robot = Robot()
    robot.run(6.0)
    robot.ahead_s = 0.5 * floor.LAP_S
    robot.run(6.0)
    assert robot.estimator.counts['lost'] == 1
    assert rms(robot.run(5.0)[:, :2]) < 0.05


def test_codes_are_mapped_where_there_is_no_map():
    robot = Robot(has_map=False)
    robot.run(floor.LAP_S)
    off = robot.run(5.0)
    assert rms(off[:, :2]) < 0.3
    assert off[:, 3].mean() < 4.0
    ids = robot.estimator.landmark_ids
    true = se3.transform(robot.origin, robot.codes[ids, :3, 3])
    assert len(ids) > 20
    assert rms((robot.estimator.world_points - true)[:, :2]) < 0.3
