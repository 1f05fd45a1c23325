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


def check(names, written):
    context = SimpleNamespace(launch_configurations={'params_file': str(written)})
    names['check_params_file'](context)
    return context.launch_configurations['params_file']


@contextmanager
def in_folder(folder):
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def test_a_home_folder_in_params_file_is_expanded(load, tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'my_robot.yaml').touch()
    assert check(load('observer.launch.py'), '~/my_robot.yaml') == str(tmp_path / 'my_robot.yaml')


def test_params_file_may_be_relative(load, tmp_path):
    (tmp_path / 'my_robot.yaml').touch()
    with in_folder(tmp_path):
        path = check(load('observer.launch.py'), 'my_robot.yaml')
    assert path == str(tmp_path / 'my_robot.yaml')


@pytest.mark.parametrize('name', ['my_robto.yaml', '', '~nobody-of-that-name/my_robot.yaml'])
def test_a_params_file_that_there_is_not_ends_the_launch_with_the_reason(load, tmp_path, name):
    with in_folder(tmp_path), pytest.raises(RuntimeError, match=r"^params_file: no file '.*/"):
        check(load('observer.launch.py'), name)


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
