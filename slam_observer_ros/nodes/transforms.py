"""What /tf and CameraInfo have, live, and the estimated pose on /tf.

The pose goes out as map to odom where others publish odom to base, else as map to base.
"""

from __future__ import annotations

from collections import deque
import time

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from slam_observer_ros.common.errors import MessageError, TransformError
from slam_observer_ros.common.findings import fault
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.lie import se3
from slam_observer_ros.messages.detections import CAMERA_INFO, decode_camera_info
from slam_observer_ros.messages.outgoing import encode_transform
from slam_observer_ros.messages.poses import decode_transforms
from slam_observer_ros.nodes.ros_node import (
    message_class,
    RELIABLE_QOS,
    take,
    TFMessage,
    ThrottledLog,
)
from slam_observer_ros.recordings.frames import ALWAYS_NS, insert_transforms, TransformBuffer
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

TF_QOS = QoSProfile(depth=100)
CAMERA_TOPIC = 'camera_info'
CAMERA_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
TF_STATIC_QOS = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class LiveTransforms:
    """Listens to /tf, /tf_static and camera_info; without tf2_msgs no transform is ever known.

    ``own`` are parent and child of the transform that the node itself publishes where nobody else
    gives the child a parent: heard back, it would replace another parent. ``sent`` is what is
    published from here, None if nothing is.
    """

    def __init__(
        self,
        node: Node,
        buffer: TransformBuffer,
        own: tuple[str, str],
        sent: PoseBroadcaster | None = None,
    ) -> None:
        self._node, self._buffer = node, buffer
        self._own, self._sent = own, sent
        self._log = ThrottledLog(node)
        self._dynamic: Subscription | None = None
        if TFMessage is not None:
            self._dynamic = self._subscribe('/tf', TF_QOS, is_static=False)
            self._subscribe('/tf_static', TF_STATIC_QOS, is_static=True)
        node.create_subscription(
            message_class(CAMERA_INFO), CAMERA_TOPIC, self._receive_camera, CAMERA_QOS, raw=True
        )

    def read_waiting(self) -> None:
        """Take what has come on /tf: while the node was busy, it may be a lot."""
        if self._dynamic is None:
            return
        for _ in range(TF_QOS.depth):
            if (taken := take(self._dynamic)) is None:
                return
            self._dynamic.callback(taken[0])

    def _receive_camera(self, raw: bytes) -> None:
        try:
            frame, camera = decode_camera_info(raw)
        except MessageError as error:
            topic = f"'{self._node.resolve_topic_name(CAMERA_TOPIC)}'"
            self._log.event('malformed_message', CAMERA_TOPIC, topic=topic, error=error)
            return
        self._buffer.cameras[frame.lstrip('/')] = camera

    def _subscribe(self, topic: str, qos: QoSProfile, *, is_static: bool) -> Subscription:
        def receive(raw: bytes) -> None:
            if self._sent is not None and self._sent.is_own(raw):
                return
            try:
                transforms = decode_transforms(raw)
            except MessageError as error:
                self._log.event('malformed_message', topic, topic=f"'{topic}'", error=error)
                return
            if self._sent is not None:
                for each in transforms:
                    stamp_ns = None if is_static else each.stamp_ns
                    self._sent.hear(each.frame_id, each.child_frame_id, stamp_ns)
            others = [t for t in transforms if (t.frame_id, t.child_frame_id) != self._own]
            insert_transforms(self._buffer, others, is_static=is_static)

        return self._node.create_subscription(TFMessage, topic, receive, qos, raw=True)


