"""What a recording gives reason to warn of: what of it was used, and the times of its messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

from slam_observer_ros.common.findings import Finding, found
from slam_observer_ros.estimates import Reason
from slam_observer_ros.recordings.contents import Arrivals
from slam_observer_ros.recordings.decoding import input_decoders
from slam_observer_ros.recordings.event_builder import NO_TRANSFORM
from slam_observer_ros.recordings.reader import Recording
from slam_observer_ros.recordings.topics import SelectedTopics
from slam_observer_ros.runs.health import of_stamps
from slam_observer_ros.runs.reported_run import Replay
from slam_observer_ros.settings.node_settings import (
    InputSettings,
    ObserverNodeSettings,
    POSE_DIFFERENCES,
)

MALFORMED = 'malformed'
"""Reason under which messages that can't be decoded are counted."""

PLACE_THE_SENSOR = (
    '--set sensor_pose=[X,Y,Z,ROLL,PITCH,YAW] places a sensor that is not on /tf, '
    '--base-frame names another frame of the robot'
)
"""What to do where /tf does not connect sensor and robot."""

MAX_CLOCK_OFFSET_S = ObserverNodeSettings.max_clock_offset

MAX_AHEAD_S = 0.05
"""A message can be late, but not early."""

MAX_SILENCE = 0.1
"""Share of the time beyond which velocities that are missing are more than a pause."""

MAX_END_SILENCE = 1.0 / 3.0
"""Share of the time after which landmarks that come no more are more than out of view."""

FEWEST = 10
"""Messages that a topic of landmarks has at least if it can be said to have ended."""


def unused_messages(recording: Recording, selected: SelectedTopics) -> Counter[str]:
    """Count the messages that did not become events, by reason."""
    malformed = sum(recording.malformed[topic.name] for topic in selected.inputs)
    return recording.dropped + Counter({MALFORMED: malformed})


def list_dropped(dropped: Mapping[str, int]) -> str:
    """Return how many events were dropped, by reason, as text."""
    return ', '.join(f'{count} {reason}' for reason, count in dropped.items()) or 'none'


def of_use(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, result: Replay
) -> Iterator[Finding]:
    """Judge whether velocities and observations, and an Imu's angular ones, were of use."""
    counts = result.estimator.counts
    dropped = result.estimator.dropped + unused_messages(recording, selected)
    # In a loaded map there may be none as its pose was not found, which is refused by itself.
    is_lost = counts['observed_point'] > 0 and not result.estimator.is_localised
    has_observations = result.observations > 0 or is_lost
    if not has_observations:
        kind = 'no_observation' if counts['velocity'] else 'nothing_used'
        remedy = _remedy_where_none_was_used(
            recording, selected, inputs, _unused_points(counts) + dropped
        )
        finding = found(kind, dropped=list_dropped(_unused_points(counts) + dropped))
        yield replace(finding, remedy=remedy or finding.remedy)
    elif not counts['velocity']:
        yield found('no_velocity', dropped=list_dropped(dropped))
    if selected.imu is not None and not result.angular_velocities:
        yield found(
            'no_angular_velocity',
            topic=selected.imu.name,
            dropped=list_dropped(dropped),
            instead=selected.velocity.name,
        )


def _unused_points(counts: Counter[str]) -> Counter[str]:
    """Return how many observations had no point that is used, and why the points were not."""
    return Counter({'without a point that is used': counts['observation']}) + Counter(
        {f'points {reason.words}': counts[reason.value] for reason in Reason}
    )


def _remedy_where_none_was_used(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, dropped: Counter[str]
) -> str:
    """Return what may be wrong where no observation was used; empty if nothing is known."""
    for finding in of_clocks(recording, selected):
        return f'{finding.what}: {finding.remedy}'
    is_unplaced = recording.dropped[NO_TRANSFORM] > 0
    if dropped and not is_unplaced:
        return ''
    missing_tags = recording.contents.missing_tags(selected, inputs.tag_frame_prefix)
    return missing_tags or (PLACE_THE_SENSOR if is_unplaced else '')


def of_recording(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings, result: Replay
) -> Iterator[Finding]:
    """Judge what was read, to its end: damage, stamps, and an odometry's poses."""
    if result.resets:
        seconds = result.seconds_until(result.estimator.stamp_ns or 0)
        yield found('clock_jumped', seconds=seconds, count=result.resets)
    if recording.loss and not recording.warning:
        yield found('damaged', path=recording.path, loss=recording.loss)
    yield from of_stamps(recording.unstamped)
    yield from of_publishers(recording, selected, inputs)
    if inputs.velocity_source != POSE_DIFFERENCES:
        yield from _of_poses(recording, selected, result)


