"""The documentation is true of the code: tables, commands, links, views."""

from __future__ import annotations

import ast
from distutils.core import run_setup  # setuptools' own where Python has none any more
import inspect
from itertools import pairwise
import json
from pathlib import Path
import re
import shlex
import subprocess
import sys
import tempfile

import pytest
import setuptools  # noqa: F401 (provides distutils)
import yaml

from slam_observer_ros.cli.main import make_parser
from slam_observer_ros.estimator.estimator import Estimator
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.mapping.map_file import read_map
from slam_observer_ros.nodes import launch_setup
from slam_observer_ros.report.summary import as_json, identity
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings, SimulatorNodeSettings
from slam_observer_ros.settings.parameter_table import table
from slam_observer_ros.simulation import Scenario

CHECKOUT = Path(__file__).resolve().parents[2]
PAGES = [CHECKOUT / 'README.md', CHECKOUT / 'CONTRIBUTING.md', *CHECKOUT.glob('docs/*.md')]
TABLES_OF_NODES = {
    'observer_node': (Settings, ObserverNodeSettings),
    'lifecycle_observer_node': (Settings, ObserverNodeSettings),
    'simulator_node': (Scenario, SimulatorNodeSettings),
}

pages = pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)


def blocks(page, language):
    """The page's fenced blocks of a language."""
    return re.findall(rf'^```{language}\n(.*?)^```', page.read_text(), re.MULTILINE | re.DOTALL)


def commands(page, program):
    """Arguments of all console lines that begin with a program."""
    lines = [line for block in blocks(page, 'console') for line in block.splitlines()]
    words = [shlex.split(line[2:], comments=True) for line in lines if line.startswith('$ ')]
    return [w[len(program) :] for w in words if w[: len(program)] == program]


def parameters_of(executable):
    """Rows of all tables of a node, by name."""
    return {row.name: row for settings in TABLES_OF_NODES[executable] for row in table(settings)}


def write_docs(*options):
    return subprocess.run(
        [sys.executable, CHECKOUT / 'scripts' / 'write_docs.py', *options],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.fixture(scope='module')
def published():
    """Types of all topics that the nodes publish, by relative name."""
    run = write_docs('--json')
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.ros
def test_tables_are_current():
    run = write_docs('--check')
    assert run.returncode == 0, run.stdout + run.stderr


@pages
def test_slam_observer_understands_every_command(page):
    for arguments in commands(page, ['slam-observer']):
        make_parser(arguments).parse_args(arguments)


@pages
def test_run_commands_name_existing_executables_and_parameters(page):
    entry_points = run_setup(str(CHECKOUT / 'setup.py'), stop_after='init').entry_points
    executables = {entry.split(' = ')[0] for entry in entry_points['console_scripts']}
    for executable, *arguments in commands(page, ['ros2', 'run', 'slam_observer_ros']):
        assert executable in executables
        rows = parameters_of(executable)
        for option, value in pairwise(arguments):
            assert option != '-p' or value.partition(':=')[0] in rows


@pages
def test_launch_commands_name_existing_files_and_arguments(page):
    for file, *arguments in commands(page, ['ros2', 'launch', 'slam_observer_ros']):
        declared = launch_arguments(file)
        assert {argument.partition(':=')[0] for argument in arguments} <= declared


def launch_arguments(file):
    """Return the names of a launch file's arguments, with the ones of a file that it includes."""
    tree = ast.parse((CHECKOUT / 'launch' / file).read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    names = {
        call.args[0].value
        for call in calls
        if getattr(call.func, 'id', '') == 'DeclareLaunchArgument'
        and isinstance(call.args[0], ast.Constant)
    }
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    if 'localization.launch.py' in texts:
        names |= launch_arguments('localization.launch.py')
    imported = {getattr(node, 'module', '') for node in tree.body}
    if launch_setup.__name__ in imported:
        names |= set(launch_setup.ARGUMENTS)
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], 'id', '') == 'ARGUMENTS':
            names |= {key.value for key in node.value.keys}
    return names


@pages
def test_make_commands_name_existing_targets(page):
    targets = set(re.findall(r'^([a-z-]+):', (CHECKOUT / 'Makefile').read_text(), re.MULTILINE))
    assert {target for target, *_ in commands(page, ['make'])} <= targets


@pages
def test_parameter_names_and_values_are_right(page):
    rows = parameters_of('observer_node')
    for block in blocks(page, 'yaml'):
        content = yaml.safe_load(block)
        if isinstance(content, dict) and 'ros__parameters' in content.get('/**', {}):
            for name, value in content['/**']['ros__parameters'].items():
                rows[name].check(value)
                # ROS refuses lists that mix integers and others.
                assert not isinstance(value, list) or {type(entry) for entry in value} == {float}
    for _node, name, value in commands(page, ['ros2', 'param', 'set']):
        rows[name].check(yaml.safe_load(value))


