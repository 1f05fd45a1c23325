"""Types are read as the recording defines them: by former names, and with former fields."""

from __future__ import annotations

import sqlite3

from mcap.writer import Writer
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
import ros_messages as ros
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from slam_observer_ros.common.errors import RecordingError
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.recordings.reader import Recording

LINE = '=' * 80
DETECTIONS = 'vision_msgs/msg/Detection3DArray'
BOX = (
    f'{LINE}\nMSG: vision_msgs/BoundingBox3D\n'
    'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n'
)
RELEASES = {
    'Galactic': (
        'string id\n',
        'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
        f'{LINE}\nMSG: vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n',
    ),
    'Foxy': (
        'sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id\n',
        'string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n',
    ),
    'ROS 1': (
        'sensor_msgs/PointCloud2 source_cloud\n',
        'int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n',
    ),
}


def definition_of(release, detection_fields=None):
    detection, result = RELEASES[release]
    return (
        f'std_msgs/Header header\nDetection3D[] detections\n{LINE}\nMSG: vision_msgs/Detection3D\n'
        'std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\n'
        f'{detection_fields or detection}{LINE}\nMSG: vision_msgs/ObjectHypothesisWithPose\n'
        f'{result}{BOX}'
    )


def detections(release, store):
    """One detection by its result, of class 7, and one by its box alone."""
    store.register(get_types_from_msg(definition_of(release), DETECTIONS))

    def make(name, *values):
        return store.types[name](*values)

    def header():
        made = ros.header('base_link')
        stamp = store.types['std_msgs/msg/Header']
        is_ros1 = 'seq' in stamp.__dataclass_fields__
        return stamp(0, made.stamp, made.frame_id) if is_ros1 else made

    pose = ros.make(
        'geometry_msgs/msg/PoseWithCovariance',
        ros.pose([1.0, 2.0, 3.0], [0, 0, 0, 1.0]),
        np.zeros(36),
    )
    result = 'vision_msgs/msg/ObjectHypothesisWithPose'
    if release == 'Galactic':
        hypothesis = make('vision_msgs/msg/ObjectHypothesis', 'tag_7', 0.9)
        results, rest = [make(result, hypothesis, pose)], ['']
    else:
        cloud = ros.point_cloud2(np.zeros((1, 2), [('x', '<f4'), ('y', '<f4')]))
        cloud.header = header()
        results = [make(result, 7 if release == 'ROS 1' else 'tag_7', 0.9, pose)]
        rest = [cloud] if release == 'ROS 1' else [cloud, False, '']
    size = ros.make('geometry_msgs/msg/Vector3', 1.0, 1.0, 1.0)
    box = make('vision_msgs/msg/BoundingBox3D', ros.pose([4.0, 5.0, 6.0], [0, 0, 0, 1.0]), size)
    seen = [make('vision_msgs/msg/Detection3D', header(), r, box, *rest) for r in (results, [])]
    return make(DETECTIONS, header(), seen)


def write_mcap(path, data, message_type, definition):
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        twist = ros.twist_stamped([0.0] * 6)
        for topic, kind, text, content in (
            ('/twist', twist.__msgtype__, '', ros.serialise(twist)),
            ('/tags', message_type, definition, data),
        ):
            schema = writer.register_schema(kind, 'ros2msg', text.encode())
            channel = writer.register_channel(topic, 'cdr', schema)
            writer.add_message(channel, ros.STAMP_NS, content, ros.STAMP_NS)
        writer.finish()
    return path


def observed(path):
    with Recording(path) as recording:
        events = list(recording.events(recording.find_topics()))
        assert not recording.malformed
    (observation,) = (event for event in events if isinstance(event, ObservationEvent))
    return observation


