"""What a replay is asked for, whoever asks: replay itself, batch and calibrate."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
import logging
from pathlib import Path
from typing import Any

import numpy as np

from slam_observer_ros.cli.options import Given, named, named_path, settings_of
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import found
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import SelectedTopics, TopicNames
from slam_observer_ros.recordings.trajectory import Truth
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    ObserverNodeSettings,
    short_names,
)
from slam_observer_ros.settings.parameter_table import from_parameters, table, Value

logger = logging.getLogger(__name__)

_ROWS = {row.name: row for row in table(InputSettings)}
INPUT_NAMES = frozenset(_ROWS)
"""Parameters of the node that a replay knows, too."""

INSTEAD = {
    'map_file': '--load-map',
    'autosave_map': '--map',
    'velocity_type': '--velocity-topic',
}
"""Options of a replay for what the node does by these parameters."""


@dataclass(frozen=True, slots=True)
class Records:
    """What of a run is kept beside its figures.

    That are all poses, NIS, all that a page shows, and the map; and the estimate as a
    recording, with its inputs or without, which replaces none unless ``overwrite``.
    """

    poses: bool = False
    nis: bool = True
    whole_run: bool = False
    map: bool = False
    mcap: Path | None = None
    with_inputs: bool = False
    overwrite: bool = False


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """A recording, and how it is to be replayed; it can be sent to another process or machine.

    The base frame of ``inputs`` is empty if the user names none.
    """

    recording: Path
    settings: Settings
    inputs: InputSettings
    topics: TopicNames = TopicNames()
    load_map: Path | None = None
    smooth: bool = False
    records: Records = Records()

    def with_values(self, values: Mapping[str, Value]) -> ReplayRequest:
        """Return the same with other values of some parameters."""
        of_inputs: dict[str, Any] = {}
        others: dict[str, Any] = {}
        for name, value in values.items():
            (of_inputs if name in INPUT_NAMES else others)[name] = value
        return replace(
            self,
            settings=replace(self.settings, **others),
            inputs=replace(self.inputs, **of_inputs).with_plain_frames(),
        ).checked()

    def checked(self) -> ReplayRequest:
        """Return itself; a UsageError is raised if it is to smooth with gains that can't."""
        if self.smooth:
            self.need_errors('--smooth')
        return self

    def need_errors(self, what: str) -> None:
        """Raise a UsageError unless its gains know their errors, which ``what`` needs."""
        if make_gains(self.settings, np.eye(4)).errors is None:
            raise UsageError(f'{what} needs riccati gains, not {self.settings.gains}')


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of topics and inputs."""
    landmarks, ambiguous = (
        ', '.join(short_names('landmarks', is_ambiguous)) for is_ambiguous in (False, True)
    )
    topics = parser.add_argument_group(
        'topics', 'found by their types; a name is needed only where two fit'
    )
    for option, what in (
        ('--velocity-topic', ', '.join(short_names('velocity'))),
        (
            '--landmarks-topic',
            f'{landmarks}, clouds with ids; if named here or called landmarks, also clouds '
            f'without, and {ambiguous}; if named, /tf with fiducials',
        ),
        ('--imu', 'take the angular velocity from this Imu, the linear one as before'),
        ('--pose-truth-topic', f'true pose: {", ".join(short_names("pose"))}'),
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


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how a recording is replayed, but for settings."""
    add_input_options(parser)
    parser.add_argument(
        '--load-map',
        type=named_path,
        metavar='FILE',
        help='known landmarks, as --map writes them, or a folder of such maps, one of them that '
        'of the place: the estimate is then in their frame, and has no ANEES of the pose '
        '(nor of the configuration, if they are fixed)',
    )
    parser.add_argument(
        '--smooth',
        action='store_true',
        help='estimate trajectory and map from all observations together, too; --tum and --map '
        'then write these',
    )


def read_request(args: argparse.Namespace, given: Given, recording: Path) -> ReplayRequest:
    """Return what the options of :func:`add_run_options` ask for; without any records.

    A SlamObserverError is raised if settings are wrong, or don't fit the options.
    """
    defaults = {'smoothing_window': 0} if args.smooth else {}
    topics = TopicNames(
        args.velocity_topic,
        args.landmarks_topic,
        args.pose_truth_topic,
        args.landmark_truth_topic,
        args.imu,
    )
    settings = settings_of(given, INPUT_NAMES, INSTEAD, **defaults)
    inputs = _inputs_of(args, given)
    return ReplayRequest(recording, settings, inputs, topics, args.load_map, args.smooth).checked()


def _inputs_of(args: argparse.Namespace, given: Given) -> InputSettings:
    """Build settings from ``--config``, ``--set`` and the options themselves; later ones win."""
    values: dict[str, object] = {'base_frame': ''}
    values |= {name: value for name, value in given.values.items() if name in INPUT_NAMES}
    options = {
        'velocity_source': args.velocity_source,
        'base_frame': args.base_frame,
        'tag_frame_prefix': args.tag_frame_prefix,
        'use_imu': None if args.imu is None else True,
    }
    values |= {name: value for name, value in options.items() if value is not None}
    return from_parameters(InputSettings, values).with_plain_frames()


def warn_of_unused(args: argparse.Namespace, given: Given) -> None:
    """Warn of what ``--config`` sets for the node, while the option for it here isn't given."""
    defaults = {row.name: row.default for row in table(ObserverNodeSettings)}
    unused = [
        f'{name} (use {INSTEAD[name]})'
        for name, value in given.config.items()
        if name in INSTEAD
        and value != defaults[name]
        and getattr(args, INSTEAD[name].removeprefix('--').replace('-', '_')) is None
    ]
    if unused:
        logger.warning('Not used of --config: %s.', ', '.join(unused))


def select_inputs(
    request: ReplayRequest, recording: Recording
) -> tuple[SelectedTopics, InputSettings, Truth]:
    """Return the topics to be read, the settings with the frames of these, and the truth."""
    if recording.warning:
        logger.warning('%s', found('incomplete_recording', problem=recording.warning))
    selected = recording.find_topics(request.topics, request.inputs)
    inputs = _with_base_frame(request.inputs, recording, selected)
    _check_frames(inputs)
    truth = recording.truth(selected, inputs.base_frame)
    return selected, inputs, truth.flattened() if request.settings.two_d_mode else truth


def _with_base_frame(
    inputs: InputSettings, recording: Recording, selected: SelectedTopics
) -> InputSettings:
    """Name the base frame, if the user doesn't: the frame of the velocities.

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
            logger.warning('%s', found('guessed_base', frame=base_frame))
    return replace(inputs, base_frame='' if base_frame in world else base_frame)


def _check_frames(inputs: InputSettings) -> None:
    """Raise a ParameterError if the node refuses these frames; an unnamed base has its default."""
    base_frame = inputs.base_frame or InputSettings().base_frame
    replace(inputs, base_frame=base_frame).check_frames_differ()
