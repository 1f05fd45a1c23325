"""Landmarks from poses, boxes and fiducials; a recording of /tf replays like one of clouds."""

from __future__ import annotations

from command_line import CommandLine
import numpy as np
from numpy.testing import assert_array_equal
import pytest
import ros_messages as ros
from rosbags import rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import get_types_from_msg

from slam_observer_ros.errors import MessageError
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.extrinsics import move_observation, pose_from_rpy
from slam_observer_ros.geometry import se3, so3
from slam_observer_ros.recording.detections import (
    decode_apriltags,
    decode_detections,
    decode_pose_array,
    observed_tags,
)
from slam_observer_ros.recording.input_settings import InputSettings
from slam_observer_ros.recording.messages import PoseMessage
from slam_observer_ros.recording.reader import open_recording
from slam_observer_ros.recording.topics import TopicNames
from slam_observer_ros.replay import replay
from slam_observer_ros.settings import Settings
from slam_observer_ros.simulation import Scenario, Simulation

NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])
DEFINITIONS = {
    'vision_msgs/msg/ObjectHypothesis': 'string class_id\nfloat64 score\n',
    'vision_msgs/msg/ObjectHypothesisWithPose': (
        'ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n'
    ),
    'vision_msgs/msg/BoundingBox3D': 'geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n',
    'vision_msgs/msg/Detection3D': (
        'std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\n'
        'string id\n'
    ),
    'vision_msgs/msg/Detection3DArray': 'std_msgs/Header header\nDetection3D[] detections\n',
    'apriltag_msgs/msg/Point': 'float64 x\nfloat64 y\n',
    'apriltag_msgs/msg/AprilTagDetection': (
        'string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n'
        'Point centre\nPoint[4] corners\nfloat64[9] homography\n'
    ),
    'apriltag_msgs/msg/AprilTagDetectionArray': (
        'std_msgs/Header header\nAprilTagDetection[] detections\n'
    ),
}


@pytest.fixture(scope='module', autouse=True)
def definitions():
    """Define the optional packages' messages, as they are published, for the test's own side."""
    for name, text in DEFINITIONS.items():
        if name not in ros.TYPESTORE.types:
            ros.TYPESTORE.register(get_types_from_msg(text, name))


