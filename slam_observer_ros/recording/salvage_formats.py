"""Scans of damaged ROS 1 bags and SQLite databases, for what is whole in them."""

from __future__ import annotations

import bz2
from collections.abc import Iterator
import mmap
import struct
from typing import Final

import lz4.frame  # type: ignore[import-untyped]

from slam_observer_ros.messages.cdr import Buffer
from slam_observer_ros.recording.bag_source import (
    Damaged,
    Found,
    FoundChannel,
    FoundMessage,
    Scan,
)
from slam_observer_ros.recording.sources import ros2_type, Topic

_BAG_MAGIC: Final = b'#ROSBAG V2.0\n'
_BAG_MESSAGE, _BAG_CHUNK, _BAG_CONNECTION, _BAG_INDEX = 2, 5, 7, 4
_DECOMPRESSORS: Final = {b'none': bytes, b'bz2': bz2.decompress, b'lz4': lz4.frame.decompress}


def scan_bag(data: mmap.mmap) -> Iterator[Found]:
    """Read a ROS 1 bag's chunks one after the other, without its index at the end."""
    size = len(data)
    if data[: len(_BAG_MAGIC)] != _BAG_MAGIC:
        yield Damaged(min(size, len(_BAG_MAGIC)))
    place, is_closed = len(_BAG_MAGIC), False
    while place < size:
        try:
            header, content, end = _bag_record(data, place)
            operation = header[b'op'][0]
        except (struct.error, LookupError, ValueError):
            found = data.find(b'compression=', place + 9)
            after = size if found < 0 else found - 8
            yield Damaged(after - place, is_cut_off=found < 0)
            place = after
            continue
        is_closed |= operation == _BAG_CONNECTION  # which follow the last chunk
        try:
            if operation == _BAG_CHUNK:
                chunk = _DECOMPRESSORS[header[b'compression']](content)
                yield from list(_of_bag_chunk(chunk))
            elif operation == _BAG_CONNECTION:
                yield _bag_connection(header, content)
        except Exception:  # noqa: BLE001 (decompressors raise whatever they like)
            yield Damaged(end - place)
        place = end
    if not is_closed:
        yield Damaged(0, is_cut_off=True)


def _of_bag_chunk(chunk: bytes) -> Iterator[Found]:
    place = 0
    while place < len(chunk):
        header, content, place = _bag_record(chunk, place)
        (number,) = struct.unpack('<I', header[b'conn'])
        if header[b'op'][0] == _BAG_CONNECTION:
            yield _bag_connection(header, content)
        else:
            seconds, nanoseconds = struct.unpack('<II', header[b'time'])
            yield FoundMessage(number, seconds * 1_000_000_000 + nanoseconds, content)


def _bag_connection(header: dict[bytes, bytes], content: bytes) -> FoundChannel:
    (number,) = struct.unpack('<I', header[b'conn'])
    fields, name = _bag_fields(content), header[b'topic'].decode()
    message_type = ros2_type(fields[b'type'].decode())
    definition = fields.get(b'message_definition', b'').decode(errors='replace')
    return FoundChannel(number, Topic(name, message_type, 0, definition))


def _bag_record(data: Buffer | mmap.mmap, place: int) -> tuple[dict[bytes, bytes], bytes, int]:
    """Return header fields, content and end of the record that begins at ``place``."""
    (length,) = struct.unpack_from('<I', data, place)
    begin = place + 4 + length
    (content_length,) = struct.unpack_from('<I', data, begin)
    end = begin + 4 + content_length
    if end > len(data):
        raise ValueError('the record goes beyond the end')
    return _bag_fields(bytes(data[place + 4 : begin])), bytes(data[begin + 4 : end]), end


def _bag_fields(header: bytes) -> dict[bytes, bytes]:
    fields, place = {}, 0
    while place < len(header):
        (length,) = struct.unpack_from('<I', header, place)
        name, _, value = header[place + 4 : place + 4 + length].partition(b'=')
        fields[name] = value
        place += 4 + length
    return fields


_SQLITE_MAGIC: Final = b'SQLite format 3\0'
_LEAF_OF_TABLE: Final = 0x0D
_OTHER_PAGES: Final = (0x02, 0x05, 0x0A)
"""Of indices, and what leads to leaves."""
_INTEGER_SIZES: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


