"""Subscriptions whose message type is given or found on the topic."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import time
from typing import Generic, TypeVar

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud, PointCloud2

from slam_observer_ros.errors import MessageError
from slam_observer_ros.nodes.qos import SENSOR_QOS
from slam_observer_ros.nodes.settings import AUTO
from slam_observer_ros.recording.cdr import Buffer

MESSAGE_CLASSES = {
    'geometry_msgs/msg/TwistStamped': TwistStamped,
    'geometry_msgs/msg/Twist': Twist,
    'nav_msgs/msg/Odometry': Odometry,
    'sensor_msgs/msg/PointCloud2': PointCloud2,
    'sensor_msgs/msg/PointCloud': PointCloud,
}
"""Types that can be received, the preferred one first where a topic carries several."""

REPORT_PERIOD_S = 10.0
"""Shortest time between two reports about one topic."""

DISCOVERY_S = 3.0
"""How long a topic may be without publisher at the start before that is reported."""

MessageT = TypeVar('MessageT')
Decoder = Callable[[Buffer, int], MessageT]


class Input(Generic[MessageT]):
    """One input topic of the observer.

    Parameters
    ----------
    node : Node
        Node that subscribes.
    topic : str
        Relative topic name.
    type_choice : str
        Short name of the message type, or ``'auto'``.
    decoders : mapping of str to callable
        From full type names to decoders.
    on_message : callable
        Called with each decoded message.

    Attributes
    ----------
    topic : str
        Topic name after remapping.
    received : int
        Messages so far.
    malformed : int
        Messages that could not be decoded.
    trouble : str
        Why no message can come, empty if a publisher is there.
    last_received_s : float or None
        Steady time of the last message, seconds.

    """

    def __init__(
        self,
        node: Node,
        topic: str,
        type_choice: str,
        decoders: Mapping[str, Decoder[MessageT]],
        on_message: Callable[[MessageT], None],
    ) -> None:
        self._node = node
        self._decoders = {
            name: decoders[name]
            for name in MESSAGE_CLASSES
            if name in decoders and type_choice in (AUTO, _short(name))
        }
        self._on_message = on_message
        self._subscription: Subscription | None = None
        self._type_name = ''
        self.topic = node.resolve_topic_name(topic)
        self.received = 0
        self.malformed = 0
        self.trouble = ''
        self.last_received_s: float | None = None
        self._quiet_until_s = time.monotonic() + DISCOVERY_S
        if type_choice != AUTO:
            self._subscribe(next(iter(self._decoders)))

    @property
    def age_s(self) -> float | None:
        """Steady time since the last message, seconds; None before the first."""
        if self.last_received_s is None:
            return None
        return time.monotonic() - self.last_received_s

    def look(self) -> None:
        """Look at what the topic carries; subscribe to it, or report why that can't be done."""
        found = self._found_types()
        usable = [name for name in self._decoders if name in found]
        self.trouble = '' if usable else self._describe(found)
        if self.trouble:
            self._warn(self.trouble)
        elif self._type_name not in usable:
            self._subscribe(usable[0])

    def _found_types(self) -> set[str]:
        return {info.topic_type for info in self._node.get_publishers_info_by_topic(self.topic)}

    def _subscribe(self, type_name: str) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._type_name = type_name
        self._subscription = self._node.create_subscription(
            MESSAGE_CLASSES[type_name], self.topic, self._receive, SENSOR_QOS, raw=True
        )
        self._node.get_logger().info(f"receiving {type_name} on '{self.topic}'")

    def _receive(self, raw: bytes) -> None:
        receive_stamp_ns = self._node.get_clock().now().nanoseconds
        self.received += 1
        self.last_received_s = time.monotonic()
        try:
            message = self._decoders[self._type_name](raw, receive_stamp_ns)
        except MessageError as error:
            self.malformed += 1
            self._warn(f"malformed message on '{self.topic}' dropped: {error}")
            return
        self._on_message(message)

    def _warn(self, text: str) -> None:
        # rclpy throttles by line of code, so one topic's report would silence the other's.
        now_s = time.monotonic()
        if now_s >= self._quiet_until_s:
            self._quiet_until_s = now_s + REPORT_PERIOD_S
            self._node.get_logger().warning(text)

    def _describe(self, found: set[str]) -> str:
        wanted = ' or '.join(self._decoders)
        if found:
            return f"'{self.topic}' carries {', '.join(sorted(found))}; {wanted} is needed"
        return f"nothing publishes on '{self.topic}' ({wanted} is needed)"


def _short(type_name: str) -> str:
    return type_name.rsplit('/', 1)[-1]
