"""Map → odom for Nav2: the observer as a managed node, and a map server beside it if asked for.

It takes the place of nav2_bringup's localization_launch.py, whose arguments have the same names.
"""

from importlib.util import find_spec

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from slam_observer_ros.nodes.launch_arguments import (
    check_file,
    check_optional_file,
    check_packages,
)

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
    'map_file': ('', 'landmarks to be localised among; empty: as params_file says'),
    'map': ('', 'occupancy grid for a map server, a YAML file; empty: none is started'),
}

INPUTS_AND_OUTPUTS = ('twist', 'landmarks', 'imu', 'pose')
RESPAWN_DELAY_S = 2.0

HAS_BOND = find_spec('bondpy') is not None
"""Whether the lifecycle manager can notice that the observer has died."""


def start(context):
    """Return the nodes; beside a map server, the lifecycle manager starts both."""
    given = context.launch_configurations
    common = {
        'namespace': given['namespace'],
        'ros_arguments': ['--log-level', given['log_level']],
        'respawn': is_true(given['use_respawn']),
        'respawn_delay': RESPAWN_DELAY_S,
        'output': 'screen',
    }
    return [observer(given, common), *map_server(given, common)]


def observer(given, common):
    overrides = {
        'use_sim_time': is_true(given['use_sim_time']),
        'autostart_node': is_true(given['autostart']) and not given['map'],
        'bond_heartbeat_period': 0.25 if given['map'] and HAS_BOND else 0.0,
    }
    if given['map_file']:
        overrides['map_file'] = given['map_file']
    return Node(
        package='slam_observer_ros',
        executable='lifecycle_observer_node',
        name='observer_node',
        parameters=[given['params_file'], overrides],
        remappings=[
            *((name, given[name]) for name in INPUTS_AND_OUTPUTS),
            ('~/odometry', given['odometry']),
            # as Nav2's nodes have it: each robot has its own below its namespace
            ('/tf', 'tf'),
            ('/tf_static', 'tf_static'),
        ],
        **common,
    )


def map_server(given, common):
    if not given['map']:
        return []
    check_packages('nav2_map_server', 'nav2_lifecycle_manager')
    use_sim_time = {'use_sim_time': is_true(given['use_sim_time'])}
    managed = {
        'autostart': is_true(given['autostart']),
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


def is_true(written):
    return written.lower() in ('true', '1')


def generate_launch_description():
    default_parameters = PathJoinSubstitution(
        [FindPackageShare('slam_observer_ros'), 'config', 'observer.yaml']
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
            OpaqueFunction(function=check_optional_file, args=['map_file']),
            OpaqueFunction(function=check_optional_file, args=['map']),
            OpaqueFunction(function=start),
        ]
    )
