"""Exceptions of the command line."""

from __future__ import annotations

from slam_observer_ros.errors import SlamObserverError


class UsageError(SlamObserverError):
    """The command line asks for something that can't be done."""


class OutputError(SlamObserverError):
    """Some of what was asked for could not be written."""
