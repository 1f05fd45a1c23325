"""Start the observer alone, with a parameter file and topics of one's own robot."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from slam_observer_ros.nodes.launch_setup import check_file


def generate_launch_description():
    share = FindPackageShare('slam_observer_ros')
    default_parameters = PathJoinSubstitution([share, 'config', 'observer.yaml'])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file', default_value=default_parameters, description='parameter file'
            ),
            DeclareLaunchArgument(
                'twist', default_value='twist', description='topic of the velocity'
            ),
            DeclareLaunchArgument(
                'landmarks', default_value='landmarks', description='topic of the observations'
            ),
            DeclareLaunchArgument(
                'imu', default_value='imu', description='topic of the angular velocity'
            ),
            DeclareLaunchArgument(
                'camera_info',
                default_value='camera_info',
                description='topic of the calibration of the camera, for detections of pixels',
            ),
            DeclareLaunchArgument(
                'landmark_map', default_value='landmark_map', description='topic of the landmarks'
            ),
            DeclareLaunchArgument(
                'odometry', default_value='~/odometry', description='topic of the estimate'
            ),
            DeclareLaunchArgument(
                'pose', default_value='pose', description='topic of the pose, as amcl_pose'
            ),
            DeclareLaunchArgument(
                'namespace', default_value='', description='namespace of the robot'
            ),
            DeclareLaunchArgument(
                'use_sim_time', default_value='false', description='whether /clock gives the time'
            ),
            OpaqueFunction(function=check_file, args=['params_file']),
            Node(
                package='slam_observer_ros',
                executable='observer_node',
                name='observer_node',
                namespace=LaunchConfiguration('namespace'),
                parameters=[
                    LaunchConfiguration('params_file'),
                    {'use_sim_time': LaunchConfiguration('use_sim_time')},
                ],
                remappings=[
                    ('twist', LaunchConfiguration('twist')),
                    ('landmarks', LaunchConfiguration('landmarks')),
                    ('imu', LaunchConfiguration('imu')),
                    ('camera_info', LaunchConfiguration('camera_info')),
                    ('landmark_map', LaunchConfiguration('landmark_map')),
                    ('~/odometry', LaunchConfiguration('odometry')),
                    ('pose', LaunchConfiguration('pose')),
                ],
                output='screen',
            ),
        ]
    )
