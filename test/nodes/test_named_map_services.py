"""Maps are saved and loaded under a name that the caller gives, where Nav2's types are there."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from slam_observer_ros import Estimator, LandmarkMap, Settings
from slam_observer_ros.mapping.map_file import read_map, write_map
from slam_observer_ros.nodes.services import MapServices, NamedMapServices, path_of
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

HALL = LandmarkMap(np.array([3, 4]), np.array([[1.0, 2, 0], [4, 0, 0]]), None, np.ones(2, int))
LOADED = SimpleNamespace(
    RESULT_SUCCESS=0, RESULT_MAP_DOES_NOT_EXIST=1, RESULT_INVALID_MAP_DATA=2, result=None
)


@pytest.fixture(name='services')
def fixture_services(monkeypatch):
    """The callbacks of both services, by name, and the estimator."""
    monkeypatch.setitem(sys.modules, 'nav2_msgs', Mock())
    monkeypatch.setitem(sys.modules, 'nav2_msgs.srv', Mock())
    node, estimator = Mock(), Estimator(Settings())
    maps = MapServices(node, ObserverNodeSettings(), estimator, Mock())
    NamedMapServices(node, maps)
    calls = {call.args[1]: call.args[2] for call in node.create_service.call_args_list}
    return SimpleNamespace(
        save=calls['~/save_map_to'],
        load=calls['~/load_map_from'],
        maps=maps,
        estimator=estimator,
        log=node.get_logger.return_value,
    )


def test_a_map_is_loaded_from_and_saved_to_the_file_that_is_named(services, tmp_path):
    write_map(tmp_path / 'hall.yaml', HALL, None)
    request = SimpleNamespace(map_url=f'file://{tmp_path}/hall.yaml')
    assert services.load(request, LOADED).result == LOADED.RESULT_SUCCESS
    services.estimator.set_pose(np.eye(4))
    request = SimpleNamespace(map_url=str(tmp_path / 'other.yaml'))
    assert services.save(request, SimpleNamespace(result=None)).result
    assert read_map(tmp_path / 'other.yaml').ids.tolist() == [3, 4]


def test_what_fails_is_answered(services, tmp_path):
    request = SimpleNamespace(map_url=str(tmp_path / 'none.yaml'))
    assert services.load(request, LOADED).result == LOADED.RESULT_MAP_DOES_NOT_EXIST
    assert services.save(request, SimpleNamespace(result=None)).result is False
    assert not (tmp_path / 'none.yaml').exists()
    (tmp_path / 'notes.yaml').write_text('no map')
    request = SimpleNamespace(map_url=str(tmp_path / 'notes.yaml'))
    assert services.load(request, LOADED).result == LOADED.RESULT_INVALID_MAP_DATA


def test_a_url_of_another_kind_is_refused_with_what_is_taken(services):
    request = SimpleNamespace(map_url='package://my_robot/maps/hall.yaml')
    assert services.load(request, LOADED).result == LOADED.RESULT_MAP_DOES_NOT_EXIST
    assert services.save(request, SimpleNamespace(result=None)).result is False
    services.log.error.assert_called_with(
        "map_url takes a path or a file:// URL, not 'package://my_robot/maps/hall.yaml'"
    )


def test_without_nav2_there_are_the_plain_services_alone(monkeypatch):
    monkeypatch.setitem(sys.modules, 'nav2_msgs', None)
    monkeypatch.setitem(sys.modules, 'nav2_msgs.srv', None)
    node = Mock()
    NamedMapServices(node, Mock())
    node.create_service.assert_not_called()


def test_urls_and_paths():
    assert path_of('file:///data/my%20hall.yaml') == '/data/my hall.yaml'
    assert path_of('FILE://localhost/data/a#b?c.yaml') == '/data/a#b?c.yaml'
    assert path_of('~/hall.yaml') == '~/hall.yaml'
    assert path_of('//[') == '//['


@pytest.mark.parametrize(
    'map_url',
    [
        'file:///srv/a%00b', 'file://[x/y', 'http://[::1', 'file:///srv/%ff', 'file://other/srv/x',
        'file://', 'file:x', 'file://a?b', '~nobody_there/x', 'a\0b', '\ud800',
        f'file:///{5000 * "a"}',
    ],
)  # fmt: skip
def test_a_url_that_names_no_file_is_refused_and_nothing_is_saved(services, tmp_path, map_url):
    services.maps.save_to = Mock(wraps=services.maps.save_to)
    request = SimpleNamespace(map_url=map_url)
    assert services.load(request, LOADED).result == LOADED.RESULT_MAP_DOES_NOT_EXIST
    assert services.save(request, SimpleNamespace(result=None)).result is False
    services.log.error.assert_called()
    assert all(call.args[0] for call in services.maps.save_to.call_args_list)
