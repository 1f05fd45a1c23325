"""Which values a recording can't distinguish, and what would."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import CalibrationEstimate

MUCH = 0.9
"""Correlation beyond which two values trade."""

WELL_KNOWN = 0.1
"""Standard deviation over that at the start, below which nobody minds."""

_WORDS = {
    'range_scale': 'range scale',
    'linear_scale': 'wheel scale',
    'angular_scale': 'scale of turning',
    'angular_bias': 'bias of turning',
    'linear_bias': 'bias of driving',
    'velocity_delay': 'delay',
    'sensor_rotation': 'mount angle',
    'sensor_translation': 'mount offset',
}

_ADVICE = (
    (
        {'range_scale', 'linear_scale'},
        'give a surveyed map (--map), or drive a measured distance and state it (--set '
        'linear_scale, linear_scale_stddev)',
    ),
    ({'angular_scale', 'angular_bias'}, 'turn to both sides, fast and slowly'),
    ({'sensor_translation'}, 'turn on the spot, to both sides'),
    ({'velocity_delay'}, 'change speed and direction often'),
)
"""What distinguishes values, by their kinds, the first that fits."""


@dataclass(frozen=True, slots=True)
class Trade:
    """Two values that grow or shrink together without any change in what is seen."""

    names: tuple[str, str]
    correlation: float
    text: str


COMMON_SCALE = Trade(
    ('linear_scale_x', 'range_scale'),
    1.0,
    'range scale and wheel scale trade: the wheels are as the ranges have them; for both of them '
    + _ADVICE[0][1],
)
"""What no map that is made on the way shows: how large it is."""


def trades(parts: list[CalibrationEstimate], correlations: FloatArray) -> list[Trade]:
    """Return the pairs among parts (c,) that can't be distinguished, the closest first."""
    unknown = np.array([part.deviation > WELL_KNOWN * part.stated for part in parts])
    close = np.triu(np.abs(correlations) > MUCH, 1) & unknown & unknown[:, None]
    found = []
    for i, j in np.argwhere(close).tolist():
        one, other, correlation = parts[i].name, parts[j].name, float(correlations[i, j])
        words = ' and '.join(sorted([_words(one), _words(other)]))
        text = f'{words} trade (correlation {correlation:.2f}): {_advice(one, other)}'
        found.append(Trade((one, other), correlation, text))
    return sorted(found, key=lambda trade: -abs(trade.correlation))


def _kind(name: str) -> str:
    name = name.partition('/')[0]
    return name if name in _WORDS else name.rpartition('_')[0]


def _words(name: str) -> str:
    kind, axis = _kind(name), name.partition('/')[0][-1]
    return _WORDS[kind] if name.partition('/')[0] in _WORDS else f'{_WORDS[kind]} {axis}'


def _advice(one: str, other: str) -> str:
    kinds = {_kind(one), _kind(other)}
    for pair, advice in _ADVICE:
        if pair <= kinds:
            return advice
    return 'drive with more changes, or state one of them with --set'
