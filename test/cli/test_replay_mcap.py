"""The estimate of a replay as a recording: whole, readable, and made by the node's code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import events, MESSAGE_COUNT, write_mcap
import ros_messages as ros
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.writer import RecordingWriter

LAYOUT = Path(__file__).resolve().parents[2] / 'foxglove' / 'replay.json'


@pytest.fixture(name='recording')
def fixture_recording(tmp_path):
    return write_mcap(tmp_path / 'run.mcap')


def messages_of(path):
    """Read all messages back, by topic."""
    found = {}
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def bytes_of(path):
    """Read all messages back as bytes, by topic."""
    found = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, stamp_ns, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp_ns, bytes(raw)))
    return found


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def test_it_has_what_the_node_publishes(slam_observer, recording, tmp_path):
    written = tmp_path / 'estimate.mcap'
    slam_observer.succeed('replay', recording, '--mcap', written, '--tum', tmp_path / 'run.tum')
    found = messages_of(written)
    assert '/twist' not in found
    odometry, path = found['/observer_node/odometry'], found['/path']
    assert len(odometry) == MESSAGE_COUNT
    assert {message.header.frame_id for message in odometry} == {'map'}
    assert {message.child_frame_id for message in odometry} == {'base_link'}
    (transform,) = found['/tf'][-1].transforms
    assert transform.transform.translation.x == odometry[-1].pose.pose.position.x
    assert found['/pose'][-1].pose.covariance[0] > 0.0
    assert len(path) == 1
    spacing_s = np.diff([seconds(pose.header.stamp) for pose in path[0].poses])
    assert spacing_s.min() == pytest.approx(0.1)
    last_tum = (tmp_path / 'run.tum').read_text().splitlines()[-1].split()
    at_end = {
        f'{seconds(message.header.stamp):.3f}': message.pose.pose.position.x
        for message in odometry
    }
    assert at_end[f'{float(last_tum[0]):.3f}'] == pytest.approx(float(last_tum[1]), abs=1e-12)


def test_landmarks_have_ellipsoids_and_residuals_are_in_standard_deviations(
    slam_observer, recording, tmp_path
):
    written = tmp_path / 'estimate.mcap'
    slam_observer.succeed('replay', recording, '--mcap', written)
    found = messages_of(written)
    assert found['/landmark_map'][-1].width == 3
    names = [marker.ns for marker in found['/markers'][-1].markers]
    assert [names.count(name) for name in ('uncertainties', 'ids', 'landmarks')] == [3, 3, 1]
    for landmark_id in (3, 5, 9):
        values = [m.data for m in found[f'/residual_sigma/landmark_{landmark_id}']]
        assert len(values) == MESSAGE_COUNT / 2 - 1
    assert '/calibration/angular_bias_z' in found


def test_it_has_diagnostics_of_the_estimate(slam_observer, recording, tmp_path):
    written = tmp_path / 'estimate.mcap'
    figures = slam_observer.succeed('replay', recording, '--mcap', written, '--json').json
    (status,) = messages_of(written)['/diagnostics'][-1].status
    assert (status.name, status.message) == ('observer_node: estimate', 'running')
    values = {value.key: value.value for value in status.values}
    assert values['landmarks known'] == '3'
    assert values['used: observed_point'] == str(figures['used']['observed_point'])


def test_it_has_where_the_sensors_are_on_the_robot(slam_observer, recording, tmp_path):
    mounted, written = tmp_path / 'mounted.mcap', tmp_path / 'estimate.mcap'
    camera = se3.pose(np.eye(3), np.array([0.1, 0.0, 0.2]))
    with RecordingWriter(mounted) as writer:
        for event in events():
            writer.write_event(event)
        transform = writer.messages.transform_stamped(ros.STAMP_NS, 'base_link', 'camera', camera)
        message = writer.messages.make('tf2_msgs/msg/TFMessage', transforms=[transform])
        writer.write_message('/tf_static', message, ros.STAMP_NS, latched=True)
    slam_observer.succeed('replay', mounted, '--mcap', written)
    found = messages_of(written)
    (transform,) = found['/tf_static'][0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('base_link', 'camera')
    assert found['/tf']


def test_the_truth_is_moved_to_the_estimate(slam_observer, recording, tmp_path):
    written = tmp_path / 'estimate.mcap'
    slam_observer.succeed('replay', recording, '--mcap', written)
    found = messages_of(written)
    estimates = {
        seconds(m.header.stamp): m.pose.pose.position for m in found['/observer_node/odometry']
    }
    for truth in found['/aligned_truth/pose']:
        position = estimates[seconds(truth.header.stamp)]
        assert position.x == pytest.approx(truth.pose.position.x, abs=0.01)
    assert found['/aligned_truth/landmark_map'][0].width == 3


def test_with_inputs_it_replays_to_the_same_bits(slam_observer, recording, tmp_path):
    written, again = tmp_path / 'estimate.mcap', tmp_path / 'again.mcap'
    slam_observer.succeed('replay', recording, '--mcap', written, '--with-inputs')
    slam_observer.succeed('replay', written, '--mcap', again)
    first, second = bytes_of(written), bytes_of(again)
    assert len(first['/twist']) == MESSAGE_COUNT
    for topic in ('/observer_node/odometry', '/landmark_map', '/lyapunov', '/nis'):
        assert first[topic] == second[topic]


def test_the_layout_for_foxglove_shows_what_is_there(slam_observer, recording, tmp_path):
    written = tmp_path / 'estimate.mcap'
    calibrated = [
        f'{name}={value}'
        for name, value in (
            ('angular_scale_stddev', '[0.1,0.1,0.1]'),
            ('linear_scale_stddev', '[0.1,0.1,0.1]'),
            ('velocity_delay_stddev', '0.1'),
        )
    ]
    options = [word for setting in calibrated for word in ('--set', setting)]
    slam_observer('replay', recording, '--mcap', written, *options)
    panels = json.loads(LAYOUT.read_text())['configById']
    shown = set(panels['3D!scene']['topics'])
    for panel in panels.values():
        shown |= {path['value'].split('.')[0] for path in panel.get('paths', ())}
    assert shown <= set(messages_of(written))


def test_what_is_an_input_is_not_written_over(slam_observer, recording, tmp_path):
    assert 'would replace the recording' in slam_observer.fail(
        'replay', recording, '--mcap', recording, '--force'
    )
    assert '--mcap' in slam_observer.fail('replay', recording, '--with-inputs')
