"""Signals by which a process is asked to stop; imports nothing that takes time to load."""

from __future__ import annotations

import os
import signal
from types import FrameType


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
