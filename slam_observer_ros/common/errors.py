"""Exceptions, all of them :class:`SlamObserverError`; and values as people and JSON have them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import json
import math
import reprlib

_shortened = reprlib.Repr()
_shortened.maxstring = _shortened.maxother = _shortened.maxlong = 80
_shortened.maxlist = 12


def shown(value: object) -> str:
    """Return a value as a message shows it, which may come from a file of any size."""
    return _shortened.repr(value)


def message_of(error: Exception) -> str:
    """Return what an error says, in one line; of an OSError, without the number."""
    if isinstance(error, OSError) and error.strerror:
        return f'{error.filename}: {error.strerror}' if error.filename else error.strerror
    return ' '.join(str(error).split())


class SlamObserverError(Exception):
    """Root of every error that this package raises on purpose."""


class ParameterError(SlamObserverError):
    """A parameter is unknown, of the wrong type, or out of its range."""


class InvalidEventError(SlamObserverError):
    """An event can't be used and is dropped whole, and counted under the key ``reason``."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class SmoothingError(SlamObserverError):
    """What was observed does not determine the whole trajectory."""


class MessageError(SlamObserverError):
    """A ROS message is malformed or has not a field that is needed."""


class RecordingError(SlamObserverError):
    """A recording can't be read or written, or its topics are missing or ambiguous."""


class DataSetError(SlamObserverError):
    """A public data set's files are missing or not in their published format."""


class YamlError(SlamObserverError):
    """A file is not valid YAML, or has what is not taken from files, as aliases."""


class MapError(SlamObserverError):
    """A map file can't be read or written, or its content can't be right."""


class TransformError(SlamObserverError):
    """Two frames are not connected, or not at the time that is asked for."""


class EvaluationError(SlamObserverError):
    """A trajectory, its file or a pair of point sets can't be evaluated."""


class LossError(SlamObserverError):
    """A part of a recording could not be read, and all of it was asked for."""


class UsageError(SlamObserverError):
    """The command line asks for something that can't be done."""


class OutputError(SlamObserverError):
    """Some of what was asked for could not be written."""


class IncompleteError(SlamObserverError):
    """A part of what was asked for could not be done, or is of no avail; the rest is done."""


@contextmanager
def failing(kind: type[SlamObserverError], what: str) -> Iterator[None]:
    """Raise what the system refuses as an error of a kind, which says ``what``, and why."""
    try:
        yield
    except OSError as error:
        raise kind(f'{what}: {error.strerror}') from error


_LEAST = 1e-4  # numbers below this have more zeros than anybody counts


def significant(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, and all digits before the point."""
    if value == 0.0 or not math.isfinite(value):
        return f'{value:g}'
    if abs(value) < _LEAST:
        return f'{value:.{digits - 1}e}'
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f'{value:.{max(decimals, 0)}f}'


def json_text(value: object, *, is_compact: bool = False) -> str:
    """Return a value as JSON on one line: null for what is not finite, which JSON can't say."""
    separators = (',', ':') if is_compact else None
    return json.dumps(_finite(value), allow_nan=False, separators=separators)


def _finite(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return value
