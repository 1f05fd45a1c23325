"""A recording through the estimator, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
import logging
from typing import TYPE_CHECKING

import numpy as np

from slam_observer_ros.cli.console import muted_warnings, show_progress
from slam_observer_ros.cli.replay_outcome import judged, outcome_of, ReplayOutcome, with_smoothed
from slam_observer_ros.cli.replay_request import Records, ReplayRequest, select_inputs
from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import Finding
from slam_observer_ros.common.types import is_automatic
from slam_observer_ros.estimates import Reason
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.runs.input_health import of_use
from slam_observer_ros.runs.mistakes import mistakes
from slam_observer_ros.runs.replay import replay
from slam_observer_ros.runs.reported_run import NisTally, Replay, RunRecorder
from slam_observer_ros.settings.node_settings import InputSettings, ObserverNodeSettings

if TYPE_CHECKING:
    from slam_observer_ros.recordings.writer import RecordingWriter
    from slam_observer_ros.runs.estimate_writer import EstimateWriter

logger = logging.getLogger(__name__)


def replayed(request: ReplayRequest, *, shows_progress: bool = True) -> tuple[ReplayOutcome, str]:
    """Replay a recording; return what came of it, and the frame of outputs.

    What gives reason to warn is logged, and is in the outcome.
    """
    if request.settings.localization_mode != 'off' and request.load_map is None:
        logger.warning(
            "No map is loaded, so localization_mode '%s' has no effect (use --load-map).",
            request.settings.localization_mode,
        )
    maps: Sequence[LandmarkMap] = ()
    if request.load_map is not None:
        from slam_observer_ros.mapping.map_file import read_maps  # which few runs need

        maps = read_maps(request.load_map)
    outcome = _replay(request, maps, shows_progress)
    return outcome, _frame_of_outputs(request.inputs, maps)


def _replay(
    request: ReplayRequest, maps: Sequence[LandmarkMap], shows_progress: bool
) -> ReplayOutcome:
    """Replay a recording; refuse an outcome without what is asked of it."""
    settings, records = request.settings, request.records
    with Recording(request.recording) as recording:
        selected, inputs, truth = select_inputs(request, recording)
        events = recording.blocks(selected, inputs, settings.velocity_timeout)
        if shows_progress:
            events = show_progress(events, 'replaying', recording.event_count(selected))
        recorder = _recorder(records)
        map_frame = maps[0].frame_id if maps else inputs.map_frame
        needs_poses = records.poses or records.whole_run or len(truth.stamps_ns) > 0
        with _estimate_writer(records, recording, selected, inputs, map_frame) as writer:
            recorders = [noter for noter in (recorder, writer) if noter is not None]
            result = replay(events, settings, truth, maps or None, needs_poses, recorders)
            unused = list(of_use(recording, selected, inputs, result))
            _check_used(request, unused)
            look_for_mistakes = partial(_mistakes, request, selected, inputs, maps)
            if maps and not result.estimator.is_localised:
                _check_localised(request, result, maps, look_for_mistakes)
            outcome = outcome_of(recording, selected, result, truth, recorder)
            if writer is not None:
                writer.finish(result.estimator, outcome.accuracy.pose_errors, truth.landmarks)
        outcome = judged(outcome, recording, inputs, unused, request.load_map, look_for_mistakes)
    return with_smoothed(outcome) if request.smooth else outcome


def _mistakes(
    request: ReplayRequest,
    selected: SelectedTopics,
    inputs: InputSettings,
    maps: Sequence[LandmarkMap],
) -> list[Finding]:
    """Look whether a mistake of the set-up explains a recording, which is read again for that."""
    settings = request.settings
    with muted_warnings(), Recording(request.recording) as recording:
        events = recording.events(selected, inputs, settings.velocity_timeout)
        return mistakes(settings, events, maps or None)


def _recorder(records: Records) -> RunRecorder | NisTally | None:
    if records.whole_run:
        return RunRecorder()
    return NisTally() if records.nis else None


def _frame_of_outputs(inputs: InputSettings, maps: Sequence[LandmarkMap]) -> str:
    """Return the frame of what is written: the loaded map's, if there is one."""
    if not maps or maps[0].frame_id == inputs.map_frame:
        return inputs.map_frame
    logger.warning(
        "The map is in frame '%s', and so is what is written; the node takes it with "
        'map_frame: %s only.',
        maps[0].frame_id,
        maps[0].frame_id,
    )
    return maps[0].frame_id


