"""What launch files check before they start anything; launch itself is a stand-in."""

from __future__ import annotations

from contextlib import contextmanager
import inspect
import os
from pathlib import Path
import runpy
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

from ament_index_python.packages import PackageNotFoundError
import pytest

from slam_observer_ros.nodes.launch_setup import (
    check_file,
    check_optional_file,
    check_packages,
    numbers,
)

LAUNCH_FOLDER = Path(__file__).resolve().parents[2] / 'launch'
MODULES = (
    'launch',
    'launch.actions',
    'launch.conditions',
    'launch.substitutions',
    'launch_ros',
    'launch_ros.actions',
    'launch_ros.substitutions',
)


@pytest.fixture
def load(monkeypatch):
    """Return a function that gives the names of a launch file."""
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    return lambda name: runpy.run_path(str(LAUNCH_FOLDER / name))


def entities(names, kind):
    """Return the positions of a launch description's entities of one kind, in their order."""
    source = inspect.getsource(names['generate_launch_description'])
    return [at for at in range(len(source)) if source.startswith(f'{kind}(', at)]


def check(written):
    context = SimpleNamespace(launch_configurations={'params_file': str(written)})
    check_file(context, 'params_file')
    return context.launch_configurations['params_file']


@contextmanager
def in_folder(folder):
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def test_a_home_folder_in_params_file_is_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'my_robot.yaml').touch()
    assert check('~/my_robot.yaml') == str(tmp_path / 'my_robot.yaml')


def test_params_file_may_be_relative(tmp_path):
    (tmp_path / 'my_robot.yaml').touch()
    with in_folder(tmp_path):
        path = check('my_robot.yaml')
    assert path == str(tmp_path / 'my_robot.yaml')


@pytest.mark.parametrize('name', ['my_robto.yaml', '', '~nobody-of-that-name/my_robot.yaml'])
def test_a_params_file_that_there_is_not_ends_the_launch_with_the_reason(tmp_path, name):
    with in_folder(tmp_path), pytest.raises(RuntimeError, match=r"^params_file: no file '.*/"):
        check(name)


def test_a_file_that_may_be_left_out_is_checked_if_it_is_named(tmp_path):
    context = SimpleNamespace(launch_configurations={'map': ''})
    check_optional_file(context, 'map')
    assert not context.launch_configurations['map']
    context.launch_configurations['map'] = str(tmp_path / 'hall.yaml')
    with pytest.raises(RuntimeError, match=r'^map: no file'):
        check_optional_file(context, 'map')


def test_maps_may_be_a_folder(tmp_path):
    context = SimpleNamespace(launch_configurations={'map_file': str(tmp_path)})
    check_optional_file(context, 'map_file', True)
    with pytest.raises(RuntimeError, match=r'^map_file: no file'):
        check_optional_file(context, 'map_file')


def test_params_file_is_checked_before_a_node_is_started(load):
    names = load('observer.launch.py')
    (checked,) = entities(names, 'OpaqueFunction')
    assert max(entities(names, 'DeclareLaunchArgument')) < checked < min(entities(names, 'Node'))


def test_without_rviz_the_demo_runs_and_says_so(load):
    names = load('demo.launch.py')
    names['rviz'].__globals__['get_package_prefix'] = MagicMock(side_effect=PackageNotFoundError)
    (said,) = names['rviz'](None)
    assert said is names['LogInfo'].return_value
    assert 'rviz2 is not installed' in names['LogInfo'].call_args.kwargs['msg']
    names['Node'].assert_not_called()


def test_with_rviz_the_demo_shows_it(load):
    names = load('demo.launch.py')
    names['rviz'].__globals__['get_package_prefix'] = MagicMock()
    (started,) = names['rviz'](None)
    assert started is names['Node'].return_value
    assert names['Node'].call_args.kwargs['package'] == 'rviz2'


def test_all_that_may_fail_in_the_demo_comes_before_a_node_is_started(load):
    """Where launch ends with an error, it leaves behind what it has started."""
    names = load('demo.launch.py')
    may_fail = entities(names, 'OpaqueFunction') + entities(names, 'IncludeLaunchDescription')
    assert len(may_fail) == 2
    assert may_fail[0] < may_fail[1] < min(entities(names, 'Node'))


@pytest.fixture
def nodes(load):
    """Return a function that gives what a launch file starts, by the names of executables."""

    def start(name, **arguments):
        names = load(name)
        names['start'].__globals__['check_packages'] = MagicMock()
        defaults = {key: value for key, (value, _) in names['ARGUMENTS'].items()}
        context = SimpleNamespace(
            launch_configurations=defaults | {'params_file': '/robot.yaml'} | arguments
        )
        names['start'](context)
        calls = [call.kwargs for call in names['Node'].call_args_list]
        return {call['executable']: call for call in calls}

    return start


def parameters(node):
    return {
        key: value
        for entry in node['parameters']
        if isinstance(entry, dict)
        for key, value in entry.items()
    }


def test_alone_the_observer_activates_itself(nodes):
    started = nodes('localization.launch.py', use_respawn='true', map_file='/hall.yaml')
    (observer,) = started.values()
    assert observer['respawn']
    assert parameters(observer) == {
        'use_sim_time': False,
        'autostart_node': True,
        'bond_heartbeat_period': 0.0,
        'map_file': '/hall.yaml',
    }


