"""What the node logs: lines that would be repeated, and those of the layers without ROS."""

from __future__ import annotations

import logging
import time

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

REPORT_PERIOD_S = 10.0
"""Shortest time between two lines about one subject."""


class ThrottledLog:
    """A node's log, with one line about each subject in ``REPORT_PERIOD_S``.

    rclpy throttles by line of code: there one topic's report would silence another's. Nothing is
    logged in the first ``quiet_s`` seconds.
    """

    def __init__(self, node: Node, quiet_s: float = 0.0) -> None:
        self._node = node
        self._quiet_until_s = time.monotonic() + quiet_s
        self._next_s: dict[str, float] = {}

    def error(self, subject: str, text: str) -> None:
        """Log an error, unless there was one about the subject lately."""
        if self._is_due(subject):
            self._node.get_logger().error(text)

    def warning(self, subject: str, text: str) -> None:
        """Log a warning, unless there was one about the subject lately."""
        if self._is_due(subject):
            self._node.get_logger().warning(text)

    def info(self, subject: str, text: str) -> None:
        """Log information, unless there was some about the subject lately."""
        if self._is_due(subject):
            self._node.get_logger().info(text)

    def _is_due(self, subject: str) -> bool:
        now_s = time.monotonic()
        if now_s < self._next_s.get(subject, self._quiet_until_s):
            return False
        self._next_s[subject] = now_s + REPORT_PERIOD_S
        return True


PACKAGE_LOGGER = 'slam_observer_ros'


class RosLogHandler(logging.Handler):
    """Gives log records to a node's ROS logger."""

    def __init__(self, ros_logger: RcutilsLogger) -> None:
        super().__init__()
        self._ros_logger = ros_logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log the record at the ROS severity that fits its level."""
        text = self.format(record)
        # One line a severity: rclpy remembers the severity that a line of code logs with.
        if record.levelno >= logging.ERROR:
            self._ros_logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._ros_logger.warning(text)
        else:
            self._ros_logger.info(text)


def forward_logging(ros_logger: RcutilsLogger) -> None:
    """Forward this package's Python log to ``ros_logger`` from level INFO on."""
    logger = logging.getLogger(PACKAGE_LOGGER)
    logger.setLevel(logging.INFO)
    logger.handlers = [RosLogHandler(ros_logger)]
