"""What a recording shows of sensor and odometry, as parameters, and what it can't distinguish."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam_observer_ros.cli.noise_search import NoiseFactor, of_motion, rounded, scaled
from slam_observer_ros.common.types import FloatArray
from slam_observer_ros.estimates import CalibrationEstimate, MotionFactor
from slam_observer_ros.lie import so3
from slam_observer_ros.models.calibration import Entry, OF_SENSOR, OF_VELOCITY
from slam_observer_ros.settings.estimator_settings import Settings
from slam_observer_ros.settings.node_settings import InputSettings
from slam_observer_ros.settings.parameter_table import Pose6

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


def _entry_of(name: str) -> Entry:
    name = name.partition('/')[0]
    return next(entry for entry in (*OF_VELOCITY, *OF_SENSOR) if entry.name == name)


def _kind(name: str) -> str:
    return _entry_of(name).parameter


def _words(name: str) -> str:
    kind, axis = (entry := _entry_of(name)).parameter, entry.axis
    words = _WORDS.get(kind, kind.replace('_', ' '))
    return words if axis is None else f'{words} {"xyz"[axis]}'


def _advice(one: str, other: str) -> str:
    kinds = {_kind(one), _kind(other)}
    for pair, advice in _ADVICE:
        if pair <= kinds:
            return advice
    return 'drive with more changes, or state one of them with --set'


SEEN = 0.5
"""Standard deviation over that at the start up to which something was seen of a value."""

OFF = 3.0
"""Standard deviations from where it was stated beyond which a value is off."""

CLEARLY_NOISIER = math.log(1.2)
"""Logarithm of a factor of noise from which it is worth a change."""

MOUNT = ('sensor_rotation', 'sensor_translation')

Values = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What was found; the ``depth_gain`` is of the log likelihood, and has its deviation."""

    parts: list[CalibrationEstimate]  # c
    trades: list[Trade]
    range_is_depth: bool
    depth_gain: tuple[float, float] | None  # of depth over range; None if it can't be
    noise: list[NoiseFactor]  # of points; where it alone is looked for, of motion, too
    factors: list[MotionFactor]
    too_noisy: list[str]  # scales of velocities that were not looked for

    @property
    def frames(self) -> set[str]:
        """The frames of the sensors; '' is the base frame."""
        return {
            part.name.partition('/')[2]
            for part in self.parts
            if part.name.startswith(('sensor_', 'range_'))
        }


@dataclass(frozen=True, slots=True)
class Stated:
    """Settings that state what was found; ``groups`` are the same, each with a comment."""

    settings: Settings
    inputs: InputSettings
    groups: list[tuple[str, Values]]


def is_seen(part: CalibrationEstimate) -> bool:
    """Return whether more is known of a value than at the start."""
    return part.deviation <= SEEN * part.stated


def is_off(part: CalibrationEstimate) -> bool:
    """Return whether a value is surely another than was stated."""
    return is_seen(part) and abs(part.value - part.nominal) > OFF * part.deviation


def state_found(
    settings: Settings, inputs: InputSettings, found: Found, sensor_pose: FloatArray | None
) -> Stated:
    """Return what was found as settings; ``sensor_pose`` (4, 4) is None if it is not constant.

    Where several sensors are calibrated, or one that moves, only what is of the velocities.
    """
    is_one = len(found.frames) == 1
    values: dict[str, Any] = {}
    comments: dict[str, list[str]] = {}
    for part in found.parts:
        name = part.name.partition('/')[0]
        if not is_seen(part) or (name.startswith(('sensor_', 'range_')) and not is_one):
            continue
        parameter, index = (entry := _entry_of(name)).parameter, entry.axis
        if parameter not in MOUNT:
            _put(values, settings, parameter, index, _as_known(part.value, part.deviation))
        elif sensor_pose is None:
            continue
        if '_bias' not in name:  # which is another one on another day
            deviation = _as_known(part.deviation, part.deviation)
            _put(values, settings, f'{parameter}_stddev', index, deviation)
        comments.setdefault(parameter, []).append(known_by(part))
    groups = [('\n'.join(lines), _of(parameter, values)) for parameter, lines in comments.items()]
    if is_one and found.depth_gain is not None:
        values['range_is_depth'] = found.range_is_depth
        groups.append((depth_text(found), {'range_is_depth': found.range_is_depth}))
    if sensor_pose is not None and any(parameter in comments for parameter in MOUNT):
        pose = _corrected(sensor_pose, found.parts)
        inputs = replace(inputs, sensor_pose=pose)
        groups.append(('In place of /tf, which is better put right.', {'sensor_pose': pose}))
    return Stated(replace(settings, **values), inputs, [group for group in groups if group[1]])


