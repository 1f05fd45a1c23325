"""YAML files that anybody may have written: small enough, without aliases, each key once.

They are built from PyYAML's events, not from its nodes: that takes a fifth of the time, and
libyaml's way to nodes, which calls itself for each level, crashes on files of many levels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import errno
from pathlib import Path
from typing import Any, Final

import yaml

from slam_observer_ros.common.errors import shown, YamlError
from slam_observer_ros.common.files import not_special

MAX_LEVELS: Final = 30
"""How deep lists and mappings may be in each other; parameters and maps have less than ten."""

FAST_LOADER: Final[Any] = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
"""Reads many megabytes, where libyaml is; what it says of mistakes is less than PyYAML does."""

_STANDARD: Final = 'tag:yaml.org,2002:'
_SCALARS: Final = ('bool', 'float', 'int', 'null', 'str', 'timestamp')
_RESOLVERS: Final = yaml.SafeLoader.yaml_implicit_resolvers
_CONSTRUCTOR: Final = yaml.constructor.SafeConstructor()


def load_yaml(
    path: Path,
    max_bytes: int,
    plain: Callable[[str], object],
    loader: Any = yaml.SafeLoader,
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
        raise YamlError(_reason_of(error)) from error


def constructed(kind: str, text: str) -> object:
    """Return a bool, float, int, null, str or timestamp of YAML 1.1; a ValueError if it is none.

    That is what ``!!kind text`` means.
    """
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
        is_mapping = isinstance(event, yaml.MappingStartEvent)
        return self._mapping(level) if is_mapping else self._list(level)

    def _list(self, level: int) -> list[Any]:
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
        try:
            return self._plain(event.value) if is_plain else _of_tag(event.tag, event.value)
        except ValueError as error:
            raise _marked(event, str(error)) from error


def _of_tag(tag: str, text: str) -> object:
    kind = tag.removeprefix(_STANDARD)
    if kind not in _SCALARS:
        raise ValueError(f'the tag {shown(tag)}, which is not taken,')
    return constructed(kind, text)


def _marked(event: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


def _reason_of(error: yaml.YAMLError) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f'{error.problem} in line {error.problem_mark.line + 1}'
    return str(error).splitlines()[0]
