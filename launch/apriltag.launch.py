"""AprilTags in a camera's image to map → odom: detector, camera mount and observer.

Arguments of localization.launch.py, which is included, may be given as well.
"""

from pathlib import PurePosixPath

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from slam_observer_ros.nodes.launch_setup import check_packages, numbers

SHARE = FindPackageShare('slam_observer_ros')

ARGUMENTS = {
    'namespace': ('', 'namespace of the robot'),
    'image': ('/camera/image_rect', 'topic of the rectified image'),
    'camera_info': ('', "topic of its calibration; empty: camera_info in the image's namespace"),
    'tag_family': ('36h11', 'family of the tags, as apriltag_ros names it'),
    'base_frame': (
        '',
        'frame of the robot, in which camera_pose is; empty: as params_file says, and base_link '
        'for camera_pose',
    ),
    'camera_frame': (
        '',
        "the image's frame, to be put at camera_pose; empty: it is on /tf",
    ),
    'camera_pose': (
        '0 0 0 0 0 0',
        'x y z roll pitch yaw in m and rad; zeros look ahead',
    ),
}

OPTICAL_AXES = ['--qx', '-0.5', '--qy', '0.5', '--qz', '-0.5', '--qw', '0.5']
"""Rotation of the optical frame, z forward and y down, in the camera's, x forward and z up."""


def check(context):
    """Raise a RuntimeError for what is missing or can't be read, before anything is started."""
    given = context.launch_configurations
    check_packages('apriltag_ros', *(['tf2_ros'] if given['camera_frame'] else []))
    for name, count in (('tag_size', 1), ('camera_pose', 6)):
        values = numbers(given, name, count)
    if any(values) and not given['camera_frame']:
        raise RuntimeError("camera_pose needs camera_frame: the frame of the image's header")


def start(context):
    """Return detector and mount."""
    given = context.launch_configurations
    detector = Node(
        package='apriltag_ros',
        executable='apriltag_node',
        name='apriltag',
        namespace=given['namespace'],
        parameters=[
            {
                'family': given['tag_family'],
                'size': float(given['tag_size']),
                # By homography the axes of the tag's frame are others.
                'pose_estimation_method': 'pnp',
            }
        ],
        remappings=[
            ('image_rect', given['image']),
            *calibration(given),
            ('/tf', 'tf'),
        ],
        output='screen',
    )
    return [detector, *mount(given)]


def calibration(given):
    """Return the remapping of the calibration: image_transport looks for it beside the image."""
    if not given['camera_info']:
        return []
    return [(str(PurePosixPath(given['image']).with_name('camera_info')), given['camera_info'])]


def mount(given):
    """Return what publishes the camera's pose: of its body, ahead x, and of the image, ahead z."""
    if not given['camera_frame']:
        return []
    x, y, z, roll, pitch, yaw = (str(number) for number in numbers(given, 'camera_pose', 6))
    pose = ['--x', x, '--y', y, '--z', z, '--roll', roll, '--pitch', pitch, '--yaw', yaw]
    body = f'{given["camera_frame"]}_mount'
    return [
        static_transform(given, pose, given['base_frame'] or 'base_link', body),
        static_transform(given, OPTICAL_AXES, body, given['camera_frame']),
    ]


def static_transform(given, pose, parent, child):
    return Node(
        package='tf2_ros',
        executable='static_transform_publisher',
        namespace=given['namespace'],
        arguments=[*pose, '--frame-id', parent, '--child-frame-id', child],
        remappings=[('/tf_static', 'tf_static')],
    )


def generate_launch_description():
    default_parameters = PathJoinSubstitution([SHARE, 'config', 'apriltags.yaml'])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file', default_value=default_parameters, description='parameter file'
            ),
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            # Without a default: one that is wrong would scale the whole map.
            DeclareLaunchArgument(
                'tag_size',
                description='edge of the black square, metres, for detector and observer',
            ),
            OpaqueFunction(function=check),
            IncludeLaunchDescription(
                PathJoinSubstitution([SHARE, 'launch', 'localization.launch.py']),
                launch_arguments=[
                    ('params_file', LaunchConfiguration('params_file')),
                    ('landmarks', 'detections'),
                    ('tag_size', LaunchConfiguration('tag_size')),
                ],
            ),
            OpaqueFunction(function=start),
        ]
    )
