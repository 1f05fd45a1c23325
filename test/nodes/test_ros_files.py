"""Launch files, RViz view and parameter files name only what exists."""

from __future__ import annotations

import ast
from distutils.core import run_setup  # setuptools' own where Python has none any more
from pathlib import Path

import pytest
import setuptools  # noqa: F401 (provides distutils)
import yaml

from slam_observer_ros.nodes import initial_pose
from slam_observer_ros.settings.node_settings import ObserverNodeSettings, SimulatorNodeSettings
from slam_observer_ros.settings.parameter_table import table
from slam_observer_ros.simulation import Scenario

CHECKOUT = Path(__file__).resolve().parents[2]
LAUNCH_FILES = sorted((CHECKOUT / 'launch').glob('*.launch.py'))
OTHERS = {
    'rviz2': ['rviz2'],
    'nav2_map_server': ['map_server'],
    'nav2_lifecycle_manager': ['lifecycle_manager'],
    'apriltag_ros': ['apriltag_node'],
    'tf2_ros': ['static_transform_publisher'],
}


def _calls(tree, name):
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == name
    ]


@pytest.mark.parametrize('path', LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_file_names_existing_executables_and_files(path):
    tree = ast.parse(path.read_text())
    assert 'generate_launch_description' in {
        node.name for node in tree.body if isinstance(node, ast.FunctionDef)
    }
    entry_points = run_setup(str(CHECKOUT / 'setup.py'), stop_after='init').entry_points
    scripts = {entry.split(' = ')[0] for entry in entry_points['console_scripts']}
    for call in _calls(tree, 'Node'):
        keywords = {
            keyword.arg: getattr(keyword.value, 'value', None) for keyword in call.keywords
        }
        package, executable = keywords['package'], keywords['executable']
        assert executable in (scripts if package == 'slam_observer_ros' else OTHERS[package])
    for call in _calls(tree, 'PathJoinSubstitution'):
        _share, *parts = call.args[0].elts
        assert CHECKOUT.joinpath(*(part.value for part in parts)).is_file()


def test_launch_arguments_that_are_used_are_declared():
    for path in LAUNCH_FILES:
        tree = ast.parse(path.read_text())
        declared = {
            call.args[0].value
            for call in _calls(tree, 'DeclareLaunchArgument')
            if isinstance(call.args[0], ast.Constant)
        }
        # ARGUMENTS are declared one by one by the loop over that table.
        for node in tree.body:
            if isinstance(node, ast.Assign) and node.targets[0].id == 'ARGUMENTS':
                declared |= {key.value for key in node.value.keys}
        used = {call.args[0].value for call in _calls(tree, 'LaunchConfiguration')}
        assert used <= declared


def test_rviz_gives_the_pose_where_it_is_heard():
    view = yaml.safe_load((CHECKOUT / 'rviz' / 'slam_observer.rviz').read_text())
    manager = view['Visualization Manager']
    topics = {tool['Class']: tool.get('Topic', {}).get('Value') for tool in manager['Tools']}
    assert topics['rviz_default_plugins/SetInitialPose'] in initial_pose.TOPICS
    # RViz gives it in the fixed frame, and in another one it is refused.
    assert manager['Global Options']['Fixed Frame'] == ObserverNodeSettings().map_frame


@pytest.mark.parametrize(
    'path', sorted((CHECKOUT / 'config').glob('*.yaml')), ids=lambda path: path.name
)
def test_ros_can_read_lists_of_parameter_files(path):
    for section in yaml.safe_load(path.read_text()).values():
        for value in section['ros__parameters'].values():
            assert not isinstance(value, list) or {type(entry) for entry in value} == {float}


def test_simulator_file_lists_every_parameter_with_a_value_in_range():
    content = yaml.safe_load((CHECKOUT / 'config' / 'simulator.yaml').read_text())
    given = content['/**/simulator_node']['ros__parameters']
    rows = {row.name: row for owner in (Scenario, SimulatorNodeSettings) for row in table(owner)}
    assert set(given) == set(rows)
    for name, value in given.items():
        rows[name].check(value)
