"""Numbers as people read them."""

from __future__ import annotations

import pytest

from slam_observer_ros.common.digits import significant


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (0.0, '0'), (0.27312, '0.273'), (7.449, '7.45'), (27.74, '27.7'), (1234.5, '1234'),
        (0.000456, '0.000456'), (1.3e-6, '1.30e-06'), (-0.5, '-0.500'), (float('inf'), 'inf'),
    ],
)  # fmt: skip
def test_three_digits_are_significant(value: float, text: str) -> None:
    assert significant(value) == text
