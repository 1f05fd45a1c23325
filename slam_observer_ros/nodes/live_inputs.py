"""What the topics that are alive carry, and what a node would make of them, as JSON.

The program of ``slam-observer doctor``: ``python -m slam_observer_ros.nodes.live_inputs SECONDS``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import json
import sys
import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from slam_observer_ros.common.errors import MessageError, ParameterError
from slam_observer_ros.events import ObservationEvent, UNKNOWN_ID
from slam_observer_ros.messages.detections import observed_tags
from slam_observer_ros.messages.poses import decode_transforms, TRANSFORMS
from slam_observer_ros.nodes.ros_node import message_class
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    message_types,
    MessageType,
    Role,
)

DISCOVERY_S = 1.0  # time after which publishers have been found, unless an announcement was lost
LOOK_PERIOD_S = 0.25  # for publishers that are announced later: DDS repeats it after 3 s

# By what is read: the node's topic for it, and what has to be set.
INPUTS: dict[Role, tuple[str, str]] = {
    'velocity': ('twist', ''),
    'angular velocity': ('imu', 'use_imu:=true'),
    'landmarks': ('landmarks', ''),
}


def _read_types() -> dict[str, MessageType]:
    """Return what the node reads, but for transforms."""
    return {name: known for role in INPUTS for name, known in message_types(role).items()}


@dataclass
class HeardTopic:
    """A topic that a node could use, and what was heard on it."""

    name: str
    type_name: str
    heard_s: float  # for how long
    problem: str = ''
    messages: int = 0
    last: bytes = b''
    fiducials: set[int] = field(default_factory=set)

    @property
    def role(self) -> str:
        """The node's topic for this one."""
        if self.type_name == TRANSFORMS:
            return '/tf_static' if self.name.endswith('/tf_static') else '/tf'
        return INPUTS[_read_types()[self.type_name].role][0]

    @property
    def rate_hz(self) -> float:
        """Messages a second."""
        return self.messages / self.heard_s

    def take(self, raw: bytes) -> None:
        """Take in a message."""
        self.messages += 1
        self.last = raw
        if self.type_name == TRANSFORMS:
            for seen in observed_tags(decode_transforms(raw), InputSettings.tag_frame_prefix):
                self.fiducials |= set(seen.ids.tolist())

    def text(self) -> str:
        """Say what comes at which rate, and how the node gets it."""
        role = self.role
        setting = next((needed for name, needed in INPUTS.values() if name == role), '')
        remapping = '' if self.name == f'/{role.lstrip("/")}' else f'-r {role}:={self.name}'
        needed = ' '.join(part for part in (remapping, setting and f'-p {setting}') if part)
        rate = f'{self.rate_hz:.1f} Hz' if self.messages else 'no message'
        found = [self.type_name, rate, self.problem or self._content()]
        known = _read_types().get(self.type_name)
        doubt = ', if they are landmarks' if known is not None and known.is_ambiguous else ''
        found.append(f'as {role}' + (f' with {needed}' if needed else '') + doubt)
        return ', '.join(part for part in found if part)

    def _content(self) -> str:
        if self.fiducials:
            return f'{len(self.fiducials)} fiducials, as landmarks with -p landmarks_type:=tf'
        known = _read_types().get(self.type_name)
        if not self.messages or known is None:
            return ''
        try:
            event = known.decode(self.last, time.time_ns())
        except MessageError as error:
            return f"can't be used: {error}"
        frame = f"in '{event.sensor_frame}'" if event.sensor_frame else 'without a frame'
        if not isinstance(event, ObservationEvent):
            return frame
        named = int(np.count_nonzero(event.ids != UNKNOWN_ID))
        by = ' by the CameraInfo on camera_info' if event.pixels is not None else ''
        return f'{len(event.ids)} points, {named} with an id, {frame}{by}'


def main() -> int:
    """Listen for the seconds that are given, and print what was heard."""
    seconds = float(sys.argv[1])
    rclpy.init(args=['--ros-args', '--log-level', 'fatal'])
    node = rclpy.create_node('slam_observer_doctor', enable_rosout=False)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        topics = _listen(node, executor, seconds)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    heard = [
        {
            'topic': topic.name,
            'type': topic.type_name,
            'role': topic.role,
            'rate_hz': topic.rate_hz,
            'text': topic.text(),
        }
        for topic in sorted(topics, key=lambda topic: topic.name)
    ]
    sys.stdout.write(json.dumps(heard) + '\n')
    return 0


def _listen(node: Node, executor: SingleThreadedExecutor, seconds: float) -> list[HeardTopic]:
    """Return what is heard within some seconds once discovery had its time, or later."""
    topics: dict[tuple[str, str], HeardTopic] = {}
    read = {*_read_types(), TRANSFORMS}
    look_s = time.monotonic() + DISCOVERY_S
    end_s = look_s + seconds
    while (now_s := time.monotonic()) < end_s:
        if now_s >= look_s:
            look_s = now_s + LOOK_PERIOD_S
            for name, types in node.get_topic_names_and_types():
                for type_name in read.intersection(types):
                    if (name, type_name) not in topics and node.count_publishers(name):
                        topic = HeardTopic(name, type_name, end_s - now_s)
                        topics[name, type_name] = topic
                        _subscribe(node, topic)
        executor.spin_once(timeout_sec=min(look_s, end_s) - now_s)
    return list(topics.values())


def _subscribe(node: Node, topic: HeardTopic) -> None:
    qos = QoSProfile(
        depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT
    )
    try:
        kind = message_class(topic.type_name)
    except ParameterError as error:
        topic.problem = str(error)
        return
    node.create_subscription(kind, topic.name, topic.take, qos, raw=True)


if __name__ == '__main__':
    sys.exit(main())