def scan_db3(data: mmap.mmap) -> Iterator[Found]:
    """Read the rows on each page of a rosbag2 database, without the tree that leads to them.

    See https://sqlite.org/fileformat2.html.
    """
    if len(data) < 100 or data[:16] != _SQLITE_MAGIC:
        yield Damaged(len(data), is_cut_off=True)
        return
    (page_size,) = struct.unpack_from('>H', data, 16)
    page_size = 65536 if page_size == 1 else page_size
    if page_size < 512:
        yield Damaged(len(data))
        return
    # First which pages rows go on on, as the others that hold nothing have lost what they held.
    used: set[int] = {1}
    for _ in _of_pages(data, page_size, used, None):
        pass
    yield from _of_pages(data, page_size, set(), used)
    (pages,) = struct.unpack_from('>I', data, 28)
    if pages * page_size > len(data):
        yield Damaged(pages * page_size - len(data), is_cut_off=True)


def _of_pages(
    data: mmap.mmap, page_size: int, used: set[int], known: set[int] | None
) -> Iterator[Found]:
    """Read all leaves of tables; ``used`` becomes the pages that their rows go on on."""
    for begin in range(0, len(data), page_size):
        offset = 100 if begin == 0 else 0
        page = data[begin : begin + page_size]
        kind = page[offset] if len(page) > offset + 8 else 0
        if kind != _LEAF_OF_TABLE:
            is_known = kind in _OTHER_PAGES or (known and begin // page_size + 1 in known)
            if not is_known:
                yield Damaged(len(page))
            continue
        (count,) = struct.unpack_from('>H', page, offset + 3)
        for cell in range(count):
            try:
                (place,) = struct.unpack_from('>H', page, offset + 8 + 2 * cell)
                found = _of_row(_row(data, begin + place, page_size - data[20], used))
            except (struct.error, LookupError, ValueError):
                yield Damaged(page_size // count)
                continue
            if found is not None:
                yield found


def _of_row(values: list[object]) -> Found | None:
    """Return what of a recording a row is: a topic, a message or nothing of it."""
    number = values[0]
    if len(values) >= 4 and isinstance(values[1], str) and values[3] == 'cdr':
        return FoundChannel(int(str(number)), Topic(values[1], ros2_type(str(values[2])), 0))
    if len(values) == 4 and isinstance(values[1], int) and isinstance(values[2], int):
        content = values[3]
        if isinstance(content, bytes):
            return FoundMessage(values[1], values[2], content)
    return None


def _row(data: mmap.mmap, place: int, usable: int, used: set[int]) -> list[object]:
    """Return the values of the row whose cell is at ``place``; its number for its key.

    ``used`` are the further pages that rows so far have taken: each belongs to one alone.
    """
    length, place = _varint(data, place)
    rowid, place = _varint(data, place)
    local = length
    if length > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    payload = bytearray(data[place : place + local])
    if local < length:
        (page,) = struct.unpack_from('>I', data, place + local)
        while len(payload) < length and page:
            if page in used:
                raise ValueError('two rows share a page')
            used.add(page)
            begin = (page - 1) * (usable + data[20])
            (page,) = struct.unpack_from('>I', data, begin)
            payload += data[begin + 4 : begin + 4 + min(usable - 4, length - len(payload))]
    if len(payload) < length:
        raise ValueError('a row is cut off')
    return _values(bytes(payload), rowid)


def _values(payload: bytes, rowid: int) -> list[object]:
    header_size, place = _varint(payload, 0)
    values: list[object] = []
    begin = header_size
    while place < header_size:
        kind, place = _varint(payload, place)
        size = _INTEGER_SIZES.get(kind, (kind - 12) // 2 if kind >= 12 else 8 * (kind == 7))
        content = payload[begin : begin + size]
        if len(content) < size:
            raise ValueError('a value is cut off')
        begin += size
        if kind == 0:
            values.append(rowid if not values else None)
        elif kind in _INTEGER_SIZES:
            values.append(int.from_bytes(content, 'big', signed=True))
        elif kind in (8, 9):
            values.append(kind - 8)
        else:
            values.append(content.decode() if kind >= 13 and kind % 2 else content)
    return values


def _varint(data: bytes | mmap.mmap, place: int) -> tuple[int, int]:
    """Return a number of one to nine bytes, and where it ends."""
    value = 0
    for index in range(8):
        byte = data[place + index]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, place + index + 1
    return value << 8 | data[place + 8], place + 9


SCANS: Final[dict[str, Scan]] = {'.bag': scan_bag, '.db3': scan_db3}
"""By the suffix of the file."""
