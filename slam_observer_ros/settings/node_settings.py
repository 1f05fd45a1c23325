"""Parameters beside the estimator's: what is read of messages, frames, and what nodes do.

Decoders in ``messages/`` register the types that are read. This lies below them, as parameters
offer these types, which are listed nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from itertools import combinations
from pkgutil import iter_modules
from typing import Any, Literal, TypeAlias, TypeVar

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.settings.parameter_table import parameter, Pose6

Role: TypeAlias = Literal['velocity', 'angular velocity', 'landmarks', 'pose']

_PACKAGE = 'slam_observer_ros.messages'


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type that is read, as ROS 2 names it, and what decodes it.

    Attributes
    ----------
    package : str
        What publishes it, as documents name that; empty for many.
    definition : str
        Its fields, nested types behind them as in recordings; empty for types of ROS's
        common interfaces. Recordings that define it otherwise are refused.
    is_ambiguous : bool
        Whether it may hold other things, too: it is only taken where the user names type or topic.

    """

    name: str
    role: Role
    decode: Callable[..., Any]
    module: str
    package: str = ''
    definition: str = ''
    is_ambiguous: bool = False

    @property
    def short_name(self) -> str:
        """Name without package, as parameters have it."""
        return self.name.rpartition('/')[2]


_REGISTERED: dict[tuple[Role, str], MessageType] = {}


def register(message_type: MessageType) -> None:
    """Add a type; ValueError if another decoder reads the same of it."""
    key = message_type.role, message_type.name
    if key in _REGISTERED:
        raise ValueError(f'{message_type.name} is read by {_REGISTERED[key].module} already')
    _REGISTERED[key] = message_type


def message_types(role: Role) -> dict[str, MessageType]:
    """Return the types that are read, or a part of them, by name.

    Where a live topic carries several the first is taken: they are in the order of the decoders'
    modules, and in these as they are written.
    """
    _import_decoders()
    ordered = sorted(_REGISTERED.values(), key=lambda message_type: message_type.module)
    return {known.name: known for known in ordered if known.role == role}


def short_names(role: Role, is_ambiguous: bool | None = None) -> tuple[str, ...]:
    """Return the names of the same types as parameters have them, or only of some."""
    types = message_types(role).values()
    some = [known for known in types if is_ambiguous in (None, known.is_ambiguous)]
    return tuple(dict.fromkeys(known.short_name for known in some))


@cache
def _import_decoders() -> None:
    for module in iter_modules(import_module(_PACKAGE).__path__):
        import_module(f'{_PACKAGE}.{module.name}')


AUTO = 'auto'  # message type parameter: take the type that is found on the topic
ON_TF = 'tf'  # landmarks are fiducials whose positions, and ids in the names of frames, are on /tf
POSE_DIFFERENCES = 'pose_differences'  # velocity source: the differences of an odometry's poses

InputSettingsT = TypeVar('InputSettingsT', bound='InputSettings')


@dataclass(frozen=True)
class InputSettings:
    """How measurements become events; the node has these parameters, and so has a replay."""

    # fmt: off
    velocity_source: str = parameter(
        'twist', 'What of Odometry is used: its twist, or the differences of its poses',
        choices=('twist', POSE_DIFFERENCES))
    use_imu: bool = parameter(
        False, 'Whether the angular velocity comes from imu, and only the linear one from twist')
    landmarks_type: str = parameter(
        AUTO, 'Message type on landmarks; auto takes the type found there, tf takes fiducials on '
        '/tf', choices=lambda: (AUTO, *short_names('landmarks'), ON_TF), basic=True)
    tag_frame_prefix: str = parameter(
        'tag_', "Name of a fiducial's frame before its id; family:id, as of apriltag_ros, fits "
        'too')
    image_is_rectified: bool = parameter(
        True, 'Whether 2D detections are pixels of the rectified image, as fiducials always are; '
        "otherwise CameraInfo's distortion is taken out")
    map_frame: str = parameter('map', 'Frame of the estimated pose and landmarks', basic=True)
    odom_frame: str = parameter(
        'odom', 'Odometry frame: if /tf has odom_frame to base_frame, map_frame to odom_frame is '
        'published; empty for never', basic=True)
    base_frame: str = parameter(
        'base_link', 'Frame of the robot, whose pose is estimated', basic=True)
    sensor_frame: str = parameter(
        '', "Frame of the landmarks; empty takes each message's own, base_frame needs no "
        'transform', basic=True)
    sensor_pose: Pose6 = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), "Pose of the landmarks' sensor in base_frame, x y z and "
        'roll pitch yaw; all zeros: from /tf', unit='m, rad', minimum=-1e4, maximum=1e4)
    transform_timeout: float = parameter(
        0.5, 'How long a message waits for a transform', unit='s', minimum=0.0, maximum=60.0)
    # fmt: on

    def with_plain_frames(self: InputSettingsT) -> InputSettingsT:
        """Return them with frames as tf2 has them; a ParameterError if the map's has no name."""
        names = ('map_frame', 'odom_frame', 'base_frame', 'sensor_frame')
        plain = replace(self, **{name: getattr(self, name).lstrip('/') for name in names})
        if not plain.map_frame:
            raise ParameterError("'map_frame' is empty: give it the name of a frame")
        return plain

    def check_frames(self) -> None:
        """Raise a ParameterError, which says what to do, if frames are the same, or base is ''."""
        if not self.base_frame:
            raise ParameterError("'base_frame' is empty: give it the name of a frame")
        for one, other in combinations(('map_frame', 'odom_frame', 'base_frame'), 2):
            frame = getattr(self, one)
            if not frame or frame != getattr(self, other):
                continue
            advice = 'give each a name of its own'
            if other == 'odom_frame':
                advice += f", or set 'odom_frame' to '' to have '{frame}' to the base published"
            raise ParameterError(f"'{one}' and '{other}' are both '{frame}': {advice}")


