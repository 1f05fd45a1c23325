"""Qualities of service of the nodes' topics."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, QoSProfile

RELIABLE_QOS = QoSProfile(depth=10)
"""Out: any subscriber fits a reliable publisher."""

LATCHED_POSE_QOS = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: as AMCL's pose; a late subscriber gets the last ones, as many as it keeps itself."""

LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Out: a subscriber that comes late gets the last message."""
