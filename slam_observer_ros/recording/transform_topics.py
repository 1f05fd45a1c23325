"""Which of the trees of transforms in a recording belongs to what is replayed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import logging
from os.path import commonpath

from slam_observer_ros.messages.poses import TRANSFORMS
from slam_observer_ros.recording.sources import last_part, Topic

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TransformTopics:
    """/tf_static and /tf, or those of a namespace: each one topic, or none."""

    static: tuple[Topic, ...]
    moving: tuple[Topic, ...]


def transform_topics(topics: Sequence[Topic], inputs: Sequence[Topic]) -> TransformTopics:
    """Pick the /tf and the /tf_static of the robot whose measurements are replayed.

    Robots in namespaces may each have their own, with the same names of frames. Those of the
    namespace that the inputs share come first, then those further out, /tf at last. Where none
    of these is recorded, those of another namespace are taken if there is only one.
    """
    trees = [
        topic
        for topic in topics
        if topic.message_type == TRANSFORMS
        and topic.count
        and last_part(topic.name) in ('tf', 'tf_static')
    ]
    shared = commonpath([_namespace(topic) for topic in inputs])
    fitting = [tree for tree in trees if _encloses(_namespace(tree), shared)]
    if not fitting and len({_namespace(tree) for tree in trees}) == 1:
        fitting = trees
    if trees and not fitting:
        logger.warning(
            'No transforms are used: those on %s are of several robots, and none of them is in '
            'the namespace that %s share.',
            ', '.join(tree.name for tree in trees),
            ' and '.join(topic.name for topic in inputs),
        )
    innermost_last = sorted(fitting, key=lambda tree: len(_namespace(tree)))
    chosen = {last_part(tree.name): (tree,) for tree in innermost_last}
    return TransformTopics(chosen.get('tf_static', ()), chosen.get('tf', ()))


def _encloses(outer: str, inner: str) -> bool:
    return commonpath([outer, inner]) == outer


def _namespace(topic: Topic) -> str:
    return '/' + topic.name.strip('/').rpartition('/')[0]
