"""Parameters that belong to the nodes themselves, not to the estimator or the simulation."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.settings.input_settings import AUTO, InputSettings, short_names
from slam_observer_ros.settings.parameter_table import parameter


@dataclass(frozen=True)
class ObserverNodeSettings(InputSettings):
    """What ``observer_node`` adds to the settings of the estimator and its inputs."""

    velocity_type: str = parameter(
        AUTO,
        'Message type on twist; auto takes the type found there',
        choices=lambda: (AUTO, *short_names('velocity')),
        basic=True,
    )
    landmarks_max_wait: float = parameter(
        0.05,
        'Overload: once a message on landmarks has waited this long, only the newest of each '
        'sensor is used; velocities are all used',
        unit='s',
        minimum=0.0,
        maximum=60.0,
    )
    transform_tolerance: float = parameter(
        1.0,
        'How far map_frame to odom_frame is post-dated beyond reorder_window, to hold until '
        'the next one; others see a correction that much later, the motion at once',
        unit='s',
        minimum=0.0,
        maximum=10.0,
    )
    max_clock_offset: float = parameter(
        1.0,
        'Stamps that are further than this from the time of reception come from another clock',
        unit='s',
        minimum=1e-3,
        maximum=1e9,
    )
    correct_clock_offset: bool = parameter(
        False, "Whether stamps from another clock are moved to this machine's time"
    )
    publish_rate: float = parameter(
        50.0,
        'Highest rate of odometry, pose, lyapunov, landmark_estimates and /tf',
        unit='Hz',
        minimum=0.1,
        maximum=1000.0,
    )
    publish_tf: bool = parameter(
        True, 'Whether map_frame to odom_frame or base_frame is published on /tf', basic=True
    )
    invert_tf: bool = parameter(
        False, 'Whether the transform on /tf is its inverse, with map_frame below'
    )
    position_limits: tuple[float, float] = parameter(
        (0.5, 2.0),
        'Standard deviation of the position, in its worst direction, from which on /diagnostics '
        'warns, and from which on it is an error, and ~/is_localised is false',
        unit='m',
        minimum=0.0,
        maximum=1e6,
    )
    heading_limits: tuple[float, float] = parameter(
        (0.2, 0.5), 'The same of the heading', unit='rad', minimum=0.0, maximum=1e6
    )
    map_file: str = parameter(
        '',
        'Map to load at the start, saved or surveyed; or a folder of maps, in one of which the'
        ' robot is found; empty for none',
        basic=True,
    )
    map_path: str = parameter(
        '', 'File of ~/save_map, ~/load_map and autosave_map', read_only=False
    )
    pose_file: str = parameter(
        '',
        'File that keeps the pose, every two seconds and at the end, for the next start, as '
        '~/.ros/observer_pose.yaml; empty for none',
    )
    pose_file_max_age: float = parameter(
        600.0,
        "Age, by the system's clock, up to which that file is used",
        unit='s',
        minimum=0.0,
        maximum=1e9,
    )
    autosave_map: bool = parameter(False, 'Whether the map is saved to map_path at the end')

    def with_checked_frames(self) -> ObserverNodeSettings:
        """Return the settings with plain frames that differ.

        Raises
        ------
        ParameterError
            If map or base has no name, or two of map, odometry and base have the same; it says
            what to do.

        """
        plain = self.with_plain_frames()
        plain.check_named('base_frame')
        plain.check_frames_differ()
        return plain


@dataclass(frozen=True)
class ManagedNodeSettings:
    """What ``lifecycle_observer_node`` adds; both as Nav2's nodes have them."""

    autostart_node: bool = parameter(
        False, 'Whether the node configures and activates itself at its start'
    )
    bond_heartbeat_period: float = parameter(
        0.0,
        "Period of the bond's heartbeats to Nav2's lifecycle manager, which needs bondpy; 0 for "
        'no bond',
        unit='s',
        minimum=0.0,
        maximum=10.0,
    )


@dataclass(frozen=True)
class SimulatorNodeSettings:
    """What ``simulator_node`` adds to the scenario."""

    stamped: bool = parameter(False, 'Whether twist carries TwistStamped in place of Twist')
    landmarks_type: str = parameter(
        'PointCloud', 'Message type on landmarks', choices=('PointCloud', 'PointCloud2')
    )
    real_time_factor: float = parameter(
        1.0,
        'Simulated seconds a second; other than 1 the node publishes /clock',
        minimum=0.01,
        maximum=1000.0,
    )
    wait_for_subscribers: int = parameter(
        1,
        'Subscribers that twist and landmarks must have before the robot starts',
        minimum=0,
        maximum=1000,
    )
    truth_frame: str = parameter('world', 'Frame of the true pose and landmarks')
    map_frame: str = parameter(
        'map', "Frame of the observer's estimate; /tf_static has its pose in truth_frame"
    )
    base_frame: str = parameter('base_link', 'Frame of the velocity and the observations')
