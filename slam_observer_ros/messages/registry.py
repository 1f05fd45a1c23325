"""How decoders register what they read: node, replay, doctor, parameters and documents follow.

A decoder reads one message from a :class:`.CdrReader` and returns an event whose ``sensor_frame``
is the frame that the message names. Velocities and poses that follow each other in a recording
are read at once by the same function, from arrays that have an axis more: it works on the last
one, ``values[..., 3:]``, or is given one message after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, cast, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import IntArray
from slam_observer_ros.events import VelocityBlock, VelocityEvent
from slam_observer_ros.messages.cdr import Buffer, CdrBlockReader, CdrReader
from slam_observer_ros.settings.node_settings import message_types, MessageType, register, Role

MessageT = TypeVar('MessageT')
MessageT_co = TypeVar('MessageT_co', covariant=True)

# From a serialised message and its receive time, which only unstamped messages use.
Decode: TypeAlias = Callable[[Buffer, int], MessageT]
_COMPARED = 4  # messages of the first block that are read one by one as well


class Decoder(Generic[MessageT_co]):
    """Turns the bytes of messages into what a function reads of them; MessageError if malformed.

    The receive time, nanoseconds, is the reader's ``receive_ns``: only unstamped messages use it.
    """

    def __init__(self, read: Callable[[CdrReader], MessageT_co]) -> None:
        self._read = read
        update_wrapper(self, read)

    def __call__(self, raw: Buffer, receive_ns: int = 0) -> MessageT_co:
        """Decode a message."""
        return self._whole(CdrReader(raw, receive_ns))

    def block(self, rows: NDArray[np.uint8], receive_ns: IntArray) -> MessageT_co:
        """Decode messages (k, size) received at times (k,): numbers and arrays have an axis k."""
        return self._whole(CdrBlockReader(rows, receive_ns))

    def _whole(self, reader: CdrReader) -> MessageT_co:
        message = self._read(reader)
        reader.finish()
        return message


def reads(
    *names: str, role: Role, package: str = '', definition: str = '', is_ambiguous: bool = False
) -> Callable[[Callable[[CdrReader], MessageT]], Decoder[MessageT]]:
    """Register the decorated function as reader of types, as a :class:`.MessageType` has it."""

    def registered(read: Callable[[CdrReader], MessageT]) -> Decoder[MessageT]:
        decode = Decoder(read)
        for name in names:
            register(
                MessageType(name, role, decode, read.__module__, package, definition, is_ambiguous)
            )
        return decode

    return registered


def decoders(role: Role) -> dict[str, Decoder[Any]]:
    """Return what decodes the types that are read, by their names."""
    types = message_types(role).values()
    return {known.name: cast('Decoder[Any]', known.decode) for known in types}


class BlockDecoder:
    """Decodes velocities of many messages at once, if the first block shows that it can."""

    def __init__(self, decode: Decoder[VelocityEvent]) -> None:
        self._decode = decode
        self._is_right: bool | None = None

    def __call__(self, rows: NDArray[np.uint8], receive_ns: IntArray) -> VelocityBlock:
        """Return velocities of messages (k, size) of times (k,); MessageError if they differ."""
        if self._is_right is not False:
            try:
                read = self._decode.block(rows, receive_ns)
                stamps_ns, frame = cast('IntArray', read.stamp_ns), read.sensor_frame
                measured = read.body_velocity, read.covariance
                block = VelocityBlock(stamps_ns, *measured, receive_ns, frame)
            except (IndexError, TypeError, ValueError):
                self._is_right = False
            else:
                if self._is_right is None:
                    self._is_right = self._is_as_one_by_one(block, rows, receive_ns)
                if self._is_right:
                    return block
        raise MessageError('messages of this type are read one by one')

    def _is_as_one_by_one(
        self, block: VelocityBlock, rows: NDArray[np.uint8], receive_ns: IntArray
    ) -> bool:
        if block.body_velocities.shape != (len(rows), 6):
            return False
        some = block.part(slice(_COMPARED)).events()
        one_by_one = map(self._decode, map(np.ndarray.tobytes, rows), receive_ns.tolist())
        return all(
            _bits(one) == _bits(other) for one, other in zip(some, one_by_one, strict=False)
        )


def _bits(event: VelocityEvent) -> tuple[object, ...]:
    covariance = event.covariance
    bits = None if covariance is None else covariance.tobytes()
    return event.stamp_ns, event.body_velocity.tobytes(), bits, event.sensor_frame
