"""Files that are read, YAML among them, and files that are written: never half of one.

YAML may be anybody's: it is small enough, without aliases, and has each key once. It is built from
PyYAML's events, not from its nodes: that takes a fifth of the time, and libyaml's way to nodes,
which calls itself for each level, crashes on files of many levels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
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
from typing import Any, BinaryIO, Final, TextIO

import yaml

from slam_observer_ros.common.errors import ParameterError, shown, YamlError

_UTF16_MARKS = (b'\xff\xfe', b'\xfe\xff')


def not_special(path: Path) -> Path:
    """Return the path of a file or directory; an OSError for a pipe, which might never end."""
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


def is_there(path: Path) -> bool:
    """Return whether there is such a file, as far as one may look."""
    try:
        return path.exists()
    except OSError:  # its name is too long, for example
        return False


def absolute(path: str) -> Path:
    """Return a path with ~ expanded; ParameterError where there is no such user, or file name."""
    try:
        return checked_name(Path(path).expanduser().absolute())
    except RuntimeError as error:  # of a user that there is none of
        raise ParameterError(f"can't find {path}: {error}") from error
    except OSError as error:
        raise ParameterError(f"can't find {path!r}: {error.strerror}") from error


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


MAX_LEVELS: Final = 30  # of lists and mappings in each other; ours have less than ten

FAST_LOADER: Final[Any] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
"""Reads many megabytes, where libyaml is; what it says of mistakes is less than PyYAML does."""

_STANDARD: Final = 'tag:yaml.org,2002:'
_SCALARS: Final = ('bool', 'float', 'int', 'null', 'str', 'timestamp')
_RESOLVERS: Final = yaml.SafeLoader.yaml_implicit_resolvers
_CONSTRUCTOR: Final = yaml.constructor.SafeConstructor()


def load_yaml(
    path: Path, max_bytes: int, plain: Callable[[str], object], loader: Any = yaml.SafeLoader
) -> Any:
    """Return the content of a YAML file; ``plain`` gives the values of unquoted words.

    Raises an OSError if the file can't be read, or has more bytes, and a YamlError that says in
    one line, and where, what is wrong with its YAML.
    """
    with not_special(path).open('rb') as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        reason = f'it has more than {max_bytes / 1e6:g} MB'
        raise OSError(errno.EFBIG, reason, str(path))
    try:
        return _Builder(yaml.parse(data, loader), plain).document()
    except yaml.YAMLError as error:
        if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
            raise YamlError(f'{error.problem} in line {error.problem_mark.line + 1}') from error
        raise YamlError(str(error).splitlines()[0]) from error


def constructed(kind: str, text: str) -> object:
    """Return what ``!!kind text`` means in YAML 1.1, of _SCALARS; a ValueError if it is none."""
    construct = yaml.SafeLoader.yaml_constructors[_STANDARD + kind]
    try:
        value: object = construct(_CONSTRUCTOR, yaml.ScalarNode(_STANDARD + kind, text))
    except (ValueError, LookupError, AttributeError) as error:  # PyYAML takes them to be right
        raise ValueError(f'{shown(text)} is no {kind}') from error
    return value


def plain_value(text: str) -> object:
    """Return what an unquoted word is by YAML 1.1: 010 is 8, 1:30 is 90, and on is True."""
    for tag, pattern in _RESOLVERS.get(text[:1], ()):
        kind = tag.removeprefix(_STANDARD)
        if kind in _SCALARS and pattern.match(text):
            return constructed(kind, text)
    return text


class _Builder:
    """Builds the one document of a file from its events."""

    def __init__(self, events: Iterator[Any], plain: Callable[[str], object]) -> None:
        self._events = events
        self._plain = plain

    def document(self) -> Any:
        content = None
        starts = 0
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent):
                starts += 1
                if starts > 1:
                    raise _marked(event, 'a second document')
            elif isinstance(event, yaml.NodeEvent):
                content = self._value(event, 1)
        return content

    def _value(self, event: Any, level: int) -> Any:
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if isinstance(event, yaml.AliasEvent):
            raise _marked(event, 'an alias, which is not taken,')
        if not event.implicit:
            raise _marked(event, f'the tag {shown(event.tag)}, which is not taken,')
        if level > MAX_LEVELS:
            raise _marked(event, f'more than {MAX_LEVELS} levels')
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(level)
        values = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            values.append(self._value(event, level + 1))
        return values

    def _mapping(self, level: int) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise _marked(event, 'a key that is no word')
            key = self._scalar(event)
            if key in values:
                raise _marked(event, f'{shown(key)} is there 2 times in one entry')
            values[key] = self._value(next(self._events), level + 1)
        return values

    def _scalar(self, event: Any) -> object:
        is_plain, is_text = event.implicit
        if is_text:
            return event.value
        kind = '' if is_plain else event.tag.removeprefix(_STANDARD)
        if kind and kind not in _SCALARS:
            raise _marked(event, f'the tag {shown(event.tag)}, which is not taken,')
        try:
            return constructed(kind, event.value) if kind else self._plain(event.value)
        except ValueError as error:
            raise _marked(event, str(error)) from error


def _marked(event: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
