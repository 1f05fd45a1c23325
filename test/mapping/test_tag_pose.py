"""A lost robot is found by a single tag whose pose the map has."""

from __future__ import annotations

from dataclasses import replace
import logging

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.tracking.matching import flipped

SIGMA_M, SIGMA_RAD = 0.02, 0.03
SETTINGS = Settings(
    use_tag_orientation=True,
    orientation_noise=SIGMA_RAD,
    observation_model='cartesian',
    point_noise=SIGMA_M,
    reorder_window=0.0,
    localization_mode='uncertain',
)


class TagHall:
    """Six tags on a wall, a robot that stands or drives slowly, and sees some of them."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)
        self.points = self.random.uniform([4, -6, -1], [6, 6, 1], (6, 3))
        self.R = so3.exp(self.random.normal(scale=0.7, size=(6, 3))) @ so3.exp(
            np.array([0.0, -np.pi / 2, 0.0])
        )
        self.start = se3.exp(self.random.normal(size=6) * [0.2, 0.2, 0.5, 2, 2, 0.3])

    @property
    def map(self):
        return LandmarkMap(
            np.arange(6),
            self.points,
            np.tile(1e-4 * np.eye(3), (6, 1, 1)),
            np.zeros(6, dtype=np.int64),
            orientations=self.R,
            orientation_sigmas=np.full(6, 0.01),
        )

    def estimator(self, **changes):
        estimator = Estimator(replace(SETTINGS, **changes))
        estimator.load_map(self.map)
        return estimator

    def see(self, estimator, step, ids, flips=()):
        ids = np.array(ids)
        pose = self.start @ se3.exp(np.array([0, 0, 0, 0.02, 0, 0]) * step)
        back = se3.inverse(pose)
        y = se3.transform(back, self.points[ids])
        y += self.random.normal(scale=SIGMA_M, size=y.shape)
        Z = back[:3, :3] @ self.R[ids] @ so3.exp(self.random.normal(scale=SIGMA_RAD, size=y.shape))
        are_flipped = np.isin(ids, flips)
        Z[are_flipped] = flipped(Z[are_flipped], y[are_flipped])
        estimator.add(VelocityEvent(step * 10**8, np.array([0, 0, 0, 0.2, 0, 0])))
        estimator.add(ObservationEvent(step * 10**8, ids, y, orientations=Z))
        return np.concatenate(
            [so3.log(estimator.pose[:3, :3] @ pose[:3, :3].T), estimator.pose[:3, 3] - pose[:3, 3]]
        )


def test_one_tag_is_enough_at_its_second_sighting_and_the_pose_is_honest():
    nees = []
    for seed in range(40):
        hall = TagHall(seed)
        estimator = hall.estimator()
        hall.see(estimator, 0, [2])
        assert not estimator.is_localised
        error = hall.see(estimator, 1, [2])
        assert estimator.is_localised
        nees.append(error @ np.linalg.solve(estimator.pose_covariance, error))
    assert 0.4 < np.mean(nees) / 6 < 1.5


@pytest.mark.parametrize('mode', ['off', 'fixed'])
def test_the_robot_goes_on_in_the_map_however_it_is_used(mode):
    hall = TagHall(0)
    estimator = hall.estimator(localization_mode=mode)
    for step in range(20):
        error = hall.see(estimator, step, [step // 5])
    assert estimator.is_localised
    assert np.linalg.norm(error[3:]) < 0.1


def test_a_tag_that_is_flipped_now_and_then_takes_a_few_sightings_more():
    sightings = []
    for seed in range(30):
        hall = TagHall(seed)
        estimator = hall.estimator()
        for step in range(12):
            hall.see(estimator, step, [2], flips=[2] if hall.random.random() < 0.3 else ())
            if estimator.is_localised:
                break
        sightings.append(step + 1)
    assert np.median(sightings) <= 3


def test_a_tag_that_is_flipped_for_long_is_refused_and_another_one_believed(caplog):
    hall = TagHall(3)
    estimator = hall.estimator()
    with caplog.at_level(logging.INFO):
        for step in range(3):
            hall.see(estimator, step, [2], flips=[2])
        assert estimator.is_localised  # wrongly: nothing else was seen
        for step in range(3, 30):
            error = hall.see(estimator, step, [1, 2, 4], flips=[2])
    assert 'contradict the pose that tag 2 gave' in caplog.text
    assert estimator.is_localised
    assert np.linalg.norm(error[3:]) < 0.1


def test_tags_that_the_map_has_no_orientations_of_find_nothing_alone():
    hall = TagHall(0)
    estimator = Estimator(SETTINGS)
    estimator.load_map(replace(hall.map, orientations=None, orientation_sigmas=None))
    for step in range(5):
        hall.see(estimator, step, [2])
    assert not estimator.is_localised
