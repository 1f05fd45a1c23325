"""Qualities of service of the nodes' topics."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

SENSOR_QOS = QoSProfile(
    reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=100
)
"""In: best effort, so that any publisher fits; deep, so that a short pause loses nothing."""

RELIABLE_QOS = QoSProfile(depth=10)
"""Out: any subscriber fits a reliable publisher."""

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: a subscriber that comes late gets the last message."""
