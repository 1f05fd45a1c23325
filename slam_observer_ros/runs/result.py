"""What a run is asked for, and all that came of it: data, which ``runs/replay.py`` makes.

Table, JSON, report and batch are views of a :class:`Result`, and of nothing else.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import explained, Finding, found
from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.estimates import (
    CalibrationEstimate,
    Innovations,
    Instant,
    Outcome,
    RangePower,
    Reason,
    Smoothed,
)
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.estimator.placement import make_gains
from slam_observer_ros.lie import se3
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.sources import Loss
from slam_observer_ros.recordings.topics import SelectedTopics, TopicNames
from slam_observer_ros.recordings.trajectory import interpolate, LandmarkTruth, Trajectory, Truth
from slam_observer_ros.runs.metrics import ConfigurationError, pose_errors, TrajectoryErrors
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import table, Value

logger = logging.getLogger(__name__)

INPUT_NAMES = frozenset(row.name for row in table(InputSettings))
"""Parameters of the node that a replay knows, too."""


@dataclass(frozen=True, slots=True)
class Request:
    """A recording, and how it is to be replayed; it can be sent to another process or machine.

    The base frame of ``inputs`` is empty if the user names none. Beside the figures are kept,
    where asked for: all poses, NIS, all that a page shows (``keeps_run``), and the map. The
    estimate is written as a recording ``mcap``, with its inputs or without, which replaces none
    unless ``overwrite``.
    """

    recording: Path
    settings: Settings
    inputs: InputSettings
    topics: TopicNames = TopicNames()
    load_map: Path | None = None
    smooth: bool = False
    keeps_poses: bool = False
    keeps_nis: bool = True
    keeps_run: bool = False
    keeps_map: bool = False
    mcap: Path | None = None
    with_inputs: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Raise a UsageError if it is to smooth with gains that can't."""
        if self.smooth:
            self.need_errors('--smooth')

    def with_values(self, values: Mapping[str, Value]) -> Request:
        """Return the same with other values of some parameters."""
        of_inputs: dict[str, Any] = {n: v for n, v in values.items() if n in INPUT_NAMES}
        others: dict[str, Any] = {n: v for n, v in values.items() if n not in INPUT_NAMES}
        return replace(
            self,
            settings=replace(self.settings, **others),
            inputs=replace(self.inputs, **of_inputs).with_plain_frames(),
        )

    def need_errors(self, what: str) -> None:
        """Raise a UsageError unless its gains know their errors, which ``what`` needs."""
        if make_gains(self.settings, np.eye(4)).errors is None:
            raise UsageError(f'{what} needs riccati gains, not {self.settings.gains}')

    def select_inputs(self, recording: Recording) -> tuple[SelectedTopics, InputSettings, Truth]:
        """Return the topics to be read, the settings with the frames of these, and the truth.

        A ParameterError is raised if the node refuses these frames.
        """
        if recording.warning:
            logger.warning('%s', found('incomplete_recording', problem=recording.warning))
        selected = recording.find_topics(self.topics, self.inputs)
        inputs, default = self.inputs, InputSettings().base_frame
        if not inputs.base_frame:
            inputs = replace(inputs, base_frame=self._base_frame(recording, selected, default))
        replace(inputs, base_frame=inputs.base_frame or default).check_frames()
        truth = recording.truth(selected, inputs.base_frame)
        return selected, inputs, truth.flattened() if self.settings.two_d_mode else truth

    def _base_frame(self, recording: Recording, selected: SelectedTopics, default: str) -> str:
        """Return the base frame that no user names: the frame of the velocities.

        If they name none it is the node's default, if /tf has that; else, with a warning, the
        landmarks'.
        """
        inputs = self.inputs
        world = ('', inputs.map_frame, inputs.odom_frame)
        velocity_frame, base_frame = recording.contents.frames(selected, inputs)
        base_frame = inputs.sensor_frame or base_frame
        if velocity_frame not in world:
            base_frame = velocity_frame
        elif base_frame not in (*world, default):
            if recording.contents.has_transform_of(default, selected):
                base_frame = default
            else:
                logger.warning('%s', found('guessed_base', frame=base_frame))
        return '' if base_frame in world else base_frame


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What came of a replay; since the last reset, if the clock jumped."""

    estimator: Estimate  # in its final state, with the map and the events dropped
    trajectory: Trajectory  # of the online estimate
    pose_covariances: FloatArray | None  # (k, 6, 6) of its poses; None without truth to compare
    dead_reckoning: Trajectory  # what the velocities alone give, from the identity pose
    configuration: ConfigurationError  # after each observation; empty without truth
    events: int  # dropped ones included; this and the last two also before the last reset
    seconds: float  # CPU time of the estimator alone, without reading and measuring
    in_known_map: bool
    start_ns: int  # stamp of the first event that was used; 0 if none was
    localised_ns: tuple[int, int] | None  # first and last stamp at which the final frame was known
    range_power: RangePower | None  # how ranges grow with the cosine off the sensor's axis
    has_points: bool  # by which mistakes are judged: whole ones with ids
    observations: int  # with points that were used
    angular_velocities: int  # of an Imu, that were taken in

    def seconds_until(self, stamp_ns: int) -> float:
        """Return the time from the first event to a stamp, seconds."""
        return to_s(stamp_ns - self.start_ns)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """What was smoothed, and its errors as :class:`Result` has them.

    The trajectory is at the stamps of the online one since the first of these observations, and
    ``online_errors`` are of that part.
    """

    estimate: Smoothed
    trajectory: Trajectory
    pose_errors: TrajectoryErrors | None
    online_errors: TrajectoryErrors | None
    landmark_rmse_m: float | None


MALFORMED = 'malformed'  # reason under which messages that can't be decoded are counted
MIN_GAP_S = 3.0  # shortest stretch without a used landmark that is marked


def list_dropped(dropped: Mapping[str, int]) -> str:
    """Return how many events were dropped, by reason, as text."""
    return ', '.join(f'{count} {reason}' for reason, count in dropped.items()) or 'none'


@dataclass(frozen=True, slots=True)
class Sighting:
    """An observation of a landmark, or a change of the landmark itself, and what came of it."""

    seconds: float  # since the first event of the run
    sigmas: float  # Mahalanobis distance of the residual before the correction; NaN if unknown
    residual_m: float
    what: str


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """All that came of a recording; errors are None where the truth is not in it.

    Poses, dead reckoning and the map are each compared after one rigid alignment of their own.
    ``anees`` of the pose is also None where the gains know no covariance, and where no pose is
    certain to which the truth could be moved: in a known map, or if the truth begins too late.
    """

    run: Replay
    selected: SelectedTopics
    truth: Truth
    errors: TrajectoryErrors | None  # of the online trajectory
    dead_reckoning_errors: TrajectoryErrors | None
    landmark_rmse_m: float | None
    anees: float | None
    duration_s: float  # that the recording spans
    unused: Counter[str]  # messages that did not become events, by reason
    missing_ids: str  # what Contents.missing_ids says of the landmarks
    loss: Loss
    map_frame: str  # of what is written
    nis: float | None  # per degree of freedom, over the run
    innovations: Innovations  # all residuals, where the run was kept
    instants: Sequence[Instant]  # where it was, its states, the last one at its end
    smoothed: SmoothedRun | None = None  # where that was asked for
    judged: Sequence[Finding] = ()  # what is wrong with recording and estimate
    logged: Sequence[Finding | str] = ()  # on the way

    @property
    def settings(self) -> Settings:
        """The estimator's settings."""
        return self.run.estimator.settings

    @property
    def findings(self) -> list[Finding]:
        """What is wrong, the worst first, without what another finding explains."""
        others = [
            one for one in self.logged if isinstance(one, Finding) and one not in self.judged
        ]
        return sorted(explained([*self.judged, *others]), key=lambda each: -each.level)

    @property
    def events(self) -> int:
        """How many events came in, dropped ones included."""
        return self.run.events + self.unused.total()

    @property
    def dropped(self) -> dict[str, int]:
        """How many of them were dropped, by reason."""
        return dict(self.run.estimator.dropped + self.unused)

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
    def trajectory(self) -> Trajectory:
        """The smoothed trajectory, if that was asked for; else the online one."""
        return self.run.trajectory if self.smoothed is None else self.smoothed.trajectory

    @property
    def localised_after_s(self) -> float | None:
        """Time until the pose in a loaded map was found, seconds; None without such a map."""
        localised_ns = self.run.localised_ns
        if localised_ns is None or not self.run.in_known_map:
            return None
        return self.run.seconds_until(localised_ns[0])

    def life(self, landmark_id: int) -> list[Sighting]:
        """Return what came of each observation of a landmark, and of itself, by time."""
        seen, lines = self.innovations, []
        for row in np.flatnonzero(seen.ids == landmark_id).tolist():
            weight = float(seen.weights[row])
            what = 'used' if weight == 1.0 else f'used with weight {weight:.2f}'
            if weight == 0.0:
                what = Reason.REJECTED.words
            seconds = self.run.seconds_until(int(seen.stamps_ns[row]))
            figures = float(seen.distances[row]), float(seen.residuals_m[row])
            lines.append(Sighting(seconds, *figures, what))
        for each in self.without_residual:
            if each.landmark_id == landmark_id:
                seconds = self.run.seconds_until(each.stamp_ns)
                lines.append(Sighting(seconds, math.nan, math.nan, each.what.words))
        return sorted(lines, key=lambda line: line.seconds)

    @property
    def without_residual(self) -> list[Outcome]:
        """Outcomes that the innovations have not, as they have each residual that was rejected."""
        seen = self.innovations
        judged = set(zip(seen.stamps_ns.tolist(), seen.ids.tolist(), strict=True))
        return [
            each
            for each in self.run.estimator.outcomes
            if each.what is not Reason.REJECTED or (each.stamp_ns, each.landmark_id) not in judged
        ]

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Return times since the first event of the run, seconds."""
        return np.asarray((stamps_ns - self.run.start_ns) / 1e9)

    @property
    def instants_ns(self) -> IntArray:
        """(i,) stamps of the instants."""
        return np.array([instant.stamp_ns for instant in self.instants], dtype=np.int64)

    @property
    def calibration(self) -> Sequence[CalibrationEstimate]:
        """What was found out about the velocity in the end."""
        return self.instants[-1].calibration if self.instants else ()

    @property
    def used_s(self) -> FloatArray:
        """(u,) times at which landmarks were used, seconds."""
        innovations = self.innovations
        return np.unique(self.seconds(innovations.stamps_ns[innovations.weights > 0.0]))

    @property
    def gaps_s(self) -> FloatArray:
        """(g, 2) beginnings and ends of the stretches in which no landmark was used, seconds."""
        edges_s = np.concatenate([[0.0], self.used_s, self.seconds(self.instants_ns)[-1:]])
        is_gap = np.diff(edges_s) >= MIN_GAP_S
        return np.column_stack([edges_s[:-1][is_gap], edges_s[1:][is_gap]])

    @property
    def aligned_landmarks(self) -> LandmarkTruth | None:
        """The true landmarks where the estimate should have them; None without truth."""
        truth = self.truth.landmarks
        if truth is None or self.errors is None:
            return None
        return LandmarkTruth(truth.ids, self.errors.in_estimate(truth.world_points))

    def anchored_errors(self) -> tuple[FloatArray, IntArray] | None:
        """Return pose errors (a, 6) from the first pose on, and the rows (a,) of their instants.

        The covariance is of these: it counts from the first pose. None where there is no truth, or
        the pose is that in a loaded map.
        """
        if self.errors is None or self.run.in_known_map:
            return None
        true_poses, covered = interpolate(self.truth.trajectory, self.instants_ns)
        rows = np.flatnonzero(covered).astype(np.int64)
        if not len(rows):
            return None
        poses = np.array([self.instants[row].pose for row in rows.tolist()])
        anchored = poses[0] @ se3.inverse(true_poses[rows[0]]) @ true_poses[rows]
        return pose_errors(poses, anchored), rows
