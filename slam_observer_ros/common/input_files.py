"""Files that are read: none that blocks, and text that other programs wrote."""

from __future__ import annotations

import errno
from pathlib import Path
import stat

from slam_observer_ros.common.output_files import checked_name

_UTF16_MARKS = (b'\xff\xfe', b'\xfe\xff')


def not_special(path: Path) -> Path:
    """Return a path where a regular file or directory is; raise an OSError otherwise.

    Reading a pipe or a device might never end.
    """
    mode = checked_name(path).stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, 'it is no regular file', str(path))
    return path


def read_text(path: Path) -> str:
    """Return what is in a file, in UTF-8 or UTF-16 with or without mark, or else in Latin-1."""
    content = not_special(path).read_bytes()
    if content.startswith(_UTF16_MARKS):
        return content.decode('utf-16', errors='replace')
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError:  # as spreadsheets write it in Western Europe
        return content.decode('latin-1')


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file, as :func:`read_text` reads it."""
    return read_text(path).splitlines()
