"""Log lines that would be repeated with every message."""

from __future__ import annotations

import time

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