def of_publishers(
    recording: Recording, selected: SelectedTopics, inputs: InputSettings = InputSettings()
) -> Iterator[Finding]:
    """Say on which of the topics of velocities more than one publishes, by what is on them."""
    decoders = input_decoders(selected, replace(inputs, velocity_source='twist'))
    for topic in (selected.velocity, selected.imu):
        if topic is not None:
            signs = recording.contents.signs_of_rivals(topic, decoders[topic])
            if signs:
                yield found('several_publishers', count=2, names=signs, topic=topic.name)


def _of_poses(recording: Recording, selected: SelectedTopics, result: Replay) -> Iterator[Finding]:
    """Say where the motion is, if an odometry's velocities are not how its poses move."""
    poses, velocity = result.dead_reckoning.poses, selected.velocity
    stands_still = len(poses) > 1 and bool((poses == poses[0]).all())
    if stands_still and recording.contents.poses_move(velocity):
        yield found('zero_twist', topic=velocity.name)
        return
    problem = recording.contents.twist_problem(velocity, selected.imu is None)
    if problem and not stands_still:
        yield found('wrong_twist', topic=velocity.name, problem=problem)


def of_timing(recording: Recording, selected: SelectedTopics) -> Iterator[Finding]:
    """Say which inputs of a recording, read to its end, were silent or are of another clock."""
    names = [topic.name for topic in selected.inputs]
    arrivals = recording.arrivals
    inputs = {name: arrivals[name] for name in names if name in arrivals and len(arrivals[name])}
    if not inputs:
        return
    start_s = min(arrivals.first_s for arrivals in inputs.values())
    end_s = recording.end_s
    velocity, landmarks = selected.velocity.name, selected.landmarks.name
    held = [('velocity', velocity, 'the pose was held, but for what landmarks say')]
    if selected.imu is not None:
        held.append(('angular velocity', selected.imu.name, f'that of {velocity} was taken'))
    for input_name, topic, consequence in held:
        if topic not in inputs:
            continue
        silence_s = inputs[topic].silence_s(start_s, end_s)
        if silence_s > MAX_SILENCE * (end_s - start_s):
            yield found(
                'silence',
                input=input_name,
                topic=topic,
                silence_s=silence_s,
                duration_s=end_s - start_s,
                consequence=consequence,
            )
    if landmarks in inputs:
        yield from _of_end(landmarks, inputs[landmarks], start_s, end_s)
    yield from of_clocks(recording, selected)


def _of_end(topic: str, arrivals: Arrivals, start_s: float, end_s: float) -> Iterator[Finding]:
    silence_s = end_s - arrivals.last_s
    if len(arrivals) >= FEWEST and silence_s > MAX_END_SILENCE * (end_s - start_s):
        duration_s = end_s - start_s
        finding = found('landmarks_end', topic=topic, silence_s=silence_s, duration_s=duration_s)
        yield replace(finding, start_s=arrivals.last_s - start_s, end_s=duration_s)


def of_clocks(recording: Recording, selected: SelectedTopics) -> Iterator[Finding]:
    """Say which inputs have stamps of the future, of 1970, or far from the velocity's."""
    read = recording.arrivals
    inputs = {t.name: read[t.name] for t in selected.inputs if len(read.get(t.name, ()))}
    of_1970 = [name for name, arrivals in inputs.items() if arrivals.counts_from_start]
    if 0 < len(of_1970) < len(inputs):  # else all are of a simulation
        yield found('stamps_of_1970', topics=' and '.join(of_1970))
        return
    for number, (name, arrivals) in enumerate(inputs.items()):
        if not number:
            first_name, first = name, arrivals
            if first.ahead_s > MAX_AHEAD_S:
                yield found('early_stamps', topic=name, ahead_s=first.ahead_s)
            continue
        behind_s = arrivals.behind_s(first)
        is_early = min(arrivals.ahead_s, -behind_s) > MAX_AHEAD_S
        if is_early or abs(behind_s) > MAX_CLOCK_OFFSET_S:
            side = 'behind' if behind_s > 0.0 else 'ahead of'
            yield found(
                'other_clock', topic=name, offset_s=abs(behind_s), side=side, other=first_name
            )
