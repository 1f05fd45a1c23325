"""How a process computes, in how many threads and by what is compiled, and how it ends.

It imports nothing slow to load. Each compiled module has a reference in numpy.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
import os
from pathlib import Path
import signal
import time
from types import FrameType, ModuleType
import warnings
import zlib

CHOICES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'BLIS_NUM_THREADS')
"""Environment variables by which a user says how many there shall be."""


def use_one_thread() -> None:
    """Let numpy and SciPy compute in one thread, unless the environment says more.

    They look once, as they are loaded: call this before. The matrices are small: several threads
    wait for each other longer than they compute, up to ten times on a busy machine, and take the
    processor from the robot's other programs.
    """
    if not any(name in os.environ for name in CHOICES):
        os.environ.update(dict.fromkeys(CHOICES, '1'))


SIGNALLED = 128  # to which the number of the signal that ended the program is added, as shells do
PATIENCE_S = 2.0  # of clearing away, until the next signal ends the program at once


class _Stop:
    """Handles the first signal by an exception; further ones do not cut that short."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self.number: int | None = None

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        if self._first_s is not None:
            if time.monotonic() - self._first_s > PATIENCE_S:
                _leave(number, None)
            return
        self._first_s, self.number = time.monotonic(), number
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(SIGNALLED + number)


def stopping_once() -> _Stop:
    """Return a handler of signals, which takes Ctrl-C from now on, unless that is ignored."""
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


class StopSignal:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag; before :meth:`begin` the process just ends.

    rclpy's own handlers raise KeyboardInterrupt or ExternalShutdownException wherever the program
    happens to be, a second time even inside the clean-up. A flag interrupts nothing. But while
    modules are loaded nobody would look at it, and there is nothing to clean up.
    """

    def __init__(self) -> None:
        self.is_set = False
        self._has_begun = False
        self._numbers = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup sets it
            self._numbers.append(signal.SIGHUP)
        self.listen()

    def listen(self) -> None:
        """Take the signals, again if something else has taken them."""
        for number in self._numbers:
            signal.signal(number, self._set)

    def begin(self) -> None:
        """From now on only set the flag."""
        self._has_begun = True
        # Python's handlers wait while a library computes; a byte in this pipe does not.
        self._read_end, write_end = os.pipe()
        os.set_blocking(write_end, False)
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)

    def ignore(self) -> None:
        """Take no notice of further ones: the interpreter would end by them where it clears up."""
        for number in self._numbers:
            signal.signal(number, signal.SIG_IGN)

    def wait(self) -> None:
        """Wait for the first signal, in a thread, even while the main one computes."""
        os.read(self._read_end, 1)

    def _set(self, _number: int, _frame: FrameType | None) -> None:
        if not self._has_begun:
            os._exit(0)
        self.is_set = True


VARIABLE = 'SLAM_OBSERVER_CORE'  # environment variable; numpy chooses the references

PACKAGE = Path(__file__).parents[1]


def compiled(name: str) -> ModuleType | None:
    """Return a compiled module; None where it was not built, or is not to be used."""
    if os.environ.get(VARIABLE) == 'numpy':
        return None
    try:
        module = import_module(f'slam_observer_ros.{name}')
    except ImportError:  # there was no compiler
        return None
    if digest_of_sources(name) in (None, getattr(module, 'SOURCES', 0)):
        return module
    warnings.warn(
        f'{module.__file__} was built from other sources than there are now, and numpy takes its '
        'place: build it by `make`, or `python setup.py build_ext --inplace`',
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def digest_of_sources(name: str) -> int | None:
    """Return a number that changes with the sources of a module; None where they are not."""
    source = (PACKAGE / name.replace('.', '/')).with_suffix('.c')
    if not source.exists():
        return None
    headers = sorted((PACKAGE / 'filter').glob('_*.h'))
    return zlib.crc32(b''.join(path.read_bytes() for path in (source, *headers)))