def assert_right(observation):
    assert_array_equal(observation.ids, [7, UNKNOWN_ID])
    assert_allclose(observation.points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize('is_defined', [True, False])
@pytest.mark.parametrize('release', ['Galactic', 'Foxy'])
def test_detections_of_older_releases_are_read(tmp_path, release, is_defined):
    """Those of Foxy without a definition, too: its recordings have none."""
    store = get_typestore(Stores.ROS2_FOXY)
    message = detections(release, store)
    data = bytes(store.serialize_cdr(message, DETECTIONS))
    text = definition_of(release) if is_defined else ''
    assert_right(observed(write_mcap(tmp_path / 'run.mcap', data, DETECTIONS, text)))


def test_detections_of_ros_1_are_read(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    message = detections('ROS 1', store)
    with rosbag1.Writer(tmp_path / 'run.bag') as bag:
        twist = bag.add_connection('/twist', 'geometry_msgs/msg/Twist', typestore=store)
        bag.write(twist, ros.STAMP_NS, store.serialize_ros1(ros.twist([0.0] * 6), twist.msgtype))
        tags = bag.add_connection('/tags', DETECTIONS, typestore=store)
        bag.write(tags, ros.STAMP_NS, store.serialize_ros1(message, DETECTIONS))
    assert_right(observed(tmp_path / 'run.bag'))


def test_what_is_malformed_is_said_with_the_release_that_it_is_read_as(tmp_path, caplog):
    path = write_mcap(tmp_path / 'run.mcap', bytes(9), DETECTIONS, definition_of('Foxy'))
    with Recording(path) as recording:
        list(recording.events(recording.find_topics()))
        assert recording.malformed == {'/tags': 1}
    assert 'fields as in vision_msgs of Foxy' in caplog.text


@pytest.mark.parametrize(
    ('message_type', 'definition', 'names'),
    [
        (DETECTIONS, definition_of('Galactic', 'string id\nfloat64 speed\n'), 'Detection3D'),
        (
            'apriltag_msgs/msg/AprilTagDetectionArray',
            f'std_msgs/Header header\nAprilTagDetection[] detections\n{LINE}\n'
            'MSG: apriltag_msgs/AprilTagDetection\nstring family\nint32 id\n',
            'AprilTagDetection.*',
        ),
        (
            'aruco_opencv_msgs/msg/ArucoDetection',
            f'std_msgs/Header header\nMarkerPose[] markers\n{LINE}\n'
            'MSG: aruco_opencv_msgs/MarkerPose\nuint16 marker_id\ngeometry_msgs/Pose pose\n',
            'ArucoDetection',
        ),
    ],
)
def test_fields_that_nobody_knows_here_are_refused_by_name(
    tmp_path, message_type, definition, names
):
    path = write_mcap(tmp_path / 'run.mcap', bytes(100), message_type, definition)
    package = message_type.partition('/')[0]
    with Recording(path) as recording:
        expected = f'{names} of {package} has other fields in this recording'
        with pytest.raises(RecordingError, match=expected):
            list(recording.events(recording.find_topics()))


@pytest.mark.parametrize('type_name', ['tf/msg/tfMessage', 'tf2_msgs/msg/TFMessage'])
def test_transforms_of_ros_1_place_a_sensor_by_either_name(tmp_path, type_name):
    store = get_typestore(Stores.ROS1_NOETIC)
    text = 'geometry_msgs/TransformStamped[] transforms\n'
    store.register(get_types_from_msg(text, type_name))
    stamped = store.types['std_msgs/msg/Header']

    def with_sequence(message):
        message.header = stamped(0, message.header.stamp, message.header.frame_id)
        return message

    transform = ros.transform_stamped(
        ('base_link', 'cam'), [0, 0, 0.5], [0, 0, 0, 1.0], ros.STAMP_NS
    )
    cloud = ros.point_cloud(np.array([[2.0, 0, 0]]), {'id': np.array([1])}, frame_id='cam')
    messages = {
        '/tf': store.types[type_name]([with_sequence(transform)]),
        '/twist': with_sequence(ros.twist_stamped([0.0] * 6)),
        '/tags': with_sequence(cloud),
    }
    with rosbag1.Writer(tmp_path / 'run.bag') as bag:
        for topic, message in messages.items():
            connection = bag.add_connection(topic, message.__msgtype__, typestore=store)
            bag.write(connection, ros.STAMP_NS, store.serialize_ros1(message, message.__msgtype__))
    assert_allclose(observed(tmp_path / 'run.bag').points, [[2.0, 0.0, 0.5]])


def test_a_database_of_types_without_msg_is_read(tmp_path):
    with rosbag2.Writer(tmp_path / 'run', version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        for message in (
            ros.twist([1.0] * 6),
            ros.point_cloud(np.ones((1, 3)), {'id': np.ones(1)}),
        ):
            topic = bag.add_connection(
                f'/{type(message).__name__[-4:]}', message.__msgtype__, typestore=ros.TYPESTORE
            )
            bag.write(topic, ros.STAMP_NS, ros.serialise(message))
    (path,) = (tmp_path / 'run').glob('*.db3')
    with sqlite3.connect(path) as database:
        database.execute("update topics set type = replace(type, '/msg/', '/')")
    database.close()
    assert_allclose(observed(path).points, [[1.0, 1.0, 1.0]])
