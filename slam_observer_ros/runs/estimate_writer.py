"""The estimate of a replay as a recording, as the node would have published it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import logging
from typing import Any, TYPE_CHECKING

from slam_observer_ros.common.errors import UsageError
from slam_observer_ros.common.findings import in_brief, Level, worst_first
from slam_observer_ros.common.stamps import is_due, NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FIRST_AUTOMATIC_ID
from slam_observer_ros.estimates import Update
from slam_observer_ros.estimator.estimate import Estimate
from slam_observer_ros.messages.outgoing import (
    encode_transform,
    EstimateMessages,
    OutgoingMessages,
    PATH_SPACING_NS,
    StateMessages,
    uncertain_pose,
)
from slam_observer_ros.messages.poses import ODOMETRY, TRANSFORMS
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.runs.health import estimator_values, of_now
from slam_observer_ros.runs.result import Request, Result
from slam_observer_ros.settings.node_settings import InputSettings, ObserverNodeSettings

if TYPE_CHECKING:
    from slam_observer_ros.recordings.writer import RecordingWriter

logger = logging.getLogger(__name__)

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

OVERVIEW_PERIOD_NS = 1_000_000_000  # time between two maps, nanoseconds

ODOMETRY_TOPIC = '/observer_node/odometry'
MAP_TOPIC = '/landmark_map'
DIAGNOSTICS_TOPIC = '/diagnostics'
TOPICS = (
    ODOMETRY_TOPIC, '/pose', '/lyapunov', '/path', MAP_TOPIC, '/markers', DIAGNOSTICS_TOPIC,
)  # fmt: skip
"""Topics of the estimate, named as the node's."""

ALIGNED_POSE_TOPIC = '/aligned_truth/pose'
ALIGNED_LANDMARKS_TOPIC = '/aligned_truth/landmark_map'


