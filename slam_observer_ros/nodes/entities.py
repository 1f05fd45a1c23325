"""What a node communicates with, so that parts of it can be destroyed again."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rosgraph_msgs.msg import Clock


class Entities:
    """Remembers the publishers, subscriptions, services and timers that a node has now.

    A subscription to the clock is none of them: rclpy itself makes it whenever ``use_sim_time`` is
    set, and needs it for as long.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._known = self._present()

    def remove_new(self) -> None:
        """Destroy what the node has got since."""
        for kind, entities in self._present().items():
            for entity in entities - self._known[kind]:
                getattr(self._node, f'destroy_{kind}')(entity)

    def _present(self) -> dict[str, set[Any]]:
        node = self._node
        return {
            'timer': set(node.timers),
            'subscription': {each for each in node.subscriptions if each.msg_type is not Clock},
            'service': set(node.services),
            'publisher': set(node.publishers),
        }
