"""A run replays alike, whatever messages of a detector its landmarks are recorded as."""

from __future__ import annotations

from functools import partial
import re

import detector_messages as detector
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from tum_files import read_tum

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.simulation import Scenario, Simulation

CAMERA = se3.from_rpy((0.2, 0.0, 0.4, -np.pi / 2, 0.0, -np.pi / 2))
CAMERA_FRAME = 'camera_optical_frame'
SCENARIO = Scenario(
    velocity_rate=20.0, observation_rate=10.0, duration=4.0, point_noise=0.02, landmark_count=8,
    field_of_view=150.0, late_fraction=0.2, initial_bias=0.0,
)  # fmt: skip
BOXES = 'vision_msgs/msg/Detection3DArray'
TF_DELAY_NS = 1_000_000
"""How much later than the detections their positions come on /tf."""


def transform(parent, child, position, quaternion, stamp_ns):
    return ros.transform_stamped((parent, child), position, quaternion, stamp_ns)


def transforms(*messages):
    return ros.make('tf2_msgs/msg/TFMessage', list(messages))


def tags(seen, prefix):
    """Tags and, among them, what else is on /tf."""
    stamp_ns = seen.stamp_ns
    return transforms(
        transform('odom', 'base_link', (9.0, 9.0, 9.0), detector.NO_TURN, stamp_ns),
        *(
            transform(CAMERA_FRAME, f'{prefix}{number}', point, detector.NO_TURN, stamp_ns)
            for number, point in zip(seen.ids, seen.points, strict=True)
        ),
    )


def cloud(seen, ids=None):
    dtype = [('x', '<f8'), ('y', '<f8'), ('z', '<f8'), ('id', '<i4')]
    records = np.zeros((1, len(seen.ids)), dtype=dtype)
    for axis, name in enumerate('xyz'):
        records[name] = seen.points[:, axis]
    records['id'] = seen.ids if ids is None else ids
    message = ros.point_cloud2(records, CAMERA_FRAME)
    message.header = ros.header(CAMERA_FRAME, seen.stamp_ns)
    return message


def boxes(seen):
    items = [
        detector.detection(f'reflector_{number}', centre=point)
        for number, point in zip(seen.ids, seen.points, strict=True)
    ]
    return detector.detections(items, CAMERA_FRAME, seen.stamp_ns)


def apriltags(seen):
    seen_tags = [('tag36h11', int(number)) for number in seen.ids]
    return detector.apriltags(seen_tags, CAMERA_FRAME, seen.stamp_ns)


def directions(seen):
    dtype = [('x', '<f8'), ('y', '<f8'), ('z', '<f8'), ('id', '<i4'), ('no_range', '<u1')]
    records = np.zeros((1, len(seen.ids)), dtype=dtype)
    lengths = np.linalg.norm(seen.points, axis=1)
    for axis, name in enumerate('xyz'):
        records[name] = seen.points[:, axis] / lengths
    records['id'], records['no_range'] = seen.ids, 1
    message = ros.point_cloud2(records, CAMERA_FRAME)
    message.header = ros.header(CAMERA_FRAME, seen.stamp_ns)
    return message


def distances(seen):
    """Of float32, as LinkTrack has them."""
    return np.linalg.norm(seen.points, axis=1).astype(np.float32)


def range_cloud(seen):
    records = np.zeros((1, len(seen.ids)), dtype=[('range', '<f4'), ('id', '<i4')])
    records['range'], records['id'] = distances(seen), seen.ids
    message = ros.point_cloud2(records, CAMERA_FRAME)
    message.header = ros.header(CAMERA_FRAME, seen.stamp_ns)
    return message


def linktrack(seen):
    nodes = zip(seen.ids.tolist(), distances(seen).tolist(), strict=True)
    return detector.linktrack('LinktrackNodeframe3', nodes, CAMERA_FRAME, seen.stamp_ns)


def range_beacon(seen):
    sensed = zip(seen.ids.tolist(), distances(seen).tolist(), strict=True)
    return detector.range_beacon(sensed, CAMERA_FRAME, seen.stamp_ns)


def boxes_in_image(seen):
    names = (f'lamp_{number}' for number in seen.ids)
    found = zip(names, detector.pixels_of(seen.points), strict=True)
    return detector.boxes(found, CAMERA_FRAME, seen.stamp_ns)


def tags_in_image(seen):
    seen_tags = [('tag36h11', int(number)) for number in seen.ids]
    pixels = detector.pixels_of(seen.points).tolist()
    return detector.apriltags(seen_tags, CAMERA_FRAME, seen.stamp_ns, pixels)


