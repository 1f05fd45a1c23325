"""Services and topics by which a person or another node steers the observer, and its map files."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import dataclasses
import importlib
from pathlib import Path
import re
import threading
import time
from typing import Any
from urllib.parse import unquote

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from slam_observer_ros.common.errors import MapError, ParameterError, SlamObserverError
from slam_observer_ros.common.files import absolute, is_there
from slam_observer_ros.common.stamps import to_ns, to_s
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.events import VelocityEvent
from slam_observer_ros.lie import se3
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import check_writable, read_maps, write_map
from slam_observer_ros.nodes.estimate_publisher import EstimatePublisher
from slam_observer_ros.nodes.estimator_feed import EstimatorFeed
from slam_observer_ros.nodes.ros_node import RELIABLE_QOS
from slam_observer_ros.nodes.transforms import TransformedOdometry
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

MAX_STEP_NS = 500_000_000  # time between two velocities whose stamps are believed at once


class PausedMotion:
    """Moves the estimate on at the end of a pause as the odometry on /tf did meanwhile."""

    def __init__(self, estimator: Estimator, odometry: TransformedOdometry) -> None:
        self._estimator, self._odometry = estimator, odometry
        self._correction: FloatArray | None = None

    def begin(self) -> None:
        """Remember where the odometry's frame is in the map."""
        stamp_ns, newest_ns = self._estimator.stamp_ns, self._odometry.newest_ns
        self._correction = None
        if stamp_ns is not None and newest_ns is not None:
            common_ns = min(stamp_ns, newest_ns)
            self._note(self._estimator.pose_at(common_ns), common_ns)

    def note_move(self) -> None:
        """Take that somebody has moved the robot meanwhile, to where it is now."""
        newest_ns = self._odometry.newest_ns
        self._correction = None
        if newest_ns is not None:
            self._note(self._estimator.pose, newest_ns)

    def end(self) -> bool:
        """Let the estimate follow the odometry; return whether it could."""
        start_ns, end_ns = self._estimator.stamp_ns, self._odometry.newest_ns
        odometry = None if end_ns is None else self._odometry.pose_until(end_ns)
        correction, self._correction = self._correction, None
        if correction is None or odometry is None or start_ns is None or end_ns is None:
            return False
        if end_ns <= start_ns:
            return True
        way = se3.log(se3.inverse(self._estimator.pose) @ correction @ odometry)
        step_ns = min(to_ns(self._estimator.settings.velocity_timeout) // 2, MAX_STEP_NS)
        velocity = way / to_s(end_ns - start_ns)
        for stamp_ns in range(start_ns + 1, end_ns, step_ns):
            self._estimator.add(VelocityEvent(stamp_ns, velocity, is_mean=True))
        self._estimator.add(VelocityEvent(end_ns, np.zeros(6)))
        return True

    def _note(self, pose: FloatArray, stamp_ns: int) -> None:
        odometry = self._odometry.pose_until(stamp_ns)
        if odometry is not None:
            self._correction = pose @ se3.inverse(odometry)


class ControlServices:
    """``~/reset``, ``~/pause``, ``~/resume`` and ``~/forget_landmark``."""

    def __init__(
        self,
        node: Node,
        estimator: Estimator,
        feed: EstimatorFeed,
        publisher: EstimatePublisher,
        odometry: TransformedOdometry,
    ) -> None:
        self._node, self._estimator, self._feed = node, estimator, feed
        self._publisher = publisher
        self._paused_motion = PausedMotion(estimator, odometry)
        node.create_service(Trigger, '~/reset', self._reset)
        node.create_service(Trigger, '~/pause', self._pause)
        node.create_service(Trigger, '~/resume', self._resume)
        node.create_subscription(Int64, '~/forget_landmark', self._forget, RELIABLE_QOS)

    def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.reset()
        self.note_move()
        return self._answer(response, 'pose and what was mapped are forgotten')

    def _pause(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._estimator.release()  # what has come before the pause counts
        if not self._feed.is_paused:
            self._paused_motion.begin()
        self._feed.is_paused = True
        self._feed.on_events('')
        return self._answer(response, 'paused: the pose is held, and all that comes in is dropped')

    def _resume(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        was_paused, self._feed.is_paused = self._feed.is_paused, False
        if not was_paused or self._paused_motion.end():
            return self._answer(response, 'resumed')
        return self._answer(response, 'resumed where it was paused: no odometry is on /tf')

    def note_move(self) -> None:
        """Take that the robot is somewhere else in the map than it was, or in another map."""
        self._publisher.reset()
        if self._feed.is_paused:
            self._paused_motion.note_move()

    def _answer(self, response: Trigger.Response, text: str) -> Trigger.Response:
        self._node.get_logger().info(text)
        response.success = True
        response.message = text
        return response

    def _forget(self, message: Int64) -> None:
        self._estimator.release()  # else a sighting that is held back would bring it back
        outcome = 'not known'
        if self._estimator.forget(message.data):
            self._publisher.replace_landmarks()
            outcome = 'forgotten'
        self._node.get_logger().info(f'landmark {message.data} is {outcome}')


RECENT_PERIODS = 20.0  # the map at hand is kept for as many times as long as it took to make
END_S = 0.2  # for how long, at the end, events that are held back are begun with


class MapServices:
    """The map file of the start, ``~/load_map``, ``~/save_map`` and the autosave at the end.

    The node's parameter ``map_path`` names the services' file. ``on_load`` is called after a map
    was loaded: the estimate is in another frame then. Raises a MapError if the map of the start
    can't be read, or the one of the end could not be written, a ParameterError without a file.
    """

    def __init__(
        self,
        node: Node,
        settings: ObserverNodeSettings,
        estimator: Estimator,
        on_load: Callable[[], None],
    ) -> None:
        self._node = node
        self._map_frame = settings.map_frame
        self._autosave = settings.autosave_map
        self._estimator, self._on_load = estimator, on_load
        # For an end within a long observation: a map at hand, and whether the end has come.
        self._recent: tuple[LandmarkMap, int] | None = None
        self._recent_s = self._next_s = 0.0
        self._end = threading.Lock()
        self._has_ended = False
        # Files that hold what this node has loaded or saved, and that it may write again.
        self._own_files: set[Path] = set()
        if self._autosave:
            self._check_autosave(settings.map_path)
        if settings.map_file:
            node.get_logger().info(self._load(absolute(settings.map_file)))
        elif estimator.settings.localization_mode != 'off':
            node.get_logger().warning("no 'map_file': mapping until a map comes by ~/load_map")
        if self._autosave and self._is_another(path := absolute(settings.map_path)):
            node.get_logger().warning(
                f"'autosave_map' will replace {path}, which is not loaded (map_file); what it "
                f'holds will be kept in {_backup(path).name}'
            )
        node.add_on_set_parameters_callback(self._check_changes)
        node.create_service(Trigger, '~/save_map', lambda _, answer: self.save_to('', answer))
        node.create_service(Trigger, '~/load_map', lambda _, answer: self.load_from('', answer))

    def save_at_end(self) -> None:
        """Save the map if that was asked for and there is one; MapError if it can't be saved.

        Events that are held back count as far as that is quick: launch waits for five seconds.
        """
        if self._autosave:
            self._estimator.release(END_S)
        with self._end:
            self._has_ended = True
            if not self._autosave or not len(self._estimator.landmark_ids):
                return
            try:
                self._node.get_logger().info(self._save(self._path()))
            except SlamObserverError as error:
                raise MapError(f'the map is not saved: {error}') from error

    def save_to(self, path: str, response: Trigger.Response) -> Trigger.Response:
        """Save the map to a file, ``map_path`` if none is named; return the response."""
        return self._answer(response, self._save, path)

    def load_from(self, path: str, response: Trigger.Response) -> Trigger.Response:
        """Load a map from a file, likewise."""
        return self._answer(response, self._load, path)

    def keep_recent(self) -> None:
        """Have a map at hand for :meth:`end_in_haste`; a twentieth of the time goes there."""
        start_s = time.monotonic()
        if not self._autosave or start_s < self._next_s:
            return
        estimator = self._estimator
        has_map = estimator.is_localised and len(estimator.landmark_ids)
        self._recent = self._present_map() if has_map else None
        self._recent_s = time.monotonic()
        self._next_s = self._recent_s + RECENT_PERIODS * (self._recent_s - start_s)

    def end_in_haste(self) -> int | None:
        """Save the map at hand, for an end within an observation that another thread works on.

        Return the exit code; None if that thread has come to the end by itself.
        """
        with self._end:
            if self._has_ended:
                return None
            log = self._node.get_logger()
            recent = self._recent
            if not self._autosave or recent is None:
                log.warning('stopped within an observation')
                return 0
            age_s = time.monotonic() - self._recent_s
            answer = self._answer(Trigger.Response(), lambda path: self._write(path, *recent))
            log.warning(f'stopped within an observation: the map was made {age_s:.1f} s before')
            return 0 if answer.success else 1

    def _check_changes(self, changes: list[Parameter]) -> SetParametersResult:
        """Refuse a file that the map could not be saved to at the end."""
        try:
            for change in changes:
                if change.name == 'map_path' and self._autosave:
                    self._check_autosave(str(change.value))
        except SlamObserverError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    @staticmethod
    def _check_autosave(map_path: str) -> None:
        if not map_path:
            raise ParameterError("'autosave_map' needs a file in 'map_path'")
        check_writable(absolute(map_path))

    def _is_another(self, path: Path) -> bool:
        return path not in self._own_files and is_there(path)

    def _answer(
        self, response: Trigger.Response, act: Callable[[Path], str], path: str = ''
    ) -> Trigger.Response:
        try:
            response.message = act(absolute(path) if path else self._path())
            response.success = True
            self._node.get_logger().info(response.message)
        except SlamObserverError as error:
            response.message, response.success = str(error), False
            self._node.get_logger().error(response.message)
        return response

    def _path(self) -> Path:
        path: str = self._node.get_parameter('map_path').value
        if not path:
            raise ParameterError("no file is named: set the parameter 'map_path'")
        return absolute(path)

    def _save(self, path: Path) -> str:
        estimator = self._estimator
        estimator.release()
        if len(estimator.landmark_ids):  # of an empty map it is said below
            check_writable(path)  # before all that takes time
        if not estimator.is_localised:
            raise MapError('the pose in the loaded map is not known yet: nothing is saved')
        return self._write(path, *self._present_map())

    def _present_map(self) -> tuple[LandmarkMap, int]:
        """Return the map as it would be saved now, and how many landmarks are not in it."""
        estimator = self._estimator
        landmark_map = dataclasses.replace(estimator.landmark_map, frame_id=self._map_frame)
        return landmark_map, len(estimator.landmark_ids) - len(landmark_map.ids)

    def _write(self, path: Path, landmark_map: LandmarkMap, moving: int) -> str:
        """Write a map, without ``moving`` landmarks; return what is to be said of it."""
        backup = _backup(path) if self._is_another(path) else None
        write_map(path, landmark_map, self._estimator.settings, backup)
        kept = '' if backup is None else f'; what it held before is in {backup.name}'
        self._own_files.add(path)
        without = f' (without {moving} that move)' if moving else ''
        what = f'{len(landmark_map.ids)} landmarks{without}'
        return f"saved {what} in frame '{self._map_frame}' to {path}{kept}"

    def _load(self, path: Path) -> str:
        maps = read_maps(path)
        for known in maps:
            if known.frame_id != self._map_frame:
                raise MapError(
                    f"map {known.name} of {path} is in frame '{known.frame_id}', and 'map_frame' "
                    f"is '{self._map_frame}': make them the same"
                )
        self._estimator.release()  # what has come before belongs to the old frame
        self._estimator.load_map(maps)
        self._own_files.add(path)
        self._on_load()
        what = f'{sum(len(known.ids) for known in maps)} landmarks'
        if len(maps) > 1:
            what += f' in {len(maps)} maps ({", ".join(known.name for known in maps)})'
        pose = 'the robot has found its pose in it'
        if not self._estimator.is_localised:
            number = 'two' if self._estimator.settings.two_d_mode else 'three'
            pose = (
                f'the pose is unknown until {number} of them are recognised by their ids, more '
                'without ids by how they lie to each other, or it is given on initialpose'
            )
        elif self._estimator.last_update is None:
            x, y, z = self._estimator.pose[:3, 3].tolist()
            pose = f'the robot starts at ({x:.2f}, {y:.2f}, {z:.2f}) m'
        return f'loaded {what} from {path}; {pose}'


def _backup(path: Path) -> Path:
    return path.with_name(f'{path.name}~')


_FILE_URL = re.compile('file:(?://(?:localhost)?)?(/(?!/).*)', re.IGNORECASE | re.DOTALL)


class NamedMapServices:
    """``~/save_map_to`` and ``~/load_map_from``, of a path or file:// URL, with nav2_msgs."""

    def __init__(self, node: Node, maps: MapServices) -> None:
        self._maps = maps
        self._log = node.get_logger()
        try:
            types = importlib.import_module('nav2_msgs.srv')
        except ImportError:  # the services of std_srvs do the same, with the parameter map_path
            return
        node.create_service(types.SaveMap, '~/save_map_to', self._save)
        node.create_service(types.LoadMap, '~/load_map_from', self._load)

    def _save(self, request: Any, response: Any) -> Any:
        response.result = self._succeeds(self._maps.save_to, request.map_url)
        return response

    def _load(self, request: Any, response: Any) -> Any:
        response.result = response.RESULT_MAP_DOES_NOT_EXIST
        if self._succeeds(self._maps.load_from, request.map_url):
            response.result = response.RESULT_SUCCESS
            return response
        with suppress(SlamObserverError):
            if is_there(absolute(path_of(request.map_url))):
                response.result = response.RESULT_INVALID_MAP_DATA
        return response

    def _succeeds(self, act: Callable[..., Trigger.Response], map_url: str) -> bool:
        try:
            path = path_of(map_url)
        except MapError as error:
            self._log.error(str(error))
            return False
        return bool(act(path, Trigger.Response()).success)


def path_of(map_url: str) -> str:
    """Return the path that a URL of a file, or a plain path, names; MapError for another URL."""
    if '://' not in map_url and not map_url.lower().startswith('file:'):
        return map_url
    url = _FILE_URL.fullmatch(map_url)
    if url is None:
        raise MapError(f"map_url takes a path or a file:// URL, not '{map_url}'")
    try:
        return unquote(url[1], errors='strict')
    except UnicodeDecodeError as error:
        raise MapError(f"map_url '{map_url}' is not UTF-8") from error
