"""Files that are read, and files that are written: never half of one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import glob
import os
from pathlib import Path
import secrets
import shutil
import stat
import tempfile
from typing import BinaryIO, TextIO

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


_MARK = '.unfinished-'
_DIRECTORY_MARK = f'.slam_observer{_MARK}'


def checked_name(path: Path) -> Path:
    """Return a path, or raise an OSError where no file can have its name."""
    try:
        if b'\0' not in os.fsencode(path):
            return path
    except UnicodeEncodeError:
        pass
    raise OSError(errno.EINVAL, 'no file can have this name', str(path))


def destination(path: Path) -> Path:
    """Return which file to replace for new content; links stay. What is no file is an OSError."""
    target = Path(os.path.realpath(checked_name(path)))
    if target.is_symlink() or (target.exists() and not target.is_file()):
        raise FileExistsError(errno.EEXIST, 'it is there, and no regular file', str(path))
    return target


@contextmanager
def unfinished_file(path: Path) -> Iterator[TextIO]:
    """Give a text file that becomes ``path`` at the end, or goes if there is an error."""
    with (
        _replacement(destination(path)) as file,
        open(file.fileno(), 'w', encoding='utf-8', closefd=False) as text,
    ):
        yield text


def keep_copy(path: Path, copy: Path) -> None:
    """Let ``copy`` be a copy of a file, whole or not at all; what has that name goes."""
    with _replacement(copy) as file, path.open('rb') as source:
        shutil.copyfileobj(source, file)
        status = os.fstat(source.fileno())
        os.fchmod(file.fileno(), status.st_mode & 0o777)
        os.utime(file.fileno(), ns=(status.st_atime_ns, status.st_mtime_ns))


@contextmanager
def unfinished_directory(beside: Path) -> Iterator[Path]:
    """Give a directory in another one, from where files can be moved in one step; it then goes."""
    _remove_left(beside.glob(f'{_DIRECTORY_MARK}*'))
    while True:
        directory = Path(tempfile.mkdtemp(prefix=_DIRECTORY_MARK, dir=beside))
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if _lock_own(directory, descriptor):
                yield directory
                return
        finally:
            os.close(descriptor)
            shutil.rmtree(directory, ignore_errors=True)


@contextmanager
def _replacement(target: Path) -> Iterator[BinaryIO]:
    """Give a file that takes the place of ``target`` at the end, or goes if there is an error."""
    prefix = f'.{target.name}{_MARK}'
    _remove_left(target.parent.glob(f'{glob.escape(prefix)}*'))
    while True:
        unfinished = target.with_name(f'{prefix}{secrets.token_hex(4)}')
        try:
            with unfinished.open('xb') as file:  # x: it is new, and no link of somebody
                if not _lock_own(unfinished, file.fileno()):
                    continue
                yield file
                file.flush()
                os.fsync(file.fileno())  # else a power cut may leave the name on an empty file
                unfinished.replace(target)
                return
        finally:
            unfinished.unlink(missing_ok=True)


def _lock_own(path: Path, descriptor: int) -> bool:
    """Lock a new file or directory; return whether it is still there."""
    with suppress(OSError):  # where there are no locks, nothing is taken for left behind either
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return path.exists()


def _remove_left(paths: Iterable[Path]) -> None:
    """Remove those files and directories that no process is writing, as far as one may."""
    for path in paths:
        with suppress(OSError):  # another process's, or another user's
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
            finally:
                os.close(descriptor)
