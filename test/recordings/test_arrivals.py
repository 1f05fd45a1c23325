"""When messages came, remembered in little memory."""

from __future__ import annotations

import numpy as np
import pytest

from slam_observer_ros.recordings.contents import Arrivals, MOST_SAMPLES

SECOND = 10**9


def arrivals(times_s, delay_s=0.0, timeout_s=0.5):
    """Messages received at times, with stamps a delay before."""
    made = Arrivals(timeout_s)
    for time_s in times_s:
        made.add(round(time_s * SECOND), round((time_s - delay_s) * SECOND))
    return made


def test_silence_is_what_exceeds_the_timeout_before_between_and_after():
    assert arrivals([2.0, 2.3, 4.0]).silence_s(1.0, 5.0) == pytest.approx(0.5 + 1.2 + 0.5)


def test_of_a_million_messages_a_few_thousand_say_how_far_a_clock_is_behind():
    times_s = np.arange(3 * MOST_SAMPLES) * 0.02
    late, prompt = arrivals(times_s, 1.5), arrivals(times_s[::7], 0.25)
    assert late.behind_s(prompt) == pytest.approx(1.25)
    assert len(late) == 3 * MOST_SAMPLES
    assert len(late._delays_s) <= MOST_SAMPLES
    assert late.silence_s(0.0, times_s[-1]) == 0.0


def test_clocks_of_messages_at_different_times_are_not_compared():
    assert arrivals([1.0, 2.0], 5.0).behind_s(arrivals([3.0, 4.0])) == 0.0
