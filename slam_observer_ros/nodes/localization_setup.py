"""How ``localization.launch.py`` sets the observer up; ``make robot`` does it likewise."""

from __future__ import annotations

from collections.abc import Mapping

from slam_observer_ros.nodes.launch_arguments import is_true, numbers

ARGUMENTS = {
    'namespace': ('', 'namespace of the robot'),
    'use_sim_time': ('false', 'whether time is that of /clock'),
    'autostart': ('true', 'whether the nodes are configured and activated at once'),
    'use_respawn': ('false', 'whether nodes that have ended are started again'),
    'log_level': ('info', 'least severity that is logged'),
    'twist': ('odom', 'topic of the velocity'),
    'landmarks': ('landmarks', 'topic of the observations'),
    'imu': ('imu', 'topic of the angular velocity'),
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
"""Launch arguments beside params_file: default and description."""

EXECUTABLE, NAME = 'lifecycle_observer_node', 'observer_node'

BOND_PERIOD_S = 0.25


def parameters(given: Mapping[str, str], has_bond: bool) -> dict[str, object]:
    """Return the parameters beside those of params_file.

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
        *((name, given[name]) for name in ('twist', 'landmarks', 'imu', 'pose')),
        ('~/odometry', given['odometry']),
        # as Nav2's nodes have it: each robot has its own below its namespace
        ('/tf', 'tf'),
        ('/tf_static', 'tf_static'),
    ]


def command_line(params_file: str, arguments: Mapping[str, str]) -> list[str]:
    """Return the arguments with which the launch file starts the executable."""
    given = {name: default for name, (default, _) in ARGUMENTS.items()} | dict(arguments)
    chosen = [f'{name}:={_yaml(value)}' for name, value in parameters(given, False).items()]
    names = [f'__node:={NAME}', f'__ns:=/{given["namespace"]}']
    names += [f'{name}:={topic}' for name, topic in remappings(given)]
    return [
        '--ros-args',
        *('--params-file', params_file),
        *(word for each in chosen for word in ('-p', each)),
        *(word for each in names for word in ('-r', each)),
        *('--log-level', given['log_level']),
    ]


def _yaml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
