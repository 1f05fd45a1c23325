"""Services that save and load maps under a name of their own, with Nav2's types."""

from __future__ import annotations

import importlib
from typing import Any
from urllib.parse import unquote, urlparse

from rclpy.node import Node
from std_srvs.srv import Trigger

from slam_observer_ros.nodes.services.map_services import MapServices

SAVE, LOAD = '~/save_map_to', '~/load_map_from'


class NamedMapServices:
    """``~/save_map_to`` and ``~/load_map_from``, where nav2_msgs is installed.

    Both take ``map_url``, a path or a file:// URL; what concerns an image is of no use here.
    """

    def __init__(self, node: Node, maps: MapServices) -> None:
        self._maps = maps
        try:
            types = importlib.import_module('nav2_msgs.srv')
        except ImportError:  # the services of std_srvs do the same, with the parameter map_path
            return
        node.create_service(types.SaveMap, SAVE, self._save)
        node.create_service(types.LoadMap, LOAD, self._load)

    def _save(self, request: Any, response: Any) -> Any:
        answer = self._maps.save_to(path_of(request.map_url), Trigger.Response())
        response.result = answer.success
        return response

    def _load(self, request: Any, response: Any) -> Any:
        answer = self._maps.load_from(path_of(request.map_url), Trigger.Response())
        failure = response.RESULT_INVALID_MAP_DATA
        response.result = response.RESULT_SUCCESS if answer.success else failure
        return response


def path_of(map_url: str) -> str:
    """Return the path that a URL of a file, or a plain path, names."""
    parts = urlparse(map_url)
    return unquote(parts.path) if parts.scheme == 'file' else map_url
