"""What launch files check, and how ``localization.launch.py`` sets the observer up."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_prefix, PackageNotFoundError

from slam_observer_ros.nodes.ros_node import install_command


def check_file(context: Any, name: str, may_be_folder: bool = False) -> None:
    """Expand ~ in a launch argument; raise a RuntimeError, not a warning, if no file is there."""
    written = context.launch_configurations[name]
    try:
        path = Path(written).expanduser().absolute()
    except RuntimeError as error:  # of a user that there is none of
        raise RuntimeError(f"{name}: no file '{written}': {error}") from error
    if not (path.is_file() or (may_be_folder and path.is_dir())):
        raise RuntimeError(f"{name}: no file '{path}'")
    context.launch_configurations[name] = str(path)


def check_optional_file(context: Any, name: str, may_be_folder: bool = False) -> None:
    """Do the same, unless the argument is empty."""
    if context.launch_configurations[name]:
        check_file(context, name, may_be_folder)


def check_packages(*names: str) -> None:
    """Raise a RuntimeError that says what to install, if a package is missing."""
    for name in names:
        try:
            get_package_prefix(name)
        except PackageNotFoundError as error:
            raise RuntimeError(f'{name} is not installed: {install_command(name)}') from error


def is_true(given: Mapping[str, str], name: str) -> bool:
    """Return what a launch argument says; raise a RuntimeError if that is neither yes nor no."""
    written = given[name].lower()
    if written not in ('true', '1', 'false', '0'):
        raise RuntimeError(f"{name}: '{given[name]}' is neither true nor false")
    return written in ('true', '1')


def numbers(given: Mapping[str, str], name: str, count: int) -> list[float]:
    """Return the numbers of a launch argument; raise a RuntimeError unless there are ``count``."""
    words = given[name].replace(',', ' ').split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count:
        wanted = 'a number' if count == 1 else f'{count} numbers'
        raise RuntimeError(f"{name}: '{given[name]}' is not {wanted}")
    return values


# Launch arguments beside params_file: default and description.
ARGUMENTS = {
    'namespace': ('', 'namespace of the robot'),
    'use_sim_time': ('false', 'whether /clock gives the time'),
    'autostart': ('true', 'whether the nodes are configured and activated at once'),
    'use_respawn': ('false', 'whether nodes that have ended are started again'),
    'log_level': ('info', 'least severity that is logged'),
    'twist': ('odom', 'topic of the velocity'),
    'landmarks': ('landmarks', 'topic of the observations'),
    'imu': ('imu', 'topic of the angular velocity'),
    'camera_info': ('camera_info', 'topic of the calibration of the camera, for pixels'),
    'odometry': ('~/odometry', 'topic of the estimate'),
    'pose': ('amcl_pose', 'topic of the pose'),
    'base_frame': ('', 'frame of the robot; empty: as params_file says'),
    'map_file': (
        '',
        'landmarks to be localised among, or a folder of such maps; empty: as params_file says',
    ),
    'tag_size': ('', 'edge of square tags, metres; empty: as params_file says'),
    'map': ('', 'occupancy grid for a map server, a YAML file; empty: none is started'),
}

EXECUTABLE, NAME = 'lifecycle_observer_node', 'observer_node'
BOND_PERIOD_S = 0.25


def parameters(given: Mapping[str, str], has_bond: bool) -> dict[str, object]:
    """Return the parameters that params_file has not.

    Beside a map server the lifecycle manager activates the node, with a bond if it can have one.
    """
    is_managed = bool(given['map'])
    chosen: dict[str, object] = {
        'use_sim_time': is_true(given, 'use_sim_time'),
        'autostart_node': is_true(given, 'autostart') and not is_managed,
        'bond_heartbeat_period': BOND_PERIOD_S if is_managed and has_bond else 0.0,
    }
    chosen |= {name: given[name] for name in ('base_frame', 'map_file') if given[name]}
    if given['tag_size']:
        (chosen['tag_size'],) = numbers(given, 'tag_size', 1)
    return chosen


def remappings(given: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the node's remappings."""
    return [
        *((name, given[name]) for name in ('twist', 'landmarks', 'imu', 'camera_info', 'pose')),
        ('~/odometry', given['odometry']),
        # as Nav2's nodes have it: each robot has its own below its namespace
        ('/tf', 'tf'),
        ('/tf_static', 'tf_static'),
    ]


def command_line(params_file: str, arguments: Mapping[str, str]) -> list[str]:
    """Return the arguments with which the launch file starts the executable."""
    given = {name: default for name, (default, _) in ARGUMENTS.items()} | dict(arguments)
    chosen = [  # as YAML has it
        f'{name}:={str(value).lower() if isinstance(value, bool) else value}'
        for name, value in parameters(given, False).items()
    ]
    names = [f'__node:={NAME}', f'__ns:=/{given["namespace"]}']
    names += [f'{name}:={topic}' for name, topic in remappings(given)]
    return [
        '--ros-args',
        *('--params-file', params_file),
        *(word for each in chosen for word in ('-p', each)),
        *(word for each in names for word in ('-r', each)),
        *('--log-level', given['log_level']),
    ]
