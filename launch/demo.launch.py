"""Start the paper's simulation, the observer and, if asked, RViz."""

from ament_index_python.packages import get_package_prefix, PackageNotFoundError
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
)
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('slam_observer_ros')


def rviz(_context):
    """Return RViz with its view, or what says that it is not there, as on most robots."""
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        return [LogInfo(msg='rviz2 is not installed: the demo runs without it')]
    view = PathJoinSubstitution([SHARE, 'rviz', 'slam_observer.rviz'])
    return [Node(package='rviz2', executable='rviz2', arguments=['-d', view])]


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'rviz', default_value='true', description='whether to start RViz'
            ),
            # First what may fail: launch would leave behind what it has started before.
            OpaqueFunction(function=rviz, condition=IfCondition(LaunchConfiguration('rviz'))),
            IncludeLaunchDescription(
                PathJoinSubstitution([SHARE, 'launch', 'observer.launch.py'])
            ),
            Node(
                package='slam_observer_ros',
                executable='simulator_node',
                name='simulator_node',
                parameters=[PathJoinSubstitution([SHARE, 'config', 'simulator.yaml'])],
                output='screen',
            ),
        ]
    )
