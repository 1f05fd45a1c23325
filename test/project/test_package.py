"""What is installed is complete, and says the same everywhere."""

from __future__ import annotations

from distutils.core import run_setup  # setuptools' own where Python has none any more
from importlib.metadata import distribution
from pathlib import Path
import re
import subprocess
import sys

from catkin_pkg.package import parse_package
import pytest
import setuptools  # noqa: F401 (provides distutils)
import yaml

import slam_observer_ros
from slam_observer_ros.cli.main import OPTIONAL_PACKAGES

CHECKOUT = Path(__file__).resolve().parents[2]
NAME = 'slam_observer_ros'
DISTRIBUTION = distribution(NAME)
SCRIPTS = [e for e in DISTRIBUTION.entry_points if e.group == 'console_scripts']
MANIFEST = parse_package(CHECKOUT / 'package.xml')


def test_versions_are_equal_everywhere():
    changelog = (CHECKOUT / 'CHANGELOG.rst').read_text()
    newest = re.search(r'^(\d+\.\d+\.\d+) \(', changelog, re.MULTILINE)
    versions = {
        '__version__': slam_observer_ros.__version__,
        'setup.py': DISTRIBUTION.version,
        'package.xml': MANIFEST.version,
        'CHANGELOG.rst': newest[1],
    }
    assert set(versions.values()) == {slam_observer_ros.__version__}, versions


def test_exported_names_are_imported_only_when_they_are_used():
    code = 'import slam_observer_ros, sys; print(*sys.modules)'
    run = subprocess.run(
        [sys.executable, '-c', code], cwd=CHECKOUT, capture_output=True, text=True, check=True
    )
    assert not {'numpy', 'scipy', 'matplotlib'} & set(run.stdout.split())
    for name in slam_observer_ros.__all__:
        assert getattr(slam_observer_ros, name).__name__ == name
    with pytest.raises(AttributeError, match='Estimater'):
        _ = slam_observer_ros.Estimater


def test_manifest_is_valid_and_agrees_with_setup():
    MANIFEST.validate()
    assert MANIFEST.name == NAME
    assert MANIFEST.get_build_type() == 'ament_python'
    assert MANIFEST.licenses == ['Apache-2.0']
    assert DISTRIBUTION.metadata['Maintainer'] == MANIFEST.maintainers[0].name
    assert DISTRIBUTION.metadata['Maintainer-email'] == MANIFEST.maintainers[0].email


def test_manifest_names_all_message_packages_that_are_imported():
    imports = re.compile(r'^(?:from|import) (\w+_(?:msgs|srvs|interfaces)|rclpy)\b', re.MULTILINE)
    sources = (CHECKOUT / NAME).rglob('*.py')
    imported = {name for source in sources for name in imports.findall(source.read_text())}
    assert imported <= {dependency.name for dependency in MANIFEST.exec_depends}


def test_a_robot_needs_only_debian_packages_and_the_command_line_can_be_asked_for():
    manifest = parse_package(CHECKOUT / 'package.xml')
    needed = {}
    for asked_for in ('', 'yes'):
        manifest.evaluate_conditions({'SLAM_OBSERVER_CLI': asked_for})
        needed[asked_for] = {d.name for d in manifest.exec_depends if d.evaluated_condition}
    debian = {'python3-argcomplete', 'python3-matplotlib', 'python3-rich', 'rviz2'}
    assert needed['yes'] - needed[''] == {*debian, 'python3-rosbags-pip', 'mcap-ros2-support'}
    assert not [name for name in needed[''] if name.endswith('-pip')]
    setup = run_setup(str(CHECKOUT / 'setup.py'), stop_after='init')
    names = {re.split('[><=]', requirement)[0] for requirement in setup.extras_require['cli']}
    assert names == set(OPTIONAL_PACKAGES)


@pytest.mark.parametrize('name', ['.github/workflows/ci.yml', '.pre-commit-config.yaml'])
def test_what_others_run_names_targets_that_exist(name):
    text = (CHECKOUT / name).read_text()
    targets = re.findall(r'^([a-z-]+):', (CHECKOUT / 'Makefile').read_text(), re.MULTILINE)
    named = set(re.findall(r'\bmake ([a-z-]+)', text))
    assert named
    assert named <= set(targets)
    assert yaml.safe_load(text)


def test_all_distributions_and_middlewares_are_tried():
    jobs = yaml.safe_load((CHECKOUT / '.github/workflows/ci.yml').read_text())['jobs']
    matrix = jobs['ros']['strategy']['matrix']
    assert {'jazzy', 'kilted', 'lyrical'} <= set(matrix['distribution'])
    assert {'rmw_fastrtps_cpp', 'rmw_cyclonedds_cpp', 'rmw_zenoh_cpp'} == set(matrix['rmw'])
    setup = run_setup(str(CHECKOUT / 'setup.py'), stop_after='init')
    wheels = jobs['wheels']['strategy']['matrix']['ros']
    assert {f'ros-{name}' for name in wheels} <= set(setup.extras_require)


def test_docs_ros_org_shows_the_pages():
    _kind, content = yaml.safe_load_all((CHECKOUT / 'rosdoc2.yaml').read_text())
    # Where rosdoc2 looks for it: among the settings it would be ignored.
    (builder,) = content['builders']
    assert (CHECKOUT / builder['sphinx']['user_doc_dir'] / 'index.md').is_file()


def test_launch_config_and_rviz_files_are_installed(monkeypatch):
    monkeypatch.chdir(CHECKOUT)
    data_files = dict(run_setup('setup.py', stop_after='init').data_files)
    assert f'resource/{NAME}' in data_files['share/ament_index/resource_index/packages']
    for folder in ('launch', 'config', 'rviz'):
        written = {str(path) for path in Path(folder).iterdir() if path.is_file()}
        assert set(data_files[f'share/{NAME}/{folder}']) == written


def test_there_are_executables():
    """Without the installed package the next test would have nothing to load."""
    assert SCRIPTS


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda script: script.name)
def test_executables_can_be_loaded(script):
    assert callable(script.load())


def test_folders_are_found_by_the_names_that_they_had():
    code = (
        'from slam_observer_ros.geometry import se3\n'
        'from slam_observer_ros.known_map.map_file import read_map\n'
        'from slam_observer_ros.observer.riccati.riccati import RiccatiGains\n'
        'from slam_observer_ros import filter, lie, mapping\n'
        'import slam_observer_ros.filter.riccati.riccati as now\n'
        'assert lie.se3 is se3 and now.RiccatiGains is RiccatiGains\n'
        "assert lie.__spec__.name == 'slam_observer_ros.lie'\n"
        'import slam_observer_ros.geometry.nothing\n'
    )
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=False)
    assert run.stderr.rstrip().endswith("No module named 'slam_observer_ros.lie.nothing'")
