"""Services that save and load maps under a name of their own, with Nav2's types."""

from __future__ import annotations

from collections.abc import Callable
import importlib
import re
from typing import Any
from urllib.parse import unquote

from rclpy.node import Node
from std_srvs.srv import Trigger

from slam_observer_ros.common.errors import MapError, SlamObserverError
from slam_observer_ros.nodes.services.map_services import absolute, is_there, MapServices

_FILE_URL = re.compile('file:(?://(?:localhost)?)?(/(?!/).*)', re.IGNORECASE | re.DOTALL)

SAVE, LOAD = '~/save_map_to', '~/load_map_from'


class NamedMapServices:
    """``~/save_map_to`` and ``~/load_map_from``, where nav2_msgs is installed.

    Both take ``map_url``, a path or a file:// URL; what concerns an image is of no use here.
    """

    def __init__(self, node: Node, maps: MapServices) -> None:
        self._maps = maps
        self._log = node.get_logger()
        try:
            types = importlib.import_module('nav2_msgs.srv')
        except ImportError:  # the services of std_srvs do the same, with the parameter map_path
            return
        node.create_service(types.SaveMap, SAVE, self._save)
        node.create_service(types.LoadMap, LOAD, self._load)

    def _save(self, request: Any, response: Any) -> Any:
        response.result = self._succeeds(self._maps.save_to, request.map_url)
        return response

    def _load(self, request: Any, response: Any) -> Any:
        if self._succeeds(self._maps.load_from, request.map_url):
            response.result = response.RESULT_SUCCESS
        elif _is_there(request.map_url):
            response.result = response.RESULT_INVALID_MAP_DATA
        else:
            response.result = response.RESULT_MAP_DOES_NOT_EXIST
        return response

    def _succeeds(self, act: Callable[..., Trigger.Response], map_url: str) -> bool:
        try:
            path = path_of(map_url)
        except MapError as error:
            self._log.error(str(error))
            return False
        return bool(act(path, Trigger.Response()).success)


def _is_there(map_url: str) -> bool:
    try:
        return is_there(absolute(path_of(map_url)))
    except SlamObserverError:
        return False


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
