"""Exceptions raised by the package; all derive from :class:`SlamObserverError`."""

from __future__ import annotations

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
