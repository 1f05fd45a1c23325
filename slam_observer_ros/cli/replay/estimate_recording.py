"""``replay --mcap``: the estimate as a recording, maybe with what the estimate is made of."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import logging
from typing import TYPE_CHECKING

from slam_observer_ros.cli.outputs import recording_path
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.settings.input_settings import InputSettings
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

if TYPE_CHECKING:
    from slam_observer_ros.recording.writer import RecordingWriter
    from slam_observer_ros.runs.estimate_writer import EstimateWriter

logger = logging.getLogger(__name__)


def add_recording_options(outputs: argparse._ArgumentGroup) -> None:
    """Add ``--mcap`` and ``--with-inputs``."""
    outputs.add_argument(
        '--mcap',
        type=recording_path,
        metavar='OUT.mcap',
        help='the estimate as the node would have published it, for Foxglove and others',
    )
    outputs.add_argument(
        '--with-inputs', action='store_true', help='--mcap has the messages that came in, too'
    )


@contextmanager
def estimate_writer(
    args: argparse.Namespace,
    recording: Recording,
    selected: SelectedTopics,
    inputs: InputSettings,
    map_frame: str,
) -> Iterator[EstimateWriter | None]:
    """Give what writes the file of ``--mcap``, which is there when the block ends; else None."""
    if args.mcap is None:
        if args.with_inputs:
            raise UsageError('--with-inputs is for --mcap')
        yield None
        return
    from slam_observer_ros.recording.writer import RecordingWriter  # a while to import
    from slam_observer_ros.runs.estimate_writer import EstimateWriter

    base_frame = inputs.base_frame or InputSettings().base_frame
    with RecordingWriter(args.mcap, overwrite=args.force) as writer:
        transforms, has_parent = selected.transforms, False
        if args.with_inputs:
            _copy_inputs(recording, selected, writer)
            topics = (*transforms.static, *transforms.moving)
            has_parent = recording.contents.has_parent_of(base_frame, topics)
        elif not recording.contents.has_parent_of(base_frame, transforms.static):
            recording.copy_static_to(writer, selected)  # where the sensors are on the robot
        if has_parent:
            logger.warning(
                "%s has no transform from '%s' to '%s': the inputs on /tf have another parent of "
                "'%s'.",
                args.mcap,
                map_frame,
                base_frame,
                base_frame,
            )
        yield EstimateWriter(
            writer, map_frame, base_frame, ObserverNodeSettings().publish_rate, not has_parent
        )


def _copy_inputs(recording: Recording, selected: SelectedTopics, writer: RecordingWriter) -> None:
    from slam_observer_ros.runs.estimate_writer import TOPICS

    taken = [topic.name for topic in selected.inputs if topic.name in TOPICS]
    if taken:
        raise UsageError(
            f'--with-inputs: {", ".join(taken)} would be an input and an output of {writer.path}; '
            'leave it out'
        )
    for topic in recording.copy_to(writer, selected):
        logger.warning('%s is left out of %s: its type is unknown.', topic, writer.path)
