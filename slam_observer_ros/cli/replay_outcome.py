"""A replay, and how accurate it was."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import logging
import math
from pathlib import Path

from slam_observer_ros.common.errors import EvaluationError, UsageError
from slam_observer_ros.common.findings import Finding, found, Level
from slam_observer_ros.estimates import Smoothed
from slam_observer_ros.estimator.event_warnings import UNEXPECTED_POSES
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.sources import Loss, NOTHING_LOST
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.recordings.trajectory import Trajectory, Truth
from slam_observer_ros.runs.accuracy import (
    Accuracy,
    measure,
    measure_smoothed,
    smoothed_trajectory,
    SmoothedAccuracy,
)
from slam_observer_ros.runs.corrections import explained, SUSPICIOUS
from slam_observer_ros.runs.error_health import of_errors
from slam_observer_ros.runs.health import (
    of_all_learnt,
    of_estimate,
    of_fit,
    of_left_out,
    of_map,
    of_map_without_ids,
    of_ranges,
    of_rejections,
)
from slam_observer_ros.runs.input_health import MALFORMED, of_recording, of_timing, unused_messages
from slam_observer_ros.runs.metrics import TrajectoryErrors
from slam_observer_ros.runs.reported_run import NisTally, Replay, ReportedRun, RunRecorder
from slam_observer_ros.settings.node_settings import InputSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ReplayOutcome:
    """A replay, and all that is reported of it.

    ``unused`` counts the messages that did not become events, by reason; ``missing_ids`` is what
    :meth:`.Contents.missing_ids` says of the landmarks. What is smoothed, and the ``whole_run``
    that is shown, are None if not asked for. ``findings`` are what is wrong, the worst first, and
    ``warnings`` all that was logged.
    """

    selected: SelectedTopics
    result: Replay
    truth: Truth
    accuracy: Accuracy
    duration_s: float
    unused: Counter[str]
    missing_ids: str
    loss: Loss = NOTHING_LOST
    smoothed: Smoothed | None = None
    smoothed_trajectory: Trajectory | None = None
    smoothed_accuracy: SmoothedAccuracy | None = None
    recorder: RunRecorder | NisTally | None = None
    whole_run: ReportedRun | None = None
    findings: Sequence[Finding] = ()
    warnings: Sequence[str] = ()

    @property
    def events(self) -> int:
        """How many events came in, dropped ones included."""
        return self.result.events + self.unused.total()

    @property
    def dropped(self) -> dict[str, int]:
        """How many of them were dropped, by reason."""
        return dict(self.result.estimator.dropped + self.unused)

    @property
    def unused_input(self) -> str:
        """Which kind of input was of no use at all, as a sentence; '' if something of each was."""
        kinds = ('nothing_used', 'no_observation', 'no_velocity')
        return next((each.text() for each in self.findings if each.kind in kinds), '')

    @property
    def lost(self) -> dict[str, int | float | bool]:
        """What of the recording could not be read, as ``--json`` has it."""
        return {
            'bytes': self.loss.byte_count,
            'seconds': self.loss.seconds,
            'cut_off': self.loss.is_cut_off,
            'messages': self.loss.message_count,
            'malformed': self.unused[MALFORMED],
        }

    @property
    def shown(self) -> ReportedRun:
        """What was recorded to be shown; an EvaluationError is raised if nothing was."""
        if self.whole_run is None:
            raise EvaluationError('nothing was recorded that could be shown')
        return self.whole_run

    @property
    def trajectory(self) -> Trajectory:
        """The smoothed trajectory, if that was asked for; else the online one."""
        smoothed = self.smoothed_trajectory
        return self.result.trajectory if smoothed is None else smoothed

    @property
    def trajectory_errors(self) -> TrajectoryErrors | None:
        """Errors of :attr:`trajectory`; None without truth."""
        accuracy = self.accuracy if self.smoothed_accuracy is None else self.smoothed_accuracy
        return accuracy.pose_errors

    @property
    def truth_covered(self) -> float | None:
        """Share of the trajectory that the truth covers; None without true poses."""
        errors = self.accuracy.pose_errors
        return None if errors is None else errors.covered_share

    @property
    def localised_after_s(self) -> float | None:
        """Time until the pose in a loaded map was found, seconds; None without such a map."""
        localised_ns = self.result.localised_ns
        if localised_ns is None or not self.result.in_known_map:
            return None
        return self.result.seconds_until(localised_ns[0])

    @property
    def unaligned_rmse_m(self) -> float | None:
        """See :class:`.TrajectoryErrors`; None without truth or a loaded map."""
        errors = self.accuracy.pose_errors
        return errors.unaligned_rmse_m if errors and self.result.in_known_map else None


def outcome_of(
    recording: Recording,
    selected: SelectedTopics,
    result: Replay,
    truth: Truth,
    recorder: RunRecorder | NisTally | None,
) -> ReplayOutcome:
    """Measure a replay of a recording that has been read to its end."""
    estimator = result.estimator
    accuracy = measure(
        result.trajectory,
        None if result.in_known_map else result.pose_covariances,
        result.dead_reckoning,
        (estimator.landmark_ids, estimator.world_points),
        result.configuration,
        truth,
    )
    whole_run = None
    if isinstance(recorder, RunRecorder):
        whole_run = ReportedRun(
            settings=estimator.settings,
            start_ns=result.start_ns,
            trajectory=result.trajectory,
            dead_reckoning=result.dead_reckoning,
            in_known_map=result.in_known_map,
            truth=truth,
            errors=accuracy.pose_errors,
            anees=accuracy.anees,
            configuration=result.configuration,
            instants=recorder.finish(estimator),
            innovations=recorder.innovations,
            outcomes=estimator.outcomes,
        )
    return ReplayOutcome(
        selected,
        result,
        truth,
        accuracy,
        recording.duration_s,
        unused_messages(recording, selected),
        recording.contents.missing_ids(selected.landmarks),
        recording.loss,
        recorder=recorder,
        whole_run=whole_run,
    )


def judged(
    outcome: ReplayOutcome,
    recording: Recording,
    inputs: InputSettings,
    unused: Sequence[Finding],
    map_path: Path | None,
    look_for_mistakes: Callable[[], Sequence[Finding]],
) -> ReplayOutcome:
    """Add what is wrong, and log warnings; ``unused`` is of inputs of which nothing was used."""
    result, selected = outcome.result, outcome.selected
    findings = [
        *unused,
        *_of_lost_pose(result, map_path),
        *of_recording(recording, selected, inputs, result),
        *_of_run(outcome),
        *of_timing(recording, selected),
        *(of_errors(outcome.whole_run) if outcome.whole_run is not None else ()),
    ]
    reasons = [*findings, *of_all_learnt(result.estimator)]
    if result.estimator.counts['slip'] or any(each.kind in SUSPICIOUS for each in reasons):
        findings = [*look_for_mistakes(), *findings]
    findings = explained(findings)
    findings.sort(key=lambda finding: -finding.level)
    for finding in findings:
        if finding.level >= Level.WARNING:
            logger.warning('%s', finding)
    return replace(outcome, findings=findings)


def with_logged(outcome: ReplayOutcome, logged: Sequence[Finding | str]) -> ReplayOutcome:
    """Add what was logged on the way: findings, and other warnings."""
    others = [one for one in logged if isinstance(one, Finding) and one not in outcome.findings]
    findings = sorted(explained([*outcome.findings, *others]), key=lambda each: -each.level)
    return replace(outcome, findings=findings, warnings=[str(one) for one in logged])


def _of_lost_pose(result: Replay, map_path: Path | None) -> list[Finding]:
    if result.estimator.is_localised or result.localised_ns is None:
        return []
    end_s = result.seconds_until(result.localised_ns[1])
    return [found('lost_pose', path=map_path, seconds=end_s)]


def _of_run(outcome: ReplayOutcome) -> Iterator[Finding]:
    """Judge the estimate as /diagnostics does, and what only a whole run shows."""
    result = outcome.result
    estimator, counts = result.estimator, result.estimator.counts
    yield from of_rejections(counts)
    # What ranges are taken for comes first: where that is wrong, noise makes up for it.
    yield from of_ranges(result.range_power, estimator.settings.range_is_depth)
    yield from of_estimate(estimator)
    yield from _of_map_without_ids(result)
    nis = None if outcome.recorder is None else outcome.recorder.mean_nis
    yield from of_fit(None if nis is None else math.sqrt(nis))
    if result.in_known_map and estimator.settings.localization_mode != 'off':
        yield from of_map(counts, is_start_given=estimator.settings.set_initial_pose)
    # These were logged when they happened.
    yield from of_left_out(counts, Level.NOTE)
    for name in UNEXPECTED_POSES:
        if counts[name]:
            yield replace(found(name), level=Level.NOTE)


def _of_map_without_ids(result: Replay) -> Iterator[Finding]:
    ambiguity = result.estimator.longest_ambiguity
    for finding in of_map_without_ids(result.estimator, ambiguity):
        if ambiguity is not None and finding.kind == 'ambiguous_map':
            start_s, end_s = map(result.seconds_until, (ambiguity.since_ns, ambiguity.until_ns))
            yield replace(finding, start_s=start_s, end_s=end_s)
        else:
            yield finding


def with_smoothed(outcome: ReplayOutcome) -> ReplayOutcome:
    """Add trajectory and map smoothed; raise a UsageError if there is no observation to smooth."""
    smoothed = outcome.result.estimator.smooth()
    if not len(smoothed.stamps_ns):
        raise UsageError(f'nothing to smooth: no observation since {smoothed.since}')
    online = outcome.result.trajectory
    stamps_ns = online.stamps_ns
    parked = outcome.result.estimator.counts['parked_observation']
    if len(smoothed.stamps_ns) + parked < outcome.result.observations:
        stamps_ns = stamps_ns[stamps_ns >= smoothed.stamps_ns[0]]
        logger.warning(
            'Only the last %d observations are smoothed: those since %s.',
            len(smoothed.stamps_ns),
            smoothed.since,
        )
    trajectory = smoothed_trajectory(
        smoothed,
        stamps_ns,
        outcome.result.dead_reckoning,
        outcome.result.estimator,
    )
    accuracy = measure_smoothed(smoothed, trajectory, online, outcome.truth)
    whole_run = outcome.whole_run
    if whole_run is not None:
        whole_run = replace(
            whole_run,
            smoothed=trajectory,
            smoothed_points=smoothed.world_points,
            smoothed_errors=accuracy.pose_errors,
        )
    return replace(
        outcome,
        smoothed=smoothed,
        smoothed_trajectory=trajectory,
        smoothed_accuracy=accuracy,
        whole_run=whole_run,
    )
