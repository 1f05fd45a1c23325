"""An id that is there twice is named, and so is no landmark that moves, or is seen wrongly."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.settings.estimator_settings import Settings

STEP_S, LAP_S = 0.2, 40.0
SPEED, RADIUS_M = 2.0 * np.pi * 3.0 / LAP_S, 3.0
ANGLES = np.arange(12) * np.pi / 6
RING = 5.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES])
MODES = ('mapping', 'uncertain', 'fixed')


class Drive:
    """Laps on a circle in a ring of tags; a tag may have the id of another one."""

    def __init__(self, mode, ids=range(12), sensors=(0.0,), **settings):
        self.random = np.random.default_rng(0)
        self.tags, self.ids, self.sensors = RING.copy(), np.array(ids), sensors
        self.time_s = self.carried_s = 0.0
        self.estimator = Estimator(
            Settings(
                two_d_mode=True,
                observation_model='cartesian',
                point_noise=0.05,
                reorder_window=0.0,
                localization_mode='off' if mode == 'mapping' else mode,
                **settings,
            )
        )
        if mode != 'mapping':
            _, rows = np.unique(self.ids, return_index=True)
            n = len(rows)
            covariances = np.tile(1e-4 * np.eye(3), (n, 1, 1))
            counts = np.zeros(n, dtype=np.int64)
            known = LandmarkMap(self.ids[rows], self.tags[rows], covariances, counts)
            self.estimator.load_map(known)

    def go(self, laps, outliers=0.0, most=12):
        for _ in range(round(laps * LAP_S / STEP_S)):
            self.time_s += STEP_S
            stamp_ns = round(self.time_s * 1e9)
            noise = self.random.normal(scale=0.01, size=2)
            velocity = np.array([0, 0, SPEED / RADIUS_M + noise[0], SPEED + noise[1], 0, 0])
            assert self.estimator.add(VelocityEvent(stamp_ns, velocity))
            for number, looks_to in enumerate(self.sensors):
                self._look(stamp_ns, f'camera{number}', looks_to, outliers, most)
        return self

    def _look(self, stamp_ns, sensor, looks_to, outliers, most):
        angle = SPEED * (self.time_s + self.carried_s) / RADIUS_M
        heading = angle + np.pi / 2
        place = RADIUS_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        c, s = np.cos(heading), np.sin(heading)
        points = (self.tags - place) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        bearings = np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - looks_to)))
        ranges_m = np.linalg.norm(points, axis=1)
        seen = np.flatnonzero((np.abs(bearings) < 0.9) & (ranges_m < 5.0))
        seen = seen[np.argsort(ranges_m[seen])][:most]
        _, first = np.unique(self.ids[seen], return_index=True)  # of two the nearer one
        seen = seen[np.sort(first)]
        noise = self.random.normal(scale=0.02, size=(len(seen), 3)) * [1, 1, 0]
        is_off = self.random.random((len(seen), 1)) < outliers
        points = points[seen] * (1.0 + is_off * self.random.uniform(-0.5, 0.5, is_off.shape))
        if len(seen):
            event = ObservationEvent(stamp_ns, self.ids[seen], points + noise, sensor_frame=sensor)
            assert self.estimator.add(event)

    @property
    def named(self):
        return [finding.what.split()[1] for finding in self.estimator.ids_at_two_places]


def with_twin(first, second):
    ids = np.arange(12)
    ids[second] = first
    return ids


@pytest.mark.parametrize(('mode', 'most'), [(MODES[0], 1), (MODES[1], 12), (MODES[2], 1)])
def test_an_id_that_is_there_twice_is_named_once_and_what_to_do(mode, most, caplog):
    drive = Drive(mode, with_twin(4, 9)).go(1.0, most=most)
    drive.go(1.0, outliers=0.1, most=most)
    assert drive.named == ['4']
    (finding,) = drive.estimator.ids_at_two_places
    assert 'its id is there twice, or it is moved to and fro' in finding.what
    assert finding.remedy.endswith('give one of the two another id')
    assert caplog.messages.count(str(finding)) == 1
    if mode == 'fixed':
        assert f'({RING[4, 0]:.1f}, {RING[4, 1]:.1f}, 0.0) m' in finding.what


@pytest.mark.parametrize('mode', ['mapping', 'fixed'])
def test_two_tags_of_one_id_that_two_cameras_see_at_once_are_named(mode):
    drive = Drive(mode, with_twin(4, 10), sensors=(0.0, np.pi)).go(1.2)
    assert drive.named == ['4']


@pytest.mark.parametrize(('mode', 'most'), [('mapping', 12), ('fixed', 1)])
def test_a_landmark_that_moves_once_and_points_that_are_wrong_are_not_named(mode, most):
    drive = Drive(mode).go(1.3, outliers=0.1, most=most)
    drive.tags[[2, 7]] += [[1.5, -1.0, 0.0], [-2.0, 0.5, 0.0]]
    drive.go(1.2, outliers=0.1, most=most)
    assert not drive.named


@pytest.mark.parametrize(('mode', 'most'), [('mapping', 12), ('fixed', 1)])
def test_a_robot_that_is_carried_there_and_back_again_is_not_taken_for_it(mode, most):
    drive = Drive(mode).go(1.0, most=most)
    for carried_s in (4.0, -4.0, 6.0):
        drive.carried_s += carried_s
        drive.go(0.7, most=most)
    assert not drive.named
