"""Messages of ROS 1 as those of ROS 2."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from slam_observer_ros.common.errors import RecordingError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


class Ros1Messages:
    """Turns serialised messages of ROS 1 into CDR."""

    @cached_property
    def _typestore(self) -> Typestore:
        from rosbags.typesys import get_typestore, Stores  # which takes a while to import

        return get_typestore(Stores.ROS2_JAZZY)

    def to_cdr(self, data: bytes, message_type: str) -> memoryview:
        """Return a message as CDR; raise RecordingError if its type is not known."""
        if message_type not in self._typestore.types:
            raise RecordingError(f'messages of type {message_type} are read of ROS 2 only')
        return self._typestore.ros1_to_cdr(data, message_type)