@dataclass(frozen=True)
class ObserverNodeSettings(InputSettings):
    """What ``observer_node`` adds to the settings of the estimator and its inputs."""

    # fmt: off
    velocity_type: str = parameter(
        AUTO, 'Message type on twist; auto takes the type found there',
        choices=lambda: (AUTO, *short_names('velocity')), basic=True)
    landmarks_max_wait: float = parameter(
        0.05, 'Overload: once a message on landmarks has waited this long, only the newest of '
        'each sensor is used; velocities are all used',
        unit='s', minimum=0.0, maximum=60.0)
    transform_tolerance: float = parameter(
        1.0, 'How far map_frame to odom_frame is post-dated beyond reorder_window, to hold until '
        'the next one; others see a correction that much later, the motion at once',
        unit='s', minimum=0.0, maximum=10.0)
    max_clock_offset: float = parameter(
        1.0, 'Stamps that are further than this from the time of reception come from another '
        'clock', unit='s', minimum=1e-3, maximum=1e9)
    correct_clock_offset: bool = parameter(
        False, "Whether stamps from another clock are moved to this machine's time")
    publish_rate: float = parameter(
        50.0, 'Highest rate of odometry, pose, lyapunov, landmark_estimates and /tf',
        unit='Hz', minimum=0.1, maximum=1000.0)
    publish_tf: bool = parameter(
        True, 'Whether map_frame to odom_frame or base_frame is published on /tf', basic=True)
    invert_tf: bool = parameter(
        False, 'Whether the transform on /tf is its inverse, with map_frame below')
    position_limits: tuple[float, float] = parameter(
        (0.5, 2.0), 'Standard deviation of the position, in its worst direction, from which on '
        '/diagnostics warns, and from which on it is an error, and ~/is_localised is false',
        unit='m', minimum=0.0, maximum=1e6)
    heading_limits: tuple[float, float] = parameter(
        (0.2, 0.5), 'The same of the heading', unit='rad', minimum=0.0, maximum=1e6)
    map_file: str = parameter(
        '', 'Map to load at the start, saved or surveyed; or a folder of maps, in one of which '
        'the robot is found; empty for none', basic=True)
    map_path: str = parameter(
        '', 'File of ~/save_map, ~/load_map and autosave_map', read_only=False)
    pose_file: str = parameter(
        '', 'File that keeps the pose, every two seconds and at the end, for the next start, as '
        '~/.ros/observer_pose.yaml; empty for none')
    autosave_map: bool = parameter(False, 'Whether the map is saved to map_path at the end')
    # fmt: on


@dataclass(frozen=True)
class ManagedNodeSettings:
    """What ``lifecycle_observer_node`` adds; both as Nav2's nodes have them."""

    # fmt: off
    autostart_node: bool = parameter(
        False, 'Whether the node configures and activates itself at its start')
    bond_heartbeat_period: float = parameter(
        0.0, "Period of the bond's heartbeats to Nav2's lifecycle manager, which needs bondpy; 0 "
        'for no bond', unit='s', minimum=0.0, maximum=10.0)
    # fmt: on


@dataclass(frozen=True)
class SimulatorNodeSettings:
    """What ``simulator_node`` adds to the scenario."""

    # fmt: off
    stamped: bool = parameter(False, 'Whether twist carries TwistStamped in place of Twist')
    landmarks_type: str = parameter(
        'PointCloud', 'Message type on landmarks', choices=('PointCloud', 'PointCloud2'))
    real_time_factor: float = parameter(
        1.0, 'Simulated seconds a second; other than 1 the node publishes /clock',
        minimum=0.01, maximum=1000.0)
    wait_for_subscribers: int = parameter(
        1, 'Subscribers that twist and landmarks must have before the robot starts',
        minimum=0, maximum=1000)
    truth_frame: str = parameter('world', 'Frame of the true pose and landmarks')
    map_frame: str = parameter(
        'map', "Frame of the observer's estimate; /tf_static has its pose in truth_frame")
    base_frame: str = parameter('base_link', 'Frame of the velocity and the observations')
    # fmt: on
