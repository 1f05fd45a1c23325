"""How a recording defines its messages: packages change, and keep the names; ROS 1 as ROS 2."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache, cached_property, partial
import re
from typing import Any, TYPE_CHECKING

from slam_observer_ros.common.errors import MessageError, RecordingError
from slam_observer_ros.events import ObservationEvent
from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.messages.detections import (
    decode_detections,
    DETECTIONS,
    OTHER_DETECTIONS,
)
from slam_observer_ros.messages.registry import Decode, decoders
from slam_observer_ros.settings.input_settings import message_types

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


@cache
def landmark_decoder(message_type: str, definition: str) -> Decode[ObservationEvent]:
    """Return what decodes landmarks of a type, as a recording defines it.

    Raises a RecordingError if it has other fields there than are known.
    """
    known = message_types('landmarks')[message_type]
    defined = types_in(definition, message_type)
    if message_type == DETECTIONS:
        return _decoder_of_detections(defined)
    if known.definition and message_type in defined:
        read = types_in(known.definition, message_type)
        right, there = _typestore(read), _typestore(read | defined)
        changed = [
            name
            for name in defined
            if name in read and _layout(right, name) != _layout(there, name)
        ]
        if changed:
            raise _other_release(changed)
    return decoders('landmarks')[message_type]


def _other_release(changed: Sequence[str]) -> RecordingError:
    names = ', '.join(name.rpartition('/')[2] for name in changed)
    package = changed[0].partition('/')[0]
    return RecordingError(
        f'{names} of {package} has other fields in this recording than in the releases that are '
        'read; record it with another one, or leave the topic out'
    )


def _decoder_of_detections(defined: dict[str, Any]) -> Decode[ObservationEvent]:
    detection = defined.get('vision_msgs/msg/Detection3D')
    if detection is None:
        return _of_galactic_or_foxy
    names = tuple(name for name, _ in detection[1])
    if names[:3] == ('header', 'results', 'bbox'):
        if names[3:] == ('id',):
            return decode_detections
        if names[3:] in OTHER_DETECTIONS:
            return partial(_named, *OTHER_DETECTIONS[names[3:]])
    raise _other_release(['vision_msgs/msg/Detection3D'])


def _of_galactic_or_foxy(raw: Buffer, receive_ns: int) -> ObservationEvent:
    """Decode detections of a recording that does not say how: Foxy's never do."""
    try:
        return decode_detections(raw, receive_ns)
    except MessageError:
        with suppress(MessageError):
            return next(iter(OTHER_DETECTIONS.values()))[1](raw, receive_ns)
        raise


def _named(
    release: str, decode: Decode[ObservationEvent], raw: Buffer, receive_ns: int
) -> ObservationEvent:
    try:
        return decode(raw, receive_ns)
    except MessageError as error:
        raise MessageError(f'{error} (fields as in vision_msgs of {release})') from error


def _typestore(defined: dict[str, Any]) -> Typestore:
    """Return the common types, and others that are defined."""
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({name: what for name, what in defined.items() if name not in store.types})
    return store


def _layout(store: Typestore, message_type: str) -> tuple[object, ...]:
    """Return the types of all bytes, whatever the names of fields."""

    def of(described: Any) -> object:
        kind, what = described
        if isinstance(what, str):
            return _layout(store, what) if what in store.fielddefs else what
        return kind.name, of(what[0]) if isinstance(what[0], tuple) else what[0], what[1]

    return tuple(of(described) for _, described in store.fielddefs[message_type][1])


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
