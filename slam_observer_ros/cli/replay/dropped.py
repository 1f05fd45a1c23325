"""Messages of a recording that did not become events, and events that were not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from slam_observer_ros.recording.reader import Recording
from slam_observer_ros.recording.topics import SelectedTopics

MALFORMED = 'malformed'
"""Reason under which messages that can't be decoded are counted."""


def unused_messages(recording: Recording, selected: SelectedTopics) -> Counter[str]:
    """Count the messages that did not become events, by reason."""
    malformed = sum(recording.malformed[topic.name] for topic in selected.inputs)
    return recording.dropped + Counter({MALFORMED: malformed})


def list_dropped(dropped: Mapping[str, int]) -> str:
    """Return how many events were dropped, by reason, as text."""
    return ', '.join(f'{count} {reason}' for reason, count in dropped.items()) or 'none'
