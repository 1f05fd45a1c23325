"""``slam-observer doctor`` hears what nodes publish, and says how observer_node gets it."""

from __future__ import annotations

import detector_messages as detector
from node_processes import running
import numpy as np
import pytest
from rclpy.serialization import serialize_message
import ros_messages
from tf2_msgs.msg import TFMessage

from slam_observer_ros.messages.poses import TRANSFORMS
from slam_observer_ros.nodes.live_inputs import HeardTopic
from slam_observer_ros.nodes.ros_node import MESSAGES

pytestmark = pytest.mark.ros


def test_topics_that_are_alive_are_named_with_what_a_node_needs_to_hear_them(
    ros, slam_observer, tmp_path
):
    parameters = {'stamped': True, 'landmarks_type': 'PointCloud2', 'duration': 600.0}
    arguments = ('-r', '__ns:=/a')
    with running('simulator_node', tmp_path / 'log', *arguments, **parameters):
        ros.wait_for_publisher('/a/twist', '/a/landmarks')
        # An announcement that is lost is repeated after 3 s.
        found = slam_observer.succeed('doctor', '--seconds', 5, '--json').json
    topics = {topic['topic']: topic for topic in found['topics']}
    twist, landmarks = topics['/a/twist'], topics['/a/landmarks']
    assert (twist['role'], landmarks['role']) == ('twist', 'landmarks')
    assert twist['rate_hz'] > 1.0
    assert '-r twist:=/a/twist' in twist['text']
    assert '4 points, 4 with an id' in landmarks['text']
    assert found['installed']['tf2_msgs'] == 'installed'


def test_fiducials_on_tf_are_told_from_the_rest_of_it():
    places = [('odom', 'base_link'), ('camera', 'tag36h11:7'), ('camera', 'tag_8')]
    message = TFMessage(
        transforms=[
            MESSAGES.transform_stamped(1, parent, child, np.eye(4)) for parent, child in places
        ]
    )
    tf = HeardTopic('/tf', TRANSFORMS, heard_s=3.0)
    for _ in range(6):
        tf.take(serialize_message(message))
    assert tf.text() == (
        f'{TRANSFORMS}, 2.0 Hz, 2 fiducials, as landmarks with -p landmarks_type:=tf, as /tf'
    )
    assert HeardTopic('/tf_static', TRANSFORMS, 3.0).text().endswith('as /tf_static')


def test_a_range_may_be_of_a_landmark_and_pixels_need_the_camera():
    sonar = HeardTopic('/sonar', 'sensor_msgs/msg/Range', heard_s=1.0)
    sonar.take(ros_messages.serialise(detector.one_range('sonar_front', 2.0)))
    assert sonar.text().endswith('as landmarks with -r landmarks:=/sonar, if they are landmarks')
    boxes = HeardTopic('/landmarks', 'vision_msgs/msg/Detection2DArray', heard_s=1.0)
    boxes.take(ros_messages.serialise(detector.boxes([('lamp_5', (1.0, 2.0))], 'cam')))
    assert "in 'cam' by the CameraInfo on camera_info, as landmarks" in boxes.text()


def test_it_says_that_nothing_is_heard(slam_observer):
    output = slam_observer.succeed('doctor', '--seconds', 0.2).output
    assert 'ROS_DOMAIN_ID' in output
    assert 'Python' in output


def test_seconds_that_are_none_are_refused(slam_observer):
    assert '--seconds' in slam_observer.fail('doctor', '--seconds', 0)