def with_noise(stated: Stated, found: Found, states_motion: bool) -> Stated:
    """Return the same with the noise that was found; of motion where messages state none."""
    noise = list(found.noise)
    factors = {part.name: part for part in found.factors} if states_motion else {}
    for kind in of_motion(stated.settings):
        part = factors.get(kind.name)
        if part is None:
            continue
        log = math.log(part.factor)
        if abs(log) > max(OFF * part.deviation, CLEARLY_NOISIER):
            noise.append(NoiseFactor(kind, log, part.deviation))
    kinds = [one.kind for one in noise]
    settings = scaled(stated.settings, kinds, [one.log for one in noise])
    names = [name for kind in kinds for name in kind.parameters]
    figures: Values = {name: rounded(getattr(settings, name)) for name in names}
    settings = replace(settings, **figures)
    groups = [
        (
            f'Noise of {one.kind.name}: {one} what it was',
            {name: getattr(settings, name) for name in one.kind.parameters},
        )
        for one in noise
    ]
    return replace(stated, settings=settings, groups=[*stated.groups, *groups])


def known_by(part: CalibrationEstimate) -> str:
    """Return what was found of a value, and how much less uncertain it is, as text."""
    return f'{part.name}: {part}, looked for within {looked_for(part)}'


def looked_for(part: CalibrationEstimate) -> str:
    """Return what was known of a value at the start, as text."""
    factor, unit = part.for_people
    return f'{factor * part.nominal:g} ± {factor * part.stated:.2g} {unit}'.rstrip()


def depth_text(found: Found) -> str:
    """Return in words whether ranges are depths, and by what."""
    if found.depth_gain is None:
        return 'range: what is seen is all around'
    what = 'depth along the axis' if found.range_is_depth else 'range'
    gain, deviation = found.depth_gain
    kept = '' if found.range_is_depth == (gain > 0.0) else ', which is not sure, or was not asked'
    return f'{what}: the log likelihood of depth is {gain:+.0f} ± {deviation:.0f} over range{kept}'


def _put(
    values: Values, settings: Settings, parameter: str, index: int | None, value: float
) -> None:
    if index is None:
        values[parameter] = value
        return
    entries = list(values.get(parameter, getattr(settings, parameter)))
    entries[index] = value
    values[parameter] = tuple(entries)


def _of(parameter: str, values: Values) -> Values:
    names = (parameter, f'{parameter}_stddev')
    return {name: values[name] for name in names if name in values}


def _as_known(value: float, deviation: float) -> float:
    """Return a value with two digits of its standard deviation, six decimals at most."""
    decimals = 1 - math.floor(math.log10(deviation)) if deviation > 0.0 else 6
    return round(value, min(max(decimals, 0), 6))


def _corrected(pose: FloatArray, parts: Sequence[CalibrationEstimate]) -> Pose6:
    """Return x y z and roll pitch yaw of a sensor, moved from its ``pose`` as it was found."""
    moved = {}
    for part in parts:
        name = part.name.partition('/')[0]
        if is_seen(part):
            moved[name] = part.value
    turn, shift = (
        np.array([moved.get(f'{name}_{axis}', 0.0) for axis in 'xyz']) for name in MOUNT
    )
    R = so3.exp(turn) @ pose[:3, :3]
    values = [*(pose[:3, 3] + shift), *Rotation.from_matrix(R).as_euler('xyz')]
    x, y, z, roll, pitch, yaw = (round(float(value), 5) for value in values)
    return x, y, z, roll, pitch, yaw
