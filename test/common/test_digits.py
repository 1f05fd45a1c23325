"""Numbers as people read them, and as JSON has them."""

from __future__ import annotations

import json
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from slam_observer_ros.common.errors import json_text, significant


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (0.0, '0'), (0.27312, '0.273'), (7.449, '7.45'), (27.74, '27.7'), (1234.5, '1234'),
        (0.000456, '0.000456'), (1.3e-6, '1.30e-06'), (-0.5, '-0.500'), (float('inf'), 'inf'),
    ],
)  # fmt: skip
def test_three_digits_are_significant(value: float, text: str) -> None:
    assert significant(value) == text


VALUES = st.recursive(
    st.floats() | st.none() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(VALUES)
def test_json_has_null_for_what_is_not_finite(value: object) -> None:
    read = json.loads(json_text(value), parse_constant=lambda name: pytest.fail(name))
    assert read == json.loads(json.dumps(value), parse_constant=lambda _: None)


def test_what_numpy_and_tuples_hold_is_json_too() -> None:
    assert json_text({'a': (np.float64(math.inf), 1.5)}, is_compact=True) == '{"a":[null,1.5]}'