def test_a_map_that_is_given_is_not_added_to_unless_the_parameter_file_says_so(nodes):
    """Both files have the section /**, of which the later one wins."""
    with_map = nodes('localization.launch.py', map_file='/hall.yaml')
    without = nodes('localization.launch.py')
    counts = [len(each['lifecycle_observer_node']['parameters']) for each in (with_map, without)]
    assert counts == [3, 2]
    defaults = LAUNCH_FOLDER.parent / 'config' / 'localization.yaml'
    assert '/**:' in defaults.read_text()
    assert 'localization_mode: uncertain' in defaults.read_text()


def test_it_waits_for_transitions_where_it_must_not_start_by_itself(nodes):
    started = nodes('localization.launch.py', autostart='false')
    assert parameters(started['lifecycle_observer_node'])['autostart_node'] is False


def test_beside_a_map_server_the_lifecycle_manager_starts_both(nodes):
    started = nodes('localization.launch.py', map='/hall.yaml')
    assert parameters(started['map_server'])['yaml_filename'] == '/hall.yaml'
    assert parameters(started['lifecycle_observer_node'])['autostart_node'] is False
    manager = parameters(started['lifecycle_manager'])
    assert manager['autostart']
    assert manager['node_names'] == ['map_server', started['lifecycle_observer_node']['name']]


@pytest.mark.parametrize('has_bond', [True, False])
def test_there_is_a_bond_where_bondpy_is_installed(nodes, monkeypatch, has_bond):
    monkeypatch.setattr(
        'importlib.util.find_spec', lambda _name: MagicMock() if has_bond else None
    )
    started = nodes('localization.launch.py', map='/hall.yaml')
    period_s = parameters(started['lifecycle_observer_node'])['bond_heartbeat_period']
    timeout_s = parameters(started['lifecycle_manager'])['bond_timeout']
    assert (period_s > 0.0) == (timeout_s > 0.0) == has_bond


def test_a_camera_is_mounted_where_its_pose_is_given(nodes):
    started = nodes('apriltag.launch.py', tag_size='0.2')
    assert set(started) == {'apriltag_node'}
    assert parameters(started['apriltag_node'])['size'] == 0.2
    assert parameters(started['apriltag_node'])['pose_estimation_method'] == 'pnp'
    started = nodes(
        'apriltag.launch.py', tag_size='0.2', camera_frame='eye', camera_pose='0.2 0 0.4 0 0.1 0'
    )
    assert started['static_transform_publisher']['arguments'][-1] == 'eye'


def test_a_calibration_is_heard_where_image_transport_looks_for_it(nodes):
    beside = nodes('apriltag.launch.py', tag_size='0.2')['apriltag_node']
    assert not [old for old, _ in beside['remappings'] if 'camera_info' in old]
    elsewhere = nodes(
        'apriltag.launch.py', tag_size='0.2', image='/eye/image_rect', camera_info='/eye/raw/info'
    )['apriltag_node']
    assert ('/eye/camera_info', '/eye/raw/info') in elsewhere['remappings']


def test_the_observer_has_the_base_frame_that_is_given(nodes):
    observer = nodes('localization.launch.py', base_frame='base_footprint')
    assert parameters(observer['lifecycle_observer_node'])['base_frame'] == 'base_footprint'


def test_detector_and_observer_have_one_tag_size(nodes, load):
    observer = nodes('localization.launch.py', tag_size='0.2')['lifecycle_observer_node']
    assert parameters(observer)['tag_size'] == 0.2
    names = load('apriltag.launch.py')
    names['generate_launch_description']()
    passed_on = dict(names['IncludeLaunchDescription'].call_args.kwargs['launch_arguments'])
    assert passed_on['tag_size'] is names['LaunchConfiguration'].return_value
    assert ('tag_size',) in [call.args for call in names['LaunchConfiguration'].call_args_list]


def test_a_tag_size_that_is_no_number_ends_the_launch_with_the_reason(nodes):
    with pytest.raises(RuntimeError, match=r"^tag_size: '16cm' is not a number"):
        nodes('localization.launch.py', tag_size='16cm')


def test_a_pose_of_a_camera_without_its_frame_is_refused(load):
    names = load('apriltag.launch.py')
    names['check'].__globals__['check_packages'] = MagicMock()
    given = {'tag_size': '0.2', 'camera_frame': '', 'camera_pose': '0.2 0 0.4 0 0 0'}
    with pytest.raises(RuntimeError, match='camera_pose needs camera_frame'):
        names['check'](SimpleNamespace(launch_configurations=given))


@pytest.mark.parametrize('name', ['autostart', 'use_respawn', 'use_sim_time'])
def test_what_is_neither_true_nor_false_ends_the_launch_with_the_reason(nodes, name):
    with pytest.raises(RuntimeError, match=f"^{name}: 'yes' is neither true nor false"):
        nodes('localization.launch.py', **{name: 'yes'})


def test_numbers_of_an_argument_are_counted():
    assert numbers({'pose': '1 2,3'}, 'pose', 3) == [1.0, 2.0, 3.0]
    for written in ('1 2', '1 2 x', ''):
        with pytest.raises(RuntimeError, match='is not 3 numbers'):
            numbers({'pose': written}, 'pose', 3)


def test_a_missing_package_is_named_with_how_it_is_installed(monkeypatch, tmp_path):
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'rclpy').touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    check_packages('rclpy')
    with pytest.raises(RuntimeError, match='apt install ros-jazzy-no-such-package'):
        check_packages('rclpy', 'no_such_package')
