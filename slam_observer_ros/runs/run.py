"""A recording through the estimator: from a :class:`.Request` to its :class:`.Result`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
import logging
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import Finding, Level, muted_warnings
from slam_observer_ros.common.types import is_automatic
from slam_observer_ros.estimates import Reason
from slam_observer_ros.events import Event, VelocityBlock
from slam_observer_ros.mapping.landmark_map import LandmarkMap
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.runs.mistakes import mistakes
from slam_observer_ros.runs.recorders import NisTally, RunRecorder
from slam_observer_ros.runs.replay import measure, Replay, replay, smoothed_run
from slam_observer_ros.runs.result import Request, Result
from slam_observer_ros.runs.run_health import judged, of_use, unused_messages
from slam_observer_ros.settings.node_settings import InputSettings, ObserverNodeSettings

if TYPE_CHECKING:
    from slam_observer_ros.runs.estimate_writer import EstimateWriter

logger = logging.getLogger(__name__)

Events: TypeAlias = Iterable[Event | VelocityBlock]


def result_of(
    request: Request, show_progress: Callable[[Events, int], Events] | None = None
) -> Result:
    """Replay a recording; refuse an outcome without what is asked of it.

    What gives reason to warn is logged. ``show_progress`` passes on events, of so many in all.
    """
    settings, map_path = request.settings, request.load_map
    if settings.localization_mode != 'off' and map_path is None:
        logger.warning(
            "No map is loaded, so localization_mode '%s' has no effect (use --load-map).",
            settings.localization_mode,
        )
    maps: Sequence[LandmarkMap] = ()
    if map_path is not None:
        from slam_observer_ros.mapping.map_file import read_maps  # which few runs need

        maps = read_maps(map_path)
    with Recording(request.recording) as recording:
        selected, inputs, truth = request.select_inputs(recording)
        map_frame = maps[0].frame_id if maps else inputs.map_frame
        events: Events = recording.blocks(selected, inputs, settings.velocity_timeout)
        if show_progress is not None:
            events = show_progress(events, recording.event_count(selected))
        recorder = (
            RunRecorder() if request.keeps_run else NisTally() if request.keeps_nis else None
        )
        needs_poses = request.keeps_poses or request.keeps_run or len(truth.stamps_ns) > 0

        def look_for_mistakes() -> list[Finding]:
            """Read the recording again, and look whether a mistake of the set-up explains it."""
            with muted_warnings(), Recording(request.recording) as again:
                events = again.events(selected, inputs, settings.velocity_timeout)
                return mistakes(settings, events, maps or None)

        with _estimate_writer(request, recording, selected, inputs, map_frame) as writer:
            recorders = [each for each in (recorder, writer) if each is not None]
            run = replay(events, settings, truth, maps or None, needs_poses, recorders)
            unused = list(of_use(recording, selected, inputs, run))
            _check_used(request, unused)
            if maps and not run.estimator.is_localised:
                _check_localised(request, run, maps, look_for_mistakes)
            result = Result(
                run,
                selected,
                truth,
                measure(run, truth),
                recording.duration_s,
                unused_messages(recording, selected),
                recording.contents.missing_ids(selected.landmarks),
                recording.loss,
                map_frame,
                recorder,
            )
            if writer is not None:
                writer.finish(run.estimator, result.errors, truth.landmarks)
        findings = judged(result, recording, inputs, unused, map_path, look_for_mistakes)
    for finding in findings:
        if finding.level >= Level.WARNING:
            logger.warning('%s', finding)
    smoothed = smoothed_run(run, truth) if request.smooth else None
    if map_frame != request.inputs.map_frame:
        logger.warning(
            "The map is in frame '%s', and so is what is written; the node takes it with "
            'map_frame: %s only.',
            map_frame,
            map_frame,
        )
    return replace(result, judged=findings, smoothed=smoothed)


def _check_used(request: Request, use: Sequence[Finding]) -> None:
    """Raise a UsageError if no observation was used, and something that is asked for needs one."""
    needs_some = request.smooth or request.keeps_map or request.load_map is not None
    for finding in use:
        if needs_some and finding.kind in ('no_observation', 'nothing_used'):
            raise UsageError(
                f'{finding.what}; --smooth, --map and --load-map need some: {finding.remedy}'
            )


def _check_localised(
    request: Request,
    run: Replay,
    maps: Sequence[LandmarkMap],
    look_for_mistakes: Callable[[], Sequence[Finding]],
) -> None:
    """Refuse an outcome that is not in the frame of the map that was loaded.

    Where the pose in it was found and lost again the trajectory is still of use, but not the map:
    a UsageError says if the pose was never found, or not at the end and the map is asked for.
    """
    if run.localised_ns is None:
        why = '; '.join(map(str, look_for_mistakes())) or _never_found(run, maps)
        raise UsageError(f'the pose in the map {request.load_map} was not found: {why}')
    if request.keeps_map or request.smooth:
        end_s = run.seconds_until(run.localised_ns[1])
        raise UsageError(
            f'the pose in the map {request.load_map} was lost after {end_s:.1f} s, and not found '
            'again; --map and --smooth need it at the end'
        )


def _never_found(run: Replay, maps: Sequence[LandmarkMap]) -> str:
    """Say why the landmarks seen did not determine the pose, and what to do."""
    estimator, counts, settings = run.estimator, run.estimator.counts, run.estimator.settings
    if counts['unknown_id']:
        advice = f'; {counts["unknown_id"]} points without id take --gains riccati'
    elif 2 * counts['repeated_id'] > counts['observed_point']:
        advice = f'; {counts["repeated_id"]} points were {Reason.REPEATED_ID.words}'
    elif settings.set_initial_pose:
        advice = '; they contradict the pose that was given'
    else:
        advice = (
            '. Where the start is known: --set set_initial_pose=true '
            '--set initial_pose=[X,Y,Z,ROLL,PITCH,YAW]'
        )
    problem = estimator.localisation_problem
    if problem and problem.kind in ('other_hall', 'other_ids'):
        return f'{problem.what}; {problem.remedy}'
    if problem and (is_automatic(estimator.landmark_ids).any() or len(estimator.possible_poses)):
        return f'{problem.what}{advice}'
    least = 'two' if settings.two_d_mode else 'three'
    ids = np.concatenate([known.ids for known in maps])
    seen = np.isin(ids[~is_automatic(ids)], estimator.landmark_ids).sum()
    return (
        f'that takes {least} of its landmarks or more, recognised by their ids, well apart, and '
        f'seen where the map has them; {seen} of its {len(ids)} were seen{advice}'
    )


@contextmanager
def _estimate_writer(
    request: Request,
    recording: Recording,
    selected: SelectedTopics,
    inputs: InputSettings,
    map_frame: str,
) -> Iterator[EstimateWriter | None]:
    """Give what writes the file of ``--mcap``, which is there when the block ends; else None."""
    path = request.mcap
    if path is None:
        yield None
        return
    from slam_observer_ros.recordings.writer import RecordingWriter  # a while to import
    from slam_observer_ros.runs.estimate_writer import EstimateWriter, TOPICS

    base_frame = inputs.base_frame or InputSettings().base_frame
    taken = [topic.name for topic in selected.inputs if topic.name in TOPICS]
    with RecordingWriter(path, overwrite=request.overwrite) as writer:
        transforms, has_parent = selected.transforms, False
        if request.with_inputs:
            if taken:
                raise UsageError(
                    f'--with-inputs: {", ".join(taken)} would be an input and an output of '
                    f'{path}; leave it out'
                )
            for topic in recording.copy_to(writer, selected):
                logger.warning('%s is left out of %s: its type is unknown.', topic, path)
            topics = (*transforms.static, *transforms.moving)
            has_parent = recording.contents.has_parent_of(base_frame, topics)
        elif not recording.contents.has_parent_of(base_frame, transforms.static):
            recording.copy_static_to(writer, selected)  # where the sensors are on the robot
        if has_parent:
            logger.warning(
                "%s has no transform from '%s' to '%s': the inputs on /tf have another parent of "
                "'%s'.",
                path,
                map_frame,
                base_frame,
                base_frame,
            )
        yield EstimateWriter(
            writer, map_frame, base_frame, ObserverNodeSettings().publish_rate, not has_parent
        )
