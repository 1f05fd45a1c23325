"""Map → odom for Nav2: the observer as a managed node, and a map server beside it if asked for.

It takes the place of nav2_bringup's localization_launch.py, whose arguments have the same names.
"""

from importlib.util import find_spec

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from slam_observer_ros.nodes.launch_setup import (
    ARGUMENTS,
    check_file,
    check_optional_file,
    check_packages,
    is_true,
    parameters,
    remappings,
)

RESPAWN_DELAY_S = 2.0

LOCALIZATION = PathJoinSubstitution(
    [FindPackageShare('slam_observer_ros'), 'config', 'localization.yaml']
)

HAS_BOND = find_spec('bondpy') is not None
"""Whether the lifecycle manager can notice that the observer has died."""


def start(context):
    """Return the nodes; beside a map server, the lifecycle manager starts both."""
    given = context.launch_configurations
    common = {
        'namespace': given['namespace'],
        'ros_arguments': ['--log-level', given['log_level']],
        'respawn': is_true(given, 'use_respawn'),
        'respawn_delay': RESPAWN_DELAY_S,
        'output': 'screen',
    }
    return [observer(given, common), *map_server(given, common)]


def observer(given, common):
    return Node(
        package='slam_observer_ros',
        executable='lifecycle_observer_node',
        name='observer_node',
        # A robot in a known map would, by default, add to it whatever it sees beside.
        parameters=[
            *([LOCALIZATION] if given['map_file'] else []),
            given['params_file'],
            parameters(given, HAS_BOND),
        ],
        remappings=remappings(given),
        **common,
    )


def map_server(given, common):
    if not given['map']:
        return []
    check_packages('nav2_map_server', 'nav2_lifecycle_manager')
    use_sim_time = {'use_sim_time': is_true(given, 'use_sim_time')}
    managed = {
        'autostart': is_true(given, 'autostart'),
        'node_names': ['map_server', 'observer_node'],
        'bond_timeout': 4.0 if HAS_BOND else 0.0,
    }
    return [
        Node(
            package='nav2_map_server',
            executable='map_server',
            name='map_server',
            parameters=[use_sim_time, {'yaml_filename': given['map']}],
            **common,
        ),
        Node(
            package='nav2_lifecycle_manager',
            executable='lifecycle_manager',
            name='lifecycle_manager_localization',
            parameters=[use_sim_time, managed],
            **common,
        ),
    ]


def generate_launch_description():
    default_parameters = PathJoinSubstitution(
        [FindPackageShare('slam_observer_ros'), 'config', 'wheeled_robot.yaml']
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file', default_value=default_parameters, description='parameter file'
            ),
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=check_file, args=['params_file']),
            OpaqueFunction(function=check_optional_file, args=['map_file', True]),
            OpaqueFunction(function=check_optional_file, args=['map']),
            OpaqueFunction(function=start),
        ]
    )
