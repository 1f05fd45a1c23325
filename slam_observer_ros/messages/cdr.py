"""Plain CDR, the byte format of ROS 2 messages, without building message objects."""

from __future__ import annotations

import struct
from typing import Any, cast, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.stamps import NANOSECONDS_PER_SECOND
from slam_observer_ros.common.types import FloatArray, IntArray

# One serialised message, as rclpy's raw subscriptions and rosbags' raw data give it.
Buffer: TypeAlias = bytes | bytearray | memoryview
ENCAPSULATION_BYTES = 4
MAX_PADDING_BYTES = 3
_UINT16 = {'<': struct.Struct('<H'), '>': struct.Struct('>H')}
_INT32 = {'<': struct.Struct('<i'), '>': struct.Struct('>i')}
_UINT32 = {'<': struct.Struct('<I'), '>': struct.Struct('>I')}
_STAMP = {'<': struct.Struct('<iI'), '>': struct.Struct('>iI')}
_INT64 = {'<': np.dtype('<i8'), '>': np.dtype('>i8')}
_FLOAT32 = {'<': np.dtype('<f4'), '>': np.dtype('>f4')}
_FLOAT64 = {'<': np.dtype('<f8'), '>': np.dtype('>f8')}


class CdrReader:
    """Cursor over one message with its 4-byte encapsulation header, little or big endian.

    Every read checks that the bytes are there; bytes that are not plain CDR raise a MessageError.
    ``receive_ns`` is when the message was received, nanoseconds.
    """

    __slots__ = ('_byte_order', '_position', '_raw', 'receive_ns')

    def __init__(self, raw: Buffer, receive_ns: int = 0) -> None:
        if len(raw) < ENCAPSULATION_BYTES:
            raise MessageError(f'too short: {len(raw)} bytes hold no CDR header')
        if raw[0] != 0 or raw[1] > 1:
            raise MessageError(f'not plain CDR: encapsulation {bytes(raw[:2]).hex()}')
        self._raw, self.receive_ns, self._position = raw, receive_ns, ENCAPSULATION_BYTES
        self._byte_order = '<' if raw[1] else '>'

    def _take(self, size: int, alignment: int) -> int:
        # CDR aligns to the first byte after the encapsulation header.
        start = self._position + (ENCAPSULATION_BYTES - self._position) % alignment
        if start + size > len(self._raw):
            raise MessageError(f'too short: {start + size} bytes needed, {len(self._raw)} present')
        self._position = start + size
        return start

    def uint8(self) -> int:
        """Read one byte (uint8 or bool)."""
        return self._raw[self._take(1, 1)]

    def uint16(self) -> int:
        """Read a uint16."""
        value: int = _UINT16[self._byte_order].unpack_from(self._raw, self._take(2, 2))[0]
        return value

    def int32(self) -> int:
        """Read an int32."""
        value: int = _INT32[self._byte_order].unpack_from(self._raw, self._take(4, 4))[0]
        return value

    def uint32(self) -> int:
        """Read a uint32; also the length of a sequence."""
        value: int = _UINT32[self._byte_order].unpack_from(self._raw, self._take(4, 4))[0]
        return value

    def stamp_ns(self) -> int:
        """Read a builtin_interfaces/Time as nanoseconds."""
        seconds, nanoseconds = _STAMP[self._byte_order].unpack_from(self._raw, self._take(8, 4))
        if nanoseconds >= NANOSECONDS_PER_SECOND:
            raise MessageError(f'stamp with {nanoseconds} ns in its nanosecond field')
        stamp_ns: int = seconds * NANOSECONDS_PER_SECOND + nanoseconds
        return stamp_ns

    def string(self) -> str:
        """Read a string; its terminating NUL is left out."""
        size = self.uint32()
        start = self._take(size, 1)
        try:
            return bytes(self._raw[start : start + size]).rstrip(b'\0').decode()
        except UnicodeDecodeError as error:
            raise MessageError('a string is not UTF-8') from error

    def header(self) -> tuple[int, str]:
        """Read a std_msgs/Header: stamp in nanoseconds and frame id."""
        return self.stamp_ns(), self.string()

    def int64(self, count: int) -> IntArray:
        """Read ``count`` int64 values, shape (count,)."""
        return self._numbers(_INT64[self._byte_order], count).astype(np.int64)

    def float64(self, count: int) -> FloatArray:
        """Read ``count`` float64 values, shape (count,)."""
        return _quiet(self._numbers(_FLOAT64[self._byte_order], count))

    def float32(self, count: int) -> FloatArray:
        """Read ``count`` float32 values as float64, shape (count,)."""
        return _quiet(self._numbers(_FLOAT32[self._byte_order], count))

    def _numbers(self, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        if count == 0:  # CDR puts no alignment bytes before an empty sequence.
            return np.zeros(0, dtype)
        start = self._take(count * dtype.itemsize, dtype.itemsize)
        return np.frombuffer(self._raw, dtype, count, start)

    def data(self, size: int) -> memoryview:
        """Read ``size`` bytes without copying them."""
        start = self._take(size, 1)
        return memoryview(self._raw)[start : start + size]

    @property
    def bytes_left(self) -> int:
        """How many bytes are still to be read, but for padding: of a field of newer releases."""
        left = len(self._raw) - self._position
        return left if left > MAX_PADDING_BYTES else 0

    def finish(self) -> None:
        """Check that the message ends here: else it is of another type."""
        if self.bytes_left:
            raise MessageError(f'{self.bytes_left} bytes too long: is it of another type?')


class CdrBlockReader(CdrReader):
    """Cursor over k messages of one size (k, size), as :class:`CdrReader` is over one.

    Stamps are (k,), arrays (k, count), and times of reception (k,). All else that is read must be
    the same in all messages: else a MessageError is raised.
    """

    __slots__ = ('_rows',)

    def __init__(self, rows: NDArray[np.uint8], receive_ns: IntArray) -> None:
        super().__init__(rows[0].tobytes(), cast('int', receive_ns))
        self._rows = rows
        self._check_common(0, 2)

    def stamp_ns(self) -> Any:
        """Read builtin_interfaces/Time as nanoseconds (k,)."""
        times = self._numbers(np.dtype(f'{self._byte_order}u4'), 2)
        if (times[:, 1] >= NANOSECONDS_PER_SECOND).any():
            raise MessageError('a stamp with too much in its nanosecond field')
        seconds = times[:, 0].astype(np.int32).astype(np.int64)
        return seconds * NANOSECONDS_PER_SECOND + times[:, 1].astype(np.int64)

    def _take(self, size: int, alignment: int) -> int:
        start = super()._take(size, alignment)
        self._check_common(start, self._position)
        return start

    def _numbers(self, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        if count == 0:
            return np.zeros((len(self._rows), 0), dtype)
        start = super()._take(count * dtype.itemsize, dtype.itemsize)
        return np.ascontiguousarray(self._rows[:, start : self._position]).view(dtype)

    def _check_common(self, begin: int, end: int) -> None:
        if (self._rows[:, begin:end] != self._rows[0, begin:end]).any():
            raise MessageError('a string, or the byte order, is not the same in all messages')


def _quiet(values: NDArray[Any]) -> FloatArray:
    """Return values as float64 without signalling NaNs, for whoever reads them next."""
    with np.errstate(invalid='ignore'):  # Any bits may be there; a product, unlike a copy,
        quiet: FloatArray = np.multiply(values, 1.0, dtype=np.float64)  # makes them quiet.
    return quiet


def encode_string(text: str) -> bytes:
    """Serialise a string, with padding so that a 4-byte value may follow; little endian."""
    characters = text.encode() + b'\0'
    return struct.pack('<I', len(characters)) + characters + bytes(-len(characters) % 4)