def test_poses_are_landmarks_without_ids():
    poses = [ros.pose((1.0, 2.0, 3.0), NO_TURN), ros.pose((4.0, 5.0, 6.0), NO_TURN)]
    raw = ros.serialise(ros.make('geometry_msgs/msg/PoseArray', ros.header('camera'), poses))
    message = decode_pose_array(raw)
    assert message.frame_id == 'camera'
    assert message.event.stamp_ns == ros.STAMP_NS
    assert_array_equal(message.event.ids, [-1, -1])
    assert_array_equal(message.event.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    with pytest.raises(MessageError):
        decode_pose_array(raw[:-20])


def detection(name, class_id=None, covariance=None):
    results = []
    if class_id is not None:
        hypothesis = ros.make('vision_msgs/msg/ObjectHypothesis', class_id, 0.9)
        whole = np.zeros((6, 6))
        if covariance is not None:
            whole[:3, :3] = covariance
        pose = ros.make(
            'geometry_msgs/msg/PoseWithCovariance',
            ros.pose((1.0, 2.0, 3.0), NO_TURN),
            whole.ravel(),
        )
        results = [ros.make('vision_msgs/msg/ObjectHypothesisWithPose', hypothesis, pose)]
    box = ros.make(
        'vision_msgs/msg/BoundingBox3D',
        ros.pose((7.0, 8.0, 9.0), NO_TURN),
        ros.vector((1.0, 1.0, 1.0)),
    )
    return ros.make('vision_msgs/msg/Detection3D', ros.header('camera'), results, box, name)


def detections(*items):
    message = ros.make('vision_msgs/msg/Detection3DArray', ros.header('camera'), list(items))
    return decode_detections(ros.serialise(message)).event


def test_detections_have_the_number_in_their_id_or_class():
    event = detections(
        detection('17'), detection('', 'reflector_4', np.eye(3)), detection('pole', 'pole')
    )
    assert_array_equal(event.ids, [17, 4, -1])
    assert_array_equal(event.points, [[7.0, 8.0, 9.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    assert event.covariances is None, 'not all are known'


def test_detections_keep_their_covariances():
    covariance = np.array([[3.0, 0.5, 0.1], [0.5, 2.0, 0.2], [0.1, 0.2, 1.0]])
    event = detections(detection('1', 'x', covariance), detection('2', 'x', 2 * covariance))
    assert_array_equal(event.covariances, [covariance, 2 * covariance])


def test_apriltag_detections_give_ids_and_families():
    point = ros.make('apriltag_msgs/msg/Point', 0.0, 0.0)
    tags = [
        ros.make('apriltag_msgs/msg/AprilTagDetection', family, number, 0, 1.0, 2.0, point,
                 [point] * 4, np.zeros(9))
        for family, number in (('tag36h11', 5), ('tag16h5', 12))
    ]  # fmt: skip
    message = ros.make('apriltag_msgs/msg/AprilTagDetectionArray', ros.header('camera'), tags)
    decoded = decode_apriltags(ros.serialise(message))
    assert decoded.ids == (5, 12)
    assert decoded.families == ('tag36h11', 'tag16h5')
    assert (decoded.frame_id, decoded.stamp_ns) == ('camera', ros.STAMP_NS)


def test_fiducials_on_tf_are_told_by_their_names():
    def transform(parent, child, x, stamp_ns=5):
        return PoseMessage(stamp_ns, parent, child, np.array([x, 0.0, 0.0]), NO_TURN)

    seen = observed_tags(
        [
            transform('left', 'tag36h11:7', 1.0),
            transform('odom', 'base_link', 2.0),
            transform('left', 'marker8', 3.0),
            transform('right', 'tag36h11:7', 4.0),
            transform('left', 'tag36h11:9', 5.0, stamp_ns=6),
            transform('base_link', 'marker8_mount', 6.0),
        ],
        'marker',
    )
    assert [(m.frame_id, m.event.stamp_ns) for m in seen] == [
        ('left', 5), ('left', 6), ('right', 5),
    ]  # fmt: skip
    assert_array_equal(seen[0].event.ids, [7, 8])
    assert_array_equal(seen[0].event.points, [[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])


CAMERA = pose_from_rpy((0.2, 0.0, 0.4, -np.pi / 2, 0.0, -np.pi / 2))
CAMERA_FRAME = 'camera_optical_frame'
SCENARIO = Scenario(
    velocity_rate=20.0, observation_rate=10.0, duration=4.0, point_noise=0.02, landmark_count=8,
    field_of_view=150.0, late_fraction=0.2, initial_bias=0.0,
)  # fmt: skip


@pytest.fixture(scope='module')
def recording_path(tmp_path_factory):
    """A run whose landmarks are on record three times: as clouds, apriltag-style and named."""
    path = tmp_path_factory.mktemp('tags') / 'tags'
    with rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {}

        def write(topic, stamp_ns, message):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, name, typestore=ros.TYPESTORE)
            bag.write(connections[topic], stamp_ns, ros.serialise(message))

        quaternion = so3.to_quaternion(CAMERA[:3, :3])
        mount = transform('base_link', CAMERA_FRAME, CAMERA[:3, 3], quaternion, ros.STAMP_NS)
        write('/tf_static', ros.STAMP_NS, transforms([mount]))
        for delivery in Simulation(SCENARIO, ros.STAMP_NS).deliveries():
            event, now_ns = delivery.event, delivery.arrival_ns
            if isinstance(event, VelocityEvent):
                velocity = ros.twist_stamped(event.body_velocity, stamp_ns=event.stamp_ns)
                write('/twist', now_ns, velocity)
            elif isinstance(event, ObservationEvent):
                seen = move_observation(event, se3.inverse(CAMERA))
                write('/landmarks', now_ns, cloud(seen))
                write('/tf', now_ns, tags(seen, 'tag36h11:'))
                write('/tags/tf', now_ns, tags(seen, 'dock'))
    return path


def transform(parent, child, position, quaternion, stamp_ns):
    return ros.transform_stamped((parent, child), position, quaternion, stamp_ns)


def transforms(messages):
    return ros.make('tf2_msgs/msg/TFMessage', messages)


def tags(event, prefix):
    """Tags and, among them, what else is on /tf."""
    odometry = transform('odom', 'base_link', (9.0, 9.0, 9.0), NO_TURN, event.stamp_ns)
    seen = [
        transform(CAMERA_FRAME, f'{prefix}{number}', point, NO_TURN, event.stamp_ns)
        for number, point in zip(event.ids, event.points, strict=True)
    ]
    return transforms([odometry, *seen])


def cloud(event):
    dtype = [('x', '<f8'), ('y', '<f8'), ('z', '<f8'), ('id', '<u4')]
    records = np.zeros((1, len(event.ids)), dtype=dtype)
    for axis, name in enumerate('xyz'):
        records[name] = event.points[:, axis]
    records['id'] = event.ids
    message = ros.point_cloud2(records, CAMERA_FRAME)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(event.stamp_ns, 1_000_000_000)
    return message


def replayed(path, **names):
    with open_recording(path) as recording:
        selected = recording.find_topics(TopicNames(**names))
        inputs = InputSettings(tag_frame_prefix='dock')
        return replay(recording.events(selected, inputs), Settings()).estimator


@pytest.mark.parametrize('topic', ['/tf', '/tags/tf'])
def test_fiducials_on_tf_replay_like_a_cloud(recording_path, topic):
    expected, estimator = replayed(recording_path), replayed(recording_path, landmarks=topic)
    assert len(expected.landmark_ids) > 4
    assert_array_equal(estimator.pose, expected.pose)
    assert_array_equal(estimator.landmark_ids, expected.landmark_ids)
    assert_array_equal(estimator.world_points, expected.world_points)


def test_the_camera_is_placed_by_tf_static(recording_path):
    simulation = Simulation(SCENARIO, ros.STAMP_NS)
    estimator = replayed(recording_path)
    motion = se3.inverse(simulation.pose(ros.STAMP_NS)) @ simulation.pose(estimator.stamp_ns)
    # Were the camera taken for the base, the robot would drive sideways and climb.
    assert np.linalg.norm(estimator.pose[:3, 3] - motion[:3, 3]) < 0.1


def test_tf_is_replayed_from_the_command_line(recording_path, capsys):
    ended = CommandLine(capsys).succeed(
        'replay', recording_path, '--landmarks-topic', '/tags/tf', '--tag-frame-prefix', 'dock',
        '--json',
    )  # fmt: skip
    assert ended.json['landmarks'] > 4
    assert not ended.json['dropped']
