"""Start the paper's simulation, the observer and, if asked, RViz."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    share = FindPackageShare('slam_observer_ros')
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'rviz', default_value='true', description='whether to start RViz'
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, 'launch', 'observer.launch.py'])
            ),
            Node(
                package='slam_observer_ros',
                executable='simulator_node',
                name='simulator_node',
                parameters=[PathJoinSubstitution([share, 'config', 'simulator.yaml'])],
                output='screen',
            ),
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=['-d', PathJoinSubstitution([share, 'rviz', 'slam_observer.rviz'])],
                condition=IfCondition(LaunchConfiguration('rviz')),
            ),
        ]
    )