def markers(build, seen):
    found = [
        (int(number), point, detector.NO_TURN)
        for number, point in zip(seen.ids, seen.points, strict=True)
    ]
    return build(found, CAMERA_FRAME, seen.stamp_ns)


def landmark_list(seen):
    found = [
        (str(number), point, detector.NO_TURN)
        for number, point in zip(seen.ids, seen.points, strict=True)
    ]
    return detector.landmark_list(found, CAMERA_FRAME, seen.stamp_ns)


def range_bearing(seen):
    x, y, z = seen.points.T
    ranges, yaws, level = np.linalg.norm(seen.points, axis=1), np.arctan2(y, x), np.hypot(x, y)
    sensed = zip(seen.ids.tolist(), ranges, yaws, np.arctan2(-z, level), strict=True)
    return detector.range_bearing(sensed, CAMERA_FRAME, seen.stamp_ns)


MESSAGES = {
    '/landmarks': cloud,
    '/nameless': lambda seen: cloud(seen, ids=-1),
    '/poses': lambda seen: detector.pose_array(seen.points, CAMERA_FRAME, seen.stamp_ns),
    '/boxes': boxes,
    '/detections': apriltags,
    '/aruco_detections': partial(markers, detector.aruco_detection),
    '/aruco_markers': partial(markers, detector.aruco_markers),
    '/tag_detections': partial(markers, detector.isaac_apriltags),
    '/landmark_list': landmark_list,
    '/range_bearing': range_bearing,
    '/directions': directions,
    '/range_cloud': range_cloud,
    '/linktrack': linktrack,
    '/range_beacon': range_beacon,
    '/boxes_in_image': boxes_in_image,
    '/tags_in_image': tags_in_image,
    '/camera_info': lambda _seen: detector.camera_info(CAMERA_FRAME),
    '/tf': lambda seen: tags(seen, 'tag36h11:'),
    '/tags/tf': lambda seen: tags(seen, 'dock'),
}


def record(path, *topics):
    """Write a run whose landmarks are on record on each of the topics."""
    deliveries = list(Simulation(SCENARIO, ros.STAMP_NS).deliveries())
    quaternion = so3.to_quaternion(CAMERA[:3, :3])
    mount = transform('base_link', CAMERA_FRAME, CAMERA[:3, 3], quaternion, ros.STAMP_NS)
    messages = [(ros.STAMP_NS, '/tf_static', transforms(mount))]
    for delivery in deliveries:
        event, now_ns = delivery.event, delivery.arrival_ns
        if isinstance(event, VelocityEvent):
            velocity = ros.twist_stamped(event.body_velocity, stamp_ns=event.stamp_ns)
            messages.append((now_ns, '/twist', velocity))
        elif isinstance(event, ObservationEvent):
            seen = event.moved(se3.inverse(CAMERA))
            for topic in topics:
                delay_ns = TF_DELAY_NS if topic == '/tf' else 0
                messages.append((now_ns + delay_ns, topic, MESSAGES[topic](seen)))
    with rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {}
        for now_ns, topic, message in sorted(messages, key=lambda entry: entry[0]):
            if topic not in connections:
                name = message.__msgtype__
                connections[topic] = bag.add_connection(topic, name, typestore=ros.TYPESTORE)
            bag.write(connections[topic], now_ns, ros.serialise(message))
    return path


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """One recording with all of the topics, and several with one detector's."""
    folder = tmp_path_factory.mktemp('detections')
    chosen = {
        'all': MESSAGES,
        'poses': ['/poses'],
        'boxes': ['/boxes'],
        'apriltag': ['/detections', '/tf'],
        'aruco_opencv': ['/aruco_detections'],
        'ros2_aruco': ['/aruco_markers', '/poses'],
        'isaac': ['/tag_detections'],
        'cartographer': ['/landmark_list'],
        'mrpt': ['/range_bearing'],
        'two': ['/detections', '/boxes'],
        'unplaced': ['/detections'],
        'directions': ['/directions'],
        'range cloud': ['/range_cloud'],
        'linktrack': ['/linktrack'],
        'range beacon': ['/range_beacon'],
        'boxes in images': ['/boxes_in_image', '/camera_info'],
        'tags in images': ['/tags_in_image', '/camera_info'],
        'no camera': ['/boxes_in_image'],
    }
    return {name: record(folder / name, *topics) for name, topics in chosen.items()}


@pytest.fixture(scope='module')
def estimates():
    """Trajectories and maps, by recording and options."""
    return {}


