"""Options of ``slam-observer replay`` that choose its topics and what is used of them."""

from __future__ import annotations

import argparse
import dataclasses
import logging

from slam_observer_ros.cli.options import named, read_assignments, read_config
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics, TopicNames
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings
from slam_observer_ros.settings.parameter_table import from_parameters, table

_ROWS = {row.name: row for row in table(InputSettings)}
INPUT_NAMES = frozenset(_ROWS)
"""Parameters of the node that a replay knows, too."""

INSTEAD = {
    'map_file': '--load-map',
    'autosave_map': '--map',
    'velocity_type': '--velocity-topic',
}
"""Options of a replay for what the node does by these parameters."""

logger = logging.getLogger(__name__)


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that :func:`topic_names` and :func:`read_inputs` read."""
    topics = parser.add_argument_group(
        'topics', 'found by their types; a name is needed only where two fit'
    )
    for option, what in (
        ('--velocity-topic', 'Twist, TwistStamped, TwistWithCovarianceStamped or Odometry'),
        (
            '--landmarks-topic',
            'PointCloud or PointCloud2 with ids, Detection3DArray, AprilTagDetectionArray, '
            'ArucoDetection or ArucoMarkers; if named here or called landmarks, also clouds '
            'without ids and PoseArray; if named, /tf with fiducials',
        ),
        ('--imu', 'take the angular velocity from this Imu, the linear one as before'),
        (
            '--pose-truth-topic',
            'true pose: PoseStamped, PoseWithCovarianceStamped, TransformStamped or Odometry',
        ),
        ('--landmark-truth-topic', 'true landmarks'),
    ):
        topics.add_argument(option, type=named, metavar='TOPIC', help=what)
    inputs = parser.add_argument_group(
        'inputs', "the node's parameters of these names, which --config and --set give as well"
    )
    inputs.add_argument(
        '--velocity-source',
        choices=_ROWS['velocity_source'].choices,
        help='what of Odometry is used: its twist (default), or the differences of its poses',
    )
    inputs.add_argument(
        '--base-frame',
        type=named,
        metavar='FRAME',
        help='frame whose pose is estimated; other sensors are placed in it by /tf and '
        '/tf_static (default: that of the velocities, or base_link if they name none)',
    )
    inputs.add_argument(
        '--tag-frame-prefix',
        metavar='PREFIX',
        help="fiducials on /tf: a tag's frame before its id (default: "
        f'{_ROWS["tag_frame_prefix"].default}); family:id is known, too',
    )


def topic_names(args: argparse.Namespace) -> TopicNames:
    """Return the topics that the user names."""
    return TopicNames(
        args.velocity_topic,
        args.landmarks_topic,
        args.pose_truth_topic,
        args.landmark_truth_topic,
        args.imu,
    )


def read_inputs(args: argparse.Namespace) -> InputSettings:
    """Build settings from ``--config``, ``--set`` and the options themselves; later ones win.

    The base frame is empty if the user names none. A SlamObserverError says what is wrong.
    """
    values: dict[str, object] = {'base_frame': ''}
    given = read_config(args) | read_assignments(args)
    values |= {name: value for name, value in given.items() if name in INPUT_NAMES}
    options = {
        'velocity_source': args.velocity_source,
        'base_frame': args.base_frame,
        'tag_frame_prefix': args.tag_frame_prefix,
        'use_imu': None if args.imu is None else True,
    }
    values |= {name: value for name, value in options.items() if value is not None}
    return from_parameters(InputSettings, values).with_plain_frames()


def warn_of_unused(args: argparse.Namespace, settings: Settings) -> None:
    """Warn of what is set but has no effect, as it takes an option that isn't given."""
    if settings.localization_mode != 'off' and args.load_map is None:
        logger.warning(
            "No map is loaded, so localization_mode '%s' has no effect (use --load-map).",
            settings.localization_mode,
        )
    defaults = {row.name: row.default for row in table(ObserverNodeSettings)}
    unused = [
        f'{name} (use {INSTEAD[name]})'
        for name, value in read_config(args).items()
        if name in INSTEAD
        and value != defaults[name]
        and getattr(args, INSTEAD[name].removeprefix('--').replace('-', '_')) is None
    ]
    if unused:
        logger.warning('Not used of --config: %s.', ', '.join(unused))


def with_base_frame(
    inputs: InputSettings, recording: Recording, selected: SelectedTopics
) -> InputSettings:
    """Name the base frame, if the user doesn't: that of the velocities.

    If they name none it is the node's, if /tf has that; else, with a warning, the landmarks'.
    """
    if inputs.base_frame:
        return inputs
    world, default = ('', inputs.map_frame, inputs.odom_frame), InputSettings().base_frame
    velocity_frame, base_frame = recording.contents.frames(selected, inputs)
    base_frame = inputs.sensor_frame or base_frame
    if velocity_frame not in world:
        base_frame = velocity_frame
    elif base_frame not in (*world, default):
        if recording.contents.has_transform_of(default, selected):
            base_frame = default
        else:
            logger.warning(
                "The velocities don't say whose they are: '%s', the landmarks' frame, is taken "
                'for the robot; --base-frame names another.',
                base_frame,
            )
    return dataclasses.replace(inputs, base_frame='' if base_frame in world else base_frame)


def check_frames(inputs: InputSettings) -> None:
    """Raise a ParameterError if the node refuses these frames; an unnamed base has its default."""
    base_frame = inputs.base_frame or InputSettings().base_frame
    dataclasses.replace(inputs, base_frame=base_frame).check_frames_differ()