@pytest.mark.parametrize(
    ('name', 'page'), [('wheeled_robot.yaml', 'my_robot.md'), ('apriltags.yaml', 'apriltags.md')]
)
def test_parameter_files_that_are_shown_are_those_that_are_shipped(name, page):
    shipped = (CHECKOUT / 'config' / name).read_text()
    assert shipped in blocks(CHECKOUT / 'docs' / page, 'yaml')


def test_all_counts_are_explained():
    page = (CHECKOUT / 'docs' / 'topics.md').read_text()
    names = re.findall(r"``'(\w+)'``", Estimator.counts.__doc__)
    assert len(names) > 10
    for name in names:
        assert f'`used: {name}`' in page


def test_all_keys_of_json_are_explained():
    page = (CHECKOUT / 'docs' / 'recordings.md').read_text()
    source = inspect.getsource(identity) + inspect.getsource(as_json)
    keys = re.findall(r"^        '(\w+)': ", source, re.MULTILINE)
    assert re.findall(r'^\| `(\w+)` ', page, re.MULTILINE) == keys


@pages
def test_maps_can_be_read(page, tmp_path):
    for block in blocks(page, 'yaml'):
        if block.startswith('format:'):
            path = tmp_path / 'map.yaml'
            path.write_text(block)
            assert isinstance(read_map(path), LandmarkMap)


@pages
def test_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))  # a page makes a folder that stays
    for block in blocks(page, 'python'):
        if '@reads' not in block:  # what is registered stays: test_registry.py runs that
            exec(compile(block, page.name, 'exec'), {})


@pages
def test_links_lead_somewhere(page):
    for target in re.findall(r'(?:\]\(|src=")([^)"\s]+)', page.read_text()):
        path, _, anchor = target.partition('#')
        if re.match(r'https?:', target):
            continue
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert not anchor or anchor in anchors(linked), target


def anchors(page):
    """Anchors that GitHub and mkdocs give to a page's headings."""
    headings = re.findall(r'^#+ (.*)', page.read_text(), re.MULTILINE)
    words = [re.sub(r'[^\w -]', '', heading).strip().lower() for heading in headings]
    return {heading.replace(' ', '-') for heading in words}


def test_site_has_every_page():
    navigation = (CHECKOUT / 'mkdocs.yml').read_text()
    for page in CHECKOUT.glob('docs/*.md'):
        assert f': {page.name}\n' in navigation


@pages
def test_pages_name_no_place_of_one_machine(page):
    assert not re.search(r'(?<![\w.$~])/(?:work|home|root|tmp)/', page.read_text())


@pytest.mark.ros
def test_foxglove_shows_topics_that_are_published(published):
    layout = json.loads((CHECKOUT / 'foxglove' / 'slam_observer.json').read_text())
    panels = layout['configById']
    shown = set(panels['3D!scene']['topics'])
    for panel in panels.values():
        shown |= {path['value'].split('.')[0] for path in panel.get('paths', ())}
        shown |= {panel[name] for name in ('topicToRender',) if name in panel}
    names = {f'/{name.lstrip("/").replace("~", "observer_node")}' for name in published}
    assert shown <= names
    assert set(panels_of(layout['layout'])) == set(panels)


def panels_of(layout):
    """Names of the panels in a layout's tree."""
    if isinstance(layout, str):
        return [layout]
    return [*panels_of(layout['first']), *panels_of(layout['second'])]


@pytest.mark.ros
def test_rviz_shows_topics_of_their_types(published):
    view = yaml.safe_load((CHECKOUT / 'rviz' / 'slam_observer.rviz').read_text())
    displays = view['Visualization Manager']['Displays']
    shown = {d['Topic']['Value']: d['Class'].split('/')[1] for d in displays if 'Topic' in d}
    for topic, display in shown.items():
        message = published[topic].split('/')[1]
        assert message.removesuffix('Stamped') == display.removesuffix('Stamped')


def test_citation_has_the_version():
    citation = yaml.safe_load((CHECKOUT / 'CITATION.cff').read_text())
    setup = run_setup(str(CHECKOUT / 'setup.py'), stop_after='init')
    assert citation['version'] == setup.get_version()


def test_the_readme_is_read_in_a_few_minutes():
    assert len((CHECKOUT / 'README.md').read_text().split()) <= 800
