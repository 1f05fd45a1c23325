"""Sends what the ROS-free layers log to the node's own logger, and so to /rosout."""

from __future__ import annotations

import logging

from rclpy.impl.rcutils_logger import RcutilsLogger

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