class TransformedOdometry:
    """Where the base is in ``odom_frame``, if that is on /tf."""

    def __init__(self, settings: ObserverNodeSettings, transforms: TransformBuffer) -> None:
        self._frames = settings.odom_frame, settings.base_frame
        self._transforms = transforms

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp, nanoseconds; None if there is no odometry that moves."""
        newest_ns = self._transforms.newest_ns(*self._frames) if self._frames[0] else None
        return None if newest_ns == ALWAYS_NS else newest_ns

    def pose_until(self, stamp_ns: int) -> FloatArray | None:
        """Return the pose (4, 4) of the base at a stamp, or the newest before; None if unknown."""
        newest_ns = self.newest_ns
        if newest_ns is None:
            return None
        try:
            return self._transforms.lookup(*self._frames, min(stamp_ns, newest_ns))
        except TransformError:
            return None

    def motion(self, start_ns: int, end_ns: int) -> FloatArray | None:
        """Return how the base has moved (4, 4) between two stamps; None if that is not known."""
        start, end = self.pose_until(start_ns), self.pose_until(end_ns)
        return None if start is None or end is None else se3.inverse(start) @ end


SENT = 10  # messages that may be on their way back at once


class TransformPublisher:
    """Publishes transforms, the last ones ``sent``; ``publisher`` is None without tf2_msgs."""

    def __init__(self, node: Node, topic: str, qos: QoSProfile) -> None:
        self.sent: deque[bytes] = deque(maxlen=SENT)
        self.publisher = None
        if TFMessage is None:
            node.get_logger().warning(f'tf2_msgs is not installed: nothing goes out on {topic}')
        else:
            self.publisher = node.create_publisher(TFMessage, topic, qos)

    def publish(self, stamp_ns: int, parent: str, child: str, pose: FloatArray) -> None:
        """Publish the pose (4, 4) of frame ``child`` in frame ``parent``."""
        if self.publisher is not None:
            message = encode_transform(stamp_ns, parent, child, pose)
            self.sent.append(message)
            self.publisher.publish(message)


DISCOVERY_S = 2.0  # from the first pose on, before the base is taken to have no parent on /tf
MAX_WAITING_NS = 10_000_000_000  # a pose waits for odometry as long as tf keeps transforms
LATE_NS = 500_000_000  # odometry that is further behind the poses is reported
OWN_STAMPS = 2000  # of what was published here, by which it is known when it is heard back
RIVAL_S = 5.0  # how long another publisher of the same transform is reported
CHECK_PERIOD_S = 0.5  # between two searches for another parent of the base


class PoseBroadcaster:
    """Keeps the tree of frames whole, as REP 105 asks: each frame has one parent.

    Nothing goes out before it is known who is the base frame's parent. Where that is the odometry
    frame, its correction goes out post-dated by ``transform_tolerance``, so that it holds until
    the next one, and by how long poses are held back, which has passed by then; while the observer
    is paused, the last correction is repeated. Odometry that begins later takes over. A frame is
    never published twice with one stamp. ``transforms`` has the odometry, without what is
    published here; poses are held back for ``reorder_window_s``.
    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        transforms: TransformBuffer,
        reorder_window_s: float,
    ) -> None:
        self._node, self._settings, self._transforms = node, settings, transforms
        self._log = ThrottledLog(node)
        self._publisher = TransformPublisher(node, '/tf', RELIABLE_QOS)
        self._tolerance_ns = to_ns(settings.transform_tolerance)
        self._held_back_ns = to_ns(reorder_window_s)
        self._begin_s: float | None = None
        self._check_at_s = 0.0
        self._parent = ''
        self._child = '' if settings.odom_frame else settings.base_frame
        self._waiting: deque[tuple[int, FloatArray]] = deque()
        self._correction: FloatArray | None = None
        self._last_ns: int | None = None
        self._own_ns: deque[int] = deque(maxlen=OWN_STAMPS)
        self._rival_s = -RIVAL_S
        self._rival = ''  # parent that it gives the frame
        self._static: dict[str, str] = {}  # parents of frames on /tf_static
        self.problem = ''  # why no correction goes out, or late ones do

    @property
    def is_waiting(self) -> bool:
        """Whether a pose waits for odometry, or for it to be known who is the base's parent."""
        return bool(self._waiting)

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """Publish a pose (4, 4) of the base in the map, now or once its odometry is there."""
        if self._begin_s is None:
            self._begin_s = time.monotonic()
        self._waiting.append((stamp_ns, pose))
        while self._waiting[0][0] < stamp_ns - MAX_WAITING_NS:
            self._waiting.popleft()
        self.retry()

    def is_own(self, raw: bytes) -> bool:
        """Return whether a message heard on /tf is one of the last that were sent from here."""
        return raw in self._publisher.sent

    def hear(self, parent: str, child: str, stamp_ns: int | None) -> None:
        """Take a transform that was heard: nobody else may give the same frame a parent.

        One of /tf_static, which has no stamp here, holds for good, also before any goes out.
        """
        parent, child = parent.lstrip('/'), child.lstrip('/')
        if stamp_ns is None:
            self._static[child] = parent
        elif self._is_rival(parent, child) and (
            # Of its own the last ones are heard first.
            parent != self._ends[0] or stamp_ns not in reversed(self._own_ns)
        ):
            self._rival_s, self._rival = time.monotonic(), parent
        else:
            return
        self._report_rival()

    @property
    def rival(self) -> str:
        """Report another publisher of the transform that goes out here; empty if there is none."""
        child = self._ends[1]
        parent, topic, whose = self._rival, '/tf', 'another localisation'
        if self._is_rival(self._static.get(child, ''), child):
            parent, topic = self._static[child], '/tf_static'
            whose = 'a static_transform_publisher of a launch file'
        elif not self._child or time.monotonic() - self._rival_s > RIVAL_S:
            return ''
        return fault('rival', parent=parent, child=child, topic=topic, whose=whose)

    def _is_rival(self, parent: str, child: str) -> bool:
        """Return whether a transform gives another parent to a frame that has its own here."""
        ends = self._ends
        is_of_odometry = bool(parent) and self._child == self._settings.odom_frame
        return bool(self._child) and child == ends[1] and (parent == ends[0] or is_of_odometry)

    def _report_rival(self) -> None:
        if rival := self.rival:
            self._log.warning('another', rival)

    @property
    def _ends(self) -> tuple[str, str]:
        """Parent and child of the transform that goes out here."""
        ends = self._settings.map_frame, self._child
        return ends[::-1] if self._settings.invert_tf else ends

    def retry(self) -> None:
        """Publish the newest pose that can be."""
        if not self._waiting:
            return
        newest_ns, settings = self.odometry_ns(), self._settings
        self.problem = ''
        # Whose pose to publish: odometry's on /tf, however late it comes
        if newest_ns is not None and self._child != settings.odom_frame:
            self._choose_child(settings.odom_frame, '/tf has')
        searched_s = time.monotonic() - (self._begin_s or 0.0)
        if not self._child and searched_s > DISCOVERY_S and not self._other_parent():
            self._choose_child(settings.base_frame, 'nobody publishes')
        # Odometry may be far behind the poses, or have ended
        known_ns = self._waiting[0][0] if newest_ns is None else newest_ns
        behind_ns = self._waiting[-1][0] - known_ns
        if self._child == settings.odom_frame and behind_ns > LATE_NS:
            behind = f'{to_s(behind_ns):.1f} s behind the estimate'
            self._report('odometry_behind', behind='without stamps' if newest_ns == 0 else behind)
        if self._child == settings.odom_frame:
            self._publish_correction(newest_ns)
        elif self._child and not self._other_parent():
            stamp_ns, pose = self._waiting.pop()
            self._waiting.clear()
            self._publish(stamp_ns, pose)

    def repeat(self, now_ns: int) -> None:
        """Publish the last correction of the odometry again, as of now; the base's pose never."""
        if self._correction is not None:
            self._publish(now_ns + self._tolerance_ns, self._correction)

    def clear(self) -> None:
        """Drop what waits and the correction, as after a reset or a jump of the clock."""
        self._waiting.clear()
        self._correction = None
        self.problem = ''

    def odometry_ns(self) -> int | None:
        """Return the newest stamp of the odometry on /tf; None if it has none."""
        settings = self._settings
        if not settings.odom_frame:
            return None
        return self._transforms.newest_ns(settings.odom_frame, settings.base_frame)

    def _other_parent(self) -> str:
        """Return the base's parent on /tf if that forbids to publish its pose; else ''."""
        now_s, settings = time.monotonic(), self._settings
        if now_s >= self._check_at_s:
            self._check_at_s = now_s + CHECK_PERIOD_S
            parent = self._transforms.parent_of(settings.base_frame) or ''
            # Without odom_frame it was asked for, whoever else gives the base a parent.
            forbids = settings.odom_frame and not settings.invert_tf
            self._parent = parent if forbids and parent != settings.map_frame else ''
        if self._parent:
            self._report('other_parent', parent=self._parent)
        return self._parent

    def _report(self, kind: str, **figures: object) -> None:
        names = ('map_frame', 'odom_frame', 'base_frame')
        frames = {name: getattr(self._settings, name) for name in names}
        self.problem = fault(kind, **frames, **figures)
        self._log.warning('/tf', self.problem)

    def _publish_correction(self, newest_ns: int | None) -> None:
        """Publish the newest correction that the odometry known by now gives."""
        settings, found = self._settings, None
        if newest_ns is None:
            return
        while self._waiting and self._waiting[0][0] <= newest_ns:
            found = self._waiting.popleft()
        if found is None:
            return
        stamp_ns, pose = found
        try:
            odometry = self._transforms.lookup(settings.odom_frame, settings.base_frame, stamp_ns)
        except TransformError as error:
            if stamp_ns < newest_ns - MAX_WAITING_NS:  # else it is of before the odometry began
                self._report('odometry_too_new', error=error)
            return
        self._correction = pose @ se3.inverse(odometry)
        self._publish(stamp_ns + self._held_back_ns + self._tolerance_ns, self._correction)

    def _choose_child(self, child: str, reason: str) -> None:
        self._child = child
        settings = self._settings
        if self._publisher.publisher is None:
            return
        self._node.get_logger().info(
            f"publishing '{settings.map_frame}' to '{child}' on /tf: "
            f"{reason} '{settings.odom_frame}' to '{settings.base_frame}'"
        )
        self._report_rival()

    def _publish(self, stamp_ns: int, pose: FloatArray) -> None:
        if stamp_ns == self._last_ns:
            return
        self._last_ns = stamp_ns
        self._own_ns.append(stamp_ns)
        seen_from = se3.inverse(pose) if self._settings.invert_tf else pose
        self._publisher.publish(stamp_ns, *self._ends, seen_from)
