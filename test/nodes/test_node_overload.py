"""What comes faster than it can be used: old landmarks are dropped, and the output stays new."""

from __future__ import annotations

from dataclasses import replace
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from node_processes import running
import numpy as np
import pytest
from robots import own_topics, reliable, Robot, stamp_ns, TransformSender

from slam_observer_ros.events import ObservationEvent, VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.nodes.input_topic import LoadShedding, Waiting
from slam_observer_ros.nodes.ros_node import TFMessage
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000
NOW_NS = 1_700_000_000 * SECOND
QUEUED_S = 100 / 30
"""How old the output is where a full queue of clouds is waited for, seconds."""

V = np.array([0.0, 0.0, 0.2, 0.5, 0.0, 0.0])
NONE_IS_LOST = reliable('/loaded', depth=1000)
"""A busy machine may hold up the node for longer than its queue lasts by default, a second."""

DEFAULT = {'landmarks_max_wait': ObserverNodeSettings.landmarks_max_wait, 'max_points': 1000}


def seen_by(frame_id):
    return ObservationEvent(0, np.array([1]), np.ones((1, 3)), sensor_frame=frame_id)


def waiting(*messages, oldest_s, step_s=0.02):
    """Return messages of which the oldest has waited for some time."""
    oldest_ns = NOW_NS - round(oldest_s * SECOND)
    return [
        Waiting(message, oldest_ns + round(place * step_s * SECOND), 0)
        for place, message in enumerate(messages)
    ]


def test_of_messages_that_wait_too_long_the_newest_of_each_sensor_is_used():
    left, right = seen_by('left'), seen_by('right')
    shedding = LoadShedding(0.05)
    messages = waiting(left, left, right, left, oldest_s=0.08)
    assert shedding.newest(messages, NOW_NS, 0.0) == messages[2:]
    assert shedding.shed == 2


def test_messages_that_came_at_once_are_all_used():
    shedding = LoadShedding(0.05)
    messages = waiting(*[seen_by('left')] * 5, oldest_s=0.04, step_s=0.0)
    assert shedding.newest(messages, NOW_NS, 0.0) == messages
    unknown = [Waiting(seen_by('left'), 0, 0)] * 3  # the middleware does not say when
    assert shedding.newest(unknown, NOW_NS, 0.0) == unknown
    assert shedding.shed == 0


def test_fiducials_of_several_cameras_and_transforms_without_any_are_distinguished():
    tags = replace(seen_by('front'), families=('36h11',))
    messages = waiting([seen_by('left'), seen_by('front')], [], tags, oldest_s=0.2)
    shedding = LoadShedding(0.05)
    assert shedding.newest(messages, NOW_NS, 0.0) == messages
    messages = waiting([seen_by('front')], [], tags, oldest_s=0.2)
    assert shedding.newest(messages, NOW_NS, 0.0) == messages[1:]


def test_what_would_keep_up_is_said_while_many_are_dropped():
    shedding = LoadShedding(0.05)
    for step in range(40):
        shedding.newest(waiting(*[seen_by('left')] * 3, oldest_s=0.1), NOW_NS, 0.1 * step)
        if step == 5:
            assert not shedding.problem('/tags', 0.1 * step), 'only busy for a moment'
    text = shedding.problem('/tags', 4.0)
    assert "of 30.0 messages a second on '/tags' it uses 10.0, the newest" in text
    assert not shedding.problem('/tags', 20.0)


def drive(ros, robot, duration_s, count, on_velocity=lambda stamp_ns: None):
    """Send 100 velocities a second, and 30 clouds; return the number of velocities."""
    rng, start_ns = np.random.default_rng(0), time.time_ns()
    world, ids = rng.uniform(-10.0, 10.0, (count, 3)), np.arange(count)
    velocities = [(k * SECOND // 100, True) for k in range(round(100 * duration_s))]
    clouds = [(k * SECOND // 30 + 3_000_000, False) for k in range(round(30 * duration_s))]
    for after_ns, is_velocity in sorted(velocities + clouds):
        ros.spin_for((start_ns + after_ns - time.time_ns()) * 1e-9)
        if is_velocity:
            robot.send(VelocityEvent(start_ns + after_ns, V))
            on_velocity(start_ns + after_ns)
            continue
        points = se3.transform(se3.inverse(se3.exp(V * after_ns * 1e-9)), world)
        points += rng.normal(0.0, 0.03, points.shape)
        robot.send(ObservationEvent(start_ns + after_ns, ids, points))
    return len(velocities)


def test_an_overloaded_node_drops_landmarks_and_its_output_stays_new(ros, tmp_path):
    ages_s = []

    def receive(message):
        ages_s.append((time.time_ns() - stamp_ns(message)) * 1e-9)

    ros.node.create_subscription(Odometry, '/loaded/observer_node/odometry', receive, 100)
    log = tmp_path / 'log'
    statuses = ros.collect(DiagnosticArray, '/diagnostics')
    with (
        running('observer_node', log, '-r', '__ns:=/loaded', **DEFAULT, **NONE_IS_LOST) as node,
        Robot(ros, namespace='/loaded') as robot,
    ):
        sent = drive(ros, robot, duration_s=5.0, count=200)
        node.wait_for_output(r"does not keep up: of [\d.]+ messages a second on '/loaded/land")

        def values():
            return {v.key: v.value for m in statuses[-1:] for v in m.status[0].values}

        # The last ones are held back to be put in order.
        ros.spin_until(lambda: int(values().get('used: velocity', 0)) >= sent - 10, 'velocities')
    assert np.median(ages_s) < QUEUED_S / 10
    assert int(values()['dropped: overload']) > 30
    assert 'dropped: too_late' not in values()


def test_map_to_odom_is_never_in_the_past_while_the_node_is_loaded(ros, tmp_path):
    if TFMessage is None:
        pytest.skip('tf2_msgs is not installed')
    newest_ns, left_s = [], []

    def receive(message):
        newest_ns.extend(stamp_ns(t) for t in message.transforms if t.header.frame_id == 'map')

    ros.node.create_subscription(TFMessage, '/driven/tf', receive, 100)
    sender = TransformSender(ros, '/driven')
    with (
        running('observer_node', tmp_path / 'log', *own_topics('/driven'), **DEFAULT),
        Robot(ros, namespace='/driven') as robot,
    ):
        ros.wait_for_subscriber(sender.dynamic)

        def send_odometry(stamp):
            sender.send(('odom', 'base_link', np.eye(4)), stamp_ns=stamp)
            if newest_ns:
                left_s.append((newest_ns[-1] - time.time_ns()) * 1e-9)

        drive(ros, robot, duration_s=5.0, count=200, on_velocity=send_odometry)
    assert len(left_s) > 200
    assert min(left_s) > 0.0
