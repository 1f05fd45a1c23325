"""Plain CDR, the byte format of ROS 2 messages, without building message objects."""

from __future__ import annotations

import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam_observer_ros.common.errors import MessageError
from slam_observer_ros.common.types import FloatArray, IntArray
from slam_observer_ros.common.units import NANOSECONDS_PER_SECOND

Buffer: TypeAlias = bytes | bytearray | memoryview
"""One serialised message, as rclpy's raw subscriptions and rosbags' raw data give it."""

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
    """

    __slots__ = ('_byte_order', '_position', '_raw')

    def __init__(self, raw: Buffer) -> None:
        if len(raw) < ENCAPSULATION_BYTES:
            raise MessageError(f'too short: {len(raw)} bytes hold no CDR header')
        if raw[0] != 0 or raw[1] > 1:
            raise MessageError(f'not plain CDR: encapsulation {bytes(raw[:2]).hex()}')
        self._raw = raw
        self._position = ENCAPSULATION_BYTES
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
        if count == 0:  # CDR puts no alignment bytes before an empty sequence.
            return np.zeros(0, dtype=np.int64)
        start = self._take(8 * count, alignment=8)
        return np.frombuffer(self._raw, _INT64[self._byte_order], count, start).astype(np.int64)

    def float64(self, count: int) -> FloatArray:
        """Read ``count`` float64 values, shape (count,)."""
        return self._array(_FLOAT64[self._byte_order], count, alignment=8)

    def float32(self, count: int) -> FloatArray:
        """Read ``count`` float32 values as float64, shape (count,)."""
        return self._array(_FLOAT32[self._byte_order], count, alignment=4)

    def _array(
        self, dtype: np.dtype[np.float32] | np.dtype[np.float64], count: int, alignment: int
    ) -> FloatArray:
        if count == 0:  # CDR puts no alignment bytes before an empty sequence.
            return np.zeros(0)
        start = self._take(count * dtype.itemsize, alignment)
        values = np.frombuffer(self._raw, dtype, count, start)
        with np.errstate(invalid='ignore'):  # Any bits may be there, signalling NaNs, too:
            # a product, unlike a copy, makes them quiet for whoever reads them next.
            quiet: FloatArray = np.multiply(values, 1.0, dtype=np.float64)
        return quiet

    def data(self, size: int) -> memoryview:
        """Read ``size`` bytes without copying them."""
        start = self._take(size, 1)
        return memoryview(self._raw)[start : start + size]

    def finish(self) -> None:
        """Check that the message ends here, but for padding: else it is of another type."""
        left = len(self._raw) - self._position
        if left > MAX_PADDING_BYTES:
            raise MessageError(f'{left} bytes too long: is it of another type?')


class CdrBlockReader(CdrReader):
    """Cursor over k messages of one size (k, size), as :class:`CdrReader` is over the first.

    They must have the strings in common that are read: else a MessageError is raised.
    """

    __slots__ = ('_rows',)

    def __init__(self, rows: NDArray[np.uint8]) -> None:
        super().__init__(rows[0].tobytes())
        self._rows = rows
        self._check_common(0, 2)

    def headers(self) -> tuple[IntArray, str]:
        """Read headers: stamps (k,) in nanoseconds, and their frame id."""
        times = self._columns(2, np.dtype(np.uint32), alignment=4)
        if (times[:, 1] >= NANOSECONDS_PER_SECOND).any():
            raise MessageError('a stamp with too much in its nanosecond field')
        seconds = times[:, 0].astype(np.int32).astype(np.int64)
        return seconds * NANOSECONDS_PER_SECOND + times[:, 1].astype(
            np.int64
        ), self.common_string()

    def common_string(self) -> str:
        """Read a string that is the same in all messages."""
        begin = self._position
        text = self.string()
        self._check_common(begin, self._position)
        return text

    def float64s(self, count: int) -> FloatArray:
        """Read ``count`` float64 values of each message, (k, count)."""
        values = self._columns(count, np.dtype(np.float64), alignment=8)
        with np.errstate(invalid='ignore'):  # as in _array
            quiet: FloatArray = np.multiply(values, 1.0, dtype=np.float64)
        return quiet

    def _columns(self, count: int, dtype: np.dtype[Any], alignment: int) -> NDArray[Any]:
        start = self._take(count * dtype.itemsize, alignment)
        columns = np.ascontiguousarray(self._rows[:, start : self._position])
        return columns.view(dtype.newbyteorder('<' if self._byte_order == '<' else '>'))

    def _check_common(self, begin: int, end: int) -> None:
        if (self._rows[:, begin:end] != self._rows[0, begin:end]).any():
            raise MessageError('a string, or the byte order, is not the same in all messages')


def encode_string(text: str) -> bytes:
    """Serialise a string, with padding so that a 4-byte value may follow; little endian."""
    characters = text.encode() + b'\0'
    return struct.pack('<I', len(characters)) + characters + bytes(-len(characters) % 4)
