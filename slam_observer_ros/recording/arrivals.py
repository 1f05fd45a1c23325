"""When the measurements of a topic were received, and how long after their stamps."""

from __future__ import annotations

from array import array

import numpy as np

from slam_observer_ros.common.units import to_s


class Arrivals:
    """When each measurement of a topic was received, and how long after its stamp; seconds."""

    def __init__(self) -> None:
        self.received_s = array('d')
        self.delays_s = array('d')

    def __len__(self) -> int:
        """Return how many measurements there were."""
        return len(self.received_s)

    def add(self, received_ns: int, stamp_ns: int) -> None:
        """Note when a measurement was received and what stamp it has, nanoseconds."""
        self.received_s.append(to_s(received_ns))
        self.delays_s.append(to_s(received_ns - stamp_ns))

    def silence_s(self, start_s: float, end_s: float, timeout_s: float) -> float:
        """Return for how long nothing was known, if each measurement holds until the timeout."""
        waits_s = np.diff([start_s, *self.received_s, end_s])
        return float(np.maximum(waits_s - timeout_s, 0.0).sum())

    def behind_s(self, other: Arrivals) -> float:
        """Return how far the stamps are behind those of another topic, seconds.

        That is the median, each compared with the other topic's at its time: a simulated clock
        that is slower than the recorder's is no offset. It is zero if they have no time in common.
        """
        others_s = np.interp(
            self.received_s, other.received_s, other.delays_s, left=np.nan, right=np.nan
        )
        differences_s = self.delays_s - others_s
        known_s = differences_s[np.isfinite(differences_s)]
        return float(np.median(known_s)) if len(known_s) else 0.0
