"""Files that are put where their name leads: whole or not at all, and over files only."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import os
from pathlib import Path


def destination(path: Path) -> Path:
    """Return which file to replace for new content; links stay. What is no file is an OSError."""
    target = Path(os.path.realpath(path))
    if target.is_symlink() or (target.exists() and not target.is_file()):
        raise FileExistsError(errno.EEXIST, 'it is there, and no regular file', str(path))
    return target


@contextmanager
def unfinished_file(path: Path) -> Iterator[Path]:
    """Give a file to write that becomes ``path`` at the end, or goes if there is an error."""
    target = destination(path)
    unfinished = target.with_name(f'.{target.name}.{os.getpid()}')
    try:
        yield unfinished
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
