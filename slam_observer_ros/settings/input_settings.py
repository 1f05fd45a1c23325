"""What is used of the messages that come in, live or recorded, and in which frames it is.

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


AUTO = 'auto'
"""Message type parameter: take the type that is found on the topic."""

ON_TF = 'tf'
"""Landmarks are fiducials whose positions, and ids in the names of frames, are on /tf."""

POSE_DIFFERENCES = 'pose_differences'
"""Velocity source: the differences of an odometry's poses."""

InputSettingsT = TypeVar('InputSettingsT', bound='InputSettings')


@dataclass(frozen=True)
class InputSettings:
    """How measurements become events; the node has these parameters, and so has a replay."""

    velocity_source: str = parameter(
        'twist',
        'What of Odometry is used: its twist, or the differences of its poses',
        choices=('twist', POSE_DIFFERENCES),
    )
    use_imu: bool = parameter(
        False, 'Whether the angular velocity comes from imu, and only the linear one from twist'
    )
    landmarks_type: str = parameter(
        AUTO,
        'Message type on landmarks; auto takes the type found there, tf takes fiducials on /tf',
        choices=lambda: (AUTO, *short_names('landmarks'), ON_TF),
        basic=True,
    )
    tag_frame_prefix: str = parameter(
        'tag_', "Name of a fiducial's frame before its id; family:id, as of apriltag_ros, fits too"
    )
    image_is_rectified: bool = parameter(
        True,
        'Whether 2D detections are pixels of the rectified image, as fiducials always are; '
        "otherwise CameraInfo's distortion is taken out",
    )
    map_frame: str = parameter('map', 'Frame of the estimated pose and landmarks', basic=True)
    odom_frame: str = parameter(
        'odom',
        'Odometry frame: if /tf has odom_frame to base_frame, map_frame to odom_frame is '
        'published; empty for never',
        basic=True,
    )
    base_frame: str = parameter(
        'base_link', 'Frame of the robot, whose pose is estimated', basic=True
    )
    sensor_frame: str = parameter(
        '',
        "Frame of the landmarks; empty takes each message's own, base_frame needs no transform",
        basic=True,
    )
    sensor_pose: Pose6 = parameter(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        "Pose of the landmarks' sensor in base_frame, x y z and roll pitch yaw; all zeros: "
        'from /tf',
        unit='m, rad',
        minimum=-1e4,
        maximum=1e4,
    )
    transform_timeout: float = parameter(
        0.5, 'How long a message waits for a transform', unit='s', minimum=0.0, maximum=60.0
    )

    def with_plain_frames(self: InputSettingsT) -> InputSettingsT:
        """Return the settings with frames as tf2 has them, without a leading slash.

        Raises
        ------
        ParameterError
            If the map's frame has no name.

        """
        names = ('map_frame', 'odom_frame', 'base_frame', 'sensor_frame')
        plain = replace(self, **{name: getattr(self, name).lstrip('/') for name in names})
        plain.check_named('map_frame')
        return plain

    def check_named(self, parameter_name: str) -> None:
        """Raise a ParameterError, which says what to do, if the name of a frame is empty."""
        if not getattr(self, parameter_name):
            raise ParameterError(f"'{parameter_name}' is empty: give it the name of a frame")

    def check_frames_differ(self) -> None:
        """Raise a ParameterError if two of map, odometry and base have the same name."""
        for one, other in combinations(('map_frame', 'odom_frame', 'base_frame'), 2):
            frame = getattr(self, one)
            if not frame or frame != getattr(self, other):
                continue
            advice = 'give each a name of its own'
            if other == 'odom_frame':
                advice += f", or set 'odom_frame' to '' to have '{frame}' to the base published"
            raise ParameterError(f"'{one}' and '{other}' are both '{frame}': {advice}")
