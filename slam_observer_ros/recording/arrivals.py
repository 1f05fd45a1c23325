"""When the measurements of a topic were received, and how long after their stamps."""

from __future__ import annotations

from array import array

import numpy as np

from slam_observer_ros.common.stamps import to_s
from slam_observer_ros.common.types import IntArray

MOST_SAMPLES = 8192
"""How many delays are kept; then every second one is left out, of those to come as well."""


class Arrivals:
    """When the measurements of a topic came, in memory that does not grow with their number.

    Attributes
    ----------
    first_s, last_s : float
        When the first and the last so far were received, seconds.

    """

    def __init__(self, timeout_s: float) -> None:
        self.first_s = self.last_s = 0.0
        self._timeout_s = timeout_s
        self._silence_s = 0.0
        self._count = 0
        self._every = 1
        self._received_s = array('d')
        self._delays_s = array('d')

    def __len__(self) -> int:
        """Return how many measurements there were."""
        return self._count

    def add(self, received_ns: int, stamp_ns: int) -> None:
        """Note when a measurement was received and what stamp it has, nanoseconds."""
        received_s = to_s(received_ns)
        if self._count:
            self._silence_s += max(received_s - self.last_s - self._timeout_s, 0.0)
        else:
            self.first_s = received_s
        if self._count % self._every == 0:
            self._received_s.append(received_s)
            self._delays_s.append(to_s(received_ns - stamp_ns))
        if len(self._received_s) > MOST_SAMPLES:
            del self._received_s[1::2], self._delays_s[1::2]
            self._every *= 2
        self.last_s = received_s
        self._count += 1

    def add_all(self, received_ns: IntArray, stamps_ns: IntArray) -> None:
        """Note the same of several measurements (k,)."""
        # Integers of Python, as NumPy's lose digits on their way to a quotient.
        received_s = np.array([to_s(received) for received in received_ns.tolist()])
        if not self._count:
            self.first_s = self.last_s = float(received_s[0])
        pauses_s = np.diff(received_s, prepend=self.last_s) - self._timeout_s
        self._silence_s += float(np.maximum(pauses_s, 0.0).sum())
        numbers = self._count + np.arange(len(received_s))
        kept = numbers % self._every == 0
        self._received_s.extend(received_s[kept].tolist())
        self._delays_s.extend(map(to_s, (received_ns - stamps_ns)[kept].tolist()))
        while len(self._received_s) > MOST_SAMPLES:
            del self._received_s[1::2], self._delays_s[1::2]
            self._every *= 2
        self.last_s = float(received_s[-1])
        self._count += len(received_s)

    def silence_s(self, start_s: float, end_s: float) -> float:
        """Return for how long nothing was known, as each measurement holds until the timeout."""
        before_s = max(self.first_s - start_s - self._timeout_s, 0.0)
        after_s = max(end_s - self.last_s - self._timeout_s, 0.0)
        return before_s + self._silence_s + after_s

    @property
    def ahead_s(self) -> float:
        """How far the stamps are ahead of when they were received, seconds, in the median."""
        return -float(np.median(self._delays_s)) if self._delays_s else 0.0

    def behind_s(self, other: Arrivals) -> float:
        """Return how far the stamps are behind those of another topic, seconds.

        That is the median, each compared with the other topic's at its time: a simulated clock
        that is slower than the recorder's is no offset. It is zero if they have no time in common.
        """
        others_s = np.interp(
            self._received_s, other._received_s, other._delays_s, left=np.nan, right=np.nan
        )
        differences_s = self._delays_s - others_s
        known_s = differences_s[np.isfinite(differences_s)]
        return float(np.median(known_s)) if len(known_s) else 0.0
