"""Parameters that belong to the nodes themselves, not to the estimator or the simulation."""

from __future__ import annotations

from dataclasses import dataclass

from slam_observer_ros.parameters import parameter

AUTO = 'auto'
"""Message type parameter: take the type that is found on the topic."""


@dataclass(frozen=True)
class ObserverNodeSettings:
    """What ``observer_node`` adds to the estimator's settings."""

    velocity_type: str = parameter(
        AUTO,
        'Message type on twist; auto takes the type found on the topic',
        choices=(AUTO, 'Twist', 'TwistStamped', 'Odometry'),
    )
    landmarks_type: str = parameter(
        AUTO,
        'Message type on landmarks; auto takes the type found on the topic',
        choices=(AUTO, 'PointCloud', 'PointCloud2'),
    )
    map_frame: str = parameter('map', 'Frame of the estimated pose and landmarks')
    base_frame: str = parameter(
        'base_link', 'Frame of the robot, in which velocity and landmarks are measured'
    )
    publish_rate: float = parameter(
        50.0,
        'Highest rate of odometry, pose, lyapunov, landmark_estimates and /tf',
        unit='Hz',
        minimum=0.1,
        maximum=1000.0,
    )
    publish_tf: bool = parameter(True, 'Whether map_frame to base_frame is published on /tf')
    path_length: int = parameter(
        2000, 'Most poses kept in path; the oldest go first', minimum=1, maximum=100_000
    )
    map_file: str = parameter(
        '', 'Map to load at the start: one saved earlier, or surveyed landmarks; empty for none'
    )
    map_path: str = parameter(
        '', 'File of ~/save_map, ~/load_map and autosave_map', read_only=False
    )
    autosave_map: bool = parameter(False, 'Whether the map is saved to map_path at the end')


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
    )
    truth_frame: str = parameter('world', 'Frame of the true pose and landmarks')
    map_frame: str = parameter(
        'map', "Frame of the observer's estimate; /tf_static tells where in truth_frame it starts"
    )
    base_frame: str = parameter('base_link', 'Frame of the velocity and the observations')
