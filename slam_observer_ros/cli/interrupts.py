"""Ctrl-C while libraries load, which takes a second: the program ends without a word.

A KeyboardInterrupt meanwhile comes out of some of them as another error, or aborts the process;
and there is nothing yet to clear away.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
from types import FrameType


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process, where it would raise a KeyboardInterrupt."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is not signal.default_int_handler:  # as a job in the background, which ignores it
        yield
        return
    signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _leave(number: int, _frame: FrameType | None) -> None:
    os._exit(128 + number)
