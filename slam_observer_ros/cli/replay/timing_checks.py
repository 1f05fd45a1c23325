"""What a replay warns of in the times of its messages: silence, and clocks that differ."""

from __future__ import annotations

from collections.abc import Mapping
import logging

from slam_observer_ros.recording.arrivals import Arrivals
from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics
from slam_observer_ros.settings.node_settings import ObserverNodeSettings

MAX_CLOCK_OFFSET_S = ObserverNodeSettings.max_clock_offset

MAX_AHEAD_S = 0.05
"""A message can be late, but not early."""

MAX_SILENCE = 0.1
"""Share of the time beyond which velocities that are missing are more than a pause."""

MAX_END_SILENCE = 1.0 / 3.0
"""Share of the time after which landmarks that come no more are more than out of view."""

FEWEST = 10
"""Messages that a topic of landmarks has at least if it can be said to have ended."""

logger = logging.getLogger(__name__)


def warn_of_timing(recording: Recording, selected: SelectedTopics) -> None:
    """Say which inputs of a recording, read to its end, were silent or are of another clock."""
    names = [topic.name for topic in selected.inputs]
    arrivals = recording.arrivals
    inputs = {name: arrivals[name] for name in names if name in arrivals and len(arrivals[name])}
    if not inputs:
        return
    start_s = min(arrivals.first_s for arrivals in inputs.values())
    end_s = recording.end_s
    velocity, landmarks = selected.velocity.name, selected.landmarks.name
    if velocity in inputs:
        silence_s = inputs[velocity].silence_s(start_s, end_s)
        consequence = 'the pose was held, but for what landmarks say'
        _warn_of_silence('velocity', velocity, silence_s, end_s - start_s, consequence)
    if selected.imu is not None and selected.imu.name in inputs:
        silence_s = inputs[selected.imu.name].silence_s(start_s, end_s)
        consequence = f'that of {velocity} was taken'
        _warn_of_silence(
            'angular velocity', selected.imu.name, silence_s, end_s - start_s, consequence
        )
    if landmarks in inputs:
        _warn_of_landmarks_end(landmarks, inputs[landmarks], start_s, end_s)
    _warn_of_clocks(inputs)


def _warn_of_silence(
    what: str, topic_name: str, silence_s: float, duration_s: float, consequence: str
) -> None:
    if silence_s > MAX_SILENCE * duration_s:
        logger.warning(
            'No %s on %s for %.1f s of %.1f s (velocity_timeout): %s.',
            what, topic_name, silence_s, duration_s, consequence,
        )  # fmt: skip


def _warn_of_landmarks_end(
    topic_name: str, arrivals: Arrivals, start_s: float, end_s: float
) -> None:
    silence_s = end_s - arrivals.last_s
    if len(arrivals) >= FEWEST and silence_s > MAX_END_SILENCE * (end_s - start_s):
        logger.warning(
            'No landmarks on %s for the last %.1f s of %.1f s: did the detector end?',
            topic_name,
            silence_s,
            end_s - start_s,
        )


def _warn_of_clocks(inputs: Mapping[str, Arrivals]) -> None:
    """Say which inputs have stamps of the future, or far from those of the velocity."""
    (first_name, first), *others = inputs.items()
    if first.ahead_s > MAX_AHEAD_S:
        logger.warning(
            "Stamps of %s are %.1f s ahead of the recorder's clock: synchronise the clocks.",
            first_name, first.ahead_s,
        )  # fmt: skip
    for name, arrivals in others:
        behind_s = arrivals.behind_s(first)
        is_early = min(arrivals.ahead_s, -behind_s) > MAX_AHEAD_S
        if is_early or abs(behind_s) > MAX_CLOCK_OFFSET_S:
            logger.warning(
                'Stamps of %s are %.1f s %s those of %s, by when both were received: synchronise '
                'the clocks; a node with correct_clock_offset takes this recording, played with '
                '--clock, as it is.',
                name, abs(behind_s), 'behind' if behind_s > 0.0 else 'ahead of', first_name,
            )  # fmt: skip
