"""What a node estimates of what it receives: a replay of the same estimates it to the bit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import time

from geometry_msgs.msg import PoseArray
from nav_msgs.msg import Odometry
from node_processes import running
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from robots import own_topics, reliable, Robot, stamp_ns
from sensor_msgs.msg import PointCloud2
from tag_drives import past_tags, SETTINGS, STEP_NS

from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.clouds import decode_point_cloud2
from slam_observer_ros.messages.outgoing import (
    EstimateMessages,
    StateMessages,
    uncertain_pose,
)
from slam_observer_ros.nodes.ros_node import LATCHED_QOS, MESSAGES, TFMessage
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import TopicNames
from slam_observer_ros.recordings.writer import RecordingWriter
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import changed_names
from slam_observer_ros.simulation import Scenario

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000


def hearing(namespace):
    return {**reliable(namespace, depth=1000), 'publish_rate': 200.0}


def as_received(event):
    """Return the event after the trip through a message: points are float32 there."""
    if isinstance(event, VelocityEvent):
        return event
    raw = serialize_message(
        MESSAGES.point_cloud2(event.stamp_ns, 'base_link', event.ids, event.points)
    )
    return decode_point_cloud2(raw)


def test_replay_of_what_was_received_gives_the_same_bits(ros, tmp_path):
    scenario = Scenario(
        duration=3.0,
        velocity_rate=50.0,
        observation_rate=25.0,
        field_of_view=200.0,
        landmark_count=12,
        point_noise=0.05,
        angular_velocity_noise=0.05,
        linear_velocity_noise=0.1,
        late_fraction=0.3,
        max_lateness=0.1,
    )
    odometry = ros.collect(Odometry, '/replayed/observer_node/odometry')
    maps = ros.collect(PointCloud2, '/replayed/landmark_map', LATCHED_QOS)
    # A wide window, since a busy machine may deliver one topic well before the other.
    parameters = hearing('/replayed') | {'reorder_window': 1.0}
    with (
        running('observer_node', tmp_path / 'log', '-r', '__ns:=/replayed', **parameters),
        Robot(ros, namespace='/replayed') as robot,
    ):
        events = robot.run(scenario)
        last_ns = max(event.stamp_ns for event in events) - SECOND
        ros.spin_until(lambda: maps and stamp_ns(maps[-1]) >= last_ns, 'the last map')

    # In order and without a window, the replay shows the state at every stamp.
    replay = Estimator(Settings(reorder_window=0.0))
    poses, known = {}, {}
    for event in sorted(map(as_received, events), key=_order):
        assert replay.add(event)
        poses[event.stamp_ns] = MESSAGES.pose(replay.pose)
        known[event.stamp_ns] = (replay.landmark_ids, replay.world_points.astype(np.float32))
    assert len(odometry) > 5
    for message in odometry:
        assert message.pose.pose == poses[stamp_ns(message)]
    for message in maps:
        published = decode_point_cloud2(serialize_message(message))
        ids, points = known[published.stamp_ns]
        assert_array_equal(published.ids, ids)
        assert_array_equal(published.points, points)


def _order(event):
    return event.stamp_ns, isinstance(event, ObservationEvent)


CAMERA = (0.2, 0.1, 0.4, -np.pi / 2, 0.0, -np.pi / 2)
SEEN_FROM = se3.inverse(se3.from_rpy(CAMERA))
STEPS = 60


def nameless(event):
    """Return poses without ids."""
    poses = [MESSAGES.pose(pose) for pose in tag_poses(event)]
    return 'landmarks', PoseArray(header=MESSAGES.header(event.stamp_ns, 'camera'), poses=poses)


def on_tf(event):
    """Return transforms of tags, as apriltag_ros publishes them."""
    transforms = [
        MESSAGES.transform_stamped(event.stamp_ns, 'camera', f'tag36h11:{number}', pose)
        for number, pose in zip(event.ids, tag_poses(event), strict=True)
    ]
    return 'tf', TFMessage(transforms=transforms)


def tag_poses(event):
    return SEEN_FROM @ se3.pose(event.orientations, event.points)


def drive_past(make_tags):
    """Return stamps, topics and messages of a drive past tags, of which one is in view."""
    messages = []
    for _, velocity, event in past_tags(time.time_ns(), STEPS):
        twist = MESSAGES.twist_stamped(event.stamp_ns, 'base_link', velocity.body_velocity)
        seen = replace(event, stamp_ns=event.stamp_ns + STEP_NS // 2)
        messages += [(event.stamp_ns, 'twist', twist), (seen.stamp_ns, *make_tags(seen))]
    return messages


def changed(settings):
    return {name: getattr(settings, name) for name in changed_names(settings)}


def publish(ros, namespace, messages, odometry):
    """Publish messages, each of them once the node has published what it knows by the last."""
    publishers = {
        name: ros.node.create_publisher(type(message), f'{namespace}/{name}', 10)
        for _, name, message in messages[:2]
    }
    ros.wait_for_subscriber(*publishers.values())
    for sent_ns, name, message in messages:
        publishers[name].publish(message)
        ros.spin_until(lambda now=sent_ns: odometry and stamp_ns(odometry[-1]) == now, 'the state')
    for publisher in publishers.values():
        ros.node.destroy_publisher(publisher)


def record(path, messages):
    with RecordingWriter(path) as writer:
        for sent_ns, name, message in messages:
            package, kind = type(message).__module__.split('.')[0], type(message).__name__
            data = serialize_message(message)
            writer.write(f'/{name}', f'{package}/msg/{kind}', data, sent_ns)
    return path


@dataclass
class EveryState:
    """Notes what a node may publish of each stamp of a replay."""

    odometry: dict[int, Odometry] = field(default_factory=dict)
    maps: dict[int, PointCloud2] = field(default_factory=dict)

    def note_stamp(self, estimator):
        now_ns = estimator.stamp_ns
        uncertain = uncertain_pose(estimator.pose, estimator.pose_covariance)
        velocity = estimator.body_velocity, estimator.body_velocity_covariance
        odometry = StateMessages('map', 'base_link').odometry(now_ns, uncertain, *velocity)
        self.odometry[now_ns] = deserialize_message(odometry, Odometry)
        self.maps[now_ns] = EstimateMessages(MESSAGES, 'map').landmarks(
            now_ns,
            estimator.landmark_ids,
            estimator.world_points,
            estimator.landmark_covariances,
            estimator.landmark_velocities,
        )

    def note_update(self, update):
        """Take in nothing: the state has it."""

    def clear(self):
        raise AssertionError('no clock has jumped')


def replayed(path, settings, inputs):
    """Return all states of a replay that uses every message."""
    states = EveryState()
    with Recording(path) as recording:
        selected = recording.find_topics(TopicNames(), inputs)
        blocks = recording.blocks(selected, inputs)
        assert not replay(blocks, settings, recorders=[states]).estimator.dropped
    return states


@pytest.mark.parametrize(('make_tags', 'landmarks_type'), [(nameless, 'PoseArray'), (on_tf, 'tf')])
def test_replay_of_tags_with_orientations_gives_the_same_bits(
    ros, tmp_path, make_tags, landmarks_type
):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    namespace = f'/{landmarks_type.lower()}'
    odometry = ros.collect(Odometry, f'{namespace}/observer_node/odometry')
    maps = ros.collect(PointCloud2, f'{namespace}/landmark_map', LATCHED_QOS)
    settings = Settings(**SETTINGS, use_tag_orientation=True, reorder_window=0.0)
    inputs = InputSettings(landmarks_type=landmarks_type, sensor_pose=CAMERA, odom_frame='')
    messages = drive_past(make_tags)
    end_ns, _, _ = messages[-1]
    arguments = own_topics(namespace)
    parameters = hearing(namespace) | changed(settings) | changed(inputs)
    with running('observer_node', tmp_path / 'log', *arguments, **parameters):
        publish(ros, namespace, messages, odometry)
        ros.spin_until(lambda: maps and stamp_ns(maps[-1]) == end_ns, 'the last map')

    path = record(tmp_path / 'drive.mcap', messages)
    states = replayed(path, settings, inputs)
    assert odometry == list(states.odometry.values())
    assert maps == [states.maps[stamp_ns(each)] for each in maps]
    assert len(decode_point_cloud2(serialize_message(maps[-1])).ids) > 0
    points_alone = replayed(path, replace(settings, use_tag_orientation=False), inputs)
    assert odometry[-1] != points_alone.odometry[end_ns], 'orientations were not used'