def _check_used(request: ReplayRequest, use: list[Finding]) -> None:
    """Raise a UsageError if no observation was used, and something that is asked for needs one."""
    for finding in use:
        if finding.kind in ('no_observation', 'nothing_used') and (
            request.smooth or request.records.map or request.load_map is not None
        ):
            raise UsageError(
                f'{finding.what}; --smooth, --map and --load-map need some: {finding.remedy}'
            )


def _check_localised(
    request: ReplayRequest,
    result: Replay,
    maps: Sequence[LandmarkMap],
    look_for_mistakes: Callable[[], Sequence[Finding]],
) -> None:
    """Refuse an outcome that is not in the frame of the map that was loaded.

    Where the pose in it was found and lost again the trajectory is still of use, but not the map:
    a UsageError says if the pose was never found, or not at the end and the map is asked for.
    """
    if result.localised_ns is None:
        why = '; '.join(str(mistake) for mistake in look_for_mistakes())
        raise UsageError(
            f'the pose in the map {request.load_map} was not found: '
            f'{why or _never_found(result, maps)}'
        )
    if request.records.map or request.smooth:
        end_s = result.seconds_until(result.localised_ns[1])
        raise UsageError(
            f'the pose in the map {request.load_map} was lost after {end_s:.1f} s, and not found '
            'again; --map and --smooth need it at the end'
        )


def _never_found(result: Replay, maps: Sequence[LandmarkMap]) -> str:
    estimator = result.estimator
    problem = estimator.localisation_problem
    if problem and problem.kind in ('other_hall', 'other_ids'):
        return f'{problem.what}; {problem.remedy}'
    if problem and (is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses)):
        return f'{problem.what}{_advice(result)}'
    least = 'two' if estimator.settings.two_d_mode else 'three'
    ids = np.concatenate([known.ids for known in maps])
    named = ids[~is_automatic(ids)]
    return (
        f'that takes {least} of its landmarks or more, '
        'recognised by their ids, well apart, and seen where the map has them; '
        f'{np.isin(named, estimator.landmark_ids).sum()} of its {len(ids)} were '
        f'seen{_advice(result)}'
    )


def _advice(result: Replay) -> str:
    """Return what to do if the landmarks seen did not determine the pose."""
    counts, settings = result.estimator.counts, result.estimator.settings
    if counts['unknown_id']:
        return f'; {counts["unknown_id"]} points without id take --gains riccati'
    if 2 * counts['repeated_id'] > counts['observed_point']:
        return f'; {counts["repeated_id"]} points were {Reason.REPEATED_ID.words}'
    if settings.set_initial_pose:
        return '; they contradict the pose that was given'
    return (
        '. Where the start is known: --set set_initial_pose=true '
        '--set initial_pose=[X,Y,Z,ROLL,PITCH,YAW]'
    )


@contextmanager
def _estimate_writer(
    records: Records,
    recording: Recording,
    selected: SelectedTopics,
    inputs: InputSettings,
    map_frame: str,
) -> Iterator[EstimateWriter | None]:
    """Give what writes the file of ``--mcap``, which is there when the block ends; else None."""
    if records.mcap is None:
        yield None
        return
    from slam_observer_ros.recordings.writer import RecordingWriter  # a while to import
    from slam_observer_ros.runs.estimate_writer import EstimateWriter

    base_frame = inputs.base_frame or InputSettings().base_frame
    with RecordingWriter(records.mcap, overwrite=records.overwrite) as writer:
        transforms, has_parent = selected.transforms, False
        if records.with_inputs:
            _copy_inputs(recording, selected, writer)
            topics = (*transforms.static, *transforms.moving)
            has_parent = recording.contents.has_parent_of(base_frame, topics)
        elif not recording.contents.has_parent_of(base_frame, transforms.static):
            recording.copy_static_to(writer, selected)  # where the sensors are on the robot
        if has_parent:
            logger.warning(
                "%s has no transform from '%s' to '%s': the inputs on /tf have another parent of "
                "'%s'.",
                records.mcap,
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