@pytest.fixture
def estimate(slam_observer, estimates, tmp_path):
    """Replay a recording, once with the same options; return the trajectory and the map."""

    def run(path, *options):
        if (path, options) in estimates:
            return estimates[path, options]
        files = tmp_path / 'poses.tum', tmp_path / 'map.yaml'
        outputs = ('--tum', files[0], '--map', files[1], '--force', '--json')
        report = slam_observer.succeed('replay', path, *outputs, *options).json
        assert not report['dropped']
        estimates[path, options] = read_tum(files[0]), read_map(files[1])
        return estimates[path, options]

    return run


def assert_same(actual, expected):
    assert_array_equal(actual[0].stamps_ns, expected[0].stamps_ns)
    assert_allclose(actual[0].poses, expected[0].poses, atol=1e-9)
    assert len(expected[1].ids) > 4
    assert_array_equal(actual[1].ids, expected[1].ids)
    assert_allclose(actual[1].world_points, expected[1].world_points, atol=1e-9)


@pytest.mark.parametrize(
    ('name', 'options'),
    [
        ('boxes', ()),
        ('boxes', ('--set', 'landmarks_type=Detection3DArray')),
        ('apriltag', ()),
        ('apriltag', ('--set', 'landmarks_type=AprilTagDetectionArray')),
        ('apriltag', ('--set', 'landmarks_type=tf')),
        ('apriltag', ('--landmarks-topic', '/tf')),
        ('aruco_opencv', ()),
        ('aruco_opencv', ('--set', 'landmarks_type=ArucoDetection')),
        ('ros2_aruco', ()),
        ('ros2_aruco', ('--set', 'landmarks_type=ArucoMarkers')),
        ('isaac', ()),
        ('cartographer', ()),
        ('cartographer', ('--set', 'landmarks_type=LandmarkList')),
        ('mrpt', ()),
        ('mrpt', ('--set', 'landmarks_type=ObservationRangeBearing')),
        ('isaac', ('--set', 'landmarks_type=AprilTagDetectionArray')),
        ('all', ('--landmarks-topic', '/detections')),
        ('all', ('--landmarks-topic', '/tags/tf', '--tag-frame-prefix', 'dock')),
        ('all', ('--set', 'landmarks_type=tf', '--landmarks-topic', '/tags/tf',
                 '--tag-frame-prefix', 'dock')),
    ],
)  # fmt: skip
def test_detections_with_ids_replay_like_a_cloud(recordings, estimate, name, options):
    assert_same(estimate(recordings[name], *options), estimate(recordings['all']))


@pytest.mark.parametrize(
    ('name', 'like'),
    [
        ('boxes in images', 'directions'),
        ('tags in images', 'directions'),
        ('linktrack', 'range cloud'),
        ('range beacon', 'range cloud'),
    ],
)
def test_what_a_driver_says_of_half_points_replays_like_a_cloud_of_them(
    recordings, slam_observer, estimate, tmp_path, name, like
):
    """In a map; pixels by the CameraInfo that was recorded."""
    known = tmp_path / 'known.yaml'
    slam_observer.succeed('replay', recordings['all'], '--map', known)
    options = ('--load-map', known, '--set', 'set_initial_pose=true')
    actual = estimate(recordings[name], *options)
    assert_same(actual, estimate(recordings[like], *options))


def test_pixels_of_a_camera_that_nobody_knows_are_dropped_and_reported(recordings, slam_observer):
    ended = slam_observer('replay', recordings['no camera'], '--json')
    assert ended.json['dropped'] == {'no_transform': 41}
    assert "no CameraInfo of 'camera_optical_frame' has come" in ended.errors


@pytest.mark.parametrize(
    'options', [('--landmarks-topic', '/poses'), ('--set', 'landmarks_type=PoseArray')]
)
def test_poses_replay_like_a_cloud_without_ids(recordings, estimate, options):
    expected = estimate(recordings['all'], '--landmarks-topic', '/nameless')
    assert_same(estimate(recordings['poses'], *options), expected)


@pytest.mark.parametrize(
    ('name', 'landmarks_type'),
    [('poses', 'PoseArray'), ('boxes', 'auto'), ('apriltag', 'auto'), ('apriltag', 'tf')],
)
def test_orientations_that_nobody_filled_in_change_nothing(
    recordings, estimate, name, landmarks_type
):
    """But for rounding."""
    chosen = ('--set', f'landmarks_type={landmarks_type}')
    expected = estimate(recordings[name], *chosen)
    assert_same(estimate(recordings[name], *chosen, '--set', 'use_tag_orientation=true'), expected)


