"""Messages of ROS 1 as those of ROS 2, and the definitions that recordings have of types."""

from __future__ import annotations

from functools import cached_property
import re
from typing import Any, TYPE_CHECKING

from slam_observer_ros.common.errors import RecordingError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


_IDL = re.compile(r'\s*(=+\s*IDL:|#include|module\b)')


def types_in(definition: str, message_type: str) -> dict[str, Any]:
    """Return what a definition defines, as rosbags has it; nothing if it can't be read."""
    if not definition:
        return {}
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, TypesysError

    try:
        if _IDL.match(definition):
            return dict(get_types_from_idl(definition))
        return dict(get_types_from_msg(definition, message_type))
    except (TypesysError, LookupError, ValueError):
        return {}


class Ros1Messages:
    """Turns serialised messages of ROS 1 into CDR."""

    @cached_property
    def _typestore(self) -> Typestore:
        from rosbags.typesys import get_typestore, Stores  # which takes a while to import

        return get_typestore(Stores.ROS2_JAZZY)

    def to_cdr(self, data: bytes, message_type: str, definition: str) -> memoryview:
        """Return a message as CDR; raise RecordingError if nothing defines its type."""
        types = self._typestore.types
        if message_type not in types:
            defined = types_in(definition, message_type)
            self._typestore.register({k: v for k, v in defined.items() if k not in types})
        if message_type not in types:
            raise RecordingError(f'messages of type {message_type} are read of ROS 2 only')
        return self._typestore.ros1_to_cdr(data, message_type)
