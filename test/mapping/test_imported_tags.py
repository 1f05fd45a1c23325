"""In an imported map one tag in view gives the pose, if the map has its orientation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tag_drives import past_tags, SEED, SETTINGS, true_tags
import yaml

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.mapping.map_import import import_map
from slam_observer_ros.settings.estimator_settings import Settings

STEPS = 300
SIGMA_M, SIGMA_RAD = 0.02, 0.03  # of the survey
START_SIGMAS = np.array([0.05, 0.05, 0.5, 2.0, 2.0, 0.1])  # rad and m
START_ERROR = np.array([0.0, 0.0, 0.4, 1.0, -1.5, 0.0])
BODY = se3.exp(np.array([0.2, -0.1, 2.0, 1.0, -2.0, 0.5]))


def table(poses):
    """Return tags (n, 4, 4) as a CSV table."""
    lines = ['id,x,y,z,qx,qy,qz,qw']
    for tag_id, pose in enumerate(poses):
        values = [*pose[:3, 3], *so3.to_quaternion(pose[:3, :3])]
        lines.append(','.join([str(tag_id), *(f'{value:.6f}' for value in values)]))
    return '\n'.join(lines)


def tagslam(poses):
    """Return them as tags on a body of TagSLAM."""
    tags = [{'id': i, 'pose': _vectors(se3.inverse(BODY) @ T)} for i, T in enumerate(poses)]
    body = {'is_static': True, 'pose': _vectors(BODY), 'tags': tags}
    return yaml.safe_dump({'bodies': [{'lab': body}]})


def _vectors(pose):
    parts = {'position': pose[:3, 3], 'rotation': so3.log(pose[:3, :3])}
    return {name: dict(zip('xyz', part.tolist(), strict=True)) for name, part in parts.items()}


def bundle(poses):
    """Return them as a bundle of apriltag_ros."""
    names = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    layout = []
    for tag_id, pose in enumerate(poses):
        values = [*pose[:3, 3].tolist(), *so3.to_quaternion(pose[:3, :3]).tolist()]
        layout.append({'id': tag_id, 'size': 0.16} | dict(zip(names, values, strict=True)))
    return yaml.safe_dump({'tag_bundles': [{'name': 'hall', 'layout': layout}]})


@pytest.fixture
def convert(tmp_path):
    """Return a function that surveys the tags, writes them, and converts the file to a map."""

    def made(written, suffix, tag_axes):
        points, orientations = true_tags(np.random.default_rng(SEED))
        rng = np.random.default_rng(1)
        points = points + SIGMA_M * rng.normal(size=points.shape)
        orientations = orientations @ so3.exp(SIGMA_RAD * rng.normal(size=points.shape))
        path, output = tmp_path / f'tags{suffix}', tmp_path / 'map.yaml'
        path.write_text(written(se3.pose(orientations, points)))
        write_map(output, import_map(path, 'map', SIGMA_M, SIGMA_RAD, tag_axes), None)
        return read_map(output)

    return made


def localised(known, use_tag_orientation):
    """Drive in a map from a pose that is hardly known.

    Return the errors of the heading (S,), rad, and of the position (S,), m, and the standard
    deviation of the heading once the first tag was seen.
    """
    settings = Settings(**SETTINGS, localization_mode='uncertain', max_hypotheses=1)
    estimator = Estimator(
        replace(settings, reorder_window=0.0, use_tag_orientation=use_tag_orientation)
    )
    estimator.load_map(known)
    estimator.set_pose(se3.exp(START_ERROR), np.diag(START_SIGMAS**2))
    errors, sigmas_rad = [], []
    for truth, velocity, seen in past_tags(0, STEPS):
        estimator.add(velocity)
        estimator.add(seen)
        off = se3.inverse(truth.pose) @ estimator.pose
        errors.append((abs(so3.log(off[:3, :3])[2]), np.linalg.norm(off[:3, 3])))
        sigmas_rad.append(np.sqrt(estimator.pose_covariance[2, 2]))
    assert estimator.is_localised
    return *np.array(errors).T, sigmas_rad[0]


@pytest.mark.parametrize(
    ('written', 'suffix'), [(table, '.csv'), (tagslam, '.yaml'), (bundle, '.yaml')]
)
def test_one_tag_in_view_gives_the_pose(convert, written, suffix):
    known = convert(written, suffix, 'right-up-out')
    headings_rad, positions_m, sigma_rad = localised(known, use_tag_orientation=True)
    assert headings_rad[0] < 3.0 * sigma_rad
    points = convert(written, suffix, 'none')
    by_points_rad, by_points_m, by_points_sigma_rad = localised(points, use_tag_orientation=False)
    assert sigma_rad < 0.06
    assert by_points_sigma_rad > 0.3
    assert rms(headings_rad) < 0.5 * rms(by_points_rad)
    assert rms(positions_m) < 0.5 * rms(by_points_m)


def rms(errors):
    return np.sqrt(np.mean(errors**2))
