"""What a shell does with the program: signals end it, and it asks what completes a word."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import os
import signal
import time
from types import FrameType
from typing import Any

SIGNALLED = 128
"""To which the number of the signal that ended the program is added, as shells do."""

PATIENCE_S = 2.0
"""How long clearing away takes at most until the next signal ends the program at once."""


class _Stop:
    """Handles the first signal by an exception; further ones do not cut that short."""

    def __init__(self) -> None:
        self._first_s: float | None = None

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        if self._first_s is not None:
            if time.monotonic() - self._first_s > PATIENCE_S:
                _leave(number, None)
            return
        self._first_s = time.monotonic()
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(SIGNALLED + number)


def stopping_once() -> _Stop:
    """Return a handler of signals, which is that of Ctrl-C from now on.

    Who ignores Ctrl-C, as a job in the background does, goes on doing so.
    """
    handler, stop = signal.getsignal(signal.SIGINT), _Stop()
    if handler is signal.default_int_handler or isinstance(handler, _Stop):
        signal.signal(signal.SIGINT, stop)
    return stop


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process, where it would raise a KeyboardInterrupt."""
    handler = signal.getsignal(signal.SIGINT)
    if not (handler is signal.default_int_handler or isinstance(handler, _Stop)):
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _leave(number: int, _frame: FrameType | None) -> None:
    os._exit(SIGNALLED + number)


def typed_words(environment: Mapping[str, str]) -> list[str] | None:
    """Return the words after the program that a shell wants completed; None if it wants none."""
    if '_ARGCOMPLETE' not in environment:
        return None
    return environment.get('COMP_LINE', '').split()[1:]


def complete(parser: argparse.ArgumentParser) -> None:
    """Write the completions and exit."""
    import argcomplete  # which --help has no use for

    argcomplete.autocomplete(parser)


def completed_by(action: argparse.Action, completer: Callable[..., Sequence[str]]) -> None:
    """Have an option's value completed by what a function returns, as argcomplete takes it."""
    described: Any = action
    described.completer = completer
