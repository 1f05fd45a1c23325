"""Warnings of what may happen at each event, told at the 1st, the 10th, the 100th time."""

from __future__ import annotations

from collections import Counter
import logging


class CountedWarnings:
    """Counts what there is to warn of, and logs it more and more seldom.

    Parameters
    ----------
    logger : Logger
        Where to.

    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._counts: Counter[str] = Counter()

    def warn(self, kind: str, text: str) -> None:
        """Count one more of a kind; ``text`` is logged if their number is a power of ten."""
        self._counts[kind] += 1
        count = self._counts[kind]
        if str(count).rstrip('0') == '1':
            self._logger.warning('%s (%d so far).', text, count)