class EstimateWriter:
    """Writes the estimate to a recording while a replay goes on.

    Messages are received at their stamps. ``publishes_tf`` says whether the pose goes out on /tf,
    where each frame has one parent.
    """

    def __init__(
        self,
        writer: RecordingWriter,
        map_frame: str,
        base_frame: str,
        rate_hz: float,
        publishes_tf: bool,
    ) -> None:
        self._writer, self._write = writer, writer.write_message
        self._messages = EstimateMessages(writer.messages, map_frame)
        self._state = StateMessages(map_frame, base_frame)
        self._map_frame, self._base_frame = map_frame, base_frame
        self._period_ns = round(NANOSECONDS_PER_SECOND / rate_hz)
        self._publishes_tf = publishes_tf
        self._path: list[Any] = []
        self.clear()

    def clear(self) -> None:
        """Forget the path and when something was written: the run has started again."""
        self._path.clear()
        self._state_ns: int | None = None
        self._path_ns: int | None = None
        self._overview_ns: int | None = None

    def note_stamp(self, estimator: Estimate) -> None:
        """Write the state when all events of a stamp have been used, if it is due."""
        stamp_ns = estimator.stamp_ns
        if stamp_ns is None or not estimator.is_localised:
            return
        if is_due(stamp_ns, self._state_ns, self._period_ns):
            self._state_ns = stamp_ns
            self._write_state(estimator, stamp_ns)
        if is_due(stamp_ns, self._overview_ns, OVERVIEW_PERIOD_NS):
            self._overview_ns = stamp_ns
            self._write_landmarks(estimator, stamp_ns)

    def note_update(self, update: Update) -> None:
        """Write how far off an observation was, in standard deviations."""
        self._write('/lyapunov', self._messages.value(update.lyapunov), update.stamp_ns)
        innovation = update.innovation
        if innovation is None or not len(update.ids):
            return
        ids = update.ids.tolist()
        for landmark_id, distance in zip(ids, innovation.distances.tolist(), strict=True):
            if landmark_id < FIRST_AUTOMATIC_ID:
                topic = f'/residual_sigma/landmark_{landmark_id}'
                self._write(topic, self._messages.value(distance), update.stamp_ns)
        if innovation.nis is not None:
            per_degree = innovation.nis / innovation.degrees_of_freedom
            self._write('/nis', self._messages.value(per_degree), update.stamp_ns)

    def finish(self, result: Result) -> None:
        """Write the path, the map at the end, and the truth moved to where the estimate has it."""
        estimator, errors = result.run.estimator, result.errors
        stamp_ns = estimator.stamp_ns
        if stamp_ns is not None and estimator.is_localised:
            self._write('/path', self._messages.path(stamp_ns, self._path), stamp_ns)
            self._write_landmarks(estimator, stamp_ns)
        if errors is None:
            return
        truth = errors.aligned_truth
        for true_ns, pose in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
            self._write(ALIGNED_POSE_TOPIC, self._messages.path_pose(true_ns, pose), true_ns)
        if (landmarks := result.aligned_landmarks) is not None:
            first_ns, aligned = int(truth.stamps_ns[0]), (landmarks.ids, landmarks.world_points)
            cloud = self._writer.messages.point_cloud2(first_ns, self._map_frame, *aligned)
            self._write(ALIGNED_LANDMARKS_TOPIC, cloud, first_ns, latched=True)

    def _write_state(self, estimator: Estimate, stamp_ns: int) -> None:
        pose, covariance = estimator.uncertain_pose
        uncertain = uncertain_pose(pose, covariance)
        message = self._state.pose(stamp_ns, uncertain)
        self._writer.write('/pose', POSE, message, stamp_ns, latched=True)
        velocity = estimator.body_velocity, estimator.body_velocity_covariance
        odometry = self._state.odometry(stamp_ns, uncertain, *velocity)
        self._writer.write(ODOMETRY_TOPIC, ODOMETRY, odometry, stamp_ns)
        if self._publishes_tf:
            transform = encode_transform(stamp_ns, self._map_frame, self._base_frame, pose)
            self._writer.write('/tf', TRANSFORMS, transform, stamp_ns)
        if is_due(stamp_ns, self._path_ns, PATH_SPACING_NS):
            self._path_ns = stamp_ns
            self._path.append(self._messages.path_pose(stamp_ns, pose))

    def _write_landmarks(self, estimator: Estimate, stamp_ns: int) -> None:
        points, velocities = estimator.world_points, estimator.landmark_velocities
        landmarks = estimator.landmark_ids, points, estimator.landmark_covariances
        cloud = self._messages.landmarks(stamp_ns, *landmarks, velocities)
        self._write(MAP_TOPIC, cloud, stamp_ns, latched=True)
        last, doubted = estimator.last_update, estimator.doubted_ids
        markers = self._messages.markers(stamp_ns, *landmarks, last, doubted)
        self._write('/markers', markers, stamp_ns)
        status = diagnostics(self._writer.messages, stamp_ns, estimator, self._base_frame)
        self._write(DIAGNOSTICS_TOPIC, status, stamp_ns)
        for part in estimator.calibration:
            topic = f'/calibration/{part.name}'
            self._write(topic, self._messages.value(part.value), stamp_ns)
            self._write(f'{topic}_stddev', self._messages.value(part.deviation), stamp_ns)


@contextmanager
def estimate_writer(
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


def diagnostics(
    messages: OutgoingMessages, stamp_ns: int, estimator: Estimate, hardware_id: str
) -> Any:
    """Make the diagnostic_msgs/DiagnosticArray of an estimate, named as the node's."""
    findings = of_now(estimator)
    problems = worst_first(findings, [])
    values = estimator_values(estimator, estimator.dropped, findings)
    status = messages.make(
        'diagnostic_msgs/msg/DiagnosticStatus',
        level=Level.WARNING if problems else Level.NOTE,
        name='observer_node: estimate',
        message=in_brief(problems) or 'running',
        hardware_id=hardware_id,
        values=[
            messages.make('diagnostic_msgs/msg/KeyValue', key=key, value=value)
            for key, value in values.items()
        ],
    )
    header = messages.header(stamp_ns, '')
    return messages.make('diagnostic_msgs/msg/DiagnosticArray', header=header, status=[status])
