"""What a node communicates with, so that parts of it can be destroyed again."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock


class Entities:
    """Remembers the publishers, subscriptions, services, timers and callbacks a node has now.

    A subscription to the clock is none of them: rclpy itself makes it whenever ``use_sim_time`` is
    set, and needs it for as long.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known = self._present()

    def remove_new(self) -> None:
        """Destroy what the node has got since."""
        for remove, entities in self._present().items():
            for entity in entities - self._known[remove]:
                getattr(self._node, remove)(entity)

    def _present(self) -> dict[str, set[Any]]:
        node = self._node
        return {
            'destroy_timer': set(node.timers),
            'destroy_subscription': {
                each for each in node.subscriptions if each.msg_type is not Clock
            },
            'destroy_service': set(node.services),
            'destroy_publisher': set(node.publishers),
            # rclpy has no public name for these.
            'remove_on_set_parameters_callback': set(node._on_set_parameters_callbacks),
            'remove_post_set_parameters_callback': set(node._post_set_parameters_callbacks),
        }
