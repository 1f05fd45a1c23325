"""Text that other programs wrote."""

from __future__ import annotations

from pathlib import Path

_UTF16_MARKS = (b'\xff\xfe', b'\xfe\xff')


def read_text(path: Path) -> str:
    """Return what is in a file, in UTF-8 or UTF-16 with or without mark, or else in Latin-1."""
    content = path.read_bytes()
    if content.startswith(_UTF16_MARKS):
        return content.decode('utf-16', errors='replace')
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError:  # as spreadsheets write it in Western Europe
        return content.decode('latin-1')


def read_lines(path: Path) -> list[str]:
    """Return the lines of a file, as :func:`read_text` reads it."""
    return read_text(path).splitlines()
