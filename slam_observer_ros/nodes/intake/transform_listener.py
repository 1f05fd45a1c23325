"""Transforms from /tf and /tf_static, live."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import re
from typing import Any, Protocol

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from rclpy.time import Time

from slam_observer_ros.common.errors import MessageError, TransformError
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.inputs.frames import insert_transforms, TransformSource
from slam_observer_ros.inputs.transform_buffer import ALWAYS_NS, TransformBuffer
from slam_observer_ros.messages.poses import decode_transforms, pose_matrices
from slam_observer_ros.nodes.intake.input_topic import take
from slam_observer_ros.nodes.publishing.transform_publisher import TFMessage
from slam_observer_ros.nodes.throttled_log import ThrottledLog

try:
    import tf2_ros
except ImportError:  # No wheel of it exists; TopicTransforms does the same.
    tf2_ros = None

TF_QOS = QoSProfile(depth=100)
TF_STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class LiveTransforms(TransformSource, Protocol):
    """Transforms that come in while a node runs."""

    on_transform: Callable[[str, str, int], None]
    """Called with parent, child and stamp, nanoseconds, of each transform on /tf."""

    is_own: Callable[[bytes], bool]
    """Says of a message on /tf whether it came from here; then it is not looked into."""

    def read_waiting(self) -> None:
        """Take what has come on /tf: while the node was busy, it may be a lot."""


class TopicTransforms:
    """A listener of /tf and /tf_static of our own; without tf2_msgs no transform is ever known.

    ``own`` are parent and child of the transform that the node itself publishes where nobody else
    gives the child a parent: heard back, it would replace another parent.
    """

    def __init__(self, node: Node, own: tuple[str, str]) -> None:
        self._node = node
        self._own = own
        self._log = ThrottledLog(node)
        self.on_transform: Callable[[str, str, int], None] = _ignore
        self.is_own: Callable[[bytes], bool] = _is_of_another
        self._buffer = TransformBuffer()
        self.lookup = self._buffer.lookup
        self.lookup_child = self._buffer.lookup_child
        self.newest_ns = self._buffer.newest_ns
        self.parent_of = self._buffer.parent_of
        self.clear = self._buffer.clear
        self._dynamic: Subscription | None = None
        if TFMessage is not None:
            self._dynamic = self._subscribe('/tf', TF_QOS, is_static=False)
            self._subscribe('/tf_static', TF_STATIC_QOS, is_static=True)

    def read_waiting(self) -> None:
        """As :meth:`LiveTransforms.read_waiting`."""
        if self._dynamic is not None:
            _read_waiting(self._dynamic)

    def _subscribe(self, topic: str, qos: QoSProfile, *, is_static: bool) -> Subscription:
        def receive(raw: bytes) -> None:
            if self.is_own(raw):
                return
            try:
                transforms = decode_transforms(raw)
            except MessageError as error:
                self._log.warning(topic, f"malformed message on '{topic}' dropped: {error}")
                return
            if not is_static:
                for each in transforms:
                    self.on_transform(each.frame_id, each.child_frame_id, each.stamp_ns)
            others = [t for t in transforms if (t.frame_id, t.child_frame_id) != self._own]
            insert_transforms(self._buffer, others, is_static=is_static)

        return self._node.create_subscription(TFMessage, topic, receive, qos, raw=True)


class Tf2Transforms:
    """tf2_ros's buffer and listener."""

    def __init__(self, node: Node) -> None:
        self.on_transform: Callable[[str, str, int], None] = _ignore
        self.is_own: Callable[[bytes], bool] = _is_of_another  # tf2 looks into all messages
        self._buffer = tf2_ros.Buffer()
        self._insert = self._buffer.set_transform
        self._buffer.set_transform = self._set_transform
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        # tf2 takes one transform a frame and stamp: of a fiducial that two cameras see at once,
        # the first.
        self._parents: dict[str, str] = {}
        self._of_several = TransformBuffer()

    def clear(self) -> None:
        """As :meth:`TransformSource.clear`."""
        self._buffer.clear()
        self._of_several.clear()

    def _set_transform(self, stamped: Any, authority: str) -> None:
        """Take a transform from the listener, which gives the buffer all of /tf this way."""
        header = stamped.header
        stamp_ns = Time.from_msg(header.stamp).nanoseconds
        self.on_transform(header.frame_id, stamped.child_frame_id, stamp_ns)
        self._insert(stamped, authority)
        parent, child = header.frame_id, stamped.child_frame_id
        if self._parents.setdefault(child, parent) != parent:
            self._parents[child] = ''
        if not self._parents[child]:
            self._of_several.insert(parent, child, stamp_ns, _pose_of(stamped))

    def lookup(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """As :meth:`TransformSource.lookup`."""
        try:
            stamped = self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns))
        except tf2_ros.TransformException as error:
            raise TransformError(str(error)) from error
        return _pose_of(stamped)

    def lookup_child(self, parent: str, child: str, stamp_ns: int) -> FloatArray:
        """As :meth:`TransformSource.lookup_child`."""
        with suppress(TransformError):
            return self._of_several.lookup_child(parent, child, stamp_ns)
        return self.lookup(parent, child, stamp_ns)

    def read_waiting(self) -> None:
        """As :meth:`LiveTransforms.read_waiting`."""
        _read_waiting(self._listener.tf_sub)

    def parent_of(self, frame: str) -> str | None:
        """As :meth:`TransformSource.parent_of`."""
        # Not by a YAML parser: a frame's name may be what that takes for an alias.
        entry = re.search(
            rf"^{re.escape(frame)}: *\n(?: +.*\n)*? +parent: '?([^'\n]*)'?",
            self._buffer.all_frames_as_yaml(),
            re.MULTILINE,
        )
        return entry[1] if entry else None

    def newest_ns(self, target: str, source: str) -> int | None:
        """As :meth:`TransformSource.newest_ns`."""
        try:
            newest_ns: int = self._buffer.get_latest_common_time(target, source).nanoseconds
        except tf2_ros.TransformException:
            return None
        return newest_ns or ALWAYS_NS  # tf2 has zero for what is static


def _pose_of(stamped: Any) -> FloatArray:
    """Return the pose (4, 4) of a TransformStamped."""
    position, q = stamped.transform.translation, stamped.transform.rotation
    return pose_matrices(
        np.array([position.x, position.y, position.z]), np.array([q.x, q.y, q.z, q.w])
    )


def _ignore(_parent: str, _child: str, _stamp_ns: int) -> None:
    """Take no notice of a transform."""


def _is_of_another(_raw: bytes) -> bool:
    """Take each message to be of another publisher."""
    return False


def _read_waiting(subscription: Subscription) -> None:
    """Give a subscription's callback what waits, which an executor does one by one."""
    for _ in range(TF_QOS.depth):
        taken = take(subscription)
        if taken is None:
            return
        subscription.callback(taken[0])


def open_transforms(node: Node, own: tuple[str, str]) -> LiveTransforms:
    """Return tf2_ros's buffer where ROS provides it, else :class:`TopicTransforms`."""
    # tf2 keeps the parent of each stamp, so that one does not replace another.
    return TopicTransforms(node, own) if tf2_ros is None else Tf2Transforms(node)
