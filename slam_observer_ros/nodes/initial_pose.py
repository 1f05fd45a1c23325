"""Poses that people or other nodes give to the observer, and the last one kept over a restart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.node import Node
import yaml

from slam_observer_ros.common.errors import (
    failing,
    MapError,
    MessageError,
    ParameterError,
    SlamObserverError,
    YamlError,
)
from slam_observer_ros.common.files import (
    absolute,
    is_there,
    load_yaml,
    plain_value,
    unfinished_file,
)
from slam_observer_ros.common.stamps import is_of_1970, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.estimator.placement import GIVEN_POSE_STD
from slam_observer_ros.lie import se3, so3
from slam_observer_ros.lie.matrices import are_covariances, limited
from slam_observer_ros.mapping.landmark_map import MAX_NUMBER
from slam_observer_ros.messages.poses import decode_pose_with_covariance_stamped, PoseMessage
from slam_observer_ros.nodes.ros_node import RELIABLE_QOS, ThrottledLog
from slam_observer_ros.nodes.transforms import TransformedOdometry
from slam_observer_ros.runs.health import FUTURE_NS
from slam_observer_ros.settings.estimator_settings import MAX_POSITION_M
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.tracking.covariances import MAX_POSE_ERRORS, of_moved_pose

TOPICS = ('initialpose', '~/set_pose')


class InitialPoseListener:
    """Moves the robot to the poses in ``map_frame`` that come on ``TOPICS``."""

    def __init__(
        self,
        node: Node,
        map_frame: str,
        estimator: Estimator,
        odometry: TransformedOdometry,
        on_move: Callable[[], None],
    ) -> None:
        self._node, self._odometry, self._map_frame = node, odometry, map_frame
        self._estimator, self._on_move = estimator, on_move
        for topic in TOPICS:
            node.create_subscription(
                PoseWithCovarianceStamped, topic, self._receive, RELIABLE_QOS, raw=True
            )

    def _receive(self, raw: bytes) -> None:
        try:
            message = decode_pose_with_covariance_stamped(raw)
            self._check(message)
            covariance = filled_in(message.covariance)
            self._estimator.release()  # what has come before belongs to where the robot was
            self._set(message.pose, covariance, message.stamp_ns)
        except (MessageError, ParameterError) as error:
            self._node.get_logger().error(f'the pose given is not used: {error}')
            return
        self._on_move()
        x, y, z = message.position.tolist()
        what = 'is set to' if self._estimator.is_localised else 'is searched for about'
        self._node.get_logger().info(f'the robot {what} ({x:.2f}, {y:.2f}, {z:.2f}) m')

    def _set(self, pose: FloatArray, covariance: FloatArray, stamp_ns: int) -> None:
        """Move the robot to where it was at a stamp, and add how it moved since, as AMCL does."""
        estimator = self._estimator
        now_ns = estimator.stamp_ns or 0
        if other_clock := self._other_clock(stamp_ns):
            stamp_ns = 0
            self._node.get_logger().warning(
                f'the pose given is stamped {other_clock[0]}: it is taken as of now; '
                f'{other_clock[1]}'
            )
        if not 0 < stamp_ns < now_ns or estimator.knows_motion_since(stamp_ns):
            estimator.set_pose(pose, covariance, min(stamp_ns or now_ns, now_ns))
            return
        motion = self._odometry.motion(stamp_ns, now_ns)
        if motion is None:
            self._node.get_logger().warning(
                f'the pose given is {to_s(now_ns - stamp_ns):.1f} s old, and how the robot moved '
                'since is not known: it is taken as of now'
            )
            motion = np.eye(4)
        moved = of_moved_pose(covariance, pose, motion, np.zeros((6, 6)))
        estimator.set_pose(pose @ motion, moved)

    def _other_clock(self, stamp_ns: int) -> tuple[str, str] | None:
        """Return by which other clock a pose is stamped, and what to do; None if by none."""
        clock = self._node.get_clock()
        ahead_ns = stamp_ns - int(clock.now().nanoseconds)
        if ahead_ns > FUTURE_NS:
            is_of_system = abs(stamp_ns - time.time_ns()) < ahead_ns
            if clock.ros_time_is_active and is_of_system:
                return (
                    "by the system's clock, and this node follows /clock",
                    'set use_sim_time in RViz, or in what else gives it',
                )
            return (
                f"{to_s(ahead_ns):.3f} s ahead of this machine's clock",
                'synchronise the clocks',
            )
        if stamp_ns and is_of_1970(stamp_ns) and not is_of_1970(self._estimator.stamp_ns or 0):
            return (
                "in 1970, as by a simulation's clock",
                'let this node, RViz and what else gives it agree in use_sim_time',
            )
        return None

    def _check(self, message: PoseMessage) -> None:
        if not message.frame_id:
            self._node.get_logger().warning(
                f"the pose given names no frame: it is taken as one in '{self._map_frame}'; let "
                'what gives it fill in header.frame_id'
            )
        if message.frame_id.lstrip('/') not in ('', self._map_frame):
            raise MessageError(f"it is in frame '{message.frame_id}', not '{self._map_frame}'")
        if not np.isfinite(message.position).all():
            raise MessageError('its position has a NaN or infinite entry')
        if np.abs(message.position).max() > MAX_POSITION_M:
            raise MessageError(f'its position has an entry beyond {MAX_POSITION_M:g} m')


def filled_in(covariance: FloatArray | None) -> FloatArray:
    """Return a covariance (6, 6) with variances assumed where the message gives none.

    RViz's 2D Pose Estimate, for one, gives only x, y and yaw, and zeros else. Variances
    that are so large that they only say 'unknown' are made less, lest they drown all others.
    Raises a MessageError if it is not finite, not symmetric, or negative in some direction.
    """
    given = np.zeros((6, 6)) if covariance is None else covariance
    if not (np.isfinite(given).all() and are_covariances(given)):
        raise MessageError(
            'its covariance is not finite, not symmetric, or negative in some direction'
        )
    assumed: FloatArray = np.where(np.diagonal(given) == 0.0, GIVEN_POSE_STD**2, 0.0)
    return limited(given, MAX_POSE_ERRORS) + np.diag(assumed)


# Age up to which a kept pose is used: a respawn, an update or new batteries take less, and who
# stood for longer may have been pushed.
MAX_AGE_S = 600.0
FAST_M_PER_S = 3.0  # no robot indoors drives faster: its odometry then is another
AT_START_M, AT_START_RAD = 0.1, 0.1  # how far from its origin an odometry is that has just begun


class KeptPose:
    """Starts where the robot was when the node ended, unless that was too long ago.

    Where the odometry on /tf has gone on meanwhile, by as much as it says. What can't be read or
    written is a warning: the robot is localised without it, too.
    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        estimator: Estimator,
        odometry: TransformedOdometry,
    ) -> None:
        self._odometry = odometry
        self._restored: StoredPose | None = None  # until odometry says how the robot has moved
        self._log = ThrottledLog(node)
        self._logger = node.get_logger()
        self._settings, self._estimator = settings, estimator
        self._path = absolute(settings.pose_file) if settings.pose_file else None
        self._stamp_ns: int | None = None

    def restore(self) -> None:
        """Set the robot to the kept pose, if there is one that may be right."""
        if self._path is None or not is_there(self._path):
            return
        try:
            stored = read_pose(self._path)
            reason = self._reason_against(stored)
            if not reason:
                # It may have been moved a little meanwhile, as a pose given in RViz may be off.
                covariance = stored.covariance + np.diag(GIVEN_POSE_STD**2)
                self._estimator.set_pose(stored.pose, covariance, map_name=stored.map_name)
                self._restored = stored
        except SlamObserverError as error:
            reason = str(error)
        if reason:
            self._logger.warning(f'the pose kept in pose_file is not used: {reason}')
            return
        x, y, z = stored.pose[:3, 3].tolist()
        where = f' in the map {stored.map_name}' if stored.map_name else ''
        self._logger.info(f'the robot is where it was{where}: ({x:.2f}, {y:.2f}, {z:.2f}) m')

    def follow_odometry(self) -> None:
        """Let a restored pose move on as odometry has, once it is heard, and it has gone on."""
        stored, update = self._restored, self._estimator.last_update
        stamp_ns = None if stored is None else self._odometry.newest_ns
        if stored is None or stamp_ns is None:
            return
        self._restored = None
        then, now = stored.odometry, self._odometry.pose_until(stamp_ns)
        if then is None or now is None or (update is not None and len(update.ids)):
            return
        age_s, motion = time.time() - stored.time_s, se3.inverse(then) @ now
        way_m = float(np.linalg.norm(motion[:3, 3]))
        if (_is_at_start(now) and not _is_at_start(then)) or way_m > FAST_M_PER_S * age_s:
            self._logger.info('the odometry has begun again: the robot is where it was')
            return
        s = self._estimator.settings
        noise = np.array([*s.angular_velocity_noise, *s.linear_velocity_noise])
        moved = of_moved_pose(stored.covariance, stored.pose, motion, np.diag(noise**2 * age_s))
        self._estimator.set_pose(stored.pose @ motion, moved, stamp_ns, stored.map_name)
        self._logger.info(f'by odometry the robot has moved {way_m:.2f} m since')

    def keep(self) -> None:
        """Write the present pose, if it is known and new."""
        estimator = self._estimator
        stamp_ns = estimator.stamp_ns
        is_known = estimator.is_localised and stamp_ns not in (None, self._stamp_ns)
        if self._path is None or not is_known:
            return
        pose, covariance = estimator.uncertain_pose
        if covariance is None:
            covariance = np.zeros((6, 6))
        frame = self._settings.map_frame
        self._stamp_ns = stamp_ns
        try:
            odometry = self._odometry.pose_until(stamp_ns or 0)
            name = estimator.map_name if len(estimator.loaded_maps) > 1 else ''
            kept = StoredPose(pose, covariance, frame, time.time(), odometry, name)
            write_pose(self._path, kept)
        except SlamObserverError as error:
            self._log.warning('pose_file', str(error))

    def _reason_against(self, stored: StoredPose) -> str:
        age_s = time.time() - stored.time_s
        if age_s < 0.0:
            return f"by this machine's clock it was kept {-age_s:.0f} s from now"
        if age_s > MAX_AGE_S:
            return f'it is {age_s:.0f} s old, beyond {MAX_AGE_S:.0f} s'
        if stored.frame_id != self._settings.map_frame:
            return f"it is in frame '{stored.frame_id}', not '{self._settings.map_frame}'"
        names = [known.name for known in self._estimator.loaded_maps]
        if stored.map_name and stored.map_name not in names:
            return f"it is in the map '{stored.map_name}', which is not loaded"
        return ''


