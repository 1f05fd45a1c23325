"""A recording through the estimator, and what came of it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
import logging

from slam_observer_ros.cli.console import show_progress
from slam_observer_ros.cli.replay.asked import Asked
from slam_observer_ros.cli.replay.estimate_recording import estimate_writer
from slam_observer_ros.cli.replay.input_options import (
    check_frames,
    topic_names,
    warn_of_unused,
    with_base_frame,
)
from slam_observer_ros.cli.replay.outcome import outcome_of, ReplayOutcome, with_smoothed
from slam_observer_ros.cli.replay.outcome_checks import (
    check_localised,
    check_used,
    warn_of_input,
    warn_of_resets,
)
from slam_observer_ros.cli.replay.timing_checks import warn_of_timing
from slam_observer_ros.known_map.landmark_map import LandmarkMap
from slam_observer_ros.known_map.map_file import read_maps
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.recorded_truth import Truth
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.runs.recorder import NisTally, RunRecorder
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.input_settings import InputSettings

logger = logging.getLogger(__name__)


def replayed(
    args: argparse.Namespace, asked: Asked, *, shows_progress: bool = True
) -> tuple[ReplayOutcome, str]:
    """Replay ``args.recording``; return what came of it, and the frame of outputs."""
    warn_of_unused(args, asked.settings)
    maps = [] if args.load_map is None else read_maps(args.load_map)
    outcome = _replay(args, asked.settings, asked.inputs, maps, shows_progress)
    return outcome, _frame_of_outputs(asked.inputs, maps)


def select_inputs(
    args: argparse.Namespace, recording: Recording, asked: Asked
) -> tuple[SelectedTopics, InputSettings, Truth]:
    """Return the topics to be read, the settings with the frames of these, and the truth."""
    if recording.warning:
        logger.warning('%s', recording.warning)
    selected = recording.find_topics(topic_names(args), asked.inputs)
    inputs = with_base_frame(asked.inputs, recording, selected)
    check_frames(inputs)
    truth = recording.truth(selected, inputs.base_frame)
    return selected, inputs, truth.flattened() if asked.settings.two_d_mode else truth


def _replay(
    args: argparse.Namespace,
    settings: Settings,
    inputs: InputSettings,
    maps: Sequence[LandmarkMap],
    shows_progress: bool,
) -> ReplayOutcome:
    """Replay a recording; warn of what may be wrong with it, or with what is asked of it."""
    with Recording(args.recording) as recording:
        selected, inputs, truth = select_inputs(args, recording, Asked(settings, inputs))
        events = recording.blocks(selected, inputs, settings.velocity_timeout)
        if shows_progress:
            events = show_progress(events, 'replaying', recording.event_count(selected))
        recorder = _recorder(args)
        map_frame = maps[0].frame_id if maps else inputs.map_frame
        needs_poses = args.tum is not None or _is_shown(args) or len(truth.stamps_ns) > 0
        with estimate_writer(args, recording, selected, inputs, map_frame) as writer:
            recorders = [noter for noter in (recorder, writer) if noter is not None]
            result = replay(events, settings, truth, maps or None, needs_poses, recorders)
            warn_of_resets(result)
            check_used(args, recording, selected, inputs, result)
            if maps:
                check_localised(args, result, maps)
            outcome = outcome_of(recording, selected, result, truth)
            if writer is not None:
                writer.finish(result.estimator, outcome.accuracy.pose_errors, truth.landmarks)
        warn_of_input(recording, selected, inputs, result)
        warn_of_timing(recording, selected)
    if recorder is not None:
        outcome = replace(outcome, recorder=recorder)
    return with_smoothed(outcome) if args.smooth else outcome


def _recorder(args: argparse.Namespace) -> RunRecorder | NisTally | None:
    if _is_shown(args):
        return RunRecorder()
    return NisTally() if args.json else None


def _is_shown(args: argparse.Namespace) -> bool:
    """Return whether anything is asked for that shows the whole run."""
    return any(output is not None for output in (args.report, args.plot, args.rerun))


def _frame_of_outputs(inputs: InputSettings, maps: Sequence[LandmarkMap]) -> str:
    """Return the frame of what is written: that of the map that was loaded, if one was."""
    if not maps or maps[0].frame_id == inputs.map_frame:
        return inputs.map_frame
    logger.warning(
        "The map is in frame '%s', and so is what is written; the node takes it with "
        'map_frame: %s only.',
        maps[0].frame_id,
        maps[0].frame_id,
    )
    return maps[0].frame_id