def test_the_nodes_file_says_which_type(recordings, estimate, tmp_path):
    config = tmp_path / 'apriltags.yaml'
    config.write_text('/**: {ros__parameters: {landmarks_type: AprilTagDetectionArray}}')
    actual = estimate(recordings['apriltag'], '--config', config)
    assert_same(actual, estimate(recordings['all']))


def test_the_camera_is_placed_by_tf_static(recordings, estimate):
    trajectory, _ = estimate(recordings['all'])
    simulation = Simulation(SCENARIO, ros.STAMP_NS)
    last_ns = int(trajectory.stamps_ns[-1])
    motion = se3.inverse(simulation.pose(ros.STAMP_NS)) @ simulation.pose(last_ns)
    # Were the camera taken for the base, the robot would drive sideways and climb.
    assert np.linalg.norm(trajectory.poses[-1][:3, 3] - motion[:3, 3]) < 0.1


def test_tags_that_tf_does_not_have_are_dropped_and_reported(recordings, slam_observer):
    ended = slam_observer('replay', recordings['unplaced'], '--json')
    assert ended.code == 0
    assert ended.json['landmarks'] == 0
    assert ended.json['dropped'] == {'no_transform': 41}
    assert ended.errors.count('Dropped a message, no_transform: ') == 1
    assert 'fiducials are where /tf has them, which was not recorded' in ended.errors


def test_tags_that_tf_has_by_another_name_are_reported(tmp_path, monkeypatch, slam_observer):
    monkeypatch.setitem(MESSAGES, '/tf', MESSAGES['/tags/tf'])
    path = record(tmp_path / 'run', '/detections', '/tf')
    errors = slam_observer('replay', path).errors
    assert "no frame on /tf is named 'tag_<id>' or '<family>:<id>' (there are" in errors
    assert 'dock0' in errors
    assert 'sensor_pose' not in errors
    renamed = slam_observer('replay', path, '--tag-frame-prefix', 'dock', '--json')
    assert renamed.json['dropped'] == {}


def test_fiducials_on_tf_by_another_name_are_reported(recordings, slam_observer):
    options = ('--landmarks-topic', '/tags/tf')
    errors = slam_observer('replay', recordings['all'], *options).errors
    assert "no frame on /tf is named 'tag_<id>' or '<family>:<id>' (there are" in errors
    assert 'dock0' in errors
    assert 'set tag_frame_prefix' in errors


@pytest.mark.parametrize(
    ('name', 'options', 'reason'),
    [
        ('two', (), '2 topics could be the landmark topic: .*choose one with --landmarks-topic'),
        ('poses', (), 'no landmark topic: .* with ids; --landmarks-topic may name /poses; '),
        ('boxes', ('--set', 'landmarks_type=tf'), 'no topic /tf; the recording holds'),
        ('boxes', ('--set', 'landmarks_type=PoseArray'),
         'PoseArray; --landmarks-topic names another; the recording holds'),
        ('boxes', ('--set', 'landmarks_type=PoseArray', '--landmarks-topic', '/boxes'),
         'can not be the landmark topic, which is one of geometry_msgs/msg/PoseArray$'),
        ('boxes', ('--set', 'landmarks_type=Boxes'), "'landmarks_type' takes one of auto, "),
        ('all', ('--landmark-truth-topic', '/boxes'), 'can not be the true landmark topic'),
    ],
)  # fmt: skip
def test_what_can_not_be_replayed_is_reported(recordings, slam_observer, name, options, reason):
    error = slam_observer.fail('replay', recordings[name], *options)
    assert re.search(reason, error.rstrip())


def test_boxes_whose_fields_are_of_no_release_are_refused(tmp_path, slam_observer):
    typestore = get_typestore(Stores.ROS1_NOETIC)
    definition = 'vision_msgs/Detection3D[] detections\n'
    for text, name in (('string id\n', 'vision_msgs/msg/Detection3D'), (definition, BOXES)):
        typestore.register(get_types_from_msg(text, name))
    path = tmp_path / 'ros_1.bag'
    with rosbag1.Writer(path) as bag:
        for topic, message in (
            ('/twist', ros.twist(np.zeros(6))),
            ('/boxes', typestore.types[BOXES]([])),
        ):
            name = message.__msgtype__
            connection = bag.add_connection(topic, name, typestore=typestore)
            bag.write(connection, ros.STAMP_NS, typestore.serialize_ros1(message, name))
    error = slam_observer.fail('replay', path)
    assert 'Detection3D of vision_msgs has other fields in this recording' in error