def _is_at_start(odometry: FloatArray) -> bool:
    way_m, turn_rad = np.linalg.norm(se3.log(odometry).reshape(2, 3), axis=1)[::-1]
    return bool(way_m < AT_START_M and turn_rad < AT_START_RAD)


FORMAT = 'slam_observer_ros pose'
MAX_BYTES = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class StoredPose:
    """Where the robot was, and when, by the system's clock."""

    pose: FloatArray  # (4, 4) in frame_id
    covariance: FloatArray  # (6, 6) of rotation vector and position along the map's axes
    frame_id: str
    time_s: float  # since 1970
    odometry: FloatArray | None = None  # (4, 4) the base in odom_frame then, if that is on /tf
    map_name: str = ''  # of the map that it was in, where several were loaded


def write_pose(path: Path, stored: StoredPose) -> None:
    """Write the file whole, or not at all; MapError if it can't be written."""
    content = {
        'format': FORMAT,
        'frame': stored.frame_id,
        'time': stored.time_s,
        'position': stored.pose[:3, 3].tolist(),
        'orientation': so3.to_quaternion(stored.pose[:3, :3]).tolist(),
        'covariance': stored.covariance.ravel().tolist(),
    }
    if stored.odometry is not None:
        R, x = stored.odometry[:3, :3], stored.odometry[:3, 3]
        content['odometry'] = [*x.tolist(), *so3.to_quaternion(R).tolist()]
    if stored.map_name:
        content['map'] = stored.map_name
    with failing(MapError, f"can't write the pose {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished_file(path) as file:
            yaml.safe_dump(content, file, sort_keys=False)


def read_pose(path: Path) -> StoredPose:
    """Read the file; MapError if it can't be read, or is no such file."""
    try:
        with failing(MapError, f"can't read the pose {path}"):
            content = load_yaml(path, MAX_BYTES, plain_value)
    except YamlError as error:
        raise MapError(f'the pose {path} is not valid YAML: {error}') from error
    if not isinstance(content, dict) or content.get('format') != FORMAT:
        raise MapError(f"{path} has no line 'format: {FORMAT}'")
    sizes = {'position': 3, 'orientation': 4, 'covariance': 36}
    values = {name: _numbers(path, content, name, size) for name, size in sizes.items()}
    (time_s,) = _numbers(path, {'time': [content.get('time')]}, 'time', 1)
    odometry = None
    if 'odometry' in content:
        numbers = _numbers(path, content, 'odometry', 7)
        odometry = _pose(path, 'odometry', numbers[:3], numbers[3:])
    return StoredPose(
        _pose(path, 'orientation', values['position'], values['orientation']),
        values['covariance'].reshape(6, 6),
        str(content.get('frame')),
        float(time_s),
        odometry,
        str(content.get('map', '')),
    )


def _pose(path: Path, name: str, position: FloatArray, quaternion: FloatArray) -> FloatArray:
    if not 0.99 < np.linalg.norm(quaternion) < 1.01:
        raise MapError(f"the pose {path}: '{name}' is no unit quaternion")
    return se3.pose(so3.from_quaternion(quaternion), position)


def _numbers(path: Path, content: dict[str, Any], name: str, size: int) -> FloatArray:
    written = content.get(name)
    numbers = written if isinstance(written, list) else []
    # NaN is within no bounds, and an int may have more digits than any array takes.
    are_usable = all(type(each) in (int, float) and abs(each) <= MAX_NUMBER for each in numbers)
    if len(numbers) != size or not are_usable:
        raise MapError(
            f"the pose {path}: '{name}' is not {size} finite numbers, {MAX_NUMBER:g} at most"
        )
    return np.array(numbers, dtype=np.float64)
