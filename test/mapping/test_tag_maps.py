"""Maps of points and tags: saved, loaded, and used in every mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam_observer_ros.common.errors import MapError
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.settings.estimator_settings import Settings

SETTINGS = Settings(
    use_tag_orientation=True,
    orientation_noise=0.02,
    observation_model='cartesian',
    point_noise=0.02,
    reorder_window=0.0,
    angular_bias_stddev=(0.0, 0.0, 0.0),
)
IDS = np.array([3, 5, 8, 9])
POINTS = np.array([[3.0, 0.0, 0.2], [3.0, 2.0, 0.5], [1.0, -2.0, 0.1], [-1.0, 2.0, 0.4]])
R = so3.exp(np.array([[0.3, -1.2, 0.1], [0.0, 1.0, 0.4], [0.5, 0.5, 0.5], [0.0, 0.0, 0.0]]))
R[3] = 0.0  # a point
MAP = LandmarkMap(
    IDS,
    POINTS,
    np.tile(1e-4 * np.eye(3), (4, 1, 1)),
    np.full(4, 9),
    orientations=R,
    orientation_sigmas=np.array([0.01, 0.01, 0.01, 0.0]),
)


def seen_from(pose, rows, stamp_ns):
    back = se3.inverse(pose)
    points = se3.transform(back, POINTS[rows])
    return ObservationEvent(stamp_ns, IDS[rows], points, orientations=back[:3, :3] @ R[rows])


def look(estimator, pose, rows, times=5, first=0):
    for k in range(first, first + times):
        estimator.add(VelocityEvent(k * 10**8, np.zeros(6)))
        estimator.add(seen_from(pose, rows, k * 10**8))


def test_a_mixed_map_is_saved_as_it_is_loaded(tmp_path):
    write_map(tmp_path / 'map.yaml', MAP, SETTINGS)
    loaded = read_map(tmp_path / 'map.yaml')
    np.testing.assert_allclose(loaded.orientations, R, atol=1e-12)
    np.testing.assert_array_equal(loaded.orientation_sigmas, MAP.orientation_sigmas)
    np.testing.assert_array_equal(loaded.select([1, 3]).orientations, loaded.orientations[[1, 3]])


def test_what_was_mapped_goes_to_the_file(tmp_path):
    estimator = Estimator(SETTINGS)
    look(estimator, np.eye(4), np.arange(4))
    write_map(tmp_path / 'map.yaml', estimator.landmark_map, SETTINGS)
    loaded = read_map(tmp_path / 'map.yaml')
    np.testing.assert_allclose(loaded.orientations, R, atol=1e-9)
    assert np.all(loaded.orientation_sigmas[:3] > 0.0)
    assert np.all(loaded.orientation_sigmas[:3] < 0.03)


def test_a_map_of_positions_alone_has_no_orientations(tmp_path):
    estimator = Estimator(replace(SETTINGS, use_tag_orientation=False))
    look(estimator, np.eye(4), np.arange(4))
    write_map(tmp_path / 'map.yaml', estimator.landmark_map, SETTINGS)
    assert 'orientation' not in (tmp_path / 'map.yaml').read_text().partition('landmarks:')[2]
    assert read_map(tmp_path / 'map.yaml').orientations is None


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
@pytest.mark.parametrize('two_d_mode', [False, True])
def test_in_a_loaded_map_one_tag_corrects_the_heading(mode, two_d_mode):
    pose = se3.exp(np.array([0.0, 0.0, 0.15, 0.5, 0.0, 0.0]))
    settings = replace(SETTINGS, localization_mode=mode, two_d_mode=two_d_mode)
    estimator = Estimator(settings)
    estimator.load_map(MAP)
    estimator.set_pose(np.eye(4), np.diag(np.repeat([0.1, 0.5], 3) ** 2))
    look(estimator, pose, np.array([0]))
    turn = so3.log(estimator.pose[:3, :3] @ pose[:3, :3].T)
    assert abs(turn[2]) < 0.02
    assert np.sqrt(estimator.pose_covariance[2, 2]) < 0.03
    np.testing.assert_allclose(estimator.landmark_map.orientations[0], R[0], atol=0.05)


@pytest.mark.parametrize('mode', ['off', 'uncertain', 'fixed'])
def test_the_pose_is_found_in_a_map_with_tags(mode):
    pose = se3.exp(np.array([0.0, 0.1, 2.0, 0.5, 0.3, 0.0]))
    estimator = Estimator(replace(SETTINGS, localization_mode=mode))
    estimator.load_map(MAP)
    look(estimator, pose, np.arange(4), times=8)
    assert estimator.is_localised
    np.testing.assert_allclose(estimator.pose, pose, atol=0.03)
    assert estimator.counts['rejected_orientation'] == 0
    np.testing.assert_allclose(estimator.landmark_map.orientations, R, atol=0.03)


@pytest.mark.parametrize(
    ('entry', 'problem'),
    [
        ('orientation: [0.0, 0.0, 0.0, 1.0]', 'needs both'),
        ('orientation: [0.0, 0.0, 0.0, 0.5], orientation_sigma: 0.1', 'norm 1'),
        ('orientation: [0.0, 0.0, 1.0], orientation_sigma: 0.1', '4 numbers'),
        ('orientation: [0.0, 0.0, 0.0, 1.0], orientation_sigma: -0.1', 'negative'),
    ],
)
def test_wrong_orientations_in_a_file_are_named(tmp_path, entry, problem):
    head = 'format: slam_observer_ros map\nversion: 1\nframe: map\nlandmarks:\n'
    path = tmp_path / 'map.yaml'
    path.write_text(f'{head}- {{id: 7, position: [1.0, 2.0, 3.0], {entry}}}\n')
    with pytest.raises(MapError, match=f'landmark 7.*{problem}'):
        read_map(path)
