"""The last pose, kept over a restart."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node

from slam_observer_ros.common.errors import SlamObserverError
from slam_observer_ros.estimator.estimator import Estimator, GIVEN_POSE_STD
from slam_observer_ros.known_map.pose_file import read_pose, StoredPose, write_pose
from slam_observer_ros.nodes.logs import ThrottledLog
from slam_observer_ros.nodes.services.map_services import absolute, is_there
from slam_observer_ros.settings.node_settings import ObserverNodeSettings


class KeptPose:
    """Starts where the robot was when the node ended, unless that was too long ago.

    What can't be read or written is a warning: the robot is localised without it, too.
    """

    def __init__(self, node: Node, settings: ObserverNodeSettings, estimator: Estimator) -> None:
        self._log = ThrottledLog(node)
        self._logger = node.get_logger()
        self._settings = settings
        self._estimator = estimator
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
                self._estimator.set_pose(stored.pose, covariance)
        except SlamObserverError as error:
            reason = str(error)
        if reason:
            self._logger.warning(f'the pose kept in pose_file is not used: {reason}')
            return
        x, y, z = stored.pose[:3, 3].tolist()
        self._logger.info(f'the robot is where it was: ({x:.2f}, {y:.2f}, {z:.2f}) m')

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
            write_pose(self._path, StoredPose(pose, covariance, frame, time.time()))
        except SlamObserverError as error:
            self._log.warning('pose_file', str(error))

    def _reason_against(self, stored: StoredPose) -> str:
        age_s = time.time() - stored.time_s
        if age_s < 0.0:
            return f"by this machine's clock it was kept {-age_s:.0f} s from now"
        if age_s > self._settings.pose_file_max_age:
            return f'it is {age_s:.0f} s old (pose_file_max_age)'
        if stored.frame_id != self._settings.map_frame:
            return f"it is in frame '{stored.frame_id}', not '{self._settings.map_frame}'"
        return ''
