"""Orientations of tags in a recording: with one tag in view they determine the heading."""

from __future__ import annotations

import detector_messages as detector
import numpy as np
import pytest
import ros_messages as ros
from rosbags import rosbag2
from rosbags.rosbag2 import StoragePlugin
from tag_drives import past_tags, SEED, SETTINGS, true_tags

from slam_observer_ros.lie import so3
from slam_observer_ros.mapping.map_file import read_map

STEPS = 300


def detections(seen):
    """Return a Detection3DArray of tags."""
    items = [
        detector.detection(
            f'tag_{number}',
            class_id='tag',
            position=point,
            quaternion=so3.to_quaternion(Z),
        )
        for number, point, Z in zip(seen.ids, seen.points, seen.orientations, strict=True)
    ]
    return detector.detections(items, 'base_link', seen.stamp_ns)


def record(path):
    with rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {
            topic: bag.add_connection(topic, name, typestore=ros.TYPESTORE)
            for topic, name in (
                ('/ground_truth/pose', 'geometry_msgs/msg/PoseStamped'),
                ('/twist', 'geometry_msgs/msg/TwistStamped'),
                ('/tags', 'vision_msgs/msg/Detection3DArray'),
            )
        }
        for truth, velocity, seen in past_tags(ros.STAMP_NS, STEPS):
            stamp_ns = seen.stamp_ns
            for topic, message in (
                ('/ground_truth/pose', ros.OUTGOING.pose_stamped(stamp_ns, 'world', truth.pose)),
                ('/twist', ros.twist_stamped(velocity.body_velocity, stamp_ns=stamp_ns)),
                ('/tags', detections(seen)),
            ):
                bag.write(connections[topic], stamp_ns, ros.serialise(message))
    return path


@pytest.fixture
def ended(slam_observer):
    """Replay a recording; return how it ended."""
    # So large a noise of the velocity leaves the ids in doubt, which takes most of the time.
    settings = SETTINGS | {'max_hypotheses': 1}
    options = [f'{name}={written(value)}' for name, value in settings.items()]

    def run(path, use_tag_orientation, *more):
        chosen = [*options, f'use_tag_orientation={use_tag_orientation}']
        arguments = [word for option in chosen for word in ('--set', option)]
        return slam_observer('replay', path, '--json', *arguments, *more)

    return run


@pytest.fixture
def replay(ended):
    """Replay a recording without a word of complaint; return the report."""

    def run(*arguments):
        result = ended(*arguments)
        assert (result.code, result.errors) == (0, '')
        assert not result.json['dropped']
        return result.json

    return run


def written(value):
    return str(list(value)) if isinstance(value, tuple) else str(value)


def test_with_one_tag_in_view_its_orientation_determines_the_heading(replay, tmp_path):
    path = record(tmp_path / 'tags')
    errors_rad = [replay(path, use)['heading_rmse_rad'] for use in ('true', 'false')]
    assert errors_rad[0] < 0.5 * errors_rad[1]


def test_orientations_are_smoothed_and_written_to_the_map(replay, tmp_path):
    path, online, smoothed = record(tmp_path / 'tags'), tmp_path / 'a.yaml', tmp_path / 'b.yaml'
    replay(path, 'true', '--map', online)
    report = replay(path, 'true', '--map', smoothed, '--smooth')
    assert report['smoothed_ate_rmse_m'] < report['ate_rmse_m']
    before, after = read_map(online), read_map(smoothed)
    np.testing.assert_array_equal(after.ids, before.ids)
    turns = so3.log(after.orientations @ before.orientations.swapaxes(1, 2))
    assert 0.0 < np.max(np.linalg.norm(turns, axis=1)) < 0.1


@pytest.fixture
def in_a_map(tmp_path, slam_observer, ended):
    """Replay from a known start, in a map of the true tags that was a table; return the end."""
    path, table, made = (tmp_path / name for name in ('tags', 'tags.csv', 'map.yaml'))
    points, orientations = true_tags(np.random.default_rng(SEED))
    values = np.hstack([points, so3.to_quaternion(orientations)])
    rows = [','.join(map(str, [tag_id, *row])) for tag_id, row in enumerate(values)]
    table.write_text('\n'.join(['id,x,y,z,qx,qy,qz,qw', *rows]))
    record(path)

    def run(tag_axes, use_tag_orientation='true'):
        convert = ('map', 'convert', table, made, '--tag-axes', tag_axes, '--force')
        slam_observer.succeed(*convert)
        chosen = ('--set', 'set_initial_pose=true', '--set', 'localization_mode=uncertain')
        return ended(path, use_tag_orientation, '--load-map', made, *chosen)

    return run


def test_orientations_of_a_table_improve_the_pose(in_a_map):
    tags, points = in_a_map('right-up-out'), in_a_map('none', 'false')
    assert tags.errors == ''
    assert tags.json['heading_rmse_rad'] < 0.7 * points.json['heading_rmse_rad']


@pytest.mark.parametrize('tag_axes', ['right-down-in', 'left-down-out'])
def test_other_tag_axes_than_the_detectors_are_reported(in_a_map, tag_axes):
    errors = in_a_map(tag_axes).errors
    assert 'has the map other tag axes than the detector' in errors
